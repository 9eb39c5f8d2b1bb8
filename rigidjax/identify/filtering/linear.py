"""Compute the smoother of a linear model with normal noise, in square-root form."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax._types import Scalar
from rigidjax.identify.filtering import roots
from rigidjax.identify.filtering.steps import LinearReadings


class Moves(NamedTuple):
    """Hold linear steps from a state x to `F x + d + G u`, where u is normal with unit variance."""

    transition: Float[Array, "steps n n"]  # F
    noise: Float[Array, "steps n m"]  # G
    push: Float[Array, "steps n"]  # d


class LinearEstimate(NamedTuple):
    """Hold the state of a linear model at each time, and the noise u of each step, by all readings.

    The likelihood and the innovations are those of the filter.
    """

    mean: Float[Array, "times n"]
    root: Float[Array, "times n n"]  # S of the covariance S Sᵀ
    innovation: Float[Array, "times k"]
    variance: Float[Array, "times k"]  # of each innovation
    log_likelihood: Scalar
    kicks: Float[Array, "steps m"]
    kick_covariance: Float[Array, "steps m m"]


def linear_smooth(
    moves: Moves, readings: LinearReadings, mean: Float[Array, " n"], root: Float[Array, "n n"]
) -> LinearEstimate:
    """Return the states at T times by the smoother of Rauch, Tung and Striebel (1965,
    doi:10.2514/3.3166), from the T − 1 steps between them; `mean` and `root` precede all readings.
    """

    def update_by(row: LinearReadings, mean: Array, root: Array) -> roots.Update:
        return roots.kalman_update(mean, root, row.matrix, row.error, row.deviation**2, row.mask)

    def advance(carry: tuple[Array, Array], row: tuple[Moves, LinearReadings]) -> tuple[Any, Any]:
        (mean, root), (move, later) = carry, row
        n, m = move.noise.shape
        predicted = jnp.sum(move.transition * mean[None], 1) + move.push
        # The gain and the roots are blocks of the triangular root of `[[F S, G], [S, 0]]` (Park and
        # Kailath 1995, doi:10.1080/00207179508921582). If m < n, columns of zeros are added, which
        # do not change `A Aᵀ`: the matrix A then has at least as many columns as rows.
        upper = jnp.concatenate([roots.matrix_product(move.transition, root), move.noise], 1)
        whole = jnp.concatenate([upper, jnp.pad(root, ((0, 0), (0, m)))])
        whole = roots.triangular_root(jnp.pad(whole, ((0, 0), (0, max(0, n - m)))))
        before, cross = whole[:n, :n], whole[n:, :n]
        # The gain maps a change after the step to the change before it; `rest` is a root of the
        # covariance before the step, for a known state after it.
        gain, rest = roots.right_divide(cross, before), whole[n:, n:]
        update = update_by(later, predicted, before)
        return (update.step, update.root), (update, (mean, predicted, before, gain, rest))

    def step_back(after: tuple[Array, Array], row: tuple) -> tuple[Any, Any]:
        noise, (mean, predicted, before, gain, rest) = row
        off, m = after[0] - predicted, noise.shape[1]
        # The covariance of u is `I − ZᵀZ + (Zᵀ L⁻¹ S)(Zᵀ L⁻¹ S)ᵀ` with the unit matrix I, `Z = L⁻¹
        # G`, the root L of the predicted covariance and the root S of the smoothed one.
        both = roots.left_divide(before, jnp.concatenate([noise, off[:, None], after[1]], 1))
        whitened = both[:, :m]
        left = jnp.eye(m, dtype=noise.dtype) - roots.matrix_product(whitened.T, whitened)
        known = roots.matrix_product(whitened.T, both[:, m + 1 :])
        kicks = jnp.sum(whitened * both[:, m : m + 1], 0)
        covariance = left + roots.matrix_product(known, known.T)
        mean = mean + jnp.sum(gain * off[None], 1)
        out = mean, roots.predicted_root(gain, after[1], rest)
        return out, (*out, kicks, covariance)

    first_row, later = (
        jax.tree.map(lambda leaf, at=at: leaf[at], readings) for at in (0, slice(1, None))
    )
    first = update_by(first_row, mean, root)
    last, (rest, steps) = lax.scan(advance, (first.step, first.root), (moves, later))
    updates = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    _, _, innovation, variance = updates
    _, (*before, kicks, covariance) = lax.scan(step_back, last, (moves.noise, steps), reverse=True)
    means, all_roots = (jnp.concatenate([a, b[None]]) for a, b in zip(before, last, strict=True))
    total = roots.density_terms(innovation, variance, readings.mask).total
    return LinearEstimate(means, all_roots, innovation, variance, total, kicks, covariance)
