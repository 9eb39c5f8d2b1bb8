"""Compute tangents and cotangents of a recorded run by a second pass over its steps.

The function that is differentiated is the sequence of steps that the run took. Their lengths are
held constant, except that a step that was cut short at a stop moves with the stop. The record has
the single steps of the last segment only; each other segment is run once more. If the second run
rounds differently, it may divide a segment into other steps. The derivative is then that of the new
steps, and differs from the derivative of the old steps by no more than the tolerance.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.engine.loop import (
    HEAD,
    STEP,
    Method,
    Record,
    Run,
    Segment,
    fill_saved,
    is_running,
    loop_at_start,
    over_bodies,
    record_segment,
    segment_of,
    state_in_step,
    step_times,
    unpack_loop,
)  # fmt: skip
from rigidjax.solve.programs.batching import Arrays, lift
from rigidjax.solve.steps import runge_kutta
from rigidjax.solve.steps.runge_kutta import Step, stages


class Smooth(NamedTuple):
    """Hold the arrays of a `Run` that have derivatives, or their tangents or cotangents."""

    t0: Array  # the time at which the run begins
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    between: Array  # (K,) the times whose states are saved
    y0: Array  # (n,) the state at t0


def saved_before(run: Run, segment: Segment) -> Array:
    """Return (N + 1,) the number of saved times before each step and before the segment's end."""
    ends = jnp.concatenate([jnp.minimum(segment.times, segment.end[None]), segment.end[None]])
    search = lambda ts, t: jnp.searchsorted(ts, t, side="right").astype(jnp.int32)  # noqa: E731
    count = over_bodies(run, search)(lax.stop_gradient(run.between), ends)
    # A saved time equal to the start of the run belongs to the first step, and is not counted as
    # before it.
    return jnp.where(ends <= lax.stop_gradient(run.t0)[None], 0, count)


class SavedCotangents(NamedTuple):
    """Hold the cotangents of a step from those of the states that are saved within it."""

    times: Array | None  # (K, *bodies) of the saved times, summed over the steps so far
    step: Step
    slopes: Array


def pull_saved(
    method: Method, run: Run, step: Step, slopes: Array, first: Array, last: Array,
    state_cotangents: Array, time_cotangents: Array | None,
) -> SavedCotangents:  # fmt: skip
    """Return the cotangents of a step from those of the states saved in it: transpose its output.

    The saved times of the step are those from `first` to `last` − 1; `time_cotangents` is the sum
    so far, or `None` if it is not wanted.
    """
    state_at, most = partial(state_in_step, method), run.between.shape[0] - 1
    pick = over_bodies(run, lambda a, index: a[index])

    # The saved times in a step are treated one after the other. To treat them together, the arrays
    # of all bodies would need room for as many times as the body with most saved times has in its
    # step, and most bodies have far fewer.
    def one(state: Any) -> Any:
        number, total, by = state
        inside, there = number < last, jnp.minimum(number, most)
        t = jnp.where(inside, pick(run.between, there), step.t)
        bar = jnp.where(inside[None], pick(state_cotangents, there), 0)
        by_t, *more = jax.vjp(state_at, t, step, slopes)[1](bar)
        if total is not None:
            total = over_bodies(run, lambda a, i, b: a.at[i].add(b))(total, there, by_t)
        return number + 1, total, jax.tree.map(jnp.add, by, more)

    start = (first, time_cotangents, jax.tree.map(jnp.zeros_like, [step, slopes]))
    _, total, by = lax.while_loop(lambda state: jnp.any(state[0] < last), one, start)
    return SavedCotangents(total, *by)


class Replayed(NamedTuple):
    """Hold the states of a recorded run that is computed once more."""

    ys: Array  # (K, n, *bodies) at the saved times
    y: Array  # (n, *bodies) at the end of the run
    starts: Array  # at the starts of the segments, then at the end
    rows: Array  # the rows of the last segment, with these states


def replay(method: Method, constants: Arrays, run: Run, record: Record) -> Replayed:
    """Compute a recorded run once more by its steps, so that it can be differentiated."""

    def one(i: Array, state: tuple[Array, Array, Array, Array]) -> Any:
        y, ys, starts, _ = state
        part = _segment(method, *still, held, i)
        starts = lax.dynamic_update_index_in_dim(starts, y, i, 0)

        def step(k: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
            y, rows = both
            row = part.rows[k]
            there = stages(method.tableau, method.field, constants, Step(*step_times(run, row), y))
            rows = lax.dynamic_update_index_in_dim(rows, row.at[HEAD:].set(y), k, 0)
            return jnp.where(lift(row[2] >= STEP, y), method.project(there.end), y), rows

        y, rows = lax.fori_loop(0, part.number, step, (y, part.rows))
        if run.between.shape[0]:
            ys = fill_saved(method, constants, run, part._replace(rows=rows), ys)
        return y, ys, starts, rows

    still, held = lax.stop_gradient(((constants, run), record))
    number = jnp.max(held.counts[0])
    ys = jnp.zeros((run.between.shape[0], *run.y0.shape), run.y0.dtype)
    state = (run.y0, ys, held.starts[0], held.rows)
    y, ys, starts, rows = lax.fori_loop(0, number, one, state)
    return Replayed(ys, y, lax.dynamic_update_index_in_dim(starts, y, number, 0), rows)


def pull_run(
    method: Method,
    constants: Arrays,
    run: Run,
    record: Record,
    state_cotangents: Arrays,
    moving_times: bool,
) -> tuple[Arrays, Smooth]:
    """Return the cotangents of constants and run, from those of the saved states and the end.

    It is the transpose of `replay`. Unless `moving_times`, the cotangents of the times are 0.
    """
    number, size = jnp.max(record.counts[0]), run.between.shape[0]

    def one(i: Array, sums: tuple[Arrays, Smooth]) -> tuple[Arrays, Smooth]:
        part = _segment(method, constants, run, record, number - 1 - i)
        known = saved_before(run, part) if size else None

        def step(k: Array, sums: tuple[Arrays, Smooth]) -> tuple[Arrays, Smooth]:
            total, of_run = sums
            k = part.number - 1 - k
            row = part.rows[k]

            def step_of_times(t0: Array, stops: Array) -> tuple[Array, Array, Array]:
                return step_times(run._replace(t0=t0, stops=stops), row)

            (t, h, end), of_times = jax.vjp(step_of_times, run.t0, run.stops)
            here = Step(t, h, end, row[HEAD:])
            dense, seeds, of_slopes, between = False, None, None, of_run.between
            if known is not None:
                dense = jnp.any(known[k] < known[k + 1])
            there = stages(method.tableau, method.field, constants, here, dense)
            bar = jax.vjp(method.project, there.end)[1](of_run.y0)[0]
            if known is not None:
                between, seeds, of_slopes = pull_saved(
                    method, run, here, there.slopes, known[k], known[k + 1], state_cotangents[0],
                    between if moving_times else None,
                )  # fmt: skip
            by_constants, *rest = runge_kutta.pull_back(
                method.tableau, method.field, constants, here, there, bar, of_slopes
            )
            if seeds is not None:
                rest = [a + b for a, b in zip(rest, (seeds.t, seeds.h, seeds.y), strict=True)]
            # The cotangents of a body without a step in this row may be NaN, and are replaced by 0.
            on = row[2] >= STEP
            by_t, by_h, by_y = (_zero_unless(on, a) for a in rest)
            by_t0, by_stops = of_times((by_t, by_h, jnp.zeros_like(end)))
            total = [a + _zero_unless(on, b) for a, b in zip(total, by_constants, strict=True)]
            of_run = of_run._replace(y0=by_y + _zero_unless(~on, of_run.y0))
            if between is None or not moving_times:
                return total, of_run
            t0, stops = of_run.t0 + by_t0, of_run.stops + by_stops
            return total, of_run._replace(t0=t0, stops=stops, between=between)

        return lax.fori_loop(0, part.number, step, sums)

    t0, stops, between = (jnp.zeros_like(a) for a in (run.t0, run.stops, run.between))
    none = Smooth(t0, stops, between, state_cotangents[1])
    return lax.fori_loop(0, number, one, ([jnp.zeros_like(c) for c in constants], none))


def _zero_unless(condition: Array, a: Array) -> Array:
    """Return `a` (…, *bodies) for the bodies with a true `condition`, and 0 for the others."""
    return jnp.where(lift(condition, a), a, jnp.zeros_like(a))


def _segment(method: Method, constants: Arrays, run: Run, record: Record, number: Array) -> Segment:
    """Return segment `number` of a recorded run.

    The record has the rows of the last segment alone; any other segment is run once more. If it
    then takes more steps than there are rows, its states become NaN: no wrong derivative is
    computed.
    """
    like = loop_at_start(run)
    loop, after = (unpack_loop([a[i] for a in record.starts], like) for i in (number, number + 1))
    # The record has the step count and the result of the forward run, either of which could end the
    # segment. The segment therefore starts with a step count of 0 and a successful result.
    loop = loop._replace(steps=like.steps, result=like.result)
    count, filled = (jnp.max(a) for a in record.counts)
    again = number < count - 1
    # Any segment but the last is run once more up to its end. The steps of the last segment are in
    # the record: with the end −∞ it takes no step here.
    until = jnp.where(again, lax.stop_gradient(after.t), -jnp.inf)
    end, rows, count = record_segment(method, constants, run, loop, record.rows, until)
    # If the segment takes more steps than the record has rows for, some are missing and the
    # derivative would be wrong: it is set to NaN.
    short = jnp.where(jnp.any(is_running(method, run, end, until)), jnp.nan, 0.0)
    rows = rows.at[:, HEAD:].add(short.astype(rows.dtype))
    count = jnp.where(again, count, filled)
    return segment_of(rows, after.t, count)
