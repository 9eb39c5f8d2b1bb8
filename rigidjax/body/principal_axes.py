"""Principal moments and axes that may stand inside a differentiated function.

`eigh`'s own derivative divides by differences of eigenvalues: NaN for a sphere and for every
symmetric top, and, as implemented in JAX, for distinct moments above 1e16 kg m² (jax#669).
"""

from typing import Any

import jax
import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, Vec3
from rigidjax.body.scaling import exponent_of, times_power_of_two
from rigidjax.body.symmetric3 import product

# Moments closer than this many units of round-off of the largest count as equal.
_EQUAL = 64.0
# Convergence is quadratic: double precision needs four or five.
_SWEEPS = 6


def principal(tensor: Mat3Like) -> tuple[Vec3, Quat]:
    """Principal moments, ascending, and the rotation principal axes → body axes.

    **Arguments:** `tensor` (3, 3) symmetric: I (kg m²) or 𝔖 (kg m²), body frame.
    **Returns** `(moments, q)`: (3,), ascending, in the units of `tensor`, and (4,) a unit
    quaternion (w, x, y, z) with `A = R(q) diag(moments) R(q)ᵀ`. Of the four right-handed choices
    of sign the one closest to no rotation is taken, hence `w ≥ ½`.

    The derivative is exact where moments differ. Moments that are equal to round-off are one
    eigenspace: the axes do not turn inside it, and its moments move by their own diagonal
    entries. That is the right derivative of whatever depends on the moments symmetrically and on
    the eigenspaces only. What mixes axes inside an eigenspace is not seen by any finite tangent
    of an axis: for a smooth function of the whole matrix, such as a square root, use
    `rigidjax.body.matrix_function`; to solve, use the matrix itself.

    Source: notes, eqs 71–72; first-order perturbation theory, Kato 1966, II.2.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> moments, q = principal(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> moments, q
    (Array([1., 2., 3.], dtype=float64), Array([1., 0., 0., 0.], dtype=float64))
    """
    moments, axes = eigensystem(_checks.floating(tensor, (3, 3), "tensor"))
    return moments, _quaternion_near_identity(axes)


@jax.custom_jvp
@jax.jit
def eigensystem(a: Mat3) -> tuple[Vec3, Mat3]:
    """Ascending eigenvalues and a right-handed matrix of eigenvectors, as columns.

    Cyclic Jacobi rotations on components (Golub and Van Loan 2013, section 8.5): in a batch eight
    times as fast as LAPACK's `eigh` matrix by matrix, and the small moment of a slender body whose
    axes lie along the body's keeps its relative accuracy.
    """
    # A power of two, so that scaling costs no digit.
    exponent = exponent_of(a)
    b = times_power_of_two(0.5 * (a + a.T), -exponent)
    one, nil = jnp.ones((), a.dtype), jnp.zeros((), a.dtype)
    start = (
        (b[0, 0], b[1, 1], b[2, 2]),
        (b[1, 2], b[0, 2], b[0, 1]),  # the entry opposite each diagonal one
        ((one, nil, nil), (nil, one, nil), (nil, nil, one)),
    )
    values, _, axes = jax.lax.fori_loop(0, _SWEEPS, _sweep, start)
    values, axes = _ascending(values, axes)
    return times_power_of_two(jnp.stack(values), exponent), _nearest_signs(axes)


@eigensystem.defjvp
def _eigensystem_jvp(primals, tangents):
    (a,), (da,) = primals, tangents
    values, axes = eigensystem(a)
    turned = product(axes.T, product(0.5 * (da + da.T), axes))
    gap = values[None, :] - values[:, None]
    size = jnp.maximum(jnp.abs(values[0]), jnp.abs(values[2]))
    apart = jnp.abs(gap) > _EQUAL * jnp.finfo(values.dtype).eps * size
    turning = jnp.where(apart, turned, 0.0) / jnp.where(apart, gap, 1.0)
    return (values, axes), (jnp.diagonal(turned), product(axes, turning))


def _sweep(_, state):
    values, opposite, axes = state
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        d, e = values[j] - values[i], 2.0 * opposite[k]
        size = jnp.abs(d) + jnp.sqrt(d * d + e * e)
        t = jnp.where(size > 0, jnp.where(d < 0, -e, e) / jnp.where(size > 0, size, 1.0), 0.0)
        c = 1.0 / jnp.sqrt(1.0 + t * t)
        s = t * c
        values = _with(values, {i: values[i] - 0.5 * t * e, j: values[j] + 0.5 * t * e})
        x, y = opposite[j], opposite[i]  # the entries (k, i) and (k, j)
        opposite = _with(opposite, {k: jnp.zeros_like(e), j: c * x - s * y, i: s * x + c * y})
        u, v = axes[i], axes[j]
        axes = _with(
            axes,
            {
                i: tuple(c * p - s * q for p, q in zip(u, v, strict=True)),
                j: tuple(s * p + c * q for p, q in zip(u, v, strict=True)),
            },
        )
    return values, opposite, axes


def _ascending(values, axes):
    """Sort by exchanges; each turns one axis round, so that they stay right-handed."""
    for i, j in ((0, 1), (1, 2), (0, 1)):
        wrong = values[i] > values[j]
        low = jnp.where(wrong, values[j], values[i])
        high = jnp.where(wrong, values[i], values[j])
        u = tuple(jnp.where(wrong, q, p) for p, q in zip(axes[i], axes[j], strict=True))
        v = tuple(jnp.where(wrong, -p, q) for p, q in zip(axes[i], axes[j], strict=True))
        values, axes = _with(values, {i: low, j: high}), _with(axes, {i: u, j: v})
    return values, axes


def _nearest_signs(axes) -> Mat3:
    """Turn two axes round, or none: whichever gives the largest trace."""
    d0, d1, d2 = axes[0][0], axes[1][1], axes[2][2]
    choices = (d0 + d1 + d2, d0 - d1 - d2, d1 - d0 - d2, d2 - d0 - d1)
    best = jnp.maximum(jnp.maximum(choices[0], choices[1]), jnp.maximum(choices[2], choices[3]))
    first = (choices[1] == best) & (choices[0] != best)
    second = (choices[2] == best) & (choices[0] != best) & ~first
    third = (choices[0] != best) & ~first & ~second
    signs = (
        jnp.where(second | third, -1.0, 1.0),
        jnp.where(first | third, -1.0, 1.0),
        jnp.where(first | second, -1.0, 1.0),
    )
    columns = [
        jnp.stack([sign.astype(p.dtype) * p for p in axis])
        for sign, axis in zip(signs, axes, strict=True)
    ]
    return jnp.stack(columns, axis=1)


def _with(values: tuple[Any, ...], changed: dict[int, Any]) -> tuple[Any, ...]:
    return tuple(changed[k] if k in changed else v for k, v in enumerate(values))


def _quaternion_near_identity(m: Mat3) -> Quat:
    """The quaternion of a rotation matrix with trace ≥ 0: no branch is needed."""
    w = 0.5 * jnp.sqrt(1.0 + m[0, 0] + m[1, 1] + m[2, 2])
    f = 0.25 / w
    return jnp.stack([w, f * (m[2, 1] - m[1, 2]), f * (m[0, 2] - m[2, 0]), f * (m[1, 0] - m[0, 1])])
