"""Compute a step of an explicit Runge–Kutta method, its tangent and its transpose.

The stages are computed in a loop. XLA therefore compiles only one evaluation of the field and, for
the gradient, one vector–Jacobian product of the field. States are arrays (n, *bodies): the n
numbers of a state are in the first axis. `*bodies` is one last axis in a batch of bodies, and no
axis for one body.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve.programs.batching import Arrays, lift
from rigidjax.solve.steps.tableaus import Tableau, round_weights

# field(constants, t, y) → dy/dt, for t (*bodies), y (n, *bodies).
Field = Callable[[Arrays, Array, Array], Array]


class Step(NamedTuple):
    """Hold a step: the times of its start and end, its length, and the state at its start."""

    t: Array  # (*bodies), s: the time at the start
    h: Array  # (*bodies), s: the length
    # (*bodies), s: the time at the end of the step, equal to t + h but for rounding. If the step
    # ends at a jump of the field, it is the last floating-point number before the time of the jump.
    end: Array
    y: Array  # (n, *bodies) the state at the start


class Stages(NamedTuple):
    """Hold the s stages of a step, and the state at its end."""

    times: Array  # (s, *bodies) the times of the stages, in seconds
    places: Array  # (n, s, *bodies) the states at which the field is evaluated
    slopes: Array  # (n, s, *bodies) the values dy/dt of the field at the stages
    end: Array  # (n, *bodies) the state at the end of the step
    number: Any  # how many of the stages were computed


class Weights(NamedTuple):
    """Hold the numbers of a Runge–Kutta method as arrays over its s stages.

    The stages of a step come first, then those that only dense output needs.
    """

    a: Array  # (s, s) the weights of the slopes in the state of each stage
    b: Array  # (s,) the weights of the slopes in the state at the end of the step
    c: Array  # (s,) the times of the stages, from 0 at the start of the step to 1 at its end
    last: Array  # (s,) whether c is 1
    dense: Array  # (r, s) the weights of the slopes in the r coefficients of dense output
    errors: Array  # (1 or 2, s) the weights of the slopes in the estimates of the error
    plain: int  # how many stages a step without dense output has


def weights_of(tableau: Tableau, dtype: Any) -> Weights:
    """Return the numbers of a Runge–Kutta method as arrays of the `dtype`."""
    tableau = round_weights(tableau, dtype)
    c = np.array([0.0, *tableau.c, 1.0, *tableau.extra_c])
    rows = [{}, *tableau.a, tableau.b, *tableau.extra_a, *tableau.dense, *tableau.errors]
    table, whole = np.zeros((len(rows), c.size)), c.size
    for into, row in zip(table, rows, strict=True):
        into[list(row)] = list(row.values())
    first, last = np.eye(whole)[[0, len(tableau.a) + 1]]
    b, more = table[len(tableau.a) + 1], table[whole : len(rows) - len(tableau.errors)]
    dense = np.stack([b, first - b, 2 * b - first - last, *more])
    errors = table[len(rows) - len(tableau.errors) :]
    plain = max(len(tableau.a), *tableau.errors[0]) + 1
    a, b, nodes = (jnp.asarray(w, dtype) for w in (table[:whole], b, c))
    dense, errors = jnp.asarray(dense, dtype), jnp.asarray(errors, dtype)
    return Weights(a, b, nodes, jnp.asarray(c == 1.0), dense, errors, plain)


def _weighted_sum(weights: Array, slopes: Array) -> Array:
    """Return Σ wᵢ kᵢ (n, …) of the slopes (n, s, …); weights beyond the slopes are left out."""
    weights = weights[: slopes.shape[1]]
    return jnp.sum(weights.reshape(1, -1, *[1] * (slopes.ndim - 2)) * slopes, 1)


def stages(
    tableau: Tableau, field: Field, constants: Arrays, step: Step, dense: Any = False
) -> Stages:
    """Compute all stages of a step; the quaternion at its end is not scaled to length 1.

    If `dense` is traced, the arrays have places for the stages of dense output in any case; if it
    is false, these hold the time and the state at the start, and the slope 0.
    """
    w = weights_of(tableau, step.y.dtype)
    count = w.plain if dense is False else w.c.size
    number: Any = np.int32(count)

    def stage(i: Array, sofar: tuple[Array, Array, Array]) -> Any:
        new = _stage(w, field, constants, step, i, sofar[2])
        put = lax.dynamic_update_index_in_dim
        return tuple(put(a, b, i, axis) for a, b, axis in zip(sofar, new, (0, 1, 1), strict=True))

    empty = jnp.zeros((step.y.shape[0], count, *step.y.shape[1:]), step.y.dtype)
    times, places = jnp.zeros((count, *step.t.shape), step.t.dtype), empty
    if not isinstance(dense, bool):
        # If `dense` is false, the stages for dense output are not computed. Their places in the
        # arrays hold the time and state at the start of the step, and not zeros, because the field
        # may be infinite or NaN at a state of zeros.
        times, places = times + step.t[None], places + step.y[:, None]
        number = jnp.where(dense, number, np.int32(w.plain))
    times, places, slopes = lax.fori_loop(np.int32(0), number, stage, (times, places, empty))
    h = lift(step.h.astype(step.y.dtype), step.y)
    return Stages(times, places, slopes, step.y + h * _weighted_sum(w.b, slopes), number)


def _stage(
    w: Weights, field: Field, constants: Arrays, step: Step, i: Array, slopes: Array
) -> tuple[Array, Array, Array]:
    """Return time, state and slope of stage `i`, from the slopes (n, s, *bodies) before it."""
    # The dtype of the time may differ from that of the state.
    y = step.y + lift(step.h.astype(step.y.dtype), step.y) * _weighted_sum(w.a[i], slopes)
    t = jnp.where(w.last[i], step.end, step.t + w.c[i].astype(step.t.dtype) * step.h)
    return t, y, field(constants, t, y)


def dense_rows(tableau: Tableau, field: Field, step: Step, slopes: Array) -> Array:
    """Return the coefficients (r, n) of dense output in a step of one body (see `dense_change`).

    The length of the step is in them as a factor.
    """
    w = weights_of(tableau, slopes.dtype)
    slopes = jnp.pad(slopes, ((0, 0), (0, w.c.size - w.plain)))

    def more(i: Array, slopes: Array) -> Array:
        slope = _stage(w, field, [], step, i, slopes)[2]
        return lax.dynamic_update_index_in_dim(slopes, slope, i, 1)

    slopes = lax.fori_loop(w.plain, w.c.size, more, slopes)
    return step.h.astype(slopes.dtype) * jnp.sum(w.dense[:, None] * slopes[None], 2)


def dense_change(theta: Array, rows: Array) -> Array:
    """Return the change of the state since the start of a step, at its fraction θ.

    It is θ (F0 + (1−θ) (F1 + θ (F2 + (1−θ) (F3 + …)))), where `rows` are F0, F1, …. Source: Hairer,
    Nørsett and Wanner (1993), II.6.
    """
    total = jnp.zeros((), rows.dtype)
    for i in reversed(range(rows.shape[0])):
        total = (total + rows[i]) * (1 - theta if i % 2 else theta)
    return total


def error_estimate(tableau: Tableau, sizes: list[int], h: Array, slopes: Array) -> Array:
    """Return an estimate of the error of each number of the state after a step, (n, *bodies).

    Estimates e5 of order 5 and e3 of order 3 are combined to e5 |e5|/√(|e5|² + 0.01 |e3|²), which
    is proportional to h⁸ for short steps (Hairer, Nørsett and Wanner 1993, II.10). The norms are
    taken over each array of the state, of `sizes`.
    """
    dtype, ones = slopes.dtype, [1] * (slopes.ndim - 2)
    # All sums over stages are computed in one operation, because for one body each separate sum
    # would be a kernel of its own.
    rows = weights_of(tableau, dtype).errors[:, : slopes.shape[1]]
    found = jnp.sum(rows.reshape(len(rows), 1, -1, *ones) * slopes[None], 2)
    found = lift(h.astype(dtype), found) * found
    if len(rows) == 1:
        return found[0]
    which = np.repeat(np.eye(len(sizes)), sizes, axis=1)
    which = jnp.asarray(which, dtype).reshape(*which.shape, *ones)
    high, low = jnp.sum(which[None] * (found * found)[:, None], 2)
    # The smallest normal number is added to prevent 0/0. Its square root is smaller than the error
    # estimate of any real step.
    ratio = jnp.sqrt(high / (high + 0.01 * low + float(jnp.finfo(dtype).tiny)))
    return found[0] * jnp.sum(which * ratio[:, None], 0)


class StepCotangents(NamedTuple):
    """Hold the cotangents of the inputs of a step."""

    constants: Arrays
    t: Array
    h: Array
    y: Array


def pull_back(
    tableau: Tableau, field: Field, constants: Arrays, step: Step, step_stages: Stages,
    cotangent: Array, cotangents_of_slopes: Array | None = None,
) -> StepCotangents:  # fmt: skip
    """Return the cotangents of a step's inputs from those of its end and of its slopes."""
    w, count = weights_of(tableau, step.y.dtype), step_stages.slopes.shape[1]
    h, put = step.h.astype(step.y.dtype), lax.dynamic_update_index_in_dim

    def stage(i: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        m = step_stages.number - 1 - i
        below, seeds = both
        seed = w.b[m] * cotangent + _weighted_sum(w.a[:, m], below)
        bar = lift(h, seed) * seed
        if cotangents_of_slopes is not None:
            bar = bar + cotangents_of_slopes[:, m]
        pull = jax.vjp(
            lambda y: field(constants, step_stages.times[m], y), step_stages.places[:, m]
        )[1]
        return put(below, pull(bar)[0], m, 1), put(seeds, seed, m, 1)

    none = jnp.zeros_like(step_stages.slopes)
    below, seeds = lax.fori_loop(np.int32(0), step_stages.number, stage, (none, none))
    # The cotangents of the constants from different stages do not depend on each other, so that all
    # stages are transposed at once. Each stage gets a copy of the constants, and the cotangents of
    # the copies are summed at the end: otherwise XLA makes a kernel for each number.
    every = jax.vmap(lambda c, t, y: field(c, t, y), (0, 0, 1), 1)
    own = [jnp.broadcast_to(c, (count, *c.shape)) for c in constants]
    pull = jax.vjp(lambda c, t: every(c, t, step_stages.places), own, step_stages.times)[1]
    bars = lift(h, seeds) * seeds
    by_own, by_times = pull(bars if cotangents_of_slopes is None else bars + cotangents_of_slopes)
    by_constants = [jnp.sum(by, 0) for by in by_own]
    by_length = jnp.sum(seeds * step_stages.slopes, (0, 1)).astype(by_times.dtype)
    c = w.c[:count].astype(by_times.dtype).reshape(-1, *[1] * (by_times.ndim - 1))
    by_length = by_length + jnp.sum(c * by_times, 0)
    by_start = cotangent + jnp.sum(below, 1)
    return StepCotangents(by_constants, jnp.sum(by_times, 0), by_length, by_start)
