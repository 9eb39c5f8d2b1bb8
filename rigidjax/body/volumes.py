"""Give volumes of the solids of `shapes`, to make a mass from a density.

`shapes.box(density * volumes.box(size), size)` is differentiable in the density and in the size.
"""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Scalar, ScalarLike, Vector


def box(size: Vector) -> Scalar:
    """Return the volume of a box, m³. **Arguments:** `size` (3,) full edge lengths, m.

    >>> box([1.0, 2.0, 3.0])
    Array(6., dtype=float64)
    """
    a = _checks.array_of_shape(size, (3,), "size")
    return a[0] * a[1] * a[2]


def ellipsoid(semi_axes: Vector) -> Scalar:
    """Return the volume of an ellipsoid, m³, `4π abc/3`. **Arguments:** `semi_axes` (3,) = (a, b,
    c), m.

    >>> round(float(ellipsoid([1.0, 1.0, 0.75])), 12)
    3.14159265359
    """
    return (4.0 * jnp.pi / 3.0) * box(_checks.array_of_shape(semi_axes, (3,), "semi_axes"))


def sphere(radius: ScalarLike) -> Scalar:
    """Return the volume of a sphere, m³, `4π r³/3`. **Arguments:** `radius` m.

    >>> round(float(sphere(1.0)), 12)
    4.188790204786
    """
    return (4.0 * jnp.pi / 3.0) * _checks.array_of_shape(radius, (), "radius") ** 3


def hollow_sphere(inner: ScalarLike, outer: ScalarLike) -> Scalar:
    """Return the volume between two concentric spheres, m³, `4π (R³ − r³)/3`. **Arguments:**
    `inner` radius r and `outer` radius R, m.

    >>> round(float(hollow_sphere(0.0, 1.0)), 12)
    4.188790204786
    """
    r, R = _checks.array_of_shape(inner, (), "inner"), _checks.array_of_shape(outer, (), "outer")
    return (4.0 * jnp.pi / 3.0) * (R - r) * (R * R + R * r + r * r)


def cylinder(radius: ScalarLike, height: ScalarLike) -> Scalar:
    """Return the volume of a cylinder, m³, `π r² h`. **Arguments:** `radius` r, `height` h, m.

    >>> round(float(cylinder(1.0, 1.0)), 12)
    3.14159265359
    """
    r = _checks.array_of_shape(radius, (), "radius")
    return jnp.pi * r * r * _checks.array_of_shape(height, (), "height")


def hollow_cylinder(inner: ScalarLike, outer: ScalarLike, height: ScalarLike) -> Scalar:
    """Return the volume of a tube, m³, `π (R² − r²) h`. **Arguments:** `inner` radius r, `outer`
    radius R, `height` h, m.

    >>> round(float(hollow_cylinder(0.0, 1.0, 1.0)), 12)
    3.14159265359
    """
    r, R = _checks.array_of_shape(inner, (), "inner"), _checks.array_of_shape(outer, (), "outer")
    return jnp.pi * (R - r) * (R + r) * _checks.array_of_shape(height, (), "height")


def capsule(radius: ScalarLike, length: ScalarLike) -> Scalar:
    """Return the volume of a capsule, m³. **Arguments:** `radius`, `length` of the cylindrical
    part, m.

    >>> round(float(capsule(1.0, 0.0)), 12)
    4.188790204786
    """
    return sphere(radius) + cylinder(radius, _checks.array_of_shape(length, (), "length"))


def cone(radius: ScalarLike, height: ScalarLike) -> Scalar:
    """Return the volume of a cone, m³, `π r² h/3`. **Arguments:** `radius` r of the base, `height`
    h, m.

    >>> round(float(cone(1.0, 3.0)), 12)
    3.14159265359
    """
    return cylinder(radius, height) / 3.0


def torus(major: ScalarLike, minor: ScalarLike) -> Scalar:
    """Return the volume of a ring, m³, `2π² R r²`. **Arguments:** `major` radius R of the ring,
    `minor` radius r of the tube, m.

    >>> round(float(torus(0.5, 1.0)), 12)
    9.869604401089
    """
    R, r = _checks.array_of_shape(major, (), "major"), _checks.array_of_shape(minor, (), "minor")
    return 2.0 * jnp.pi**2 * R * r * r


__all__ = [
    "box", "capsule", "cone", "cylinder", "ellipsoid", "hollow_cylinder", "hollow_sphere", "sphere",
    "torus",
]  # fmt: skip

define_dir_and_getattr(__name__)
