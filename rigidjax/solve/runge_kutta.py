"""A step of an explicit Runge–Kutta method, its tangent and its transpose.

The stages are a loop: one evaluation of the field is all that XLA has to compile, and one vjp of
it for the gradient, which takes a tenth of the time that twelve copies take, and the loop runs as
fast to a fifth. States are (n, *bodies): numbers first, bodies last.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve.components import lift
from rigidjax.solve.tableaus import Tableau

# field(constants, t, y) → dy/dt, for t (*bodies), y (n, *bodies).
Field = Callable[[list[Array], Array, Array], Array]


class Step(NamedTuple):
    """Time, length and end of a step (*bodies), state at its start (n, *bodies).

    `end` is `t + h` but for the last digit: before a jump it is the last moment before it.
    """

    t: Array
    h: Array
    end: Array
    y: Array


class Stages(NamedTuple):
    """Times (s, *bodies), states and slopes (n, s, *bodies) at the stages; end (n, *bodies)."""

    times: Array
    places: Array
    slopes: Array
    end: Array


class Weights(NamedTuple):
    """The tableau as arrays: `a` (s, s), `b`, `c` (s,); `last` whether c is 1."""

    a: Array
    b: Array
    c: Array
    last: Array


def weights(tableau: Tableau, dtype: Any) -> Weights:
    """The weights of a tableau.

    >>> from rigidjax.solve.tableaus import KUTTA4
    >>> weights(KUTTA4, jnp.float64).a[3].tolist()
    [0.0, 0.0, 1.0, 0.0]
    """
    count = len(tableau.a) + 1
    a, b = np.zeros((count, count)), _row(tableau.b, count)
    for i, row in enumerate(tableau.a):
        a[i + 1, :count] = _row(row, count)
    c = np.array([0.0, *tableau.c])
    a, b, nodes = (jnp.asarray(w, dtype) for w in (a, b, c))
    return Weights(a, b, nodes, jnp.asarray(c == 1.0))


def _row(row: dict[int, float], count: int) -> np.ndarray:
    out = np.zeros(count)
    out[list(row)] = list(row.values())
    return out


def _sum(row: Array, slopes: Array) -> Array:
    """Σ row_i k_i over axis 1 of k (n, s, …)."""
    return jnp.sum(row.reshape(1, -1, *[1] * (slopes.ndim - 2)) * slopes, 1)


def _put(record: Array, row: Array, i: Array) -> Array:
    return lax.dynamic_update_slice_in_dim(record, row[:, None], i, 1)


def stages(tableau: Tableau, field: Field, constants: list[Array], step: Step) -> Stages:
    """All stages of a step; `end` is not projected."""
    w = weights(tableau, step.y.dtype)
    count = w.b.shape[0]
    # Time may be kept in another precision than the state.
    h = lift(step.h.astype(step.y.dtype), step.y)

    def stage(i: Array, both: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        times, places, slopes = both
        y = step.y + h * _sum(w.a[i], slopes)
        t = jnp.where(w.last[i], step.end, step.t + w.c[i].astype(step.t.dtype) * step.h)
        slope = field(constants, t, y)
        times = lax.dynamic_update_slice_in_dim(times, t[None], i, 0)
        return times, _put(places, y, i), _put(slopes, slope, i)

    empty = jnp.zeros((step.y.shape[0], count, *step.y.shape[1:]), step.y.dtype)
    times = jnp.zeros((count, *step.t.shape), step.t.dtype)
    times, places, slopes = lax.fori_loop(
        np.int32(0), np.int32(count), stage, (times, empty, empty)
    )
    return Stages(times, places, slopes, step.y + h * _sum(w.b, slopes))


def error_estimate(
    tableau: Tableau, sizes: list[int], h: Array, slopes: Array, last: Array | None
) -> Array:
    """The error of a step (n, *bodies).

    Two estimates e5, e3 make e5 |e5|/√(|e5|² + 0.01 |e3|²), which falls as h⁸ (Hairer, Nørsett and
    Wanner 1993, II.10). The lengths are those of one array of the state, of `sizes` numbers: scales
    are not mixed.

    **Arguments:** `slopes` (n, s, *bodies), `last` (n, *bodies) the slope at the end, if the
    tableau asks for it.
    """
    count, dtype = slopes.shape[1], slopes.dtype
    ones = [1] * (slopes.ndim - 2)
    # All sums at once: for one body each is a kernel of its own.
    rows = [_row({i: v for i, v in row.items() if i < count}, count) for row in tableau.errors]
    sums = jnp.asarray(np.stack(rows), dtype).reshape(len(rows), 1, count, *ones)
    found = jnp.sum(sums * slopes[None], 2)
    if last is not None:
        ends = np.array([row.get(count, 0.0) for row in tableau.errors])
        found = found + jnp.asarray(ends, dtype).reshape(-1, 1, *ones) * last[None]
    found = lift(h.astype(dtype), found) * found
    if len(rows) == 1:
        return found[0]
    which = np.repeat(np.eye(len(sizes)), sizes, axis=1)
    which = jnp.asarray(which, dtype).reshape(*which.shape, *ones)
    high, low = jnp.sum(which[None] * (found * found)[:, None], 2)
    # The smallest normal number keeps 0/0 out; no real estimate is as small as its root.
    ratio = jnp.sqrt(high / (high + 0.01 * low + float(jnp.finfo(dtype).tiny)))
    return found[0] * jnp.sum(which * ratio[:, None], 0)


def needs_last_slope(tableau: Tableau) -> bool:
    """Whether the error estimate uses the slope at the end of the step."""
    return max(tableau.errors[0]) > len(tableau.a)


class Axes(NamedTuple):
    """Axes of tangents beyond those of the states: `bodies` 0 or 1 last ones, `directions` 0 or 1
    before all others but the first.
    """

    bodies: int
    directions: int

    def over(self, function: Any, into: Any, out: Any) -> Any:
        """The function for every direction; `into`, `out` are axes, -1 stands for constants'."""
        if not self.directions:
            return function
        axes: Any = jax.tree.map(lambda a: -1 - self.bodies if a < 0 else a, (into, out))
        return jax.vmap(function, *axes)


def pushed(
    tableau: Tableau,
    field: Field,
    constants: list[Array],
    step: Step,
    there: Stages,
    along: tuple[list[Array], Array, Array, Array],
    axes: Axes,
) -> Array:
    """The tangent (n, *directions, *bodies) of the state at the end, not projected.

    **Arguments:** `along` tangents of the constants, of the step's time and length, of its state.
    """
    w = weights(tableau, step.y.dtype)
    of_constants, of_t, of_h, of_y = along
    h, dh = (lift(a.astype(of_y.dtype), of_y) for a in (step.h, of_h))
    slopes = jnp.expand_dims(there.slopes, 2) if axes.directions else there.slopes

    def stage(i: Array, moved: Array) -> Array:
        y = of_y + dh * _sum(w.a[i], slopes) + h * _sum(w.a[i], moved)
        t = of_t + w.c[i].astype(of_t.dtype) * of_h
        here = (constants, there.times[i], there.places[:, i])

        def slope(of_constants: Any, t: Array, y: Array) -> Array:
            return jax.jvp(field, here, (of_constants, t, y))[1]

        return _put(moved, axes.over(slope, (-1, 0, 1), 1)(of_constants, t, y), i)

    count = w.b.shape[0]
    none = jnp.zeros((of_y.shape[0], count, *of_y.shape[1:]), of_y.dtype)
    moved = lax.fori_loop(np.int32(0), np.int32(count), stage, none)
    return of_y + dh * _sum(w.b, slopes) + h * _sum(w.b, moved)


def pulled(
    tableau: Tableau,
    field: Field,
    constants: list[Array],
    step: Step,
    there: Stages,
    cotangent: Array,
    axes: Axes,
) -> tuple[list[Array], Array, Array, Array]:
    """The transpose of `pushed`: cotangents of the constants, of time, of length, of the state."""
    w = weights(tableau, step.y.dtype)
    count = w.b.shape[0]
    h = step.h.astype(step.y.dtype)

    def stage(i: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        m = count - 1 - i
        below, seeds = both
        seed = w.b[m] * cotangent + _sum(w.a[:, m], below)
        pull = jax.vjp(lambda y: field(constants, there.times[m], y), there.places[:, m])[1]
        return _put(below, axes.over(pull, 1, (1,))(lift(h, seed) * seed)[0], m), _put(
            seeds, seed, m
        )

    none = jnp.zeros((cotangent.shape[0], count, *cotangent.shape[1:]), cotangent.dtype)
    below, seeds = lax.fori_loop(np.int32(0), np.int32(count), stage, (none, none))
    # The constants' share of all stages at once: it does not wait for the others. Each stage has
    # constants of its own, and their shares are summed last: else each number is a kernel.
    every = jax.vmap(lambda c, t, y: field(c, t, y), (0, 0, 1), 1)
    own = [jnp.broadcast_to(c, (count, *c.shape)) for c in constants]
    pull = jax.vjp(lambda c, t: every(c, t, there.places), own, there.times)[1]
    by_own, by_times = axes.over(pull, 2, (-1, 1))(lift(h, seeds) * seeds)
    by_constants = [jnp.sum(by, 0) for by in by_own]
    slopes = jnp.expand_dims(there.slopes, 2) if axes.directions else there.slopes
    by_length = jnp.sum(seeds * slopes, (0, 1)).astype(by_times.dtype)
    c = w.c.astype(by_times.dtype).reshape(-1, *[1] * (by_times.ndim - 1))
    by_length = by_length + jnp.sum(c * by_times, 0)
    return by_constants, jnp.sum(by_times, 0), by_length, cotangent + jnp.sum(below, 1)
