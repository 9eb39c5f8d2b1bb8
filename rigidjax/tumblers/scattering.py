"""Scattering laws: the light from a piece of surface, and from a whole ellipsoid.

r = A u with |u| = 1 maps a sphere to an ellipsoid: `μ₀ dA = det A (p·u) du`, p = A⁻¹ s, and the lit
and visible part becomes the lune between p and q = A⁻¹ o. The result depends only on
`|p|, |q|, p·q`, so on the tensor A² and not on its axes: a sphere is not singular.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Numbers, Scalar, Vec3, Vec3Like
from rigidjax.body.scaling import exponent_of, times_power_of_two
from rigidjax.rotation.linalg3 import apply, cofactors, cross, determinant, dot

# The function of Lommel and Seeliger's law is a series of so many terms below this.
_SMALL, _TERMS = 0.1, 16
# Gauss–Legendre points of both integrals of Lambert's law.
_POINTS = 32

Faces = Float[Array, "*faces"]


class AbstractScattering(eqx.Module):
    """A scattering law: the light from a piece of surface, and from a whole ellipsoid.

    >>> class Flat(AbstractScattering):  # all that is lit and seen is equally bright
    ...     def per_area(self, incidence, emission):
    ...         return emission
    ...     def of_ellipsoid(self, shape, sun, observer):
    ...         return Geometric().of_ellipsoid(shape, sun, observer)
    >>> float(Flat().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    @abc.abstractmethod
    def per_area(self, incidence: Faces, emission: Faces) -> Faces:
        """Brightness over area, of the cosines of incidence and emission, both positive."""

    @abc.abstractmethod
    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        """Brightness, m², of the ellipsoid `r·shape⁻¹r = 1`; `sun`, `observer` of length one."""


class Geometric(AbstractScattering):
    """Every lit piece equally bright: the projected area of the lit and visible part, m².

    Source: Ostro and Connelly 1984, Icarus 57:443, doi:10.1016/0019-1035(84)90127-X.

    >>> float(Geometric().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    def per_area(self, incidence: Faces, emission: Faces) -> Faces:
        return emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        p, _, more, _, _ = _sides(shape, sun, observer)
        return 0.5 * math.pi * _over(more, p)


class LommelSeeliger(AbstractScattering):
    """Single scattering, `2 μ₀ μ/(μ₀ + μ)`: the law of dark surfaces, such as asteroids.

    An ellipsoid has `π (|p||q| + p·q)/(|p| + |q|) [1 − (1 − z²) artanh(z)/z]/z²` with `z = |p +
    q|/(|p| + |q|)`, p and q times the product of the semi-axes. This form of the result of Muinonen
    and Lumme 2015, A&A 584:A23, doi:10.1051/0004-6361/201526456, keeps its digits at any phase. At
    zero phase the second derivative by a direction is −∞ (the brightness is like φ² ln φ there);
    the computed value is finite and wrong.

    >>> float(LommelSeeliger().per_area(jnp.asarray(0.5), jnp.asarray(0.5)))
    0.5
    """

    def per_area(self, incidence: Faces, emission: Faces) -> Faces:
        return 2.0 * incidence * emission / (incidence + emission)

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        p, q, more, w, rest = _sides(shape, sun, observer)
        return math.pi * _over(more, p + q) * (1.0 - rest * _excess(w, rest))


class Lambert(AbstractScattering):
    """`3/2 μ₀ μ`: the law of bright, rough surfaces.

    A triaxial ellipsoid has no elementary form: it needs two integrals of one variable, with 32
    points each. The relative error is below 1e-9 for axes up to 30 : 1 at phases up to 170°. Errors
    of first and second derivatives are below 1e-8 and 1e-6 of the brightness.

    >>> float(Lambert().per_area(jnp.asarray(1.0), jnp.asarray(0.5)))
    0.75
    """

    def per_area(self, incidence: Faces, emission: Faces) -> Faces:
        return 1.5 * incidence * emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        return 1.5 * _lambert(shape, sun, observer)


def law_of(scattering: AbstractScattering | None) -> AbstractScattering:
    """The law; `None` is Lommel and Seeliger's. **Raises** `TypeError` for another type."""
    if scattering is None:
        return LommelSeeliger()
    wanted = "LommelSeeliger(), Geometric() or Lambert()"
    return _checks.instance(scattering, AbstractScattering, "scattering", wanted=wanted)


def direction(value: Vec3Like | Numbers, name: str) -> Vec3:
    """A vector (3,) of length one along `value`. **Raises** for length zero, NaN, a wrong shape."""
    v = _checks.finite(_checks.floating(value, (3,), name), name)
    words = f"{name}: wanted a direction, got a vector of length zero"
    v = _checks.refuse(v, ~(jnp.abs(v) > 0).any(), words)
    # The square of a star's 1e200 m would overflow.
    v = times_power_of_two(v, -exponent_of(v))
    return v / jnp.sqrt(dot(v, v))


def _sides(shape: Mat3, sun: Vec3, observer: Vec3) -> tuple[Scalar, ...]:
    """|p|, |q|, |p||q| + p·q, z² and 1 − z², p and q times the product of the semi-axes."""
    minors = cofactors(shape)
    of_sun, turned = apply(minors, sun), cross(sun, observer)
    pq = dot(observer, of_sun)
    p, q = _root(dot(sun, of_sun)), _root(dot(observer, apply(minors, observer)))
    # |p × q|² without subtraction: what is small at zero phase and opposite to it keeps its digits.
    across = dot(turned, apply(shape, turned)) * determinant(shape)
    ahead = pq > 0
    large = p * q + jnp.where(ahead, pq, -pq)
    small = _over(across, large)
    more, less = jnp.where(ahead, large, small), jnp.where(ahead, small, large)
    rest = _over(2.0 * less, (p + q) * (p + q))
    return p, q, more, 1.0 - rest, rest


def _excess(w: Array, rest: Array) -> Array:
    """`(artanh(√w)/√w − 1)/w`, with `rest` = 1 − w, also of complex numbers; 1/3 at w = 0."""
    near = jnp.abs(w) < _SMALL
    few = jnp.where(near, w, 0.0)
    series = jnp.zeros_like(w)
    for k in reversed(range(_TERMS)):
        series = series * few + 1.0 / (2 * k + 3)
    far = jnp.where(near, 0.5, w)
    z = jnp.sqrt(far)
    lone = jnp.abs(rest) > 0
    # x ln x and its derivative's limit along any direction: at zero phase x is least.
    logarithm = jnp.where(lone, jnp.log(jnp.where(lone, rest, 1.0)), 0.0)
    return jnp.where(near, series, ((jnp.log1p(z) - 0.5 * logarithm) / z - 1.0) / far)


def _lambert(shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
    """`∫ μ₀ μ dA` over the lit and visible part, over normals: dA = det E/(n·En)² dn.

    Over all that is lit, with μ < 0 on its hidden part, it is `sun·T observer`, where
    `T = π det E ∫ (E + τ²)⁻¹ det(E + τ²)^(−½) dτ` from 0 on (both are one Gaussian integral). So
    `B(sun, observer) = sun·T observer + B(sun, −observer)`, and the integral over the smaller lune
    is computed.
    """
    minors = cofactors(shape)
    total, of_sun = shape[0, 0] + shape[1, 1] + shape[2, 2], apply(minors, sun)
    size, second = determinant(shape), minors[0, 0] + minors[1, 1] + minors[2, 2]
    x, w = np.polynomial.legendre.leggauss(_POINTS)
    tangent, w = np.tan(0.25 * np.pi * (1.0 + x)), 0.25 * np.pi * w
    tangent, w = (jnp.asarray(v, size.dtype) for v in (tangent, w * (1.0 + tangent**2)))
    # τ² of the middle point, between the squares of the least and the largest semi-axis.
    middle = jax.lax.stop_gradient(jnp.sqrt(total * size / second))
    square, both = middle * tangent * tangent, dot(sun, observer)
    top = total * both - dot(observer, apply(shape, sun)) + square * both
    top = dot(observer, of_sun) + square * top
    below = size + square * (second + square * (total + square))
    whole = math.pi * size * jnp.sqrt(middle) * jnp.sum(w * top / (below * jnp.sqrt(below)))
    seen = whole > 0
    lune = _across_the_lune(shape, minors, sun, jnp.where(seen, -observer, observer))
    return jnp.where(seen, whole, 0.0) + size * lune


def _across_the_lune(shape: Mat3, minors: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
    """`∫ (n·sun)(n·observer)/(n·En)² dn` over the normals n for which both factors are positive."""
    pole = cross(sun, observer)
    sine, apart = _root(dot(pole, pole)), dot(pole, pole) > jnp.finfo(pole.dtype).eps ** 2
    # Any pole is good if there is hardly a lune.
    least = jnp.eye(3, dtype=pole.dtype)[jnp.argmin(jnp.abs(sun))]
    pole = jnp.where(apart, pole, cross(sun, least))
    pole = pole / jnp.sqrt(dot(pole, pole))
    edge = cross(pole, sun)
    width = jnp.arctan2(jnp.where(apart, sine, 0.0), -dot(sun, observer))
    e_edge, e_pole, turned = apply(shape, edge), apply(shape, pole), apply(minors, edge)
    d0, d1, d2 = dot(sun, apply(minors, sun)), -dot(sun, turned), dot(edge, turned)
    # The integrand has a peak where d is least. In a variable after two of Landen's transformations
    # it has none: nearly that of an elliptic integral.
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
    # With a = c edge + s sun: a·Ea, a·E pole, and the determinant of E on the plane of both.
    mixed = 2.0 * c * dot(sun, e_edge) + s * dot(sun, apply(shape, sun))
    along = c * c * dot(edge, e_edge) + s * mixed
    tilt = c * dot(edge, e_pole) + s * dot(sun, e_pole)
    d = c * c * d0 + s * (2.0 * c * d1 + s * d2)
    root = jnp.sqrt(d)
    e = jax.lax.complex(root / along, -tilt / along)
    square = e * e
    excess = _excess(1.0 - square, square)
    inner = (e + e * (1.0 - square) * excess).real * dot(pole, e_pole) / root
    inner = inner + (square * excess).real
    return jnp.sum(weight * s * jnp.sin(width - angle) * inner / d)


def _root(x: Scalar) -> Scalar:
    """√x, with derivative 0 at zero: an ellipsoid without thickness, seen edge on."""
    some = x > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, x, 1.0)), 0.0)


def _over(x: Scalar, y: Scalar) -> Scalar:
    """x/y, and 0 if y is 0."""
    some = y > 0
    return jnp.where(some, x / jnp.where(some, y, 1.0), 0.0)
