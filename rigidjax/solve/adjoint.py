"""Tangents along a recorded run, and cotangents back along it.

The derivative is that of the steps that were taken, their lengths held but for those cut short at a
stop, which follow it, as in `diffrax.RecursiveCheckpointAdjoint`. Both directions go through the
segments of `rigidjax.solve.adaptive_loop`; all but the last are run once more. Where another
program rounds otherwise, such a segment may take other steps between the same two ends: then the
derivative is that of those, the same to the tolerance.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import runge_kutta
from rigidjax.solve.adaptive_loop import going, recorded
from rigidjax.solve.components import lift
from rigidjax.solve.record import (
    LAST,
    NONE,
    VISIT,
    Method,
    Record,
    Rows,
    Run,
    SegmentEnd,
    per_body,
    replaced,
    row_of,
    unpacked,
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
    size, number = run.between.shape[0], jnp.max(record.number)

    def segment(i: Array, state: Any) -> Any:
        moved, back, out, starts, _ = state
        rows, count = _segment(method, constants, run, record, i)
        starts = [
            lax.dynamic_update_slice_in_dim(a, b[None], i, 0)
            for a, b in zip(starts, (moved, back), strict=True)
        ]

        def step(i: Array, state: Any) -> Any:
            moved, back, out, path = state
            here, kind, stop = row_of(run, rows[i])
            visit = lift(kind >= VISIT, moved)
            before = jnp.where(visit, back, moved)
            path = lax.dynamic_update_slice_in_dim(path, before[None], i, 0)
            of_t, of_h = _of_times(run, kind, stop, along)
            there = runge_kutta.stages(method.tableau, method.field, constants, here)
            push = (along.constants, of_t, of_h, before)
            after = runge_kutta.pushed(
                method.tableau, method.field, constants, here, there, push, axes
            )

            def projected(tangent: Array) -> Array:
                return jax.jvp(method.project, (there.end,), (tangent,))[1]

            after = axes.over(projected, 1, 1)(after)
            taken = lift((kind != NONE) & (kind < VISIT), moved)
            if size:
                # What is no visit goes to the place beyond the last.
                place = jnp.where(kind >= VISIT, kind - VISIT, size)
                out = per_body(replaced, run.t0.ndim)(out, after, place)
            return jnp.where(taken, after, moved), jnp.where(taken, moved, back), out, path

        path = jnp.zeros((rows.shape[0], *moved.shape), moved.dtype)
        moved, back, out, path = lax.fori_loop(0, count, step, (moved, back, out, path))
        return moved, back, out, starts, path

    none = jnp.zeros((record.starts.shape[0], *along.y0.shape), along.y0.dtype)
    out = jnp.zeros((size + 1, *along.y0.shape), along.y0.dtype)
    path = jnp.zeros((record.rows.shape[0], *along.y0.shape), along.y0.dtype)
    state = (along.y0, along.y0, out, [none, none], path)
    moved, _, out, (y, back_y), path = lax.fori_loop(0, number, segment, state)
    kind, stop = (record.rows[:, i].astype(jnp.int32) for i in (2, 3))
    heads = jnp.stack([*_of_times(run, kind, stop, along)])
    heads = _many_first(run, jnp.concatenate([heads, jnp.zeros_like(heads)]))
    starts = unpacked(jnp.moveaxis(record.starts, 1, 0))
    zero = jnp.zeros_like(y[:, :1])
    t, back_t = (
        _many_first(run, _gathered(run, along.ends, i))[:, None]
        for i in (starts.stop, starts.back_stop)
    )
    starts = jnp.concatenate([t, zero, back_t, *[zero] * 5, y, back_y], 1)
    return Outputs(out[:size], moved), RecordTangents(starts, jnp.concatenate([heads, path], 1))


def cotangents(
    method: Method, constants: list[Array], run: Run, record: Record, bars: Outputs, axes: Axes
) -> Inputs:
    """The transpose of `tangents`, but for the record."""
    size, number = run.between.shape[0], jnp.max(record.number)
    seeds = bars.between

    def segment(i: Array, state: Any) -> Any:
        rows, count = _segment(method, constants, run, record, number - 1 - i)

        def step(i: Array, both: Any) -> Any:
            sums, extra = both
            here, kind, stop = row_of(run, rows[count - 1 - i])
            visit, taken = kind >= VISIT, (kind != NONE) & (kind < VISIT)
            there = runge_kutta.stages(method.tableau, method.field, constants, here)
            bar, place = sums.y0, jnp.clip(kind - VISIT, 0, max(size - 1, 0))
            if size:
                bar = jnp.where(lift(visit, bar), _gathered(run, seeds, place), bar)
            bar = axes.over(jax.vjp(method.project, there.end)[1], 1, (1,))(bar)[0]
            bar = _where(visit | taken, bar)
            by_constants, by_t, by_h, by_y = runge_kutta.pulled(
                method.tableau, method.field, constants, here, there, bar, axes
            )
            # A body that has no step here may be NaN, and its sum is shared with others.
            by_t, by_h, by_y = (_where(visit | taken, by) for by in (by_t, by_h, by_y))
            held = kind != LAST
            ends = _added(run, sums.ends, stop, by_t - _where(visit | ~held, by_h))
            ends = _added(run, ends, stop + 1, _where(~held, by_h))
            between = sums.between
            if size:
                # Each is visited once; what is no visit goes to the place beyond the last.
                where = jnp.where(visit, place, size)
                between = per_body(replaced, run.t0.ndim)(between, by_h, where)
            # A visit begins where its step began, which comes next.
            total = [
                a + _where(visit | taken, b)
                for a, b in zip(sums.constants, by_constants, strict=True)
            ]
            before = jnp.where(lift(taken, by_y), by_y + extra, sums.y0)
            extra = jnp.where(lift(taken, by_y), jnp.zeros_like(extra), extra + _where(visit, by_y))
            return Inputs(total, ends, between, before), extra

        return lax.fori_loop(0, count, step, state)

    more = bars.end.shape[1:]
    sums = Inputs(
        [jnp.zeros((*c.shape[: c.ndim - run.t0.ndim], *more), c.dtype) for c in constants],
        jnp.zeros((run.stops.shape[0] + 1, *more), run.t0.dtype),
        jnp.zeros((size + 1, *more), run.t0.dtype),
        bars.end,
    )
    sums, extra = lax.fori_loop(0, number, segment, (sums, jnp.zeros_like(bars.end)))
    return sums._replace(between=sums.between[:size], y0=sums.y0 + extra)


def _segment(
    method: Method, constants: list[Array], run: Run, record: Record, number: Array
) -> tuple[Rows, Array]:
    """The rows of a segment, and how many they are: of the last as they are, else run once more."""
    end = jnp.max(record.number) - 1
    last = record.starts.shape[0] - 1
    loop, ahead = (unpacked(record.starts[jnp.clip(i, 0, last)]) for i in (number, number + 1))
    again = number < end
    # Nothing is left to do of the last one.
    until = SegmentEnd(
        jnp.where(again, ahead.t, -jnp.inf), ahead.back_t, jnp.where(again, ahead.known, 0)
    )
    loop, rows, _, count = recorded(method, constants, run, loop, record.rows, None, until)
    # With too little room for its steps there would be wrong numbers: then there are none.
    short = jnp.where(jnp.any(going(method, run, loop, until)), jnp.nan, 0.0)
    count = jnp.where(again, count, jnp.max(record.filled))
    return rows.at[:, 1].add(short.astype(rows.dtype)), count


def _of_times(run: Run, kind: Array, stop: Array, along: Inputs) -> tuple[Array, Array]:
    """Tangents of a step's start and length; kind and stop (*many, *bodies)."""
    of_t, of_stop = (_gathered(run, along.ends, i) for i in (stop, stop + 1))
    of_h = _where(kind == LAST, of_stop - of_t)
    size = run.between.shape[0]
    if size:
        asked = _gathered(run, along.between, jnp.clip(kind - VISIT, 0, size - 1))
        of_h = jnp.where(lift(kind >= VISIT, of_h), asked - of_t, of_h)
    return of_t, of_h


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
