"""Covariances by their square roots: P = S Sᵀ, which no rounding makes indefinite."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rigidjax._types import Scalar

# Beyond this many rows a loop written out takes long to compile.
_WRITTEN_OUT = 16


def triangular(a: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """The lower triangular root L of `a aᵀ`, its diagonal ≥ 0; m ≥ n.

    By the modified Gram–Schmidt process on the rows, whose triangular factor is as good as
    Householder's (Björck 1967, doi:10.1007/BF01934122). A row that depends on those before it
    leaves a zero on the diagonal, and derivatives there are taken as zero.

    >>> triangular(jnp.array([[3.0, 4.0], [3.0, 4.0]])).tolist()
    [[5.0, 0.0], [5.0, 0.0]]
    """
    n = a.shape[0]
    if n > _WRITTEN_OUT:
        root = jnp.linalg.qr(a.T, mode="reduced")[1].T
        return root * jnp.where(jnp.diagonal(root) < 0, -1.0, 1.0).astype(a.dtype)[None]
    columns = []
    for k in range(n):
        square = jnp.sum(a[0] * a[0])
        there = square > 0
        inverse = jnp.where(there, 1 / jnp.sqrt(jnp.where(there, square, 1)), 0)
        unit = a[0] * inverse
        column = jnp.sum(a * unit[None], 1)
        columns.append(jnp.concatenate([jnp.zeros(k, a.dtype), column]))
        a = a[1:] - column[1:, None] * unit[None]
    return jnp.stack(columns, 1)


def product(a: Float[Array, "n m"], b: Float[Array, "m k"]) -> Float[Array, "n k"]:
    """`a b`, in full precision and cheap for a few rows.

    >>> product(jnp.eye(2), 2 * jnp.eye(2)).tolist()
    [[2.0, 0.0], [0.0, 2.0]]
    """
    return jnp.sum(a[:, :, None] * b[None], 1)


class Absorbed(NamedTuple):
    """What one number read does: the mean's step, the root after it, and how far off it was.

    **Fields:** `step` (n,); `root` (n, n); `innovation` ν, what was read minus what was expected;
    `variance` s of ν; both of a masked number are such that it counts for nothing (0 and 1).
    """

    step: Float[Array, " n"]
    root: Float[Array, "n n"]
    innovation: Scalar
    variance: Scalar


def absorb(
    step: Float[Array, " n"],
    root: Float[Array, "n n"],
    row: Float[Array, " n"],
    error: Scalar,
    variance: Scalar,
    seen: Bool[Array, ""],
) -> Absorbed:
    """Potter's update by one number `error = row · e + noise`, of an e of mean `step`.

    `s = |Sᵀh|² + r`, `S ← S − S v vᵀ/(s + √(rs))` with `v = Sᵀh`: Potter, in Battin, Astronautical
    Guidance (1964), §9.6; Bierman, Factorization Methods (1977), §II.4.

    >>> one = jnp.array(1.0)
    >>> absorb(jnp.zeros(1), jnp.eye(1), jnp.ones(1), one, one, jnp.array(True)).step.tolist()
    [0.5]
    """
    across = jnp.where(seen, jnp.sum(row[:, None] * root, 0), 0)
    variance = jnp.where(seen, variance, 1)
    total = jnp.sum(across * across) + variance
    innovation = jnp.where(seen, error - jnp.sum(row * step), 0)
    along = jnp.sum(root * across[None], 1)
    step = step + along * (innovation / total)
    shrink = 1 / (total + jnp.sqrt(total * variance))
    return Absorbed(step, root - (along * shrink)[:, None] * across[None], innovation, total)


def log_normal(innovation: Array, variance: Array, seen: Array) -> Array:
    """The logarithm of a normal density, zero where nothing was seen.

    >>> round(float(log_normal(jnp.array(0.0), jnp.array(1.0), jnp.array(True))), 6)
    -0.918939
    """
    value = -0.5 * (innovation * innovation / variance + jnp.log(variance) + math.log(2 * math.pi))
    return jnp.where(seen, value, 0)


def divide(lower: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`lower⁻¹ right` by substitution; where the diagonal is zero, zero.

    >>> divide(2.0 * jnp.eye(2), jnp.eye(2)).tolist()
    [[0.5, 0.0], [0.0, 0.5]]
    """
    rows: list[Array] = []
    for k in range(lower.shape[0]):
        left = right[k]
        if k:
            left = left - jnp.sum(lower[k, :k, None] * jnp.stack(rows), 0)
        there = lower[k, k] > 0
        rows.append(jnp.where(there, left / jnp.where(there, lower[k, k], 1), 0))
    return jnp.stack(rows)
