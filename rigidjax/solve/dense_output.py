"""States at times inside the steps of a run: dense output, on the group.

The loop does not look at the times that are asked for. Its steps with such times in them are taken
once more: many of one body side by side, or one of each of many bodies.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Step, nested, stages, weights
from rigidjax.solve.step_control import Method, Run, Segment, times_of

# Times of one body that are taken together.
_TOGETHER = 16


def saved(
    method: Method, constants: list[Array], run: Run, part: Segment, path: Array, ys: Array
) -> Array:
    """`ys` (K, n, *bodies) with the states at those times that are in this part of the run.

    **Arguments:** `path` (R, n, *bodies) the states at the start of each row.
    """
    size, many, field, project = run.between.shape[0], run.t0.ndim, method.field, method.project
    width = 1 if many else min(size, _TOGETHER)
    if not many:
        field = jax.vmap(field, (None, -1, -1), -1)
        project = jax.vmap(project, -1, -1)
    index, inside = _rows_at(run, part)
    # What is not inside stands still at the first state, where the field has a value.
    still = part.rows[0].at[1:3].set(0)
    still = still if many else still[:, None]

    def window(i: Array, ys: Array) -> Array:
        # A window beyond the last time is moved back: states that are there are worked out again.
        number = jnp.minimum(first + i * width, size - width)
        cut = partial(_cut, number, width, many)
        there, where = cut(inside), cut(index)
        rows = jnp.where(there[None], _picked(many, part.rows, where), still)
        ts = jnp.where(there, cut(run.between), rows[0])
        step = Step(*times_of(run, rows), _picked(many, path, where))
        slopes = stages(method.tableau, field, constants, step, True).slopes
        new = _states(method, project, ts[None], step.t, step.h, step.y, slopes)[0]
        new = jnp.where(there[None], new, cut(ys))
        rows = new[None] if many else new.T
        return lax.dynamic_update_slice_in_dim(ys, rows, number, 0)

    used = jnp.any(inside.reshape(size, -1), 1)
    first = jnp.argmax(used).astype(jnp.int32)
    length = size - jnp.argmax(used[::-1]).astype(jnp.int32) - first
    count = jnp.where(jnp.any(used), (length + width - 1) // width, 0)
    return lax.fori_loop(jnp.zeros_like(count), count, window, ys)


def known(run: Run, part: Segment) -> Array:
    """The number of saved times passed at the start of each row, and at the end."""
    ends = jnp.concatenate([jnp.minimum(part.times, part.end[None]), part.end[None]])
    search = lambda ts, t: jnp.searchsorted(ts, t, side="right").astype(jnp.int32)  # noqa: E731
    return _per_body(run, search)(lax.stop_gradient(run.between), ends)


def pulled(
    method: Method, run: Run, step: Step, slopes: Array, first: Array, last: Array, bars: Array,
    between: Array | None,
) -> tuple[Array | None, Array, Array, Array, Array]:  # fmt: skip
    """The transpose of the states at the times in a step: cotangents of the times between
    (K, *bodies), and of the step: its time, length, state at the start and slopes.

    **Arguments:** `first`, `last` (*bodies) the numbers of the first of these times and of the
    first one behind; `bars` (K, n, *bodies) cotangents of all states; `between` what is added
    to, or `None`.
    """
    size = run.between.shape[0]
    width = min(size, max(4, min(size // 50, 16)))
    states = partial(_states, method, method.project)

    def window(state: Any) -> Any:
        begin, total, by = state
        number = jnp.arange(width, dtype=jnp.int32).reshape(-1, *[1] * first.ndim)
        number = begin[None] + number
        inside = number < last[None]
        number = jnp.minimum(number, size - 1)
        pick = _per_body(run, lambda a, index: a[index])
        ts = jnp.where(inside, pick(run.between, number), step.t[None])
        bar = jnp.where(jnp.expand_dims(inside, 1), pick(bars, number), 0)
        by_ts, *more = jax.vjp(states, ts, step.t, step.h, step.y, slopes)[1](bar)
        if total is not None:
            total = _per_body(run, lambda a, i, b: a.at[i].add(b))(total, number, by_ts)
        return begin + width, total, [a + b for a, b in zip(by, more, strict=True)]

    none = [jnp.zeros_like(a) for a in (step.t, step.h, step.y, slopes)]
    start = (first, between, none)
    _, total, by = lax.while_loop(lambda state: jnp.any(state[0] < last), window, start)
    return total, *by


def _rows_at(run: Run, part: Segment) -> tuple[Array, Array]:
    """The index of the row that each time between is in (K, *bodies), whether there is one.

    All at once: in a loop each search would be many small kernels.
    """
    ts = lax.stop_gradient(run.between)
    search = _per_body(run, lambda begun, ts: jnp.searchsorted(begun, ts).astype(jnp.int32) - 1)
    index = search(part.times, ts)
    return jnp.maximum(index, 0), (index >= 0) & (ts <= part.end[None])


def _per_body(run: Run, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one body's arrays as one of arrays with a last axis of bodies, if there is."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if run.t0.ndim else function


def _cut(number: Array, width: int, many: int, a: Array) -> Array:
    """Some rows of `a` (K, …, *bodies), in lanes (…, lanes)."""
    if many:
        return lax.dynamic_index_in_dim(a, number, 0, False)
    return jnp.moveaxis(lax.dynamic_slice_in_dim(a, number, width, 0), 0, -1)


def _picked(many: int, rows: Array, index: Array) -> Array:
    """Those of the rows (R, c, *bodies), in lanes: (c, lanes)."""
    return jnp.take_along_axis(rows, index[None, None], 0)[0] if many else rows[index].T


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
