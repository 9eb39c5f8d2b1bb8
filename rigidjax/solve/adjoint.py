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

from rigidjax.solve import runge_kutta
from rigidjax.solve.adaptive_loop import (
    HEAD,
    STEP,
    Method,
    Record,
    Run,
    Segment,
    fill_saved_states_of_segment,
    initial_loop_state,
    is_running,
    map_over_bodies,
    record_segment,
    segment_of_rows,
    start_length_and_end_of_steps,
    state_in_step,
    unpack_loop_state,
)  # fmt: skip
from rigidjax.solve.batching import Arrays, add_leading_axes
from rigidjax.solve.runge_kutta import Step, stages


class Smooth(NamedTuple):
    """Hold the arrays of a `Run` that have derivatives, or their tangents or cotangents.

    A `Run` describes a run with adaptive steps. The arrays are the time at which the run begins,
    the stops (times at which steps end), the saved times, and the state at the start.
    """

    t0: Array  # the time at which the run begins
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    between: Array  # (K,) the times whose states are saved
    y0: Array  # (n,) the state at t0


def arrays_with_derivatives(run: Run) -> Smooth:
    """Return the arrays of a run that have derivatives: its times, and the state at the start."""
    return Smooth(run.t0, run.stops, run.between, run.y0)


def count_saved_times_before_steps(run: Run, segment: Segment) -> Array:
    """Return the number of saved times before the start of each recorded step of a segment.

    - `run`: holds the K saved times `run.between`.
    - `segment`: a segment (a part of a run), with one row for each of its N recorded steps.

    **Returns** an array (N + 1, *bodies), where `*bodies` is one last axis for the bodies of a
    batch, or no axis. Its last number is the number of saved times before the end of the segment.
    """
    ends = jnp.concatenate([jnp.minimum(segment.times, segment.end[None]), segment.end[None]])
    search = lambda ts, t: jnp.searchsorted(ts, t, side="right").astype(jnp.int32)  # noqa: E731
    count = map_over_bodies(run, search)(lax.stop_gradient(run.between), ends)
    # A saved time equal to the start of the run belongs to the first step, and is not counted as
    # before it.
    return jnp.where(ends <= lax.stop_gradient(run.t0)[None], 0, count)


def transpose_saved_states(
    method: Method, run: Run, step: Step, slopes: Array, first: Array, last: Array,
    state_cotangents: Array, time_cotangents: Array | None,
) -> tuple[Array | None, Step, Array]:  # fmt: skip
    """Return the cotangents of a step from the cotangents of the states that are saved within it.

    This is the transpose of `state_in_step`, for all saved times in the step and for all bodies.
    `*bodies` is one last axis for the bodies of a batch, or no axis for one body.

    - `method`: the explicit method and the field.
    - `run`: holds the K saved times `run.between`.
    - `step`: the step: its start, length and end, and the state (n, *bodies) at its start.
    - `slopes`: (n, s, *bodies) the values of the field at all s stages of the step.
    - `first`, `last`: the indices of the saved times in this step go from `first` to `last` − 1.
    - `state_cotangents`: (K, n, *bodies), the cotangents of all saved states.
    - `time_cotangents`: (K, *bodies), the cotangents of the saved times, summed over the steps that
      have been treated so far; or `None` if these cotangents are not wanted.

    **Returns** three things: the array `time_cotangents`, to which the cotangents of the saved
    times in this step are added (or `None`); the cotangents of the step; and the cotangents of the
    slopes.
    """
    state_at, most = partial(state_in_step, method), run.between.shape[0] - 1
    pick = map_over_bodies(run, lambda a, index: a[index])

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
            total = map_over_bodies(run, lambda a, i, b: a.at[i].add(b))(total, there, by_t)
        return number + 1, total, jax.tree.map(jnp.add, by, more)

    start = (first, time_cotangents, jax.tree.map(jnp.zeros_like, [step, slopes]))
    _, total, by = lax.while_loop(lambda state: jnp.any(state[0] < last), one, start)
    return total, *by


def replay_steps(
    method: Method, constants: Arrays, run: Run, record: Record
) -> tuple[Array, Array, Array, Array]:
    """Compute a recorded run once more by its recorded steps, so that it can be differentiated.

    The lengths of the steps are held constant for derivatives, except where a step was cut short at
    a stop (a time at which the field jumps). `*bodies` is one last axis for the bodies of a batch,
    or no axis for one body.

    - `method`: the explicit method and the field.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start, the stops, and the K saved times `run.between`.
    - `record`: the recorded steps, in segments, which are parts of the run.

    **Returns** four things: the states (K, n, *bodies) at the saved times; the state (n, *bodies)
    at the end of the run; the states at the starts of the segments, followed by the state at the
    end; and the rows of the last segment, which contain the recomputed states.
    """

    def one(i: Array, state: tuple[Array, Array, Array, Array]) -> Any:
        y, ys, starts, _ = state
        part = _segment_of_record(method, *still, held, i)
        starts = lax.dynamic_update_index_in_dim(starts, y, i, 0)

        def step(k: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
            y, rows = both
            row = part.rows[k]
            there = stages(
                method.tableau,
                method.field,
                constants,
                Step(*start_length_and_end_of_steps(run, row), y),
            )
            rows = lax.dynamic_update_index_in_dim(rows, row.at[HEAD:].set(y), k, 0)
            return jnp.where(
                add_leading_axes(row[2] >= STEP, y), method.project(there.end), y
            ), rows

        y, rows = lax.fori_loop(0, part.number, step, (y, part.rows))
        if run.between.shape[0]:
            ys = fill_saved_states_of_segment(method, constants, run, part._replace(rows=rows), ys)
        return y, ys, starts, rows

    still, held = lax.stop_gradient(((constants, run), record))
    number = jnp.max(held.counts[0])
    ys = jnp.zeros((run.between.shape[0], *run.y0.shape), run.y0.dtype)
    state = (run.y0, ys, held.starts[0], held.rows)
    y, ys, starts, rows = lax.fori_loop(0, number, one, state)
    return ys, y, lax.dynamic_update_index_in_dim(starts, y, number, 0), rows


def cotangents_of_run(
    method: Method,
    constants: Arrays,
    run: Run,
    record: Record,
    state_cotangents: Arrays,
    wants_time_cotangents: bool,
) -> tuple[Arrays, Smooth]:
    """Return the cotangents of the constants and of the run: the transpose of `replay_steps`.

    - `method`: the explicit method and the field.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start of the run, the stops (times at which the field jumps),
      and the saved times `run.between`.
    - `record`: the recorded steps, in segments, which are parts of the run.
    - `state_cotangents`: a list of two arrays: the cotangents of the states at the saved times, and
      the cotangent of the state at the end of the run.
    - `wants_time_cotangents`: whether the cotangents of the times of the run are computed; else
      they are 0.

    **Returns** two things: the list of the cotangents of `constants`; and a `Smooth`, the tuple of
    the cotangents of the times of `run` and of its state at the start.
    """
    number, size = jnp.max(record.counts[0]), run.between.shape[0]

    def one(i: Array, sums: tuple[Arrays, Smooth]) -> tuple[Arrays, Smooth]:
        part = _segment_of_record(method, constants, run, record, number - 1 - i)
        known = count_saved_times_before_steps(run, part) if size else None

        def step(k: Array, sums: tuple[Arrays, Smooth]) -> tuple[Arrays, Smooth]:
            total, of_run = sums
            k = part.number - 1 - k
            row = part.rows[k]

            def step_of_times(t0: Array, stops: Array) -> tuple[Array, Array, Array]:
                return start_length_and_end_of_steps(run._replace(t0=t0, stops=stops), row)

            (t, h, end), of_times = jax.vjp(step_of_times, run.t0, run.stops)
            here = Step(t, h, end, row[HEAD:])
            dense, seeds, of_slopes, between = False, None, None, of_run.between
            if known is not None:
                dense = jnp.any(known[k] < known[k + 1])
            there = stages(method.tableau, method.field, constants, here, dense)
            bar = jax.vjp(method.project, there.end)[1](of_run.y0)[0]
            if known is not None:
                between, seeds, of_slopes = transpose_saved_states(
                    method, run, here, there.slopes, known[k], known[k + 1], state_cotangents[0],
                    between if wants_time_cotangents else None,
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
            if between is None or not wants_time_cotangents:
                return total, of_run
            t0, stops = of_run.t0 + by_t0, of_run.stops + by_stops
            return total, of_run._replace(t0=t0, stops=stops, between=between)

        return lax.fori_loop(0, part.number, step, sums)

    none = jax.tree.map(jnp.zeros_like, arrays_with_derivatives(run))._replace(
        y0=state_cotangents[1]
    )
    return lax.fori_loop(0, number, one, ([jnp.zeros_like(c) for c in constants], none))


def _zero_unless(condition: Array, a: Array) -> Array:
    """Return `a` (…, *bodies) for the bodies for which `condition` is true, and 0 for the others.

    `*bodies` is one last axis for the bodies of a batch, or no axis for one body. `condition`
    (*bodies) has one truth value for each body.
    """
    return jnp.where(add_leading_axes(condition, a), a, jnp.zeros_like(a))


def _segment_of_record(
    method: Method, constants: Arrays, run: Run, record: Record, number: Array
) -> Segment:
    """Return one segment of a recorded run, with one row of numbers for each of its steps.

    A segment is a part of the run of a fixed largest number of steps. The record holds the rows of
    the last segment alone, and they are read from it. Any other segment is run once more to get its
    rows. If it then takes more steps than there are rows, the states in its rows are set to NaN, so
    that no wrong derivative is computed.

    - `method`: the explicit method and the field.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start of the run, and the times at which steps end.
    - `record`: the state of the loop over steps at the start of each segment, and the rows of the
      last segment.
    - `number`: the index of the segment.
    """
    like = initial_loop_state(run)
    loop, after = (
        unpack_loop_state([a[i] for a in record.starts], like) for i in (number, number + 1)
    )
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
    return segment_of_rows(rows, after.t, count)
