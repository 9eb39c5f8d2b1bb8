"""Compute the brightness of a lit body: ellipsoids in closed form, convex meshes by their faces.

The brightness is the light to the observer from all lit and visible surface, `∫ f(μ₀, μ) dA`, where
μ₀ and μ are the cosines of the angles of incidence and emission, and f is the scattering law. Its
unit is an area: each law f is scaled so that a sphere of radius r has the brightness π r² at zero
phase, which means that sun and observer are in the same direction.
"""

import jax.numpy as jnp
from jaxtyping import ArrayLike, Float, Int

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Numbers, Scalar, Vector
from rigidjax.body.meshes import checked_faces
from rigidjax.body.scaling import binary_exponent, times_power_of_two
from rigidjax.tumblers.scattering import (
    AbstractScattering as AbstractScattering,
    Geometric as Geometric,
    Lambert as Lambert,
    LommelSeeliger as LommelSeeliger,
    scattering_or_default,
    unit_direction,
)


def ellipsoid(
    semi_axes: Vector, sun: Vector, observer: Vector, scattering: AbstractScattering | None = None
) -> Scalar:
    """Return the brightness of a triaxial ellipsoid, in square metres.

    The brightness of a sphere of radius r is π r² at zero phase, which means that sun and observer
    are in the same direction. The brightness is differentiable in all numbers, also at zero phase
    and for a sphere. For many directions use `jax.vmap`.

    **Arguments:**

    - `semi_axes`: (3,) the semi-axes along x, y and z, m.
    - `sun`, `observer`: (3,) directions from the body to sun and observer, body frame, of any
      length.
    - `scattering`: the scattering law, `LommelSeeliger()` (also for `None`), `Geometric()` or
      `Lambert()`.

    **Raises:** `ValueError` for a semi-axis that is not positive, a direction of length zero, NaN
    (`equinox` error under `jit`).

    >>> round(float(ellipsoid([3.0, 2.0, 1.0], [0, 0, 1.0], [0, 0, 1.0])) / jnp.pi, 12)
    6.0
    """
    law = scattering_or_default(scattering)
    a = _checks.array_of_shape(semi_axes, (3,), "semi_axes", unit="m")
    a = _checks.require_positive(a, "semi_axes", "three positive lengths, m")
    s, o = (
        unit_direction(v, name).astype(a.dtype)
        for v, name in ((sun, "sun"), (observer, "observer"))
    )
    # The axes are scaled by a power of two, since their fourth powers could overflow.
    size = binary_exponent(a)
    a = times_power_of_two(a, -size)
    return times_power_of_two(law.of_ellipsoid(jnp.diag(a * a), s, o), 2 * size)


def mesh(
    vertices: Float[ArrayLike, "n 3"] | Numbers,
    faces: Int[ArrayLike, "m 3"] | Numbers,
    sun: Vector,
    observer: Vector,
    scattering: AbstractScattering | None = None,
) -> Scalar:
    """Return the brightness of a convex body, m², as the sum `Σ f(μ₀, μ) area` over its lit and
    visible faces.

    Here f is the scattering law, and μ₀ and μ are the cosines of the angles of incidence and
    emission.

    For a body that is not convex the result is the brightness without shadows. The result is
    differentiable in the vertices and directions. If the light or the line of sight just grazes a
    face, the face counts as dark, and its derivatives are zero. Source: Kaasalainen and Torppa
    2001, Icarus 153:24, doi:10.1006/icar.2001.6673.

    **Arguments:**

    - `vertices`: (n, 3) the corners, in metres, body frame.
    - `faces`: (m, 3) the indices of the three corners of each face, counterclockwise as seen from
      outside, as for `rigidjax.shapes.mesh`.
    - `sun`, `observer`, `scattering`: as for `ellipsoid`.

    **Raises:** the errors of `ellipsoid`, and those of `rigidjax.shapes.mesh` for faces.

    >>> corners = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> sides = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    >>> float(mesh(corners, sides, [0, 0, -1.0], [0, 0, -1.0]))
    0.5
    """
    law = scattering_or_default(scattering)
    corners = _checks.array_of_rows(vertices, (3,), "vertices", hint="one row (x, y, z) per vertex")
    if _checks.is_known(corners):
        _checks.require_finite(corners, "vertices")
    table = checked_faces(faces, corners.shape[0])
    s = unit_direction(sun, "sun").astype(corners.dtype)
    o = unit_direction(observer, "observer").astype(corners.dtype)
    first, second, third = (corners[table[:, k]] for k in range(3))
    double = jnp.cross(second - first, third - first)
    to_sun, to_observer = (double * s[None, :]).sum(axis=1), (double * o[None, :]).sum(axis=1)
    size = (double * double).sum(axis=1)
    bright = (to_sun > 0) & (to_observer > 0) & (size > 0)
    # `size` is the square of twice the area of a face. A dark face gets the length one, since for a
    # size of zero the derivative of the square root would be NaN.
    length = jnp.sqrt(jnp.where(bright, size, 1.0))
    cosines = (jnp.where(bright, one, length) / length for one in (to_sun, to_observer))
    return jnp.where(bright, 0.5 * length * law.per_area(*cosines), 0.0).sum()


__all__ = ["AbstractScattering", "Geometric", "Lambert", "LommelSeeliger", "ellipsoid", "mesh"]

define_dir_and_getattr(__name__)
