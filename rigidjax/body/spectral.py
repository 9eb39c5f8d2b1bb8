"""Functions of a symmetric matrix, differentiable where eigenvalues meet (floor 1)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Scalar
from rigidjax.body.axes import eigensystem
from rigidjax.body.symmetric import product

# Eigenvalues within this fraction of the largest are handled by an integral, not a quotient.
_CLOSE = 0.125
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


def matrix_function(function: Callable[[Scalar], Scalar], tensor: Mat3Like) -> Mat3:
    """`f(A) = R diag(f(λ)) Rᵀ` of a symmetric matrix, such as its square root or exponential.

    Its first derivative is right also for a sphere and a symmetric top, where that of the
    principal axes does not exist. (The second derivative is right where the moments differ.)
    It is Newton's interpolating polynomial `f(λ1) + f[λ1,λ2](A − λ1) + f[λ1,λ2,λ3](A − λ1)(A − λ2)`
    with divided differences that stay smooth when eigenvalues meet (Higham 2008, "Functions of
    Matrices", section 1.2; the Hermite–Genocchi formula for close ones).

    **Arguments:** `function` f, scalar → scalar, written in `jax.numpy`, smooth on the spectrum;
    `tensor` (3, 3) symmetric, I or 𝔖, any units. **Returns** (3, 3), same frame.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> matrix_function(jnp.sqrt, 4.0 * jnp.eye(3))[0]
    Array([2., 0., 0.], dtype=float64)
    """
    a = _checks.floating(tensor, (3, 3), "tensor")
    # In units of the largest entry (a power of two), so that no product leaves the dtype's range.
    _, exponent = jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(a))))
    unit = jnp.ldexp(jnp.ones((), a.dtype), exponent)
    a = 0.5 * (a + a.T) / unit
    values, _ = eigensystem(a)

    def scaled(value):
        return function(unit * value)

    x, y, z = values[0], values[1], values[2]
    size = jnp.maximum(jnp.abs(x), jnp.abs(z))
    first = _first(scaled, x, y, size)
    second = _second(scaled, x, y, z, size)
    eye = jnp.eye(3, dtype=a.dtype)
    low, middle = a - x * eye, a - y * eye
    return scaled(x) * eye + first * low + second * product(low, middle)


def _first(f, x, y, size):
    """f[x, y]: the mean of f' between x and y."""
    close = jnp.abs(y - x) <= _CLOSE * size
    slope = jax.vmap(lambda s: jax.grad(f)(x + s * (jnp.where(close, y, x) - x)))(
        jnp.asarray(_NODES, x.dtype)
    )
    mean = (jnp.asarray(_WEIGHTS, x.dtype) * slope).sum()
    gap = jnp.where(close, 1.0, y - x)
    return jnp.where(close, mean, (f(y) - f(x)) / gap)


def _second(f, x, y, z, size):
    """f[x, y, z], x ≤ y ≤ z: an integral of f'' over the triangle they span."""
    close = jnp.abs(z - x) <= _CLOSE * size
    inside, end = jnp.where(close, y, x), jnp.where(close, z, x)
    u = np.repeat(_NODES, len(_NODES))
    v = np.tile(_NODES, len(_NODES)) * u
    weight = np.repeat(_WEIGHTS, len(_NODES)) * np.tile(_WEIGHTS, len(_NODES)) * u
    bend = jax.vmap(lambda s, t: jax.grad(jax.grad(f))(x + s * (inside - x) + t * (end - inside)))(
        jnp.asarray(u, x.dtype), jnp.asarray(v, x.dtype)
    )
    mean = (jnp.asarray(weight, x.dtype) * bend).sum()
    gap = jnp.where(close, 1.0, z - x)
    return jnp.where(close, mean, (_first(f, y, z, size) - _first(f, x, y, size)) / gap)
