"""Give mass properties of solids, shells, plates and rods in closed form.

Each function takes the mass and then the dimensions, and is differentiable with respect to all
arguments. It raises `ValueError` for a mass ≤ 0 or a negative length. Every shape has its **centre
of mass at the origin** and its axis of symmetry, if it has one, along z. Place it with `.rotate`
and `.shift`, join bodies with `+`, cut away with `-`. For a density use `rigidjax.volumes`:
`box(density * volumes.box(size), size)`.

The formulas give the second moment 𝔖 = ∫ r rᵀ dm (notes, eq 60), diagonal in these axes; the
moments of inertia are `I1 = λ2 + λ3`, … (eqs 76–78).
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Numbers, NumbersLike, ScalarLike, Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.body.meshes import mesh as mesh, mesh_file as mesh_file
from rigidjax.body.point_masses import points as points, quadrature as quadrature, voxels as voxels


def box(mass: ScalarLike, size: Vector) -> MassProperties:
    """Return a solid box of `mass` m, kg, and full edge lengths `size` (3,) = (a, b, c), in metres.
    The second moment ∫ r rᵀ dm is `𝔖 = m diag(a², b², c²)/12`.

    >>> box(12.0, [1.0, 2.0, 3.0]).inertia.moments
    Array([ 5., 10., 13.], dtype=float64)
    """
    edges = _checked_lengths(size, (3,), "size")
    return _body_at_centre(mass, edges * edges / 12.0)


def ellipsoid(mass: ScalarLike, semi_axes: Vector) -> MassProperties:
    """Return a solid ellipsoid of `mass` m, kg, and `semi_axes` (3,) = (a, b, c), in metres. The
    second moment ∫ r rᵀ dm is `𝔖 = m diag(a², b², c²)/5`.

    >>> ellipsoid(5.0, [1.0, 2.0, 3.0]).inertia.moments
    Array([ 5., 10., 13.], dtype=float64)
    """
    half = _checked_lengths(semi_axes, (3,), "semi_axes")
    return _body_at_centre(mass, half * half / 5.0)


def sphere(mass: ScalarLike, radius: ScalarLike) -> MassProperties:
    """Return a solid sphere of `mass` m, kg, and `radius` R, in metres. The second moment ∫ r rᵀ dm
    is `𝔖 = m R²/5 · 1`, with the unit matrix 1, and the inertia tensor is `I = ⅖ m R² · 1`.

    >>> sphere(5.0, 1.0).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    r = _checked_lengths(radius, (), "radius")
    return _body_at_centre(mass, _axisymmetric_diagonal(r * r / 5.0, r * r / 5.0))


def hollow_sphere(mass: ScalarLike, inner: ScalarLike, outer: ScalarLike) -> MassProperties:
    """Return a ball with a concentric hole. Its three principal second moments are `λ = m/5 · (R⁵ −
    r⁵)/(R³ − r³)`, computed with the factor R − r cancelled.

    **Arguments:** `mass` m, kg; radii `inner` r ≤ `outer` R, in metres; equal radii give a shell.

    >>> hollow_sphere(3.0, 1.0, 1.0).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    r, R = _checked_radii(inner, outer)
    # The formula for λ is written as m R²/5 times a ratio that depends on u = r/R only, so that no
    # fifth power of a radius overflows; thin shells lose no digit.
    u = r / R
    ratio = (1.0 + u * (1.0 + u * (1.0 + u * (1.0 + u)))) / (1.0 + u * (1.0 + u))
    return _body_at_centre(mass, _axisymmetric_diagonal(R * R * ratio / 5.0, R * R * ratio / 5.0))


def shell(mass: ScalarLike, radius: ScalarLike) -> MassProperties:
    """Return a thin spherical shell of `mass` m, kg, and `radius` R, in metres. The second moment ∫
    r rᵀ dm is `𝔖 = m R²/3 · 1`, with the unit matrix 1.

    >>> shell(3.0, 1.0).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    r = _checked_lengths(radius, (), "radius")
    return _body_at_centre(mass, _axisymmetric_diagonal(r * r / 3.0, r * r / 3.0))


def cylinder(mass: ScalarLike, radius: ScalarLike, height: ScalarLike) -> MassProperties:
    """Return a solid cylinder along z of `mass` m, kg, `radius` R and `height` h, in metres. The
    second moment ∫ r rᵀ dm is `𝔖 = m diag(R²/4, R²/4, h²/12)`.

    >>> cylinder(12.0, 1.0, 1.0).inertia.moments
    Array([4., 4., 6.], dtype=float64)
    """
    r, h = _checked_lengths(radius, (), "radius"), _checked_lengths(height, (), "height")
    return _body_at_centre(mass, _axisymmetric_diagonal(r * r / 4.0, h * h / 12.0))


def hollow_cylinder(
    mass: ScalarLike, inner: ScalarLike, outer: ScalarLike, height: ScalarLike
) -> MassProperties:
    """Return a tube along z. The second moment ∫ x xᵀ dm over the positions x is `𝔖 = m diag((R² +
    r²)/4, (R² + r²)/4, h²/12)`; equal radii give a thin tube.

    **Arguments:** `mass` m, kg; radii `inner` r ≤ `outer` R, and `height` h, in metres.

    >>> hollow_cylinder(2.0, 1.0, 1.0, 0.0).inertia.moments
    Array([1., 1., 2.], dtype=float64)
    """
    (r, R), h = _checked_radii(inner, outer), _checked_lengths(height, (), "height")
    return _body_at_centre(mass, _axisymmetric_diagonal((r * r + R * R) / 4.0, h * h / 12.0))


def capsule(mass: ScalarLike, radius: ScalarLike, length: ScalarLike) -> MassProperties:
    """Return a cylinder along z with a half ball on each end, of one density.

    The cylinder has the fraction `f = h/(h + 4r/3)` of the mass. The principal second moments,
    divided by the mass, are `f r²/4 + (1 − f) r²/5` across the axis and `f h²/12 + (1 − f)(r²/5 +
    3hr/8 + h²/4)` along the axis. **Arguments:** `mass` kg; `radius` r > 0, m; `length` h of the
    cylindrical part alone, m.

    >>> capsule(5.0, 1.0, 0.0).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    r, h = _checked_lengths(radius, (), "radius"), _checked_lengths(length, (), "length")
    f = h / (h + 4.0 * r / 3.0)
    ends = (4.0 * r / 3.0) / (h + 4.0 * r / 3.0)
    across = f * r * r / 4.0 + ends * r * r / 5.0
    along = f * h * h / 12.0 + ends * (r * r / 5.0 + 3.0 * h * r / 8.0 + h * h / 4.0)
    return _body_at_centre(mass, _axisymmetric_diagonal(across, along))


def cone(mass: ScalarLike, radius: ScalarLike, height: ScalarLike) -> MassProperties:
    """Return a solid cone along z. The second moment ∫ x xᵀ dm over the positions x is `𝔖 = m
    diag(3r²/20, 3r²/20, 3h²/80)`.

    **Arguments:** `mass` m, kg; `radius` r of the base, and `height` h, in metres. The centre of
    mass, at the origin, is h/4 above the base.

    >>> cone(80.0, 1.0, 2.0).inertia.moments
    Array([24., 24., 24.], dtype=float64)
    """
    r, h = _checked_lengths(radius, (), "radius"), _checked_lengths(height, (), "height")
    return _body_at_centre(mass, _axisymmetric_diagonal(3.0 * r * r / 20.0, 3.0 * h * h / 80.0))


def torus(mass: ScalarLike, major: ScalarLike, minor: ScalarLike) -> MassProperties:
    """Return a solid ring around z. The second moment ∫ x xᵀ dm over the positions x is `𝔖 = m
    diag(R²/2 + 3r²/8, R²/2 + 3r²/8, r²/4)`; `minor` 0 gives a hoop.

    **Arguments:** `mass` m, kg; `major` radius R, from the centre of the ring to the middle of the
    tube, and `minor` radius r ≤ R of the tube, in metres.

    >>> torus(2.0, 1.0, 0.0).inertia.moments
    Array([1., 1., 2.], dtype=float64)
    """
    r, R = _checked_radii(minor, major, names=("minor", "major"))
    return _body_at_centre(
        mass, _axisymmetric_diagonal(R * R / 2.0 + 3.0 * r * r / 8.0, r * r / 4.0)
    )


def rod(mass: ScalarLike, length: ScalarLike) -> MassProperties:
    """Return a thin rod along z of `mass` m, kg, and `length` ℓ, in metres; its moment of inertia
    about z is zero. The second moment ∫ r rᵀ dm is `𝔖 = m diag(0, 0, ℓ²/12)`.

    >>> rod(12.0, 1.0).inertia.moments
    Array([0., 1., 1.], dtype=float64)
    """
    h = _checked_lengths(length, (), "length")
    return _body_at_centre(mass, _axisymmetric_diagonal(jnp.zeros_like(h), h * h / 12.0))


def plate(mass: ScalarLike, size: Float[ArrayLike, "2"] | Numbers) -> MassProperties:
    """Return a thin rectangular plate in the x–y plane of `mass` m, kg, and full edge lengths
    `size` (2,) = (a, b), in metres. The second moment ∫ r rᵀ dm is `𝔖 = m diag(a², b², 0)/12`.

    >>> plate(12.0, [1.0, 2.0]).inertia.moments
    Array([1., 4., 5.], dtype=float64)
    """
    edges = _checked_lengths(size, (2,), "size")
    return _body_at_centre(mass, jnp.concatenate([edges * edges / 12.0, jnp.zeros_like(edges[:1])]))


def _checked_lengths(value: NumbersLike, shape: tuple[int, ...], name: str) -> Array:
    """Return lengths, m, as an array, or raise an error if one is known and below zero or NaN."""
    lengths = _checks.finite_array(value, shape, name, unit="m")
    return _checks.check_if_known(
        _checks.require_positive, lengths, name, "lengths ≥ 0 (m)", allow_zero=True
    )


def _checked_radii(
    inner: ScalarLike, outer: ScalarLike, names: tuple[str, str] = ("inner", "outer")
) -> tuple[Array, Array]:
    """Return both radii, m; raise an error for known ones below 0 or in the wrong order."""
    r, R = _checked_lengths(inner, (), names[0]), _checked_lengths(outer, (), names[1])
    if _checks.is_known((r, R)):
        _checks.error_if(
            r, r > R, f"{names[0]}: wanted {names[0]} ≤ {names[1]}, got {r} and {R} (m)"
        )
    return r, R


def _axisymmetric_diagonal(transverse: Array, axial: Array) -> Float[Array, "3"]:
    """Return the diagonal of a matrix that is symmetric about the z axis."""
    return jnp.stack([transverse, transverse, axial])


def _body_at_centre(mass: ScalarLike, second_moments_per_mass: Float[Array, "3"]) -> MassProperties:
    """Return the body with its centre of mass at the origin and the principal second moments ∫ x²
    dm, ∫ y² dm, ∫ z² dm, given divided by the mass, m².
    """
    m = _checks.array_of_shape(mass, (), "mass")
    com = jnp.zeros_like(second_moments_per_mass)
    return MassProperties(m, com, jnp.diag(m * second_moments_per_mass))


__all__ = [
    "box", "capsule", "cone", "cylinder", "ellipsoid", "hollow_cylinder", "hollow_sphere", "mesh",
    "mesh_file", "plate", "points", "quadrature", "rod", "shell", "sphere", "torus", "voxels",
]  # fmt: skip

define_dir_and_getattr(__name__)
