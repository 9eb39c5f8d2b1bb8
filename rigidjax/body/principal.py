"""Principal moments and axes that may stand inside a differentiated function (floor 1).

`eigh`'s own derivative divides by differences of eigenvalues: NaN for a sphere and for every
symmetric top, and, as implemented in JAX, for distinct moments above 1e16 kg m² (jax#669).
"""

import jax
import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, Vec3
from rigidjax.body.symmetric import product

# Moments closer than this many units of round-off of the largest count as equal.
_EQUAL = 64.0


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
    `rigidjax.body.spectral.matrix_function`; to solve, use the matrix itself.

    Source: notes, eqs 71–72; first-order perturbation theory, Kato 1966, II.2.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> moments, q = principal(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> moments, q
    (Array([1., 2., 3.], dtype=float64), Array([1., 0., 0., 0.], dtype=float64))
    """
    moments, axes = eigensystem(_checks.floating(tensor, (3, 3), "tensor"))
    return moments, _quaternion_near_identity(axes)


@jax.custom_jvp
def eigensystem(a: Mat3) -> tuple[Vec3, Mat3]:
    """Ascending eigenvalues and a right-handed matrix of eigenvectors, as columns."""
    # A power of two, so that scaling costs no digit.
    _, exponent = jnp.frexp(jnp.max(jnp.abs(a)))
    values, axes = jnp.linalg.eigh(jnp.ldexp(a, -exponent))
    return jnp.ldexp(values, exponent), _nearest_signs(axes)


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


def _nearest_signs(axes: Mat3) -> Mat3:
    """Flip columns so that the matrix is a rotation, the one with the largest trace."""
    right_handed = jnp.sign(jnp.linalg.det(axes))
    d0, d1, d2 = axes[0, 0], axes[1, 1], axes[2, 2] * right_handed
    choices = jnp.asarray([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=axes.dtype)
    traces = choices[:, 0] * d0 + choices[:, 1] * d1 + choices[:, 2] * d2
    signs = choices[jnp.argmax(traces)]
    signs = signs.at[2].multiply(right_handed)
    return axes * signs[None, :]


def _quaternion_near_identity(m: Mat3) -> Quat:
    """The quaternion of a rotation matrix with trace ≥ 0: no branch is needed."""
    w = 0.5 * jnp.sqrt(1.0 + m[0, 0] + m[1, 1] + m[2, 2])
    f = 0.25 / w
    return jnp.stack([w, f * (m[2, 1] - m[1, 2]), f * (m[0, 2] - m[2, 0]), f * (m[1, 0] - m[0, 1])])
