"""States at times inside the steps of a run: dense output, on the group.

The loop does not look at the times that are asked for. Its steps with such times in them are taken
once more: of one body many side by side, of many bodies one of each.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.components import lift
from rigidjax.solve.record import Method, Rows, Run, Segment, times_of
from rigidjax.solve.runge_kutta import Step, nested, stages, weights

# Times of one body that are taken together.
_TOGETHER = 16


class _Steps(NamedTuple):
    """Times in steps, in lanes: of one body (W,), of many (*bodies). Whether they are inside, the
    index of their rows, and these (4 + n, lanes).
    """

    ts: Array
    inside: Array
    row: Array
    rows: Rows


def room(run: Run) -> int:
    """How many rows there are for the times between: whole windows of them."""
    size = run.between.shape[0]
    return size if run.t0.ndim or not size else -(-size // _width(run)) * _width(run)


def _width(run: Run) -> int:
    return min(run.between.shape[0], 1 if run.t0.ndim else _TOGETHER)


def saved(
    method: Method, constants: list[Array], run: Run, part: Segment, path: Array, ys: Array
) -> Array:
    """`ys` (room, n, *bodies) with the states at those times that are in this part of the run.

    **Arguments:** `path` (R, n, *bodies) the states at the start of each row.
    """
    field, project = _in_lanes(run, method)

    def fill(found: _Steps, number: Array, ys: Array) -> Array:
        y = _picked(run, path, found.row)
        t, h, end = times_of(run, found.rows)
        there = stages(method.tableau, field, constants, Step(t, h, end, y), True)
        new = _states(method, project, found.ts[None], t, h, y, there.slopes)[0]
        new = jnp.where(found.inside[None], new, _cut(run, ys, number))
        return _put(run, ys, new, number)

    return _windows(run, part, fill, ys)


def known(run: Run, part: Segment) -> Array:
    """How many of the times between the run has passed at the start of each row, and at the end."""
    ends = jnp.concatenate([jnp.minimum(part.times, part.end[None]), part.end[None]])
    search = lambda ts, t: jnp.searchsorted(ts, t, side="right").astype(jnp.int32)  # noqa: E731
    return _per_body(run, search)(lax.stop_gradient(run.between), ends)


class Back(NamedTuple):
    """Cotangents of the times between (K, *bodies), and of a step: its time, length, state at the
    start and slopes.
    """

    between: Array | None
    t: Array
    h: Array
    y: Array
    slopes: Array


def pulled(
    method: Method, run: Run, step: Step, slopes: Array, first: Array, last: Array, bars: Array,
    between: Array | None,
) -> Back:  # fmt: skip
    """The transpose of the states at the times in a step.

    **Arguments:** `first`, `last` (*bodies) the numbers of the first of these times and of the
    first one behind; `bars` (K, n, *bodies) cotangents of all states; `between` what is added
    to, or `None`.
    """
    size = run.between.shape[0]
    width = min(size, max(4, min(size // 50, 16)))
    states = partial(_states, method, method.project)

    def window(state: tuple[Array, Back]) -> tuple[Array, Back]:
        begin, by = state
        number = jnp.arange(width, dtype=jnp.int32).reshape(-1, *[1] * first.ndim)
        number = begin[None] + number
        inside = number < last[None]
        number = jnp.minimum(number, size - 1)
        pick = _per_body(run, lambda a, index: a[index])
        ts = jnp.where(inside, pick(run.between, number), step.t[None])
        bar = pick(bars, number)
        bar = jnp.where(jnp.expand_dims(inside, 1), bar, 0)
        by_ts, *rest = jax.vjp(states, ts, step.t, step.h, step.y, slopes)[1](bar)
        total = by.between
        if total is not None:
            add = _per_body(run, lambda a, i, b: a.at[i].add(b))
            total = add(total, number, by_ts)
        more = zip(by[1:], rest, strict=True)
        return begin + width, Back(total, *(a + b for a, b in more))

    none = (jnp.zeros_like(a) for a in (step.t, step.h, step.y, slopes))
    start = (first, Back(between, *none))
    return lax.while_loop(lambda state: jnp.any(state[0] < last), window, start)[1]


def _windows(run: Run, part: Segment, over: Callable[[_Steps, Array, Any], Any], state: Any) -> Any:
    """`over(steps, number of the first, state)` for all times in this part, some at once."""
    width = _width(run)
    later, index, inside = _rows_at(run, part)
    # What is not inside stands still at the first state, where the field has a value.
    still = part.rows[0].at[1:3].set(0)
    still = still if run.t0.ndim else still[:, None]

    def window(i: Array, state: Any) -> Any:
        number = i * width
        there, where = _cut(run, inside, number), _cut(run, index, number)
        rows = jnp.where(there[None], _picked(run, part.rows, where), still)
        ts = jnp.where(there, _cut(run, later, number), rows[0])
        return over(_Steps(ts, there, where, rows), number, state)

    used = jnp.any(inside.reshape(room(run) // width, -1), 1)
    first = jnp.argmax(used).astype(jnp.int32)
    last = jnp.where(jnp.any(used), used.size - jnp.argmax(used[::-1]).astype(jnp.int32), first)
    return lax.fori_loop(first, last, window, state)


def _rows_at(run: Run, part: Segment) -> tuple[Array, Array, Array]:
    """The times (room, *bodies), the index of the row that each is in, whether there is one.

    All at once: in a loop each search would be many small kernels.
    """
    beyond = jnp.full((room(run) - run.between.shape[0], *run.t0.shape), jnp.inf, run.t0.dtype)
    ts = jnp.concatenate([run.between, beyond])
    held = lax.stop_gradient(ts)
    search = _per_body(run, lambda begun, ts: jnp.searchsorted(begun, ts).astype(jnp.int32) - 1)
    index = search(part.times, held)
    return ts, jnp.maximum(index, 0), (index >= 0) & (held <= part.end[None])


def _per_body(run: Run, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one body's arrays as one of arrays with a last axis of bodies, if there is."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if run.t0.ndim else function


def _cut(run: Run, a: Array, number: Array) -> Array:
    """Some rows of `a` (room, …, *bodies), in lanes (…, lanes)."""
    if run.t0.ndim:
        return lax.dynamic_index_in_dim(a, number, 0, False)
    return jnp.moveaxis(lax.dynamic_slice_in_dim(a, number, _width(run), 0), 0, -1)


def _put(run: Run, a: Array, lanes: Array, number: Array) -> Array:
    rows = lanes[None] if run.t0.ndim else jnp.moveaxis(lanes, -1, 0)
    return lax.dynamic_update_slice_in_dim(a, rows, number, 0)


def _picked(run: Run, rows: Array, index: Array) -> Array:
    """Those of the rows (R, c, *bodies), in lanes: (c, lanes)."""
    if run.t0.ndim:
        return jnp.take_along_axis(rows, index[None, None], 0)[0]
    return rows[index].T


def _in_lanes(run: Run, method: Method) -> tuple[Any, Any]:
    if run.t0.ndim:
        return method.field, method.project
    return jax.vmap(method.field, (None, -1, -1), -1), jax.vmap(method.project, -1, -1)


def _states(
    method: Method, project: Any, ts: Array, t: Array, h: Array, y: Array, slopes: Array
) -> Array:
    """The states (W, n, lanes) at times `ts` (W, lanes), all in one step of each lane."""
    theta = ((ts - t[None]) / jnp.where(h == 0, 1, h)[None]).astype(slopes.dtype)
    # Weights of the slopes are one number a stage; the rows F_r would be n.
    rows = weights(method.tableau, slopes.dtype, slopes.shape[1]).dense
    rows = rows.reshape(rows.shape[0], 1, -1, *[1] * (theta.ndim - 1))
    shares = nested(jnp.expand_dims(theta, 1), rows)
    rise = jnp.sum(jnp.expand_dims(shares, 1) * slopes[None], 2)
    return jax.vmap(project)(y[None] + lift(h.astype(y.dtype), rise) * rise)
