"""Compute the equilibrium points, and approximate Lyapunov and halo orbits by Richardson's
expansion.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike
from rigidjax.frames.point import Point
from rigidjax.orbits.differential_correction import PeriodicOrbit


def lagrange_points(mu: Scalar) -> Float[Array, "5 3"]:
    """Return the positions of L1 … L5, rotating axes, for the mass ratio 0 < μ ≤ ½.

    L1, L2 and L3 are roots of Euler's quintic polynomials (Szebehely 1967, sec. 4.4).
    """
    between, beyond, opposite = point_distances(mu)
    half, zero, height = 0.5 - mu, jnp.zeros_like(mu), jnp.full_like(mu, 0.75**0.5)
    x = jnp.stack([1 - mu - between, 1 - mu + beyond, -mu - opposite, half, half])
    y = jnp.stack([zero, zero, zero, height, -height])
    return jnp.stack([x, y, jnp.zeros_like(x)], axis=1)


def point_distances(mu: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return the distances of L1 and of L2 from the second body, and of L3 from the first, in units
    of the distance between the two bodies.
    """
    one = jnp.ones_like(mu)
    hill = jnp.cbrt(mu / (3 * (1 - mu)))
    between = _root([one, mu - 3, 3 - 2 * mu, -mu, 2 * mu, -mu], hill * (1 - hill / 3))
    beyond = _root([one, 3 - mu, 3 - 2 * mu, -mu, -2 * mu, -mu], hill * (1 + hill / 3))
    rest = mu - 1
    opposite = _root([one, 2 + mu, 1 + 2 * mu, rest, 2 * rest, rest], 1 - 7 * mu / 12)
    return between, beyond, opposite


def _root(coefficients: list[Scalar], start: Scalar) -> Scalar:
    """Return a root of a polynomial, whose highest coefficient is first, by seven steps of Newton's
    method, which are enough from the estimates of `point_distances` for every mass ratio.
    """

    def newton_step(_: object, x: Scalar) -> Scalar:
        value, slope = coefficients[0], jnp.zeros_like(x)
        for c in coefficients[1:]:
            value, slope = value * x + c, slope * x + value
        return x - value / slope

    return lax.fori_loop(0, 7, newton_step, start)


def orbit_guess(
    mu: Scalar, point: int, along_x: ScalarLike | None, along_z: ScalarLike | None
) -> PeriodicOrbit:
    """Return an approximate orbit about L1, L2 or L3 that starts on the xz-plane: a planar Lyapunov
    orbit with the amplitude `along_x`, or a halo orbit with the amplitude `along_z`, whose sign
    selects the branch.

    The amplitude must be small compared with the distance from the point to the nearer body.
    Source: Richardson 1980, Celest. Mech. 22, 241, doi:10.1007/BF01229511, where the orbit has the
    phase τ = 0 at its start.
    """
    if point not in (1, 2, 3):
        raise ValueError(f"point: wanted 1, 2 or 3, a collinear point, got {point}")
    unit = point_distances(mu)[point - 1]
    c2, c3, c4 = (_potential_term(mu, unit, point, n) for n in (2, 3, 4))
    rate = jnp.sqrt(0.5 * (2 - c2 + jnp.sqrt((c2 - 2) ** 2 + 4 * (c2 - 1) * (1 + 2 * c2))))
    w, w2 = rate, rate * rate
    k = 2 * w / (w2 + 1 - c2)
    k2 = k * k
    d1 = 3 * w2 / k * (k * (6 * w2 - 1) - 2 * w)
    d2 = 8 * w2 / k * (k * (11 * w2 - 1) - 2 * w)
    a21 = 3 * c3 * (k2 - 2) / (4 * (1 + 2 * c2))
    a22 = 3 * c3 / (4 * (1 + 2 * c2))
    a23 = -3 * c3 * w / (4 * k * d1) * (3 * k2 * k * w - 6 * k * (k - w) + 4)
    a24 = -3 * c3 * w / (4 * k * d1) * (2 + 3 * k * w)
    b21 = -3 * c3 * w / (2 * d1) * (3 * k * w - 4)
    b22 = 3 * c3 * w / d1
    d21 = -c3 / (2 * w2)
    e1 = 4 * c3 * (k * a23 - b21) + k * c4 * (4 + k2)
    e2 = 3 * c3 * (2 * a23 - k * b21) + c4 * (2 + 3 * k2)
    e3 = 4 * c3 * (k * a24 - b22) + k * c4
    e4 = c3 * (k * b22 + d21 - 2 * a24) - c4
    a31 = -9 * w / (4 * d2) * e1 + (9 * w2 + 1 - c2) / (2 * d2) * e2
    a32 = -(9 * w / 4 * e3 + 1.5 * (9 * w2 + 1 - c2) * e4) / d2
    b31 = 3 / (8 * d2) * (-8 * w * e2 + (9 * w2 + 1 + 2 * c2) * e1)
    b32 = (9 * w * e4 + 0.375 * (9 * w2 + 1 + 2 * c2) * e3) / d2
    d31 = 3 / (64 * w2) * (4 * c3 * a24 + c4)
    d32 = 3 / (64 * w2) * (4 * c3 * (a23 - d21) + c4 * (4 + k2))
    below = 2 * w * (w * (1 + k2) - 2 * k)
    s1 = 1.5 * c3 * (2 * a21 * (k2 - 2) - a23 * (k2 + 2) - 2 * k * b21)
    s1 = (s1 - 0.375 * c4 * (3 * k2 * k2 - 8 * k2 + 8)) / below
    s2 = 1.5 * c3 * (2 * a22 * (k2 - 2) + a24 * (k2 + 2) + 2 * k * b22 + 5 * d21)
    s2 = (s2 + 0.375 * c4 * (12 - k2)) / below
    # In Richardson's solution b33 and b34 are terms of third order in the first harmonic of y. The
    # first harmonic of x has no such terms: it is the amplitude itself.
    b33 = 12 * c3 * (b21 - 2 * k * a21 + k * a23) + 3 * c4 * k * (3 * k2 - 4)
    b33 = -k / (16 * w) * (b33 + 16 * s1 * w * (w * k - 1))
    b34 = -12 * c3 * k * a22 + 3 * c4 * k + 8 * s2 * w * (w * k - 1)
    b34 = -k / (16 * w) * (2 * b34 - 12 * c3 * (b22 + k * a24) - 3 * c4 * k)
    if along_z is None:
        ax, az = _checked_amplitude(along_x) / unit, jnp.zeros_like(unit)
    else:
        az = _checked_amplitude(along_z) / unit
        a1 = -1.5 * c3 * (2 * a21 + a23 + 5 * d21) - 0.375 * c4 * (12 - k2)
        a2 = 1.5 * c3 * (a24 - 2 * a22) + 1.125 * c4
        square = -((a2 + 2 * w2 * s2) * az * az + w2 - c2) / (a1 + 2 * w2 * s1)
        words = "halo_guess: no halo orbit of this amplitude by the expansion"
        square = _checks.error_if(square, ~(square > 0), words)
        ax = jnp.sqrt(square)
    x2, z2 = ax * ax, az * az
    sweep = w * (1 + s1 * x2 + s2 * z2)
    x = a21 * x2 + a22 * z2 - ax + a23 * x2 - a24 * z2 + ax * (a31 * x2 - a32 * z2)
    y_rate = k * ax + 2 * (b21 * x2 - b22 * z2) + 3 * ax * (b31 * x2 - b32 * z2)
    y_rate = y_rate + ax * (b33 * x2 + b34 * z2)
    z = az - 2 * d21 * ax * az + az * (d32 * x2 - d31 * z2)
    centre, zero = lagrange_points(mu)[point - 1, 0], jnp.zeros_like(x)
    place, speed = jnp.stack([centre + unit * x, zero, unit * z]), unit * sweep * y_rate
    return PeriodicOrbit(Point(place, jnp.stack([zero, speed, zero])), 2 * math.pi / sweep)


def _checked_amplitude(value: ScalarLike | None) -> Scalar:
    """Return an amplitude as one finite number, or raise an error, also for `None`."""
    return _checks.require_finite(_checks.array_of_shape(value, (), "amplitude"), "amplitude")


def _potential_term(mu: Scalar, point_distance: Scalar, point: int, n: int) -> Scalar:
    """Return the coefficient c_n of the potential about a collinear point, in units of the distance
    of the point from the nearer body (Richardson 1980, eq 8).
    """
    g = point_distance
    if point == 3:
        return ((1 - mu) + mu * (g / (1 + g)) ** (n + 1)) / g**3
    side = 1.0 if point == 1 else (-1.0) ** n
    far = g / (1 - g) if point == 1 else g / (1 + g)
    return (side * mu + (-1.0) ** n * (1 - mu) * far ** (n + 1)) / g**3
