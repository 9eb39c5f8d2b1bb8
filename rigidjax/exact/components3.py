"""Compute with vectors, quaternions and symmetric matrices that are tuples of scalars.

A symmetric matrix is the tuple of its entries (11, 22, 33, 12, 13, 23). XLA compiles a batch of
such tuples to one kernel; stacked arrays take ten times as long.
"""

import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import Scalar
from rigidjax.rotation.linalg3 import cross_components as cross

# The tuples have 3, 4 and 6 entries. Their types do not state the length, since a type checker
# cannot derive it from a generator.
Triple = tuple[Scalar, ...]
Four = tuple[Scalar, ...]
Six = tuple[Scalar, ...]
# For two symmetric matrices a and b, ½ a : b is the sum of the products of their entries, weighted
# by these numbers.
HALF = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0)


def add(a: Triple, b: Triple) -> Triple:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def matvec(m: Six, v: Triple) -> Triple:
    """Return the product of a symmetric matrix m and a vector v."""
    a, b, c, x, y, z = m
    return (
        a * v[0] + x * v[1] + y * v[2],
        x * v[0] + b * v[1] + z * v[2],
        y * v[0] + z * v[1] + c * v[2],
    )


def commuting_product(m: Six, n: Six) -> Six:
    """Return the product of two symmetric matrices that commute, which is symmetric."""
    a, b, c, x, y, z = m
    d, e, f, u, v, w = n
    return (
        a * d + x * u + y * v,
        x * u + b * e + z * w,
        y * v + z * w + c * f,
        a * u + x * e + y * w,
        a * v + x * w + y * f,
        x * v + b * w + z * f,
    )


def symmetric_rows(m: Six) -> tuple[Array, ...]:
    """Return the rows of a symmetric matrix."""
    a, b, c, x, y, z = m
    return jnp.stack([a, x, y]), jnp.stack([x, b, z]), jnp.stack([y, z, c])


def determinant(m: Six) -> Scalar:
    """Return the determinant of a symmetric matrix."""
    a, b, c, x, y, z = m
    return a * b * c + 2.0 * x * y * z - a * z * z - b * y * y - c * x * x


def adjugate(m: Six) -> Six:
    """Return the adjugate of a symmetric matrix: its determinant times its inverse."""
    a, b, c, x, y, z = m
    return (
        b * c - z * z,
        a * c - y * y,
        a * b - x * x,
        y * z - x * c,
        x * z - y * b,
        x * y - z * a,
    )


def half_product(q: Four, v: Triple) -> Four:
    """Return ½ q ⊗ (0, v), where ⊗ is the product of quaternions."""
    w, x, y, z = q
    a, b, c = 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]
    return (
        -x * a - y * b - z * c,
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    )


def change_by_inverse_rotation(q: Four, v: Triple) -> Triple:
    """Return R(q)ᵀ v − v, computed without a difference of large numbers."""
    w, *axis = q
    first = cross(v, tuple(axis))
    second = cross(first, tuple(axis))
    return tuple(2.0 * (w * a + b) for a, b in zip(first, second, strict=True))
