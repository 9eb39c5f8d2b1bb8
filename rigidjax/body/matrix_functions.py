"""Functions of a symmetric matrix, differentiable where eigenvalues meet."""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Scalar
from rigidjax.body.principal_axes import eigensystem
from rigidjax.body.scaling import exponent_of, times_power_of_two
from rigidjax.body.symmetric3 import product

# Eigenvalues within this fraction of the largest are handled by an integral, not a quotient.
_CLOSE = 1.0 / 32.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
# Which of the ascending eigenvalues, without order: (i, j), and (i, k, j).
_PAIRS = list(itertools.combinations_with_replacement(range(3), 2))
_TRIPLES = list(itertools.combinations_with_replacement(range(3), 3))
_PAIR = np.array([_PAIRS.index(tuple(sorted(t))) for t in np.ndindex(3, 3)]).reshape(3, 3)
_TRIPLE = np.array([_TRIPLES.index(tuple(sorted(t))) for t in np.ndindex(3, 3, 3)])
_TRIPLE = _TRIPLE.reshape(3, 3, 3)


def matrix_function(function: Callable[[Scalar], Scalar], tensor: Mat3Like) -> Mat3:
    """`f(A) = R diag(f(λ)) Rᵀ` of a symmetric matrix, such as its square root or exponential.

    Its first and second derivatives are right for every body, also for a sphere and a symmetric
    top, where the principal axes have none. The axes are held; what moves is `E = Rᵀ dA R`, and
    `f(Λ + E)_ij = f(λ_i) δ_ij + f[λ_i, λ_j] E_ij + Σ_k f[λ_i, λ_k, λ_j] E_ik E_kj + …` with divided
    differences, which are smooth where eigenvalues meet (Daleckii and Krein 1965; Higham 2008,
    "Functions of Matrices", section 3.2). Third derivatives are not carried.

    **Arguments:** `function` f, scalar → scalar, written in `jax.numpy`, smooth on the spectrum; it
    may depend on values that are differentiated; `tensor` (3, 3) symmetric, I or 𝔖, any units.
    **Returns** (3, 3), same frame.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> matrix_function(jnp.sqrt, 4.0 * jnp.eye(3))[0]
    Array([2., 0., 0.], dtype=float64)
    """
    a = _checks.floating(tensor, (3, 3), "tensor")
    _checks.function(function, "function", "number → number, written in jax.numpy")
    # In units of the largest entry (a power of two), so that no product leaves the dtype's range.
    # One power less, so that it is a number for the largest of the dtype, too.
    unit = times_power_of_two(jnp.ones((), a.dtype), exponent_of(a) - 1)
    a = 0.5 * (a + a.T) / unit

    def scaled(value):
        return _checks.floating(function(unit * value), (), "function(λ)", hint="one number")

    values, axes = eigensystem(stop_gradient(a))
    change = product(axes.T, product(a - stop_gradient(a), axes))
    first, second = _divided_differences(scaled, values)
    bent = second * change[:, :, None] * change[None, :, :]
    inner = jnp.diag(jax.vmap(scaled)(values)) + first * change + bent.sum(axis=1)
    return product(axes, product(inner, axes.T))


def _divided_differences(f, values):
    """f[λi, λj] as (3, 3) and f[λi, λk, λj] as (3, 3, 3), of ascending eigenvalues."""
    close = _CLOSE * jnp.max(jnp.abs(values))
    pairs, triples = np.array(_PAIRS), np.array(_TRIPLES)

    def first(x, y):
        return _first(f, x, y, close)

    def second(x, y, z):
        return _second(f, x, y, z, close)

    of_pairs = jax.vmap(first)(*(values[pairs[:, k]] for k in range(2)))
    of_triples = jax.vmap(second)(*(values[triples[:, k]] for k in range(3)))
    return of_pairs[_PAIR], of_triples[_TRIPLE]


def _first(f, x, y, close):
    """f[x, y]: the mean of f' between x and y (Hermite–Genocchi where they are close)."""
    near = y - x <= close
    end = jnp.where(near, y, x)
    slope = jax.vmap(lambda s: jax.grad(f)(x + s * (end - x)))(jnp.asarray(_NODES, x.dtype))
    mean = (jnp.asarray(_WEIGHTS, x.dtype) * slope).sum()
    return jnp.where(near, mean, (f(y) - f(x)) / jnp.where(near, 1.0, y - x))


def _second(f, x, y, z, close):
    """f[x, y, z], x ≤ y ≤ z: an integral of f'' over the triangle that they span."""
    near = z - x <= close
    middle, end = jnp.where(near, y, x), jnp.where(near, z, x)
    u = np.repeat(_NODES, len(_NODES))
    v = np.tile(_NODES, len(_NODES)) * u
    weight = np.repeat(_WEIGHTS, len(_NODES)) * np.tile(_WEIGHTS, len(_NODES)) * u
    bend = jax.vmap(lambda s, t: jax.grad(jax.grad(f))(x + s * (middle - x) + t * (end - middle)))(
        jnp.asarray(u, x.dtype), jnp.asarray(v, x.dtype)
    )
    mean = (jnp.asarray(weight, x.dtype) * bend).sum()
    quotient = (_first(f, y, z, close) - _first(f, x, y, close)) / jnp.where(near, 1.0, z - x)
    return jnp.where(near, mean, quotient)
