"""Tangents along a recorded run, and cotangents back along it.

The derivative is that of the steps that were taken, their lengths held but for those cut short at a
stop, which follow it, as in `diffrax.RecursiveCheckpointAdjoint`. Both directions go through the
segments of `rigidjax.solve.adaptive_loop`; all but the last are run once more. Where another
program rounds otherwise, such a segment may take other steps between the same two ends: then the
derivative is that of those, the same to the tolerance.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import dense_output, runge_kutta
from rigidjax.solve.adaptive_loop import going, recorded
from rigidjax.solve.components import lift
from rigidjax.solve.record import (
    NONE,
    STEP,
    Method,
    Record,
    Rows,
    Run,
    Taken,
    at_stop,
    inserted,
    per_body,
    row_of,
    unpacked,
    window,
)
from rigidjax.solve.runge_kutta import Axes

# So few rows that to add to all of them is quicker than to look for one.
_FEW = 8


class Inputs(NamedTuple):
    """Tangents (or cotangents) of what an answer depends on.

    **Fields:** of the `constants`; of `ends` (1 + J,), the start's time and the stops; of the times
    `between` (K,); of `y0` (n,). Each with `*directions, *bodies` after its own axes.
    """

    constants: list[Array]
    ends: Array
    between: Array
    y0: Array


class Outputs(NamedTuple):
    """Tangents (or cotangents) of an answer: states `between` (K, n) and at the `end` (n,)."""

    between: Array
    end: Array


class RecordTangents(NamedTuple):
    """Tangents of a recorded run, as in `Record`."""

    starts: Array
    rows: Array


def tangents(
    method: Method, constants: list[Array], run: Run, record: Record, along: Inputs, axes: Axes
) -> tuple[Outputs, RecordTangents]:
    """The tangents of the answer and of the record."""
    number, width = jnp.max(record.number), dense_output.width(run.between.shape[0])
    later, next_ts = _and_more(along.between, width), _and_more(run.between, width)

    def segment(i: Array, state: Any) -> Any:
        moved, out, starts, _ = state
        rows, count = _segment(method, constants, run, record, i)
        starts = lax.dynamic_update_slice_in_dim(starts, moved[None], i, 0)

        def step(i: Array, state: Any) -> Any:
            moved, out, path = state
            taken = row_of(run, rows[i])
            here = taken.step
            path = lax.dynamic_update_slice_in_dim(path, moved[None], i, 0)
            of_t, of_h = _of_times(run, taken.kind, taken.stop, along)
            ts, inside, dense = _asked(run, taken, next_ts, width)
            there = runge_kutta.stages(method.tableau, method.field, constants, here, dense)
            push = (along.constants, of_t, of_h, moved)
            after, slopes = runge_kutta.pushed(
                method.tableau, method.field, constants, here, there, push, axes, dense
            )
            if ts is not None:
                of_ts = _windows(run, later, taken.known, width)
                # What is not inside stands at the start of the step.
                of_ts = jnp.where(_across(axes, inside), of_ts, of_t[None])

                def states() -> Array:
                    dense = runge_kutta.dense_rows(method.tableau, here.h, there.slopes)
                    of_dense = runge_kutta.dense_rows(method.tableau, here.h, slopes)
                    of_dense = of_dense + _by_length(here.h, of_h, dense, axes)
                    inside_step = (ts, here.t, here.h, here.y, dense)
                    push = (of_ts, of_t, of_h, moved, of_dense)
                    return dense_output.moved_states(method.project, inside_step, push, axes)

                none = jnp.zeros((width, *moved.shape), moved.dtype)
                found = lax.cond(dense, states, lambda: none)
                out = per_body(inserted, run.t0.ndim)(out, found, taken.known)

            def projected(tangent: Array) -> Array:
                return jax.jvp(method.project, (there.end,), (tangent,))[1]

            after = axes.over(projected, 1, 1)(after)
            return jnp.where(lift(taken.kind >= STEP, moved), after, moved), out, path

        path = jnp.zeros((rows.shape[0], *moved.shape), moved.dtype)
        moved, out, path = lax.fori_loop(0, count, step, (moved, out, path))
        return moved, out, starts, path

    size = run.between.shape[0]
    none = jnp.zeros((record.starts.shape[0], *along.y0.shape), along.y0.dtype)
    out = jnp.zeros((size + width, *along.y0.shape), along.y0.dtype)
    path = jnp.zeros((record.rows.shape[0], *along.y0.shape), along.y0.dtype)
    moved, out, y, path = lax.fori_loop(0, number, segment, (along.y0, out, none, path))
    kind, stop = (record.rows[:, i].astype(jnp.int32) for i in (2, 3))
    heads = jnp.stack([*_of_times(run, kind, stop, along)])
    heads = _many_first(run, jnp.concatenate([heads, *[jnp.zeros_like(heads[:1])] * 4]))
    starts = unpacked(jnp.moveaxis(record.starts, 1, 0))
    zero = jnp.zeros_like(y[:, :1])
    t = _many_first(run, _gathered(run, along.ends, starts.stop))[:, None]
    starts = jnp.concatenate([t, *[zero] * 5, y], 1)
    return Outputs(out[:size], moved), RecordTangents(starts, jnp.concatenate([heads, path], 1))


def cotangents(
    method: Method, constants: list[Array], run: Run, record: Record, bars: Outputs, axes: Axes
) -> Inputs:
    """The transpose of `tangents`, but for the record."""
    number, width = jnp.max(record.number), dense_output.width(run.between.shape[0])
    seeds, next_ts = _and_more(bars.between, width), _and_more(run.between, width)

    def segment(i: Array, sums: Inputs) -> Inputs:
        rows, count = _segment(method, constants, run, record, number - 1 - i)

        def step(i: Array, sums: Inputs) -> Inputs:
            taken = row_of(run, rows[count - 1 - i])
            here = taken.step
            ts, inside, dense = _asked(run, taken, next_ts, width)
            there = runge_kutta.stages(method.tableau, method.field, constants, here, dense)
            on, held = taken.kind >= STEP, ~at_stop(taken.kind)
            bar = axes.over(jax.vjp(method.project, there.end)[1], 1, (1,))(sums.y0)[0]
            bar, more, between = _where(on, bar), None, sums.between
            if ts is not None and dense is not None:

                def states(ts: Array, t: Array, h: Array, y: Array, slopes: Array) -> Array:
                    rows_there = runge_kutta.dense_rows(method.tableau, h, slopes)
                    return dense_output.states(method.project, ts, t, h, y, rows_there)

                mask, given = _across(axes, inside), (ts, here.t, here.h, here.y, there.slopes)
                asks = _windows(run, seeds, taken.known, width)
                asks = jnp.where(jnp.expand_dims(mask, 1), asks, 0)

                def back() -> tuple[Array, ...]:
                    return axes.over(jax.vjp(states, *given)[1], 2, (1, 0, 0, 1, 2))(asks)

                none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(back))
                by_ts, *more, by_slopes = lax.cond(dense, back, lambda: none)
                between = per_body(_put_in, run.t0.ndim)(between, by_ts, mask, taken.known)
                dense = (dense, by_slopes)
            by_constants, by_t, by_h, by_y = runge_kutta.pulled(
                method.tableau, method.field, constants, here, there, bar, axes, dense
            )
            if more is not None:
                by_t, by_h, by_y = (a + b for a, b in zip((by_t, by_h, by_y), more, strict=True))
            # A body that has no step here may be NaN, and its sum is shared with others.
            used = taken.kind != NONE
            by_t, by_h, by_y = (_where(used, by) for by in (by_t, by_h, by_y))
            ends = _added(run, sums.ends, taken.stop, by_t - _where(~held, by_h))
            ends = _added(run, ends, taken.stop + 1, _where(~held, by_h))
            total = [a + _where(used, b) for a, b in zip(sums.constants, by_constants, strict=True)]
            before = by_y + _where(~on, sums.y0)
            return Inputs(total, ends, between, before)

        return lax.fori_loop(0, count, step, sums)

    more = bars.end.shape[1:]
    sums = Inputs(
        [jnp.zeros((*c.shape[: c.ndim - run.t0.ndim], *more), c.dtype) for c in constants],
        jnp.zeros((run.stops.shape[0] + 1, *more), run.t0.dtype),
        jnp.zeros((run.between.shape[0] + width, *more), run.t0.dtype),
        bars.end,
    )
    sums = lax.fori_loop(0, number, segment, sums)
    return sums._replace(between=sums.between[: run.between.shape[0]])


def _asked(run: Run, taken: Taken, next_ts: Array, width: int) -> tuple[Any, Any, Any]:
    """The times in a step (W, *bodies), which of them there are, whether any; or `None`."""
    if not width:
        return None, None, None
    ts, here = _windows(run, next_ts, taken.known, width), taken.step
    number = jnp.arange(width, dtype=jnp.int32).reshape(-1, *[1] * run.t0.ndim)
    inside = number < taken.inside[None]
    return jnp.where(inside, ts, here.t[None]), inside, jnp.any(inside)


def _by_length(h: Array, of_h: Array, rows: Array, axes: Axes) -> Array:
    """Tangents of the rows of dense output by the length of the step."""
    rows = jnp.expand_dims(rows, 2) if axes.directions else rows
    share = of_h / lift(jnp.where(h == 0, 1, h), of_h)
    return lift(share.astype(rows.dtype), rows) * rows


def _across(axes: Axes, there: Array) -> Array:
    """(W, *bodies), the same for all directions."""
    return jnp.expand_dims(there, 1) if axes.directions else there


def _and_more(a: Array, width: int) -> Array:
    return jnp.concatenate([a, jnp.zeros((width, *a.shape[1:]), a.dtype)])


def _windows(run: Run, a: Array, first: Array, width: int) -> Array:
    return per_body(partial(window, size=width), run.t0.ndim)(a, first)


def _put_in(a: Array, rows: Array, there: Array, first: Array) -> Array:
    """`a` with those rows that are there put in."""
    return inserted(a, jnp.where(there, rows, window(a, first, len(rows))), first)


def _segment(
    method: Method, constants: list[Array], run: Run, record: Record, number: Array
) -> tuple[Rows, Array]:
    """The rows of a segment, and how many they are: of the last as they are, else run once more."""
    end, last = jnp.max(record.number) - 1, record.starts.shape[0] - 1
    loop, after = (unpacked(record.starts[jnp.clip(i, 0, last)]) for i in (number, number + 1))
    again = number < end
    # Nothing is left to do of the last one.
    until = after._replace(
        t=jnp.where(again, after.t, -jnp.inf), known=jnp.where(again, after.known, 0)
    )
    loop, rows, _, count = recorded(method, constants, run, loop, record.rows, None, until)
    # With too little room for its steps there would be wrong numbers: then there are none.
    short = jnp.where(jnp.any(going(method, run, loop, until)), jnp.nan, 0.0)
    count = jnp.where(again, count, jnp.max(record.filled))
    return rows.at[:, 1].add(short.astype(rows.dtype)), count


def _of_times(run: Run, kind: Array, stop: Array, along: Inputs) -> tuple[Array, Array]:
    """Tangents of a step's start and length; kind and stop (*many, *bodies)."""
    of_t, of_stop = (_gathered(run, along.ends, i) for i in (stop, stop + 1))
    return of_t, _where(at_stop(kind), of_stop - of_t)


def _where(there: Array, a: Array) -> Array:
    """`a` (…, *bodies), nothing where it is not `there`."""
    return jnp.where(lift(there, a), a, jnp.zeros_like(a))


def _gathered(run: Run, a: Array, index: Array) -> Array:
    """Rows of each body: a (R, …, *bodies), index (*many, *bodies) → (…, *many, *bodies)."""

    def pick(a: Array, index: Array) -> Array:
        found = a[index]
        return jnp.moveaxis(found, 0, -1) if index.ndim else found

    return per_body(pick, run.t0.ndim)(a, index)


def _added(run: Run, a: Array, index: Array, by: Array) -> Array:
    """`a` (R, …, *bodies) with `by` (…, *bodies) added to one row of each body."""
    if a.shape[0] <= _FEW:
        each = jnp.arange(a.shape[0], dtype=jnp.int32).reshape(-1, *[1] * by.ndim)
        return a + _where(each == lift(index, each), jnp.broadcast_to(by[None], a.shape))

    def put(a: Array, index: Array, by: Array) -> Array:
        return a.at[index].add(by)

    return per_body(put, run.t0.ndim)(a, index, by)


def _many_first(run: Run, a: Array) -> Array:
    """(…, many, *bodies) → (many, …, *bodies)."""
    return jnp.moveaxis(a, -1 - run.t0.ndim, 0)
