"""Tangents along a recorded run, and cotangents back along it.

The derivative is that of the steps that were taken, their lengths held but for those cut short at a
stop, which follow it, as in `diffrax.RecursiveCheckpointAdjoint`. Both directions go through the
segments of `rigidjax.solve.adaptive_loop`; all but the last are run once more.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import runge_kutta
from rigidjax.solve.adaptive_loop import (
    MANY,
    Book,
    Method,
    Rows,
    Run,
    at,
    per_body,
    recorded,
    row_of,
    side_by_side,
    within,
)
from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Axes, Step

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


class BookTangents(NamedTuple):
    """Tangents of a recorded run: times and states at the starts of segments, the last rows."""

    times: Array
    states: Array
    rows: Array


class Group(NamedTuple):
    """Some of the times between, those not `ready` to be ignored.

    **Fields:** `first` of them; `row` that each lies in, its `code`, the `step` from there.
    """

    first: Array
    ready: Array
    row: Array
    code: Array
    step: Step


def tangents(
    method: Method, constants: list[Array], run: Run, book: Book, along: Inputs, axes: Axes
) -> tuple[Outputs, BookTangents]:
    """The tangents of the answer and of the record."""
    wide = side_by_side(method)

    def project(method: Method, raw: Array, tangent: Array) -> Array:
        def push(tangent: Array) -> Array:
            return jax.jvp(method.project, (raw,), (tangent,))[1]

        return axes.over(push, 1, 1)(tangent)

    def segment(number: Array, state: Any) -> Any:
        moved, out, states, _, rows, count = state
        states = lax.dynamic_update_slice_in_dim(states, moved[None], number, 0)

        def step(i: Array, state: Any) -> Any:
            moved, path = state
            path = lax.dynamic_update_slice_in_dim(path, moved[None], i, 0)
            here, code = row_of(run, rows[i])
            of_t, of_h = _of_times(run, code, along.ends)
            there = runge_kutta.stages(method.tableau, method.field, constants, here)
            push = (along.constants, of_t, of_h, moved)
            after = runge_kutta.pushed(
                method.tableau, method.field, constants, here, there, push, axes
            )
            after = project(method, there.end, after)
            return jnp.where(lift(here.h > 0, after), after, moved), path

        def some(group: Group, out: Array) -> Array:
            here, many = group.step, group.row.shape[0]
            of_t, _ = _of_times(run, group.code, along.ends)
            late = lax.dynamic_slice_in_dim(along.between, group.first, many, 0)
            of_h = _many_last(run, late) - of_t
            of_y = _gathered(run, path, group.row)
            there = runge_kutta.stages(wide.tableau, wide.field, constants, here)
            push = (along.constants, of_t, of_h, of_y)
            after = runge_kutta.pushed(wide.tableau, wide.field, constants, here, there, push, axes)
            after = project(wide, there.end, after)
            old = _many_last(run, lax.dynamic_slice_in_dim(out, group.first, many, 0))
            new = _many_first(run, jnp.where(lift(group.ready, after), after, old))
            return lax.dynamic_update_slice_in_dim(out, new, group.first, 0)

        path = jnp.zeros((rows.shape[0], *moved.shape), moved.dtype)
        moved, path = lax.fori_loop(0, count, step, (moved, path))
        out = _over_groups(run, rows, count, some, out)
        return moved, out, states, path, *_segment(method, constants, run, book, number + 1, rows)

    out = jnp.zeros((run.between.shape[0], *along.y0.shape), along.y0.dtype)
    number, count = jnp.max(book.number), jnp.max(book.filled)
    rows, again = _segment(
        method, constants, run, book, jnp.where(number > 1, 0, number), book.rows
    )
    states = jnp.zeros((book.starts.t.shape[0], *along.y0.shape), along.y0.dtype)
    path = jnp.zeros((rows.shape[0], *along.y0.shape), along.y0.dtype)
    state = (along.y0, out, states, path, rows, jnp.where(number > 1, again, count))
    moved, out, states, path, _, _ = lax.fori_loop(0, number, segment, state)
    code = book.rows[:, 2].astype(jnp.int32)
    heads = jnp.stack([*_of_times(run, code, along.ends)])
    heads = _many_first(run, jnp.concatenate([heads, jnp.zeros_like(heads[:1])]))
    times = _many_first(run, _of_times(run, 2 * book.starts.stop, along.ends)[0])
    rows = jnp.concatenate([heads, path], 1)
    return Outputs(out, moved), BookTangents(times, states, rows)


def cotangents(
    method: Method, constants: list[Array], run: Run, book: Book, bars: Outputs, axes: Axes
) -> Inputs:
    """The transpose of `tangents`."""
    wide = side_by_side(method)

    def project(method: Method, raw: Array, bar: Array) -> Array:
        return axes.over(jax.vjp(method.project, raw)[1], 1, (1,))(bar)[0]

    def segment(number: Array, state: Any) -> Any:
        sums, rows, count = state
        number = jnp.max(book.number) - 1 - number

        def some(group: Group, both: Any) -> Any:
            extra, sums = both
            here, many = group.step, group.row.shape[0]
            bar = lax.dynamic_slice_in_dim(bars.between, group.first, many, 0)
            bar = _where(group.ready, _many_last(run, bar))
            there = runge_kutta.stages(wide.tableau, wide.field, constants, here)
            bar = project(wide, there.end, bar)
            by_constants, by_t, by_h, by_y = runge_kutta.pulled(
                wide.tableau, wide.field, constants, here, there, bar, axes
            )
            # A body that is not there may be NaN, and its sum is shared with others.
            any_ready = jnp.any(group.ready, 0)
            total = _added(sums.constants, by_constants, any_ready)
            by_t, by_h, by_y = (_where(group.ready, by) for by in (by_t, by_h, by_y))
            old = lax.dynamic_slice_in_dim(sums.between, group.first, many, 0)
            between = lax.dynamic_update_slice_in_dim(
                sums.between, old + _many_first(run, by_h), group.first, 0
            )
            ends = _scattered(run, sums.ends, group.code // 2, by_t - by_h)
            extra = _scattered(run, extra, group.row, by_y)
            return extra, Inputs(total, ends, between, sums.y0)

        def step(i: Array, sums: Inputs) -> Inputs:
            i = count - 1 - i
            here, code = row_of(run, rows[i])
            there = runge_kutta.stages(method.tableau, method.field, constants, here)
            taken = here.h > 0
            bar = _where(taken, project(method, there.end, sums.y0))
            by_constants, by_t, by_h, by_y = runge_kutta.pulled(
                method.tableau, method.field, constants, here, there, bar, axes
            )
            by_t, by_h = _where(taken, by_t), _where(taken, by_h)
            cut = _where(code % 2 == 1, by_h)
            ends = _scattered(run, sums.ends, code // 2, by_t - cut)
            ends = _scattered(run, ends, code // 2 + 1, cut)
            before = jnp.where(lift(taken, by_y), by_y, sums.y0)
            if extra is not None:
                before = before + extra[i]
            return Inputs(_added(sums.constants, by_constants, taken), ends, sums.between, before)

        extra = None
        if run.between.shape[0]:
            none = jnp.zeros((rows.shape[0], *sums.y0.shape), sums.y0.dtype)
            extra, sums = _over_groups(run, rows, count, some, (none, sums))
        sums = lax.fori_loop(0, count, step, sums)
        return sums, *_segment(method, constants, run, book, number - 1, rows)

    more = bars.end.shape[1:]
    dtype = run.t0.dtype
    sums = Inputs(
        [jnp.zeros((*_own(run, c), *more), c.dtype) for c in constants],
        jnp.zeros((run.stops.shape[0] + 1, *more), dtype),
        jnp.zeros((run.between.shape[0], *more), dtype),
        bars.end,
    )
    state = (sums, book.rows, jnp.max(book.filled))
    return lax.fori_loop(0, jnp.max(book.number), segment, state)[0]


def _own(run: Run, constant: Array) -> tuple[int, ...]:
    """The shape of a constant of one body."""
    return constant.shape[: constant.ndim - run.t0.ndim]


def _added(sums: list[Array], more: list[Array], there: Array) -> list[Array]:
    return [a + _where(there, b) for a, b in zip(sums, more, strict=True)]


def _where(there: Array, a: Array) -> Array:
    """`a` (…, *bodies), nothing where it is not `there`."""
    return jnp.where(lift(there, a), a, jnp.zeros_like(a))


def _segment(
    method: Method, constants: list[Array], run: Run, book: Book, number: Array, rows: Rows
) -> tuple[Rows, Array]:
    """A segment run once more; the rows as they are if there is none of that number."""
    there = (number >= 0) & (number < jnp.max(book.number))
    place = jnp.clip(number, 0, book.starts.t.shape[0] - 1)
    walk: Any = jax.tree.map(lambda a: a[place], book.starts)
    following = book.starts.t[jnp.minimum(place + 1, book.starts.t.shape[0] - 1)]
    until = jnp.where(number + 1 < jnp.max(book.number), following, jnp.inf)
    until = jnp.where(there, until, -jnp.inf)
    _, rows, count = recorded(method, constants, run, walk, rows, until)
    return rows, count


def _of_times(run: Run, code: Array, ends: Array) -> tuple[Array, Array]:
    """Tangents of a step's start and length, from those of the start's time and the stops."""
    of_t, of_stop = (_gathered(run, ends, i) for i in (code // 2, code // 2 + 1))
    return of_t, _where(code % 2 == 1, of_stop - of_t)


def _gathered(run: Run, a: Array, index: Array) -> Array:
    """Rows of each body: a (R, …, *bodies), index (*many, *bodies) → (…, *many, *bodies)."""

    def pick(a: Array, index: Array) -> Array:
        found = a[index]
        return jnp.moveaxis(found, 0, -1) if index.ndim else found

    return per_body(pick, run.t0.ndim)(a, index)


def _scattered(run: Run, a: Array, index: Array, by: Array) -> Array:
    """The transpose of `_gathered`, added to `a`."""
    if a.shape[0] <= _FEW and index.ndim == run.t0.ndim:
        # Few rows: to add to all of them is quicker than to look for one.
        each = jnp.arange(a.shape[0], dtype=jnp.int32).reshape(-1, *[1] * by.ndim)
        return a + _where(lift(each == lift(index, each), a), jnp.broadcast_to(by[None], a.shape))

    def put(a: Array, index: Array, by: Array) -> Array:
        return a.at[index].add(jnp.moveaxis(by, -1, 0) if index.ndim else by)

    return per_body(put, run.t0.ndim)(a, index, by)


def _many_last(run: Run, a: Array) -> Array:
    """(many, …, *bodies) → (…, many, *bodies)."""
    return jnp.moveaxis(a, 0, -1 - run.t0.ndim)


def _many_first(run: Run, a: Array) -> Array:
    return jnp.moveaxis(a, -1 - run.t0.ndim, 0)


def _over_groups(
    run: Run, rows: Rows, count: Array, function: Callable[[Group, Any], Any], state: Any
) -> Any:
    """`function` on all the times between that lie in this segment, some at a time."""
    size = run.between.shape[0]
    if not size:
        return state
    many = min(MANY, size)
    (last, code), begin = row_of(run, rows[jnp.maximum(count - 1, 0)]), rows[0, 0]
    reach = jnp.where(code % 2 == 1, at(run.stops, code // 2), last.t + last.h)
    # Times that repeat the first one belong to the first segment.
    begin = jnp.where(begin <= run.t0, -jnp.inf, begin)
    first = jnp.min(jnp.sum(run.between <= begin[None], 0, dtype=jnp.int32))
    most = jnp.max(jnp.sum(run.between <= reach[None], 0, dtype=jnp.int32))
    each = jnp.arange(many, dtype=jnp.int32).reshape(-1, *[1] * run.t0.ndim)

    def group(number: Array, state: Any) -> Any:
        start = jnp.minimum(number * many, size - many)
        late = lax.dynamic_slice_in_dim(run.between, start, many, 0)
        # The last group begins early rather than ends late.
        ready = (late > begin[None]) & (late <= reach[None]) & (start + each >= number * many)
        row, code, step = within(run, rows, count, jnp.where(ready, late, reach[None]))
        return function(Group(start, ready, row, code, step), state)

    return lax.fori_loop(first // many, (most + many - 1) // many, group, state)
