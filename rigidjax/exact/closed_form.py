"""Compute the motion of a free body in principal axes; vectors and quaternions are tuples of
scalars.

The module `rigidjax.exact.derivatives` has the derivatives of these values.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar
from rigidjax.exact.components3 import QuaternionEntries, Triple
from rigidjax.exact.jacobi_duplication import (
    Elliptic,
    HalfPeriod,
    Modulus,
    clip_time,
    doubled_functions,
    elliptic_functions,
    half_period,
)
from rigidjax.rotation.barrier import barrier, one_kernel


class ClosedFormConstants(NamedTuple):
    """Hold the constants of a free motion, in principal axes that are labelled 1, 2, 3 in ascending
    or descending order of their moments I₁, I₂, I₃.
    """

    a: Scalar  # 1/I₁, the reciprocal of the moment of axis 1
    d12: Scalar  # 1/I₁ − 1/I₂
    d13: Scalar  # 1/I₁ − 1/I₃
    d23: Scalar  # 1/I₂ − 1/I₃
    P: Triple  # the three components of the initial momentum
    h: Scalar  # the length of the momentum
    modulus: Modulus  # the parameters p and q of the elliptic function S
    mu: Scalar  # the number μ in the phase ξ, the angle κ ∫ S²/(1 + μS²) du
    phase_factor: Scalar  # the number κ in the phase ξ
    half: HalfPeriod  # the length of half a period of S, and the phase and the mean of S² in it
    swapped: Float[Array, ""]  # whether axis 1 has the largest moment


@one_kernel
def closed_form_constants(moments: Triple, momentum: Triple) -> ClosedFormConstants:
    """Return the constants of a free motion; principal moments ascend, and some may be equal."""
    (i1, i2, i3), (p1, p2, p3) = moments, momentum
    r1, r2, r3 = 1.0 / i1, 1.0 / i2, 1.0 / i3
    d12, d13, d23 = (i2 - i1) * (r1 * r2), (i3 - i1) * (r1 * r3), (i3 - i2) * (r2 * r3)
    A1 = d12 * p2 * p2 + d13 * p3 * p3
    A3 = d13 * p1 * p1 + d23 * p2 * p2
    A2 = d23 * p3 * p3 - d12 * p1 * p1
    p, q, gap = d23 * A1, d12 * A3, d13 * A2
    # Exchange the labels of axes 1 and 3 if the phase ξ is then smaller: ξ is the correction to the
    # steady turn |Π| t/I₁ of the body about its momentum Π, and keeps more digits if it is small.
    swap = d12 * A1 > d23 * A3
    p, q, gap = jnp.where(swap, q, p), jnp.where(swap, p, q), jnp.where(swap, -gap, gap)
    a = jnp.where(swap, r3, r1)
    d12, d23 = jnp.where(swap, -d23, d12), jnp.where(swap, -d12, d23)
    d13 = jnp.where(swap, -d13, d13)
    mu = jnp.where(swap, d12 * -A3, d12 * A1)
    p1, p2, p3 = jnp.where(swap, p3, p1), jnp.where(swap, -p2, p2), jnp.where(swap, p1, p3)
    h = jnp.sqrt(p1 * p1 + p2 * p2 + p3 * p3)
    phase_factor = d13 * h * mu
    m = Modulus(p, q, gap)
    m, mu, phase_factor, half = barrier((m, mu, phase_factor, half_period(m, mu, phase_factor)))
    return ClosedFormConstants(a, d12, d13, d23, (p1, p2, p3), h, m, mu, phase_factor, half, swap)


class ReducedTime(NamedTuple):
    """Hold a time from which a whole number of half periods of S, C, D was subtracted."""

    halves: Scalar  # the number of half periods that were subtracted
    rest: Scalar  # the time that is left
    near: Scalar  # `rest`; on the separatrix clipped to the beginning of the steady spin


def reduce_time(u: Scalar, half_period: Scalar, modulus: Modulus) -> ReducedTime:
    """Return the `ReducedTime` of a time u.

    On the separatrix the half period is infinite, and the body ends in a steady spin about its
    middle axis: in `near`, a time within this spin is replaced by the time at which it begins.
    """
    count = jnp.round(u / half_period)
    rest = u - jnp.where(count == 0, 0.0, count) * jnp.where(count == 0, 0.0, half_period)
    return ReducedTime(count, rest, clip_time(rest, modulus))


def momentum_at(constants: ClosedFormConstants, functions: Elliptic) -> Triple:
    """Return the body momentum, in the labels of `constants`, from the elliptic functions."""
    p1, p2, p3 = constants.P
    S, C, D, *_ = functions
    # Compute the larger of C² and D² again from the smaller, by D² − C² = (p − q)S². If the
    # momentum is near the middle axis, its first component is a small difference of two terms, one
    # with the factor C and one with the factor SD. Equal errors of C and D cancel in the
    # difference; an error of C alone or of D alone does not, and the identity removes it.
    gs = constants.modulus.gap * S * S
    other = jnp.sqrt(jnp.where(gs > 0, C * C + gs, D * D - gs))
    C, D = (
        jnp.where(gs > 0, C, jnp.copysign(other, C)),
        jnp.where(gs > 0, jnp.copysign(other, D), D),
    )
    y1 = p1 * C - constants.d23 * p2 * p3 * S * D
    y2 = p2 * C * D + constants.d13 * p1 * p3 * S
    y3 = p3 * D - constants.d12 * p1 * p2 * S * C
    size = jnp.maximum(jnp.maximum(jnp.abs(y1), jnp.abs(y2)), jnp.abs(y3))
    still = size <= 0
    size = jnp.where(still, 1.0, size)
    # Divide by the largest component before the length is computed: in a steady spin about a
    # principal axis the only component becomes exactly ±1, and the momentum then stays the same to
    # the last digit.
    y1, y2, y3 = y1 / size, y2 / size, y3 / size
    r = constants.h / jnp.sqrt(jnp.where(still, 1.0, y1 * y1 + y2 * y2 + y3 * y3))
    return y1 * r, y2 * r, y3 * r


class MomentumAndTurn(NamedTuple):
    """Hold the body momentum Π(t) and the turn, which is the rotation of the body from time 0 to t,
    both along the principal axes.
    """

    momentum: Triple
    turn: QuaternionEntries


@one_kernel
def momentum_and_turn(constants: ClosedFormConstants, t: Scalar) -> MomentumAndTurn:
    """Return the momentum and the turn at the time t."""
    half_time = reduce_time(0.5 * t, constants.half.time, constants.modulus)
    return from_elliptic(
        constants,
        elliptic_functions(half_time.near, constants.modulus, constants.mu, constants.phase_factor),
        half_time,
        t,
    )


def from_elliptic(
    constants: ClosedFormConstants, functions: Elliptic, half_time: ReducedTime, t: Scalar
) -> MomentumAndTurn:
    """Return the motion at the time t from the elliptic functions and their phase at
    `half_time.near`, which is t/2 less whole half periods.
    """
    big = jnp.maximum(constants.modulus.p, constants.modulus.q)
    whole = jnp.where(half_time.halves == 0, 0.0, half_time.halves)
    # On the separatrix, from `half_time.near` on, the momentum rests on the middle axis and the
    # body spins steadily. There S² = 1/max(p, q), with the parameters p and q of S, so that the
    # phase grows at the constant rate κ S²/(1 + μS²) = κ/(max(p, q) + μ).
    spin = (
        (half_time.rest - half_time.near)
        * constants.phase_factor
        / jnp.where(big > 0, big + constants.mu, 1.0)
    )
    # Restore the half periods: each turns the signs of two functions and adds its phase.
    sign = jnp.where(jnp.abs(whole - 2.0 * jnp.round(0.5 * whole)) > 0.5, -1.0, 1.0)
    around_three = constants.modulus.gap > 0
    functions = functions._replace(
        S=sign * functions.S,
        C=jnp.where(around_three, sign, 1.0) * functions.C,
        D=jnp.where(around_three, 1.0, sign) * functions.D,
    )
    phase = whole * jnp.where(half_time.halves == 0, 0.0, constants.half.phase) + spin
    functions, phase = barrier((functions, phase))
    full = barrier(
        doubled_functions(functions, constants.modulus, constants.mu, constants.phase_factor)
    )
    _, k2, k3 = barrier(momentum_at(constants, functions))
    m1, m2, m3 = barrier(momentum_at(constants, full))

    # The rotation of the body from time 0 to t is the product (c, s Π(0)) ⊗ b of two quaternions.
    # The first, with two numbers c and s, turns about the initial momentum Π(0); the second,
    # b = (b0, 0, b2, b3), turns about an axis in the plane of axes 2 and 3.
    b0, b2, b3 = (
        functions.C,
        -constants.d12 * functions.S * k2 * functions.C,
        -constants.d13 * functions.S * k3,
    )
    size = jnp.maximum(jnp.maximum(jnp.abs(b0), jnp.abs(b2)), jnp.abs(b3))
    b0, b2, b3 = barrier((b0 / size, b2 / size, b3 / size))
    r = 1.0 / jnp.sqrt(
        (b0 * b0 + b2 * b2 + b3 * b3) * (functions.x * functions.x + functions.y * functions.y)
    )
    angle = 0.5 * constants.a * constants.h * t - phase
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    c, s = (
        r * (cosine * functions.x + sine * functions.y),
        r * (sine * functions.x - cosine * functions.y),
    )
    still = constants.h <= 0
    c, s = barrier((c, jnp.where(still, 0.0, s / jnp.where(still, 1.0, constants.h))))
    p1, p2, p3 = constants.P
    w = c * b0 - s * (p2 * b2 + p3 * b3)
    x = s * (p1 * b0 + p2 * b3 - p3 * b2)
    y = c * b2 + s * (p2 * b0 - p1 * b3)
    z = c * b3 + s * (p3 * b0 + p1 * b2)
    swap = constants.swapped
    momentum = jnp.where(swap, m3, m1), jnp.where(swap, -m2, m2), jnp.where(swap, m1, m3)
    turn = w, jnp.where(swap, z, x), jnp.where(swap, -y, y), jnp.where(swap, x, z)
    return MomentumAndTurn(momentum, turn)
