"""Covariances by their square roots: P = S Sᵀ, which round-off cannot make indefinite."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax._types import Scalar


def triangular(a: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """The lower triangular root L of `a aᵀ`, its diagonal ≥ 0.

    By the modified Gram–Schmidt process on the rows, whose triangular factor is as good as
    Householder's (Björck 1967, doi:10.1007/BF01934122). A row that depends on earlier rows, to a
    few units of round-off, leaves a zero on the diagonal. Its derivatives are zero, whereas those
    of `jnp.linalg.qr` are NaN: a state known without error has such rows.
    """
    n = a.shape[0]
    below = jnp.arange(n)
    least = (4 * float(jnp.finfo(a.dtype).eps)) ** 2 * jnp.sum(a * a, 1)

    def take(a: Array, k: Array) -> tuple[Array, Array]:
        row = lax.dynamic_index_in_dim(a, k, keepdims=False)
        unit = row * inverse_root(jnp.sum(row * row), least[k])
        column = jnp.where(below >= k, jnp.sum(a * unit[None], 1), 0)
        return a - column[:, None] * unit[None], column

    return lax.scan(take, a, below)[1].T


def predicted(
    grown: Float[Array, "k n"], root: Float[Array, "n n"], noise: Float[Array, "k m"]
) -> Float[Array, "k k"]:
    """The triangular root of `F P Fᵀ + G Gᵀ`, of F, a root of P, and G."""
    return triangular(jnp.concatenate([product(grown, root), noise], 1))


def inverse_root(x: Array, least: Any = 0) -> Array:
    """1/√x if x is above `least`, else zero with zero derivatives."""
    there = x > least
    return jnp.where(there, 1 / jnp.sqrt(jnp.where(there, x, 1)), 0)


def product(a: Float[Array, "n m"], b: Float[Array, "m k"]) -> Float[Array, "n k"]:
    """`a b`, in full precision and cheap for a few rows."""
    return jnp.sum(a[:, :, None] * b[None], 1)


class Absorbed(NamedTuple):
    """The update by the numbers read: the mean's step, the new root, and each innovation.

    **Fields:** `step` (n,); `root` (n, n); `innovation` ν, the reading minus its prediction from
    all readings before; `variance` s of ν; a masked number has 0 and 1, so that it counts for
    nothing.
    """

    step: Float[Array, " n"]
    root: Float[Array, "n n"]
    innovation: Float[Array, "*k"]
    variance: Float[Array, "*k"]


def absorb_all(
    step: Float[Array, " n"],
    root: Float[Array, "n n"],
    matrix: Float[Array, "k n"],
    error: Float[Array, " k"],
    variance: Float[Array, " k"],
    seen: Bool[Array, " k"],
) -> Absorbed:
    """Potter's update by k numbers `error = row · e + noise`, one by one, of an e of mean `step`.

    `s = |Sᵀh|² + r`, `S ← S − S v vᵀ/(s + √(rs))` with `v = Sᵀh`: Potter, in Battin, Astronautical
    Guidance (1964), §9.6; Bierman, Factorization Methods (1977), §II.4.
    """

    def absorb(now: tuple[Array, Array], number: tuple) -> tuple[Any, Any]:
        (step, root), (row, error, variance, seen) = now, number
        across = jnp.where(seen, jnp.sum(row[:, None] * root, 0), 0)
        variance = jnp.where(seen, variance, 1)
        total = jnp.sum(across * across) + variance
        innovation = jnp.where(seen, error - jnp.sum(row * step), 0)
        along = jnp.sum(root * across[None], 1)
        step = step + along * (innovation / total)
        shrink = 1 / (total + jnp.sqrt(total * variance))
        return (step, root - (along * shrink)[:, None] * across[None]), (innovation, total)

    numbers = (matrix, error, variance, seen)
    (step, root), (innovation, total) = lax.scan(absorb, (step, root), numbers)
    return Absorbed(step, root, innovation, total)


class Terms(NamedTuple):
    """Each number read, normal given the earlier ones: its `error` in standard deviations, and
    `log_variance`, the logarithm of 2π times its variance; both zero where masked.
    """

    error: Float[Array, "*n"]
    log_variance: Float[Array, "*n"]

    @property
    def log_density(self) -> Scalar:
        """The sum of the logarithms of the normal densities."""
        return -0.5 * jnp.sum(self.error**2 + self.log_variance)


def terms(innovation: Array, variance: Array, seen: Array) -> Terms:
    """The terms of innovations."""
    error = jnp.where(seen, innovation * lax.rsqrt(variance), 0)
    return Terms(error, jnp.where(seen, jnp.log(2 * math.pi * variance), 0))


def divide(lower: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`lower⁻¹ right` by substitution; zero where the diagonal is zero."""

    def take(right: Array, k: Array) -> tuple[Array, Array]:
        column = lax.dynamic_index_in_dim(lower, k, 1, keepdims=False)
        there = column[k] > 0
        row = right[k] * jnp.where(there, 1 / jnp.where(there, column[k], 1), 0)
        return right - column[:, None] * row[None], row

    return lax.scan(take, right, jnp.arange(lower.shape[0]))[1]


def divide_right(left: Float[Array, "m n"], lower: Float[Array, "n n"]) -> Float[Array, "m n"]:
    """`left lower⁻¹`; zero where the diagonal is zero."""
    turned = divide(lower[::-1, ::-1].T, left[:, ::-1].T)
    return turned.T[:, ::-1]
