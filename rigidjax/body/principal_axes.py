"""Compute principal moments and axes, and functions of a symmetric matrix, with finite derivatives.

The derivative of `eigh` divides by differences of eigenvalues: the derivative is NaN for a sphere
and for every symmetric top, and in JAX also for distinct moments above 1e16 kg m² (jax#669).
"""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, Scalar, Vec3
from rigidjax.body import validation
from rigidjax.body.scaling import binary_exponent, times_power_of_two
from rigidjax.body.symmetric3 import product

# Two moments are treated as equal if they differ by less than this many units of round-off of the
# largest moment.
_EQUAL = 64.0
# The number of Jacobi sweeps. Convergence is quadratic: double precision needs four or five sweeps.
_SWEEPS = 6
# If eigenvalues differ by less than this fraction of the largest eigenvalue, a divided difference
# is computed by an integral, not by a quotient.
_CLOSE = 1.0 / 32.0
# The nodes and weights of Gauss–Legendre quadrature with eight points on [0, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
# Divided differences do not depend on the order of their arguments: they are computed only for
# sorted pairs (i, j) and sorted triples (i, k, j) of indices of eigenvalues, which `_PAIRS` and
# `_TRIPLES` list. The arrays `_PAIR` and `_TRIPLE` give the place of any pair or triple in these
# two lists.
_PAIRS = list(itertools.combinations_with_replacement(range(3), 2))
_TRIPLES = list(itertools.combinations_with_replacement(range(3), 3))
_PAIR = np.array([_PAIRS.index(tuple(sorted(t))) for t in np.ndindex(3, 3)]).reshape(3, 3)
_TRIPLE = np.array([_TRIPLES.index(tuple(sorted(t))) for t in np.ndindex(3, 3, 3)])
_TRIPLE = _TRIPLE.reshape(3, 3, 3)


def principal(tensor: Mat3Like) -> tuple[Vec3, Quat]:
    """Return the principal moments, ascending, and the rotation principal axes → body axes.

    **Arguments:** `tensor` (3, 3) symmetric: I (kg m²) or 𝔖 (kg m²), body frame. **Returns**
    `(moments, q)`: (3,), ascending, in the units of `tensor`, and (4,), a unit quaternion (w, x, y,
    z) with `A = R(q) diag(moments) R(q)ᵀ`, where A is the tensor and R(q) the rotation matrix of q.
    Of the four right-handed choices q is the smallest turn, hence `w ≥ ½`.

    The derivative is exact if the moments differ. Moments that are equal to round-off have one
    eigenspace: their derivatives are the diagonal entries of the change of the tensor, and the axes
    do not turn inside the eigenspace. This rule gives the right derivative of every function that
    depends on the eigenspaces and is symmetric in the moments. No finite derivative of an axis can
    describe how axes mix inside an eigenspace. For a smooth function of the whole matrix, such as a
    square root, use `rigidjax.body.matrix_function`; to solve, use the matrix itself. Source:
    notes, eqs 71–72; first-order perturbation theory, Kato 1966, II.2.

    >>> moments, q = principal(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> moments, q
    (Array([1., 2., 3.], dtype=float64), Array([1., 0., 0., 0.], dtype=float64))
    """
    a = _checks.array_of_shape(tensor, (3, 3), "tensor")
    moments, m = eigensystem(validation.require_symmetric_or_nan(a, "tensor"))
    # The turn is at most 120°, so that one formula for the quaternion is enough.
    w = 0.5 * jnp.sqrt(1.0 + m[0, 0] + m[1, 1] + m[2, 2])
    f = 0.25 / w
    x, y, z = f * (m[2, 1] - m[1, 2]), f * (m[0, 2] - m[2, 0]), f * (m[1, 0] - m[0, 1])
    return moments, jnp.stack([w, x, y, z])


@jax.custom_jvp
@jax.jit
def eigensystem(a: Mat3) -> tuple[Vec3, Mat3]:
    """Return the ascending eigenvalues of a symmetric matrix, and a right-handed matrix with the
    unit eigenvectors as columns.

    The method is cyclic Jacobi rotations (Golub and Van Loan 2013, section 8.5). In a batch it is
    eight times as fast as LAPACK's `eigh`, and it is accurate for the small moment of a slender
    body that lies along one of the coordinate axes.
    """
    # The matrix is scaled to entries near 1, so that no square overflows; a power of two costs no
    # digit.
    exponent = binary_exponent(a)
    b = times_power_of_two(0.5 * (a + a.T), -exponent)
    one, nil = jnp.ones((), a.dtype), jnp.zeros((), a.dtype)
    start = (
        (b[0, 0], b[1, 1], b[2, 2]),
        (b[1, 2], b[0, 2], b[0, 1]),  # the entry opposite each diagonal one
        ((one, nil, nil), (nil, one, nil), (nil, nil, one)),
    )
    values, _, axes = map(list, jax.lax.fori_loop(0, _SWEEPS, _jacobi_sweep, start))
    for i, j in ((0, 1), (1, 2), (0, 1)):
        # Exchange two eigenvalues that do not ascend, and their axes, of which one is reversed, so
        # that the three stay right-handed.
        a, b, wrong = values[i], values[j], values[i] > values[j]
        values[i], values[j] = jnp.where(wrong, b, a), jnp.where(wrong, a, b)
        pairs = list(zip(axes[i], axes[j], strict=True))
        axes[i] = tuple(jnp.where(wrong, q, p) for p, q in pairs)
        axes[j] = tuple(jnp.where(wrong, -p, q) for p, q in pairs)
    # Four choices of the signs are right-handed. The matrix with the largest trace turns by the
    # smallest angle.
    d0, d1, d2 = axes[0][0], axes[1][1], axes[2][2]
    traces = jnp.stack([d0 + d1 + d2, d0 - d1 - d2, d1 - d0 - d2, d2 - d0 - d1])
    signs = jnp.asarray([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], traces.dtype)
    columns = jnp.stack([jnp.stack(axis) for axis in axes], axis=1)
    columns = columns * signs[jnp.argmax(traces)][None]
    return times_power_of_two(jnp.stack(values), exponent), columns


@eigensystem.defjvp
def _eigensystem_jvp(
    primals: tuple[Mat3], tangents: tuple[PyTree, ...]
) -> tuple[tuple[Vec3, Mat3], tuple[Vec3, Mat3]]:
    """Return the eigensystem and its tangent, which is finite also if eigenvalues are equal: their
    eigenvectors are not turned towards each other.
    """
    (a,), (da,) = primals, tangents
    values, axes = eigensystem(a)
    turned = product(axes.T, product(0.5 * (da + da.T), axes))
    gap = values[None, :] - values[:, None]
    size = jnp.maximum(jnp.abs(values[0]), jnp.abs(values[2]))
    apart = jnp.abs(gap) > _EQUAL * jnp.finfo(values.dtype).eps * size
    turning = jnp.where(apart, turned, 0.0) / jnp.where(apart, gap, 1.0)
    return (values, axes), (jnp.diagonal(turned), product(axes, turning))


def _jacobi_sweep(_: Array | int, state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Turn a matrix and its axes by three Jacobi rotations, each of which makes one off-diagonal
    entry zero; `state` is the diagonal, the entries (2, 3), (1, 3), (1, 2), and the axes.
    """
    values, opposite, axes = map(list, state)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        d, e = values[j] - values[i], 2.0 * opposite[k]
        size = jnp.abs(d) + jnp.sqrt(d * d + e * e)
        t = jnp.where(size > 0, jnp.where(d < 0, -e, e) / jnp.where(size > 0, size, 1.0), 0.0)
        c = 1.0 / jnp.sqrt(1.0 + t * t)
        s = t * c
        values[i], values[j] = values[i] - 0.5 * t * e, values[j] + 0.5 * t * e
        x, y = opposite[j], opposite[i]  # the entries (k, i) and (k, j)
        opposite[k], opposite[j], opposite[i] = jnp.zeros_like(e), c * x - s * y, s * x + c * y
        pairs = list(zip(axes[i], axes[j], strict=True))
        axes[i] = tuple(c * p - s * q for p, q in pairs)
        axes[j] = tuple(s * p + c * q for p, q in pairs)
    return tuple(values), tuple(opposite), tuple(axes)


def matrix_function(function: Callable[[Scalar], Scalar], tensor: Mat3Like) -> Mat3:
    """Return a function of a symmetric matrix A, such as its square root or exponential: `f(A) = R
    diag(f(λ)) Rᵀ`, with the eigenvalues λ of A, and its unit eigenvectors as the columns of R.

    Its first and second derivatives are correct for every body, also for a sphere and a symmetric
    top, whose principal axes have no derivatives; third derivatives are not available. With the
    fixed axes R, Λ = diag(λ) and the change `E = Rᵀ dA R`, the derivatives follow from `f(Λ + E)_ij
    = f(λ_i) δ_ij + f[λ_i, λ_j] E_ij + Σ_k f[λ_i, λ_k, λ_j] E_ik E_kj + …`; the divided differences
    f[…] are smooth at equal eigenvalues (Daleckii and Krein 1965; Higham 2008, "Functions of
    Matrices", section 3.2).

    **Arguments:** `function` f, scalar → scalar, written in `jax.numpy`, smooth on the spectrum; it
    may depend on differentiated values; `tensor` (3, 3) symmetric, I or 𝔖, any units. **Returns**
    (3, 3), same frame.

    >>> matrix_function(jnp.sqrt, 4.0 * jnp.eye(3))[0]
    Array([2., 0., 0.], dtype=float64)
    """
    a = validation.require_symmetric_or_nan(
        _checks.array_of_shape(tensor, (3, 3), "tensor"), "tensor"
    )
    _checks.require_function(function, "function", "number → number, written in jax.numpy")
    # The unit is a power of two near the largest entry, so that no product leaves the range of the
    # dtype. The exponent is reduced by one, because the power of two above the largest number of
    # the dtype is infinite.
    unit = times_power_of_two(jnp.ones((), a.dtype), binary_exponent(a) - 1)
    a = 0.5 * (a + a.T) / unit

    def of_scaled(scaled: Scalar) -> Scalar:
        return _checks.array_of_shape(function(unit * scaled), (), "function(λ)", hint="one number")

    values, axes = eigensystem(jax.lax.stop_gradient(a))
    change = product(axes.T, product(a - jax.lax.stop_gradient(a), axes))
    close = _CLOSE * jnp.max(jnp.abs(values))
    x, y = values[np.array(_PAIRS)].T
    first = jax.vmap(lambda x, y: _divided_difference(of_scaled, x, y, close))(x, y)[_PAIR]
    x, y, z = values[np.array(_TRIPLES)].T
    second = jax.vmap(lambda x, y, z: _second_difference(of_scaled, x, y, z, close))
    second = second(x, y, z)[_TRIPLE]
    bent = second * change[:, :, None] * change[None, :, :]
    inner = jnp.diag(jax.vmap(of_scaled)(values)) + first * change + bent.sum(axis=1)
    return product(axes, product(inner, axes.T))


def _divided_difference(
    f: Callable[[Scalar], Scalar], x: Scalar, y: Scalar, close: Scalar
) -> Scalar:
    """Return f[x, y] = (f(y) − f(x))/(y − x) for x ≤ y, or, where y − x is at most `close` and the
    quotient would lose digits, the mean of f' by quadrature (Hermite–Genocchi).
    """
    near = y - x <= close
    end = jnp.where(near, y, x)
    slope = jax.vmap(lambda s: jax.grad(f)(x + s * (end - x)))(jnp.asarray(_NODES, x.dtype))
    mean = (jnp.asarray(_WEIGHTS, x.dtype) * slope).sum()
    return jnp.where(near, mean, (f(y) - f(x)) / jnp.where(near, 1.0, y - x))


def _second_difference(
    f: Callable[[Scalar], Scalar], x: Scalar, y: Scalar, z: Scalar, close: Scalar
) -> Scalar:
    """Return f[x, y, z] = (f[y, z] − f[x, y])/(z − x) for x ≤ y ≤ z, or, where z − x is at most
    `close`, the integral of f'' over all weighted means by quadrature (Hermite–Genocchi).
    """
    near = z - x <= close
    middle, end = jnp.where(near, y, x), jnp.where(near, z, x)
    u = np.repeat(_NODES, len(_NODES))
    v = np.tile(_NODES, len(_NODES)) * u
    weight = np.repeat(_WEIGHTS, len(_NODES)) * np.tile(_WEIGHTS, len(_NODES)) * u
    bend = jax.vmap(lambda s, t: jax.grad(jax.grad(f))(x + s * (middle - x) + t * (end - middle)))(
        jnp.asarray(u, x.dtype), jnp.asarray(v, x.dtype)
    )
    mean = (jnp.asarray(weight, x.dtype) * bend).sum()
    rise = _divided_difference(f, y, z, close) - _divided_difference(f, x, y, close)
    return jnp.where(near, mean, rise / jnp.where(near, 1.0, z - x))
