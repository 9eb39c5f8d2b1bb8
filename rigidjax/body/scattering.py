"""Laws of scattering: what a piece of surface sends, and an ellipsoid as a whole (floor 1).

With r = A u and |u| = 1 an ellipsoid becomes a sphere: `μ₀ dA = det A (p·u) du`, p = A⁻¹ s, and
what is lit and seen becomes the lune between p and q = A⁻¹ o. All of it depends on `|p|, |q|, p·q`
alone, so on the tensor A² and not on its axes: nothing is singular for a sphere.
"""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Scalar, Vec3, Vec3Like
from rigidjax.body._types import Numbers
from rigidjax.rotation.linalg3 import cross, dot, entries
from rigidjax.special.scaling import exponent_of, times_power_of_two

# Below it the function of Lommel and Seeliger's law is a series, of so many terms.
_SMALL, _TERMS = 0.1, 16
# Gauss–Legendre points across and along the lune, for Lambert's law.
_ACROSS, _ALONG = 12, 24


class AbstractScattering(eqx.Module):
    """A law of scattering: what a piece of surface sends, and a whole ellipsoid.

    >>> class Flat(AbstractScattering):  # all that is lit and seen is equally bright
    ...     def per_area(self, incidence, emission):
    ...         return emission
    ...     def of_ellipsoid(self, shape, sun, observer):
    ...         return Geometric().of_ellipsoid(shape, sun, observer)
    >>> float(Flat().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    @abc.abstractmethod
    def per_area(
        self, incidence: Float[Array, "*faces"], emission: Float[Array, "*faces"]
    ) -> Float[Array, "*faces"]:
        """Brightness over area, of the cosines of incidence and emission, both positive."""

    @abc.abstractmethod
    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        """Brightness, m², of the ellipsoid `r·shape⁻¹r = 1`; `sun`, `observer` of length one."""


class Geometric(AbstractScattering):
    """Every lit piece equally bright: what is lit and seen, as it is projected, m².

    Ostro and Connelly 1984, Icarus 57:443, doi:10.1016/0019-1035(84)90127-X.

    >>> float(Geometric().per_area(jnp.asarray(0.5), jnp.asarray(0.25)))
    0.25
    """

    def per_area(
        self, incidence: Float[Array, "*faces"], emission: Float[Array, "*faces"]
    ) -> Float[Array, "*faces"]:
        return emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        p, _, more, _, _ = _sides(shape, sun, observer)
        return 0.5 * math.pi * _over(more, p)


class LommelSeeliger(AbstractScattering):
    """Light scattered once, `2 μ₀ μ/(μ₀ + μ)`: the law of dark surfaces, as asteroids have.

    Of an ellipsoid `π (|p||q| + p·q)/(|p| + |q|) [1 − (1 − z²) artanh(z)/z]/z²` with
    `z = |p + q|/(|p| + |q|)`, p and q times the product of the semi-axes. A form of the closed
    result of Muinonen and Lumme 2015, A&A 584:A23, doi:10.1051/0004-6361/201526456, that keeps its
    digits at any phase.

    >>> float(LommelSeeliger().per_area(jnp.asarray(0.5), jnp.asarray(0.5)))
    0.5
    """

    def per_area(
        self, incidence: Float[Array, "*faces"], emission: Float[Array, "*faces"]
    ) -> Float[Array, "*faces"]:
        return 2.0 * incidence * emission / (incidence + emission)

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        p, q, more, w, rest = _sides(shape, sun, observer)
        return math.pi * _over(more, p + q) * _lune(w, rest)


class Lambert(AbstractScattering):
    """`3/2 μ₀ μ`: the law of bright, rough surfaces.

    Of a triaxial ellipsoid it has no elementary form: Gauss–Legendre points on the lune, 12 across
    and 24 along it, give six digits or more of axes up to 3 : 1.

    >>> float(Lambert().per_area(jnp.asarray(1.0), jnp.asarray(0.5)))
    0.75
    """

    def per_area(
        self, incidence: Float[Array, "*faces"], emission: Float[Array, "*faces"]
    ) -> Float[Array, "*faces"]:
        return 1.5 * incidence * emission

    def of_ellipsoid(self, shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
        return 1.5 * _lambert(shape, sun, observer)


def law_of(scattering: AbstractScattering | None) -> AbstractScattering:
    """The law; of `None` Lommel and Seeliger's. **Raises** `TypeError` for what is none."""
    if scattering is None:
        return LommelSeeliger()
    wanted = "LommelSeeliger(), Geometric() or Lambert()"
    return _checks.instance(scattering, AbstractScattering, "scattering", wanted=wanted)


def direction(value: Vec3Like | Numbers, name: str) -> Vec3:
    """A vector (3,) of length one along `value`. **Raises** for length zero, NaN, a wrong shape."""
    v = _checks.finite(_checks.floating(value, (3,), name), name)
    v = _checks.refuse(
        v, ~(jnp.abs(v) > 0).any(), f"{name}: wanted a direction, got a vector of length zero"
    )
    # Of a star's 1e200 m the square would overflow.
    v = times_power_of_two(v, -exponent_of(v))
    return v / jnp.sqrt(dot(v, v))


def _sides(shape: Mat3, sun: Vec3, observer: Vec3) -> tuple[Scalar, ...]:
    """|p|, |q|, |p||q| + p·q, z² and 1 − z², p and q times the product of the semi-axes."""
    xx, xy, xz, _, yy, yz, _, _, zz = entries(shape)
    c00, c11, c22 = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    c01, c02, c12 = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    (s0, s1, s2), (o0, o1, o2) = (tuple(v[k] for k in range(3)) for v in (sun, observer))
    m0, m1, m2 = (
        c00 * s0 + c01 * s1 + c02 * s2,
        c01 * s0 + c11 * s1 + c12 * s2,
        c02 * s0 + c12 * s1 + c22 * s2,
    )
    pp, pq = s0 * m0 + s1 * m1 + s2 * m2, o0 * m0 + o1 * m1 + o2 * m2
    qq = c00 * o0 * o0 + c11 * o1 * o1 + c22 * o2 * o2
    qq = qq + 2.0 * (c01 * o0 * o1 + c02 * o0 * o2 + c12 * o1 * o2)
    p, q = _root(pp), _root(qq)
    # |p × q|² without subtraction: what is small at zero phase and opposite to it keeps its digits.
    n0, n1, n2 = s1 * o2 - s2 * o1, s2 * o0 - s0 * o2, s0 * o1 - s1 * o0
    turned = xx * n0 * n0 + yy * n1 * n1 + zz * n2 * n2
    turned = turned + 2.0 * (xy * n0 * n1 + xz * n0 * n2 + yz * n1 * n2)
    across = turned * (xx * c00 + xy * c01 + xz * c02)
    ahead = pq > 0
    large = p * q + jnp.where(ahead, pq, -pq)
    small = _over(across, large)
    more, less = jnp.where(ahead, large, small), jnp.where(ahead, small, large)
    rest = _over(2.0 * less, (p + q) * (p + q))
    return p, q, more, 1.0 - rest, rest


def _lune(w: Scalar, rest: Scalar) -> Scalar:
    """`[1 − (1 − w) artanh(√w)/√w]/w`, with `rest` = 1 − w; 2/3 at w = 0, 1 at w = 1."""
    near = w < _SMALL
    few = jnp.where(near, w, 0.0)
    series = jnp.zeros_like(w)
    for k in reversed(range(_TERMS)):
        series = series * few + 2.0 / ((2 * k + 1) * (2 * k + 3))
    far = jnp.where(near, 0.5, w)
    z = jnp.sqrt(far)
    lone = rest > 0
    # x ln x and its derivative's limit along any direction: at zero phase x is least.
    logarithm = jnp.where(lone, jnp.log(jnp.where(lone, rest, 1.0)), 0.0)
    return jnp.where(near, series, (1.0 - rest * (jnp.log1p(z) - 0.5 * logarithm) / z) / far)


def _lambert(shape: Mat3, sun: Vec3, observer: Vec3) -> Scalar:
    """`∫ μ₀ μ dA` over what is lit and seen, by points on the lune between p and q."""
    # r = L u with the triangular root L of the tensor.
    xx, xy, xz, _, yy, yz, _, _, zz = entries(shape)
    a = jnp.sqrt(xx)
    b, c = xy / a, xz / a
    d = jnp.sqrt(yy - b * b)
    e = (yz - b * c) / d
    f = jnp.sqrt(zz - c * c - e * e)

    def back(v: Vec3) -> Vec3:
        x = v[0] / a
        y = (v[1] - b * x) / d
        return jnp.stack([x, y, (v[2] - c * x - e * y) / f])

    p, q = back(sun), back(observer)
    first = p / jnp.sqrt(dot(p, p))
    pole = cross(p, q)
    size, whole = dot(pole, pole), dot(p, p) * dot(q, q)
    apart = size > jnp.finfo(size.dtype).eps * whole
    # At zero phase any pole will do; what the lune's edge moves is of second order.
    least = jnp.eye(3, dtype=p.dtype)[jnp.argmin(jnp.abs(p))]
    pole = jnp.where(apart, pole, cross(first, least))
    pole = pole / jnp.sqrt(dot(pole, pole))
    sine = jnp.sqrt(jnp.where(apart, size, 1.0))
    ahead = jnp.where(dot(p, q) > 0, 0.0, math.pi)
    angle = jnp.where(apart, jnp.arctan2(sine, dot(p, q)), ahead)
    second = cross(pole, first)
    x, wx = np.polynomial.legendre.leggauss(_ACROSS)
    y, wy = np.polynomial.legendre.leggauss(_ALONG)
    x, wx, y, wy = (jnp.asarray(v, p.dtype) for v in (x, wx, y, wy))
    half = 0.5 * (math.pi - angle)
    phi, psi = 0.5 * angle + half * x, 0.5 * math.pi * y
    around = jnp.cos(phi)[:, None] * first[None, :] + jnp.sin(phi)[:, None] * second[None, :]
    u = jnp.cos(psi)[None, :, None] * around[:, None, :] + (
        jnp.sin(psi)[None, :, None] * pole[None, None, :]
    )
    weight = half * wx[:, None] * (0.5 * math.pi * wy * jnp.cos(psi))[None, :]
    # |L⁻ᵀu|: how much longer the surface is there.
    k = u[..., 2] / f
    j = (u[..., 1] - e * k) / d
    i = (u[..., 0] - b * j - c * k) / a
    longer = jnp.sqrt(i * i + j * j + k * k)
    lit = u[..., 0] * p[0] + u[..., 1] * p[1] + u[..., 2] * p[2]
    seen = u[..., 0] * q[0] + u[..., 1] * q[1] + u[..., 2] * q[2]
    return a * d * f * jnp.sum(weight * lit * seen / longer)


def _root(x: Scalar) -> Scalar:
    """√x, with no derivative at zero: an ellipsoid without thickness, seen edge on."""
    some = x > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, x, 1.0)), 0.0)


def _over(x: Scalar, y: Scalar) -> Scalar:
    """x/y, and 0 where y is none."""
    some = y > 0
    return jnp.where(some, x / jnp.where(some, y, 1.0), 0.0)
