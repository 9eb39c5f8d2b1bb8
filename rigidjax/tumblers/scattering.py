"""Compute how a surface scatters light, for a piece of surface and for a whole ellipsoid.

The map `r = A u`, with a symmetric matrix A and |u| = 1, turns the unit sphere into an ellipsoid.
Let s and o be the unit vectors to sun and observer, `p = A⁻¹ s` and `q = A⁻¹ o`. Then `μ₀ dA = det
A (p·u) du`, where μ₀ is the cosine of the angle of incidence, and the lit and visible part of the
ellipsoid is the lune of the sphere in which p·u and q·u are positive. The result depends only on
|p|, |q| and p·q. These numbers depend on the tensor A² but not on the choice of its principal axes,
so that the formulas are regular for a sphere.
"""

import abc
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Numbers, Scalar, Vec3, Vec3Like
from rigidjax.body.scaling import binary_exponent, times_power_of_two
from rigidjax.rotation.linalg3 import apply, cofactors, cross, determinant, dot

# For arguments below _SMALL the function `_artanh_excess` is computed by a
# series of _TERMS terms.
_SMALL, _TERMS = 0.1, 16
# Each of the two integrals of Lambert's law has this number of Gauss–Legendre points.
_POINTS = 32

ValuePerFace = Float[Array, "*faces"]


class AbstractScattering(eqx.Module):
    """Describe a scattering law by the light from a piece of surface and from a whole ellipsoid.

    To make a law of your own, write a subclass with the methods `per_area` and `of_ellipsoid`.

    >>> class Flat(AbstractScattering):  # all that is lit and seen is equally bright
    ...     def per_area(self, incidence, emission):
    ...         return emission
    ...     def of_ellipsoid(self, shape, sun, observer):
    ...         return Geometric().of_ellipsoid(shape, sun, observer)
    >>> float(Flat().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    @abc.abstractmethod
    def per_area(self, incidence: ValuePerFace, emission: ValuePerFace) -> ValuePerFace:
        """Return the brightness of a piece of surface divided by its area.

        The arguments are cosines, both positive: `incidence` is the cosine of the angle between the
        normal of the surface and the direction to the sun, and `emission` the cosine of the angle
        between the normal and the direction to the observer.
        """

    @abc.abstractmethod
    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        """Return the brightness, m², of the ellipsoid `r·shape⁻¹r = 1`.

        The tensor `shape` (3, 3), m², has the squared semi-axes as eigenvalues. The directions
        `sun` and `observer` (3,) are of length one.
        """


class Geometric(AbstractScattering):
    """Describe the scattering of a surface whose lit pieces are all equally bright.

    The brightness is the projected area of the lit and visible part, m².

    Source: Ostro and Connelly 1984, Icarus 57:443, doi:10.1016/0019-1035(84)90127-X.

    >>> float(Geometric().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    def per_area(self, incidence: ValuePerFace, emission: ValuePerFace) -> ValuePerFace:
        return emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        facing = _facing(shape, sun, observer)
        return 0.5 * math.pi * _ratio_or_zero(facing.more, facing.p)


class LommelSeeliger(AbstractScattering):
    """Describe single scattering, `2 μ₀ μ/(μ₀ + μ)`, as by the dark surfaces of asteroids.

    Here μ₀ and μ are the cosines of the angles of incidence and emission.

    An ellipsoid has the brightness `π (|p||q| + p·q)/(|p| + |q|) [1 − (1 − z²) artanh(z)/z]/z²`
    with `z = |p + q|/(|p| + |q|)`, `p = D A⁻¹ s` and `q = D A⁻¹ o`. Here s and o are the unit
    vectors to sun and observer, A is the symmetric matrix that maps the unit sphere to the
    ellipsoid, and D = det A is the product of the semi-axes. This is a form of the result of
    Muinonen and Lumme 2015, A&A 584:A23, doi:10.1051/0004-6361/201526456, that keeps its digits at
    any phase. The phase φ is the angle between the directions to sun and observer. Near φ = 0 the
    brightness changes as φ² ln φ: the second derivative with respect to a direction is −∞ at φ = 0,
    but its computed value is finite, and wrong.

    >>> float(LommelSeeliger().per_area(jnp.asarray(0.5), jnp.asarray(0.5)))
    0.5
    """

    def per_area(self, incidence: ValuePerFace, emission: ValuePerFace) -> ValuePerFace:
        return 2.0 * incidence * emission / (incidence + emission)

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        p, q, more, w, rest = _facing(shape, sun, observer)
        return math.pi * _ratio_or_zero(more, p + q) * (1.0 - rest * _artanh_excess(w, rest))


class Lambert(AbstractScattering):
    """Describe the scattering of bright, rough surfaces, `3/2 μ₀ μ`.

    Here μ₀ and μ are the cosines of the angles of incidence and emission.

    The brightness of a triaxial ellipsoid has no elementary form: it needs two integrals of one
    variable, with 32 points each. The relative error is below 1e-9 for ratios of axes up to 30 and
    for phases (angles between the directions to sun and observer) up to 170°. The errors of first
    and second derivatives are below 1e-8 and 1e-6 times the brightness.

    >>> float(Lambert().per_area(jnp.asarray(1.0), jnp.asarray(0.5)))
    0.75
    """

    def per_area(self, incidence: ValuePerFace, emission: ValuePerFace) -> ValuePerFace:
        return 1.5 * incidence * emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        return 1.5 * _lambert_integral(shape, sun, observer)


def scattering_or_default(scattering: AbstractScattering | None) -> AbstractScattering:
    """Return the law `scattering`, or the law of Lommel and Seeliger for `None`."""
    if scattering is None:
        return LommelSeeliger()
    wanted = "LommelSeeliger(), Geometric() or Lambert()"
    return _checks.require_instance(
        scattering, AbstractScattering, "scattering", requirement=wanted
    )


def unit_direction(value: Vec3Like | Numbers, name: str) -> Vec3:
    """Return the unit vector along `value` after checks; `name` stands in their messages."""
    v = _checks.require_finite(_checks.array_of_shape(value, (3,), name), name)
    words = f"{name}: wanted a direction, got a vector of length zero"
    v = _checks.error_if(v, ~(jnp.abs(v) > 0).any(), words)
    # The vector is scaled by a power of two, since the square of a distance of 1e200 m would
    # overflow.
    v = times_power_of_two(v, -binary_exponent(v))
    return v / jnp.sqrt(dot(v, v))


class Facing(NamedTuple):
    """Hold the scalars that determine the brightness of an ellipsoid.

    Here p = D A⁻¹ s and q = D A⁻¹ o, where s and o are the unit vectors to sun and observer, A² is
    the tensor `shape` of the ellipsoid, and D = det A is the product of the semi-axes.
    """

    p: Scalar  # |p|
    q: Scalar  # |q|
    more: Scalar  # |p||q| + p·q
    w: Scalar  # z², with z = |p + q|/(|p| + |q|)
    rest: Scalar  # 1 − z²


def _facing(shape: Mat3, sun: Vec3, observer: Vec3) -> Facing:
    """Return the `Facing` of an ellipsoid, without a loss of digits at any angle between the unit
    vectors `sun` and `observer`.
    """
    minors = cofactors(shape)
    of_sun, turned = apply(minors, sun), cross(sun, observer)
    pq = dot(observer, of_sun)
    p, q = _sqrt_or_zero(dot(sun, of_sun)), _sqrt_or_zero(dot(observer, apply(minors, observer)))
    # Here `p` and `q` hold |p| and |q|, `pq` holds p·q, and `across` holds |p × q|². The smaller of
    # the two numbers |p||q| ± p·q is |p × q|² divided by the larger number. Since |p × q|² is
    # computed without a subtraction, the smaller number keeps its digits where sun and observer are
    # in the same or in opposite directions.
    across = dot(turned, apply(shape, turned)) * determinant(shape)
    same_side = pq > 0
    large = p * q + jnp.where(same_side, pq, -pq)
    small = _ratio_or_zero(across, large)
    more, less = jnp.where(same_side, large, small), jnp.where(same_side, small, large)
    rest = _ratio_or_zero(2.0 * less, (p + q) * (p + q))
    return Facing(p, q, more, 1.0 - rest, rest)


def _artanh_excess(w: Array, one_minus_w: Array) -> Array:
    """Return `(artanh(√w)/√w − 1)/w` of real or complex numbers w, also at w = 0, where the value
    is 1/3; 1 − w is given separately since a subtraction would lose its digits near w = 1.
    """
    near = jnp.abs(w) < _SMALL
    few = jnp.where(near, w, 0.0)
    series = jnp.zeros_like(w)
    for k in reversed(range(_TERMS)):
        series = series * few + 1.0 / (2 * k + 3)
    far = jnp.where(near, 0.5, w)
    z = jnp.sqrt(far)
    is_nonzero = jnp.abs(one_minus_w) > 0
    # At zero phase 1 − w is 0, and the caller multiplies the result by 1 − w. The logarithm is set
    # to 0 here, since x ln x tends to 0. The derivative is right as well, since 1 − w has a minimum
    # at zero phase.
    logarithm = jnp.where(is_nonzero, jnp.log(jnp.where(is_nonzero, one_minus_w, 1.0)), 0.0)
    return jnp.where(near, series, ((jnp.log1p(z) - 0.5 * logarithm) / z - 1.0) / far)


def _lambert_integral(shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
    """Return `∫ μ₀ μ dA`, m², over the lit and visible part of an ellipsoid with the tensor E =
    `shape`, where μ₀ and μ are the cosines of the angles of incidence and emission.

    The integral is computed over the unit normals n of the surface, with dA = det E/(n·En)² dn. The
    integral over the whole lit part is `sun·T observer`; there μ is negative where the observer
    does not see the surface. The matrix T is `π det E ∫ (E + τ²)⁻¹ det(E + τ²)^(−½) dτ` from 0 to ∞
    (the integrals over n and over τ are two forms of one Gaussian integral). With B for the
    integral over the lit and visible part, therefore `B(sun, observer) = sun·T observer + B(sun,
    −observer)`. Only the smaller of `B(sun, observer)` and `B(sun, −observer)` is computed as an
    integral over normals, which form a lune of the unit sphere.
    """
    minors = cofactors(shape)
    total, of_sun = shape[0, 0] + shape[1, 1] + shape[2, 2], apply(minors, sun)
    size, second = determinant(shape), minors[0, 0] + minors[1, 1] + minors[2, 2]
    x, w = np.polynomial.legendre.leggauss(_POINTS)
    tangent, w = np.tan(0.25 * np.pi * (1.0 + x)), 0.25 * np.pi * w
    tangent, w = (jnp.asarray(v, size.dtype) for v in (tangent, w * (1.0 + tangent**2)))
    # The middle point of the integration over τ has a τ² between the squares of the smallest and
    # the largest semi-axis.
    middle = jax.lax.stop_gradient(jnp.sqrt(total * size / second))
    square, both = middle * tangent * tangent, dot(sun, observer)
    top = total * both - dot(observer, apply(shape, sun)) + square * both
    top = dot(observer, of_sun) + square * top
    below = size + square * (second + square * (total + square))
    whole = math.pi * size * jnp.sqrt(middle) * jnp.sum(w * top / (below * jnp.sqrt(below)))
    is_large = whole > 0
    lune = _lune_integral(shape, minors, sun, jnp.where(is_large, -observer, observer))
    return jnp.where(is_large, whole, 0.0) + size * lune


def _lune_integral(shape: Mat3, minors: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
    """Return `∫ (n·sun)(n·observer)/(n·En)² dn` over the lune of the unit sphere in which both
    n·sun and n·observer are positive, where E is the tensor `shape` of an ellipsoid and `minors`
    its matrix of cofactors.
    """
    pole = cross(sun, observer)
    sine, apart = _sqrt_or_zero(dot(pole, pole)), dot(pole, pole) > jnp.finfo(pole.dtype).eps ** 2
    # The pole is the axis of the lune, orthogonal to the directions to sun and observer. If these
    # are nearly parallel or opposite, any pole orthogonal to them can be used.
    least = jnp.eye(3, dtype=pole.dtype)[jnp.argmin(jnp.abs(sun))]
    pole = jnp.where(apart, pole, cross(sun, least))
    pole = pole / jnp.sqrt(dot(pole, pole))
    edge = cross(pole, sun)
    width = jnp.arctan2(jnp.where(apart, sine, 0.0), -dot(sun, observer))
    e_edge, e_pole, turned = apply(shape, edge), apply(shape, pole), apply(minors, edge)
    d0, d1, d2 = dot(sun, apply(minors, sun)), -dot(sun, turned), dot(edge, turned)
    # The integral is over an angle. As in an elliptic integral, the integrand has a peak where the
    # determinant d, which is computed below from d0, d1 and d2, has its minimum. Two Landen
    # transformations of the angle remove this peak.
    m0, m1, m2 = (jax.lax.stop_gradient(d) for d in (d0, d1, d2))
    mean, far = 0.5 * (m0 + m2), jnp.sqrt(0.25 * (m0 - m2) ** 2 + m1 * m1)
    first = 0.5 * jnp.arctan2(2.0 * m1, m0 - m2)
    k = jnp.sqrt(jnp.maximum(mean - far, jnp.finfo(mean.dtype).eps * mean) / (mean + far))
    ends, moduli = jnp.stack([-first, width - first]), []
    for _ in range(2):
        c, s = jnp.cos(ends), jnp.sin(ends)
        ends = 2.0 * ends - jnp.arctan2((1.0 - k) * s * c, c * c + k * s * s)
        moduli.append((1.0 - k) / (1.0 + k))
        k = 2.0 * jnp.sqrt(k) / (1.0 + k)
    x, w = (jnp.asarray(v, k.dtype) for v in np.polynomial.legendre.leggauss(_POINTS))
    half = 0.5 * (ends[1] - ends[0])
    angle, weight = ends[0] + half * (1.0 + x), half * w
    for k in reversed(moduli):
        s = k * jnp.sin(angle)
        weight = 0.5 * weight * (1.0 + k * jnp.cos(angle) / jnp.sqrt(1.0 - s * s))
        angle = 0.5 * (angle + jnp.arcsin(s))
    angle = angle + first
    c, s = jnp.cos(angle), jnp.sin(angle)
    # With the unit vector a = c edge + s sun, `along` is a·Ea, `tilt` is a·E pole, and d is the
    # determinant of E restricted to the plane of a and the pole.
    mixed = 2.0 * c * dot(sun, e_edge) + s * dot(sun, apply(shape, sun))
    along = c * c * dot(edge, e_edge) + s * mixed
    tilt = c * dot(edge, e_pole) + s * dot(sun, e_pole)
    d = c * c * d0 + s * (2.0 * c * d1 + s * d2)
    root = jnp.sqrt(d)
    e = jax.lax.complex(root / along, -tilt / along)
    square = e * e
    excess = _artanh_excess(1.0 - square, square)
    inner = (e + e * (1.0 - square) * excess).real * dot(pole, e_pole) / root
    inner = inner + (square * excess).real
    return jnp.sum(weight * s * jnp.sin(width - angle) * inner / d)


def _sqrt_or_zero(x: Scalar) -> Scalar:
    """Return √x of a number x ≥ 0, with the derivative 0 at x = 0 in place of an infinite one: x is
    zero if an ellipsoid without thickness is seen edge on.
    """
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


def _ratio_or_zero(x: Scalar, y: Scalar) -> Scalar:
    """Return x/y for y ≥ 0, or 0 with finite derivatives at y = 0."""
    is_positive = y > 0
    return jnp.where(is_positive, x / jnp.where(is_positive, y, 1.0), 0.0)
