"""Compute with vectors, quaternions and symmetric matrices that are tuples of scalars.

A symmetric matrix is the tuple of its entries (11, 22, 33, 12, 13, 23). XLA compiles a batch of
such tuples to one kernel; stacked arrays take ten times as long.
"""

import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import Scalar
from rigidjax.rotation.linalg3 import cross_components as cross

# These tuples have 3, 4 and 6 entries. Their types do not state the length, since a type checker
# cannot derive it from a generator.
Triple = tuple[Scalar, ...]
QuaternionEntries = tuple[Scalar, ...]
SymmetricEntries = tuple[Scalar, ...]
# For two symmetric matrices a and b, each given by six entries, ½ Σᵢⱼ aᵢⱼ bᵢⱼ is the sum of the six
# products of their entries, each multiplied by its number in HALF.
HALF = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0)


def add(v: Triple, w: Triple) -> Triple:
    """Return v + w."""
    return v[0] + w[0], v[1] + w[1], v[2] + w[2]


def matvec(matrix: SymmetricEntries, vector: Triple) -> Triple:
    """Return the product of a symmetric matrix and a vector."""
    a, b, c, x, y, z = matrix
    return (
        a * vector[0] + x * vector[1] + y * vector[2],
        x * vector[0] + b * vector[1] + z * vector[2],
        y * vector[0] + z * vector[1] + c * vector[2],
    )


def commuting_product(left: SymmetricEntries, right: SymmetricEntries) -> SymmetricEntries:
    """Return the product of two symmetric matrices that commute; the product is symmetric, too."""
    a, b, c, x, y, z = left
    d, e, f, u, v, w = right
    return (
        a * d + x * u + y * v,
        x * u + b * e + z * w,
        y * v + z * w + c * f,
        a * u + x * e + y * w,
        a * v + x * w + y * f,
        x * v + b * w + z * f,
    )


def symmetric_rows(matrix: SymmetricEntries) -> tuple[Array, ...]:
    """Return the three rows, each (3,), of a symmetric matrix."""
    a, b, c, x, y, z = matrix
    return jnp.stack([a, x, y]), jnp.stack([x, b, z]), jnp.stack([y, z, c])


def determinant(matrix: SymmetricEntries) -> Scalar:
    """Return the determinant of a symmetric matrix."""
    a, b, c, x, y, z = matrix
    return a * b * c + 2.0 * x * y * z - a * z * z - b * y * y - c * x * x


def adjugate(matrix: SymmetricEntries) -> SymmetricEntries:
    """Return the adjugate of a symmetric matrix, which is its determinant times its inverse."""
    a, b, c, x, y, z = matrix
    return (
        b * c - z * z,
        a * c - y * y,
        a * b - x * x,
        y * z - x * c,
        x * z - y * b,
        x * y - z * a,
    )


def half_product(q: QuaternionEntries, vector: Triple) -> QuaternionEntries:
    """Return ½ q ⊗ (0, v), the derivative of q by time if v = `vector` is the body rate."""
    w, x, y, z = q
    a, b, c = 0.5 * vector[0], 0.5 * vector[1], 0.5 * vector[2]
    return (
        -x * a - y * b - z * c,
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    )


def change_unrotated(q: QuaternionEntries, vector: Triple) -> Triple:
    """Return R(q)ᵀ v − v for a unit quaternion q, without a difference of nearly equal numbers."""
    w, *axis = q
    first = cross(vector, tuple(axis))
    second = cross(first, tuple(axis))
    return tuple(2.0 * (w * a + b) for a, b in zip(first, second, strict=True))
