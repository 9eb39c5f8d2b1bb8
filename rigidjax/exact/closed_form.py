"""Compute the motion of a free body in principal axes; vectors and quaternions are tuples of
scalars.

The module `rigidjax.exact.derivatives` has the derivatives of these values.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar
from rigidjax.exact.components3 import Four, Triple
from rigidjax.exact.jacobi_duplication import (
    Elliptic,
    HalfPeriod,
    Modulus,
    clip_at_rest,
    duplicate,
    elliptic,
    half_period,
)
from rigidjax.rotation.barrier import barrier, compiled_as_one_kernel


class Orbit(NamedTuple):
    """Hold the constants of a free motion, in principal axes that are labelled 1, 2, 3 in ascending
    or descending order of their moments.
    """

    a: Scalar  # the reciprocal of the moment of axis 1
    d12: Scalar  # 1/I₁ − 1/I₂
    d13: Scalar  # 1/I₁ − 1/I₃
    d23: Scalar  # 1/I₂ − 1/I₃
    P: Triple  # the initial momentum
    h: Scalar  # the length of the momentum
    modulus: Modulus
    mu: Scalar  # the number μ of the phase ξ (see `elliptic`)
    turn: Scalar  # the factor of the phase ξ (see `elliptic`)
    half: HalfPeriod
    swapped: Float[Array, ""]  # whether axis 1 has the largest moment


@compiled_as_one_kernel
def orbit(moments: Triple, momentum: Triple) -> Orbit:
    """Return the constants of the motion of a body with the principal moments I₁ ≤ I₂ ≤ I₃, any of
    which may be equal, and the initial body momentum `momentum`.
    """
    (i1, i2, i3), (p1, p2, p3) = moments, momentum
    r1, r2, r3 = 1.0 / i1, 1.0 / i2, 1.0 / i3
    d12, d13, d23 = (i2 - i1) * (r1 * r2), (i3 - i1) * (r1 * r3), (i3 - i2) * (r2 * r3)
    A1 = d12 * p2 * p2 + d13 * p3 * p3
    A3 = d13 * p1 * p1 + d23 * p2 * p2
    A2 = d23 * p3 * p3 - d12 * p1 * p1
    p, q, gap = d23 * A1, d12 * A3, d13 * A2
    # Label the axes such that the phase ξ, a correction to the turn about axis 1, stays small.
    swap = d12 * A1 > d23 * A3
    p, q, gap = jnp.where(swap, q, p), jnp.where(swap, p, q), jnp.where(swap, -gap, gap)
    a = jnp.where(swap, r3, r1)
    d12, d23 = jnp.where(swap, -d23, d12), jnp.where(swap, -d12, d23)
    d13 = jnp.where(swap, -d13, d13)
    mu = jnp.where(swap, d12 * -A3, d12 * A1)
    p1, p2, p3 = jnp.where(swap, p3, p1), jnp.where(swap, -p2, p2), jnp.where(swap, p1, p3)
    h = jnp.sqrt(p1 * p1 + p2 * p2 + p3 * p3)
    turn = d13 * h * mu
    m = Modulus(p, q, gap)
    m, mu, turn, half = barrier((m, mu, turn, half_period(m, mu, turn)))
    return Orbit(a, d12, d13, d23, (p1, p2, p3), h, m, mu, turn, half, swap)


class ReducedTime(NamedTuple):
    """Hold a time from which a whole number of half periods was subtracted."""

    halves: Scalar  # the number of half periods that were subtracted
    rest: Scalar  # the time that is left
    near: Scalar  # equal to `rest`, but clipped on the separatrix where the motion is at rest


def reduce_time(u: Scalar, half_period: Scalar, m: Modulus) -> ReducedTime:
    """Return the time u reduced by a whole number of half periods of length `half_period`.

    The modulus `m` tells whether the motion is on the separatrix, where it comes to rest.
    """
    count = jnp.round(u / half_period)
    rest = u - jnp.where(count == 0, 0.0, count) * jnp.where(count == 0, 0.0, half_period)
    return ReducedTime(count, rest, clip_at_rest(rest, m))


def restore_periods(o: Orbit, f: Elliptic, u: ReducedTime) -> tuple[Elliptic, Scalar]:
    """Return two things: the functions S, C, D at the time before it was reduced, and that part of
    the phase ξ at this time which `f` does not contain.

    `f` holds the functions at the reduced time `u.near`, and `o` the constants of the motion.
    """
    big = jnp.maximum(o.modulus.p, o.modulus.q)
    whole = jnp.where(u.halves == 0, 0.0, u.halves)
    # After the time `u.near` on the separatrix the momentum rests on the middle axis, where S² =
    # 1/max(p, q): the body spins steadily.
    spin = (u.rest - u.near) * o.turn / jnp.where(big > 0, big + o.mu, 1.0)
    odd = jnp.abs(whole - 2.0 * jnp.round(0.5 * whole)) > 0.5
    sign = jnp.where(odd, -1.0, 1.0)
    around_three = o.modulus.gap > 0
    return (
        f._replace(
            S=sign * f.S,
            C=jnp.where(around_three, sign, 1.0) * f.C,
            D=jnp.where(around_three, 1.0, sign) * f.D,
        ),
        whole * jnp.where(u.halves == 0, 0.0, o.half.phase) + spin,
    )


def restore_identity(f: Elliptic, m: Modulus) -> Elliptic:
    """Return `f` with the larger of C² and D² computed again from the smaller, by D² − C² = (p −
    q)S².

    Near the middle axis the terms of the momentum with C and with SD cancel. An equal error of C
    and D, from the doublings, then cancels as well; an error of C alone or of D alone does not
    cancel, and the identity removes this error.
    """
    gs = m.gap * f.S * f.S
    other = jnp.sqrt(jnp.where(gs > 0, f.C * f.C + gs, f.D * f.D - gs))
    return f._replace(
        C=jnp.where(gs > 0, f.C, jnp.copysign(other, f.C)),
        D=jnp.where(gs > 0, jnp.copysign(other, f.D), f.D),
    )


def momentum_at(o: Orbit, f: Elliptic) -> Triple:
    """Return the body momentum at the time at which `f` holds S, C and D; the axes are labelled as
    in `o`.
    """
    p1, p2, p3 = o.P
    f = restore_identity(f, o.modulus)
    y1 = p1 * f.C - o.d23 * p2 * p3 * f.S * f.D
    y2 = p2 * f.C * f.D + o.d13 * p1 * p3 * f.S
    y3 = p3 * f.D - o.d12 * p1 * p2 * f.S * f.C
    size = jnp.maximum(jnp.maximum(jnp.abs(y1), jnp.abs(y2)), jnp.abs(y3))
    still = size <= 0
    size = jnp.where(still, 1.0, size)
    # For a steady spin the quotient of the only component by the size is exactly ±1, so that the
    # momentum stays the same to the last digit.
    y1, y2, y3 = y1 / size, y2 / size, y3 / size
    r = o.h / jnp.sqrt(jnp.where(still, 1.0, y1 * y1 + y2 * y2 + y3 * y3))
    return y1 * r, y2 * r, y3 * r


@compiled_as_one_kernel
def momentum_and_turn(o: Orbit, t: Scalar) -> tuple[Triple, Four]:
    """Return the body momentum at the time t, and the quaternion of the turn from time 0 to t, in
    principal axes.
    """
    u = reduce_time(0.5 * t, o.half.time, o.modulus)
    return motion_from_functions(o, elliptic(u.near, o.modulus, o.mu, o.turn), u, t)


def motion_from_functions(o: Orbit, f: Elliptic, u: ReducedTime, t: Scalar) -> tuple[Triple, Four]:
    """Return the body momentum at the time t and the quaternion of the turn from time 0 to t, from
    the elliptic functions `f` at `u.near`, where `u` is the reduced time t/2.
    """
    f, phase = barrier(restore_periods(o, f, u))
    full = barrier(duplicate(f, o.modulus, o.mu, o.turn))
    _, k2, k3 = barrier(momentum_at(o, f))
    m1, m2, m3 = barrier(momentum_at(o, full))

    # The turn is the product (c, s Π(0)) ⊗ b of two quaternions: the first turns about the initial
    # momentum, and b = (b0, 0, b2, b3) turns about an axis in the plane of axes 2 and 3.
    b0, b2, b3 = f.C, -o.d12 * f.S * k2 * f.C, -o.d13 * f.S * k3
    size = jnp.maximum(jnp.maximum(jnp.abs(b0), jnp.abs(b2)), jnp.abs(b3))
    b0, b2, b3 = barrier((b0 / size, b2 / size, b3 / size))
    r = 1.0 / jnp.sqrt((b0 * b0 + b2 * b2 + b3 * b3) * (f.x * f.x + f.y * f.y))
    angle = 0.5 * o.a * o.h * t - phase
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    c, s = r * (cosine * f.x + sine * f.y), r * (sine * f.x - cosine * f.y)
    still = o.h <= 0
    c, s = barrier((c, jnp.where(still, 0.0, s / jnp.where(still, 1.0, o.h))))
    p1, p2, p3 = o.P
    w = c * b0 - s * (p2 * b2 + p3 * b3)
    x = s * (p1 * b0 + p2 * b3 - p3 * b2)
    y = c * b2 + s * (p2 * b0 - p1 * b3)
    z = c * b3 + s * (p3 * b0 + p1 * b2)
    swap = o.swapped
    momentum = jnp.where(swap, m3, m1), jnp.where(swap, -m2, m2), jnp.where(swap, m1, m3)
    turn = w, jnp.where(swap, z, x), jnp.where(swap, -y, y), jnp.where(swap, x, z)
    return momentum, turn
