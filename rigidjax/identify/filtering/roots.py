"""Compute with roots S of covariances P, matrices with `P = S Sᵀ`.

A root is used because round-off cannot make the product `S Sᵀ` indefinite.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax._types import Scalar, ScalarLike


def triangular_root(rows: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Return the lower triangular matrix L with `L Lᵀ = A Aᵀ` and no negative diagonal entry.

    L is computed by the modified Gram–Schmidt process, whose triangular factor is as accurate as
    that of Householder's method (Björck 1967, doi:10.1007/BF01934122). A row of A may depend
    linearly on the rows before it, to a few units of round-off, such as the row of a number that is
    known without error. The diagonal entry of L is then zero, with zero derivatives; those of
    `jnp.linalg.qr` would be NaN.
    """
    n = rows.shape[0]
    below = jnp.arange(n)
    least = (4 * float(jnp.finfo(rows.dtype).eps)) ** 2 * jnp.sum(rows * rows, 1)

    def orthogonalise(rows: Array, k: Array) -> tuple[Array, Array]:
        row = lax.dynamic_index_in_dim(rows, k, keepdims=False)
        unit = row * inverse_sqrt(jnp.sum(row * row), least[k])
        column = jnp.where(below >= k, jnp.sum(rows * unit[None], 1), 0)
        return rows - column[:, None] * unit[None], column

    return lax.scan(orthogonalise, rows, below)[1].T


def predicted_root(
    transition: Float[Array, "k n"], root: Float[Array, "n n"], noise: Float[Array, "k m"]
) -> Float[Array, "k k"]:
    """Return a triangular root of `F P Fᵀ + G Gᵀ` with the `transition` F, `P = S Sᵀ` from the
    `root` S, and the `noise` G.
    """
    return triangular_root(jnp.concatenate([matrix_product(transition, root), noise], 1))


def inverse_sqrt(x: Array, threshold: ScalarLike = 0.0) -> Array:
    """Return 1/√x where x is above `threshold`, and zero with zero derivatives elsewhere."""
    there = x > threshold
    return jnp.where(there, 1 / jnp.sqrt(jnp.where(there, x, 1)), 0)


def matrix_product(left: Float[Array, "n m"], right: Float[Array, "m k"]) -> Float[Array, "n k"]:
    """Return `left right` in full precision, by sums that are cheap for matrices of few rows."""
    return jnp.sum(left[:, :, None] * right[None], 1)


class Update(NamedTuple):
    """Hold the update of an estimate by the numbers read."""

    step: Float[Array, " n"]  # the new mean of the errors of the estimate
    root: Float[Array, "n n"]
    innovation: Float[Array, "*k"]  # each number minus its prediction from all read before
    variance: Float[Array, "*k"]  # of the innovation, which is 0 with variance 1 if masked


def kalman_update(
    step: Float[Array, " n"],
    root: Float[Array, "n n"],
    matrix: Float[Array, "k n"],
    error: Float[Array, " k"],
    variance: Float[Array, " k"],
    mask: Bool[Array, " k"],
) -> Update:
    """Return the estimate of a vector e of errors after k numbers `h · e` plus noise were read.

    The numbers are taken one after another by Potter's formula, `s = |v|² + r`, `S ← S − S v vᵀ/(s
    + √(rs))` with `v = Sᵀh` (Battin, Astronautical Guidance (1964), §9.6; Bierman, Factorization
    Methods (1977), §II.4). Here S is the root of the covariance of e, s is the variance of the
    innovation, and r the `variance` of the noise; `step` is the mean of e before, the rows of
    `matrix` are the vectors h, and `error` holds the numbers.
    """

    def absorb(state: tuple[Array, Array], number: tuple) -> tuple[Any, Any]:
        (step, root), (row, error, variance, mask) = state, number
        across = jnp.where(mask, jnp.sum(row[:, None] * root, 0), 0)
        variance = jnp.where(mask, variance, 1)
        total = jnp.sum(across * across) + variance
        innovation = jnp.where(mask, error - jnp.sum(row * step), 0)
        along = jnp.sum(root * across[None], 1)
        step = step + along * (innovation / total)
        shrink = 1 / (total + jnp.sqrt(total * variance))
        return (step, root - (along * shrink)[:, None] * across[None]), (innovation, total)

    numbers = (matrix, error, variance, mask)
    (step, root), (innovation, total) = lax.scan(absorb, (step, root), numbers)
    return Update(step, root, innovation, total)


class LogDensityTerms(NamedTuple):
    """Hold the terms of a log-density in which each number read is normal, given those before it.

    Masked numbers have zeros in both fields.
    """

    error: Float[Array, "*n"]  # in standard deviations
    log_variance: Float[Array, "*n"]  # the logarithm of 2π times the variance

    @property
    def total(self) -> Scalar:
        """Return the logarithm of the density of all numbers read."""
        return -0.5 * jnp.sum(self.error**2 + self.log_variance)


def density_terms(innovation: Array, variance: Array, mask: Array) -> LogDensityTerms:
    """Return the terms of the log-density of readings from their innovations."""
    error = jnp.where(mask, innovation * lax.rsqrt(variance), 0)
    return LogDensityTerms(error, jnp.where(mask, jnp.log(2 * math.pi * variance), 0))


def left_divide(lower: Float[Array, "n n"], rhs: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return `lower⁻¹ rhs`; where a diagonal entry is zero, the row of the result is zero."""

    def substitute(rhs: Array, k: Array) -> tuple[Array, Array]:
        column = lax.dynamic_index_in_dim(lower, k, 1, keepdims=False)
        there = column[k] > 0
        row = rhs[k] * jnp.where(there, 1 / jnp.where(there, column[k], 1), 0)
        return rhs - column[:, None] * row[None], row

    return lax.scan(substitute, rhs, jnp.arange(lower.shape[0]))[1]


def right_divide(numerator: Float[Array, "m n"], lower: Float[Array, "n n"]) -> Float[Array, "m n"]:
    """Return `numerator lower⁻¹`; where a diagonal entry is zero, the column is zero."""
    turned = left_divide(lower[::-1, ::-1].T, numerator[:, ::-1].T)
    return turned.T[:, ::-1]
