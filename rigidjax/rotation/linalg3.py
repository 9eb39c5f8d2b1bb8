"""Compute with vectors and 3×3 matrices, written on components.

`@` on 3×3 matrices is slow in gradients on CPU and runs in TF32 on some GPUs; the functions of this
module avoid `@`. Range: the products in a formula (of two entries in `cross`, `dot`, `product` and
`apply`, of three in `determinant`, of four in `solve`) must be finite. Entries from 1e-75 to 1e75
are always in range (float32: 1e-9 to 1e9).
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Scalar, Vec3, Vec3Like
from rigidjax.rotation.barrier import computed_once


def components(v: Float[Array, "n"]) -> tuple[Scalar, ...]:
    """Return a vector's entries by one `lax.split`, in gradients faster than by indices."""
    return tuple(part.reshape(()) for part in lax.split(v, (1,) * v.shape[0]))


def entries(m: Float[Array, "3 3"]) -> tuple[Scalar, ...]:
    """Return the nine entries of a matrix, row by row, as scalars."""
    return components(m.reshape(9))


def cross(a: Vec3Like, b: Vec3Like) -> Vec3:
    """Return the vector product a × b of two vectors (3,) in one frame, any units.

    >>> cross(jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    a, b = _checks.array_of_shape(a, (3,), "a"), _checks.array_of_shape(b, (3,), "b")
    return jnp.stack(cross_components(components(a), components(b)))


def cross_components(a: Sequence[Scalar], b: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Return a × b."""
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def dot_components(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def squared_length(v: Sequence[Scalar]) -> Scalar:
    """Return |v|², which XLA computes once: costly functions depend on it."""
    return computed_once(dot_components(v, v))


def power_of_two_scale(*parts: Scalar) -> Scalar:
    """Return the power of two by which the scalars must be multiplied so that the largest is near
    1, with a derivative of zero.

    A formula that does not depend on the length of a vector first multiplies the vector by it: no
    digit is lost, and no square overflows.
    """
    sizes = [jnp.abs(lax.stop_gradient(part)) for part in parts]
    info = jnp.finfo(sizes[0].dtype)
    largest = functools.reduce(jnp.maximum, sizes)
    safe = jnp.clip(largest, 2.0 ** (info.minexp + 2), 2.0 ** (info.maxexp - 2))
    return 1 / lax.reduce_precision(safe, info.nexp, 0)


def hat(w: Vec3Like) -> Mat3:
    """Return the matrix J (3, 3) of the cross product with a vector `w` (3,), any units: J y = w ×
    y (notes, eqs 41–43, 49).

    >>> hat(jnp.array([1.0, 2.0, 3.0])).tolist()
    [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    """
    x, y, z = components(_checks.array_of_shape(w, (3,), "w"))
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def vee(matrix: Mat3Like) -> Vec3:
    """Return the vector w (3,) of an antisymmetric `matrix` A (3, 3), with A y = w × y. Of any
    other A the antisymmetric part is taken: w_i = ½ Tr(A J_iᵀ), where J_i = hat(e_i) is the matrix
    of the basis vector e_i (notes, eqs 52, 53).

    >>> vee(hat(jnp.array([1.0, 2.0, 3.0]))).tolist()
    [1.0, 2.0, 3.0]
    """
    _, b, c, d, _, f, g, h, _ = entries(_checks.array_of_shape(matrix, (3, 3), "matrix"))
    return 0.5 * jnp.stack([h - f, c - g, d - b])


def basis(dtype: DTypeLike = float) -> Float[Array, "3 3 3"]:
    """Return the basis J_1, J_2, J_3 of the antisymmetric matrices, with J_i y = e_i × y for the
    basis vectors e_i, and ½ Tr(J_iᵀ J_j) = δ_ij (notes, eqs 41–43, 53).

    **Arguments:** `dtype` of the (3, 3, 3) array. Eq 16 of the notes prints −J_3, the transpose of
    J_3; eq 42 is right.

    >>> vee(basis()[2]).tolist()
    [0.0, 0.0, 1.0]
    """
    e = jnp.eye(3, dtype=_checks.float_type(dtype))
    return jnp.stack([hat(e[0]), hat(e[1]), hat(e[2])])


def product(a: Mat3Like, b: Mat3Like) -> Mat3:
    """Return the matrix product of `a` and `b`, both (3, 3), computed as sums of products of
    entries: unlike `@`, in full precision on every device.

    >>> product(jnp.eye(3), 2.0 * jnp.eye(3)).tolist()
    [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]
    """
    a, b = _checks.array_of_shape(a, (3, 3), "a"), _checks.array_of_shape(b, (3, 3), "b")
    return jnp.sum(a[:, :, None] * b[None], 1)


def apply(a: Mat3Like, y: Vec3Like) -> Vec3:
    """Return the matrix `a` (3, 3) times the vector `y` (3,), computed as sums of products of
    entries, as in `product`.

    >>> apply(2.0 * jnp.eye(3), jnp.array([1.0, 2.0, 3.0])).tolist()
    [2.0, 4.0, 6.0]
    """
    a, y = _checks.array_of_shape(a, (3, 3), "a"), _checks.array_of_shape(y, (3,), "y")
    return jnp.sum(a * y[None], 1)


def solve(a: Mat3Like, y: Vec3Like) -> Vec3:
    """Solve a x = y for the vector x (3,) by cofactors (Cramer's rule); `a` (3, 3) well
    conditioned, `y` (3,).

    >>> solve(2.0 * jnp.eye(3), jnp.array([2.0, 4.0, 6.0])).tolist()
    [1.0, 2.0, 3.0]
    """
    m = entries(_checks.array_of_shape(a, (3, 3), "a"))
    parts = components(_checks.array_of_shape(y, (3,), "y"))
    p, q, r = m[::3], m[1::3], m[2::3]
    qr, rp, pq = cross_components(q, r), cross_components(r, p), cross_components(p, q)
    return jnp.stack([dot_components(c, parts) for c in (qr, rp, pq)]) / dot_components(p, qr)


def determinant(a: Mat3Like) -> Scalar:
    """Return the determinant of `a` (3, 3): +1 for a rotation, −1 for a reflection (notes, eq 10).

    >>> float(determinant(jnp.eye(3)))
    1.0
    """
    m = entries(_checks.array_of_shape(a, (3, 3), "a"))
    return dot_components(m[:3], cross_components(m[3:6], m[6:]))


def cofactors(a: Mat3) -> Mat3:
    """Return the matrix of cofactors of any matrix a, det a · a⁻ᵀ if a has an inverse."""
    m = entries(a)
    p, q, r = m[:3], m[3:6], m[6:]
    return jnp.stack([jnp.stack(cross_components(*two)) for two in ((q, r), (r, p), (p, q))])


def dot(a: Vec3Like, b: Vec3Like) -> Scalar:
    """Return the scalar product a · b of two vectors (3,) in one frame.

    >>> float(dot(jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])))
    6.0
    """
    a, b = _checks.array_of_shape(a, (3,), "a"), _checks.array_of_shape(b, (3,), "b")
    return dot_components(components(a), components(b))
