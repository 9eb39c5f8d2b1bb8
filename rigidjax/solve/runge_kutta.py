"""A step of an explicit Runge–Kutta method, its tangent and its transpose.

The stages are a loop, so that XLA compiles only one evaluation of the field, and one vjp of it for
the gradient. States are (n, *bodies): numbers first, bodies last.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve.batching import Arrays
from rigidjax.solve.components import lift
from rigidjax.solve.tableaus import Tableau

# field(constants, t, y) → dy/dt, for t (*bodies), y (n, *bodies).
Field = Callable[[Arrays, Array, Array], Array]


class Step(NamedTuple):
    """A step: its time and length (*bodies), the state at its start (n, *bodies)."""

    t: Array
    h: Array
    end: Array  # t + h but for the last digit: before a jump it is the last moment before it
    y: Array


class Stages(NamedTuple):
    """Times (s, *bodies), states and slopes (n, s, *bodies) at the stages; end (n, *bodies)."""

    times: Array
    places: Array
    slopes: Array
    end: Array
    number: Any  # of the stages taken


class Weights(NamedTuple):
    """The tableau as arrays."""

    a: Array  # (s, s)
    b: Array  # (s,)
    c: Array
    last: Array  # whether c is 1
    dense: Array  # (r, s) the rows of dense output


def stage_counts(tableau: Tableau) -> tuple[int, int]:
    """The number of stages of a step, and the number with those for dense output."""
    whole = len(tableau.a) + 2 + len(tableau.extra_a)
    return max(len(tableau.a), *tableau.errors[0]) + 1, whole


def weights(tableau: Tableau, dtype: Any, count: int) -> Weights:
    """The weights of the first `count` stages of a tableau."""
    rows = [{}, *tableau.a, tableau.b, *tableau.extra_a]
    c = np.array([0.0, *tableau.c, 1.0, *tableau.extra_c])[:count]
    whole = len(rows)
    a, b = np.stack([_row(row, whole) for row in rows]), _row(tableau.b, whole)
    first, last = np.eye(whole)[0], np.eye(whole)[len(tableau.a) + 1]
    more = [_row(row, whole) for row in tableau.dense]
    dense = np.stack([b, first - b, 2 * b - first - last, *more])[:, :count]
    a, b, nodes, dense = (jnp.asarray(w, dtype) for w in (a[:count, :count], b[:count], c, dense))
    return Weights(a, b, nodes, jnp.asarray(c == 1.0), dense)


def _row(row: dict[int, float], count: int) -> np.ndarray:
    out = np.zeros(count)
    out[list(row)] = list(row.values())
    return out


def _sum(row: Array, slopes: Array) -> Array:
    """Σ row_i k_i over axis 1 of k (n, s, …)."""
    return jnp.sum(row.reshape(1, -1, *[1] * (slopes.ndim - 2)) * slopes, 1)


def stages(
    tableau: Tableau, field: Field, constants: Arrays, step: Step, dense: Any = False
) -> Stages:
    """All stages of a step, if `dense` also those of dense output; `end` is not projected.

    If `dense` is traced and false, its stages are the state at the start, and their slopes 0.
    """
    plain, whole = stage_counts(tableau)
    count, number = (whole, np.int32(whole)) if dense is not False else (plain, np.int32(plain))
    w = weights(tableau, step.y.dtype, count)

    def stage(i: Array, sofar: tuple[Array, Array, Array]) -> Any:
        new = _stage(w, field, constants, step, i, sofar[2])
        put = lax.dynamic_update_index_in_dim
        return tuple(put(a, b, i, axis) for a, b, axis in zip(sofar, new, (0, 1, 1), strict=True))

    empty = jnp.zeros((step.y.shape[0], count, *step.y.shape[1:]), step.y.dtype)
    times, places = jnp.zeros((count, *step.t.shape), step.t.dtype), empty
    if not isinstance(dense, bool):
        # Where a field may have no value at 0, a stage that is left out must be somewhere else.
        times, places = times + step.t[None], places + step.y[:, None]
        number = jnp.where(dense, np.int32(whole), np.int32(plain))
    begun = (times, places, empty)
    times, places, slopes = lax.fori_loop(np.int32(0), number, stage, begun)
    h = lift(step.h.astype(step.y.dtype), step.y)
    return Stages(times, places, slopes, step.y + h * _sum(w.b, slopes), number)


def _stage(
    w: Weights, field: Field, constants: Arrays, step: Step, i: Array, slopes: Array
) -> tuple[Array, Array, Array]:
    # Time may be kept in another precision than the state.
    y = step.y + lift(step.h.astype(step.y.dtype), step.y) * _sum(w.a[i], slopes)
    t = jnp.where(w.last[i], step.end, step.t + w.c[i].astype(step.t.dtype) * step.h)
    return t, y, field(constants, t, y)


def dense_rows(tableau: Tableau, field: Field, step: Step, slopes: Array) -> Array:
    """The rows F0, F1, … of `nested` (r, n) of one body, times the length of the step."""
    count, whole = stage_counts(tableau)
    w = weights(tableau, slopes.dtype, whole)
    slopes = jnp.concatenate([slopes, jnp.zeros((slopes.shape[0], whole - count), slopes.dtype)], 1)

    def more(i: Array, slopes: Array) -> Array:
        slope = _stage(w, field, [], step, i, slopes)[2]
        return lax.dynamic_update_index_in_dim(slopes, slope, i, 1)

    slopes = lax.fori_loop(count, whole, more, slopes)
    return step.h.astype(slopes.dtype) * jnp.sum(w.dense[:, None] * slopes[None], 2)


def nested(theta: Array, rows: Array) -> Array:
    """θ (F0 + (1−θ) (F1 + θ (F2 + (1−θ) (F3 + …)))) of rows (r, …) and θ from 0 to 1 in a step.

    Added to the state at the start it is dense output: Hairer, Nørsett and Wanner (1993), II.6.
    """
    total = jnp.zeros((), rows.dtype)
    for i in reversed(range(rows.shape[0])):
        total = (total + rows[i]) * (1 - theta if i % 2 else theta)
    return total


def error_estimate(tableau: Tableau, sizes: list[int], h: Array, slopes: Array) -> Array:
    """The error of a step (n, *bodies).

    Two estimates e5, e3 make e5 |e5|/√(|e5|² + 0.01 |e3|²), which falls as h⁸ (Hairer, Nørsett and
    Wanner 1993, II.10). The lengths are those of each array of the state, of `sizes` numbers.
    """
    count, dtype = slopes.shape[1], slopes.dtype
    ones = [1] * (slopes.ndim - 2)
    # All sums at once: for one body each is a kernel of its own.
    rows = [_row(row, count) for row in tableau.errors]
    sums = jnp.asarray(np.stack(rows), dtype).reshape(len(rows), 1, count, *ones)
    found = jnp.sum(sums * slopes[None], 2)
    found = lift(h.astype(dtype), found) * found
    if len(rows) == 1:
        return found[0]
    which = np.repeat(np.eye(len(sizes)), sizes, axis=1)
    which = jnp.asarray(which, dtype).reshape(*which.shape, *ones)
    high, low = jnp.sum(which[None] * (found * found)[:, None], 2)
    # The smallest normal number keeps 0/0 out; no real estimate is as small as its root.
    ratio = jnp.sqrt(high / (high + 0.01 * low + float(jnp.finfo(dtype).tiny)))
    return found[0] * jnp.sum(which * ratio[:, None], 0)


def pulled(
    tableau: Tableau, field: Field, constants: Arrays, step: Step, there: Stages,
    cotangent: Array, of_slopes: Array | None = None,
) -> tuple[Arrays, Array, Array, Array]:  # fmt: skip
    """The transpose of a step: cotangents of the constants, of time, of length, of the state.

    `cotangent` is of the state at the end, `of_slopes` (n, s, *bodies) of all slopes.
    """
    count = there.slopes.shape[1]
    w = weights(tableau, step.y.dtype, count)
    h, put = step.h.astype(step.y.dtype), lax.dynamic_update_index_in_dim

    def stage(i: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        m = there.number - 1 - i
        below, seeds = both
        seed = w.b[m] * cotangent + _sum(w.a[:, m], below)
        bar = lift(h, seed) * seed
        if of_slopes is not None:
            bar = bar + of_slopes[:, m]
        pull = jax.vjp(lambda y: field(constants, there.times[m], y), there.places[:, m])[1]
        return put(below, pull(bar)[0], m, 1), put(seeds, seed, m, 1)

    none = jnp.zeros_like(there.slopes)
    below, seeds = lax.fori_loop(np.int32(0), there.number, stage, (none, none))
    # The constants' share of all stages at once: it does not wait for the others. Each stage has
    # constants of its own, and their shares are summed last: else each number is a kernel.
    every = jax.vmap(lambda c, t, y: field(c, t, y), (0, 0, 1), 1)
    own = [jnp.broadcast_to(c, (count, *c.shape)) for c in constants]
    pull = jax.vjp(lambda c, t: every(c, t, there.places), own, there.times)[1]
    bars = lift(h, seeds) * seeds
    by_own, by_times = pull(bars if of_slopes is None else bars + of_slopes)
    by_constants = [jnp.sum(by, 0) for by in by_own]
    by_length = jnp.sum(seeds * there.slopes, (0, 1)).astype(by_times.dtype)
    c = w.c.astype(by_times.dtype).reshape(-1, *[1] * (by_times.ndim - 1))
    by_length = by_length + jnp.sum(c * by_times, 0)
    return by_constants, jnp.sum(by_times, 0), by_length, cotangent + jnp.sum(below, 1)
