"""Bind a body to an axle; solve its free swing by Jacobi's elliptic functions."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import MassProperties
from rigidjax.elliptic import ellipk
from rigidjax.elliptic.jacobi import functions
from rigidjax.motion import Turn
from rigidjax.motion.suspension import AbstractSuspension, Friction, moment_about
from rigidjax.motion.torques import base
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot
from rigidjax.rotation.stumpff import power_of_minus_one


class Axle(AbstractSuspension):
    """Bind a body to an axle through any point of it, in any direction: a pendulum, a door.

    The centre of mass goes round the axle: `V = −m g·x`, and `M = y·Iy + m |y × d|²` is constant,
    with the unit vector y along the axle and the vector d from the point to the centre of mass.
    **Arguments:**

    - `axis` (3,), body frame, of any length;
    - `point` (3,), m, body frame: any point of the axle;
    - `gravity` g (3,), m/s², in the axes that the body has at the angle 0;
    - `friction`: a `Friction`, or `None`; `torque`: any other torque or force, or `None`.

    Without both the motion is known in closed form, for any amplitude, over the top and on the
    separatrix (see `swing`). The body is a `MassProperties`.

    Source: Landau and Lifshitz, Mechanics, §11, problem 1; the addition theorem is DLMF 22.8.

    >>> rod = rj.shapes.box(0.3, [0.02, 0.02, 0.6]).shift([0.0, 0.0, -0.3])  # hangs from its end
    >>> axle = Axle([0.0, 1.0, 0.0], [0.0, 0.0, 0.0])
    >>> rj.simulate(rod, rj.Turn(3.0, 0.0), [0.0, 0.5], axle).ys.angle[1]
    Array(2.3086423, dtype=float64)
    """

    axis: Float[Array, "3"] = eqx.field(converter=base.vector_converter("axis"))
    point: Float[Array, "3"] = eqx.field(converter=base.vector_converter("point"))
    gravity: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("gravity", hint=base.GRAVITY_HINT),
        default=(0.0, 0.0, -9.80665),
    )
    friction: Friction | None = None
    torque: Any = None

    def moment(self, body: MassProperties, angle: ScalarLike) -> Scalar:
        arm = cross(self.unit, body.com - self.point)
        return moment_about(self.unit, body) + body.mass * dot(arm, arm)

    def potential(self, body: MassProperties, angle: ScalarLike) -> Scalar:
        along, slope, bend = self._pull(body)
        return -along - bend * jnp.cos(angle) + slope * jnp.sin(angle)

    def place(self, body: MassProperties, angle: ScalarLike) -> Vec3:
        arm = body.com - self.point
        return self.point + quaternion.rotate(quaternion.exp(angle * self.unit), arm)

    def period(self, body: MassProperties, amplitude: ScalarLike) -> Scalar:
        """Return `4K(sin² ½α)/ω₀` (DLMF 22.19.3), infinite at the top, where ω₀ is the angular
        frequency of small swings.
        """
        _, slope, bend = self._pull(body)
        square = _length(slope, bend) / self.moment(body, 0.0)
        s, c = jnp.sin(0.5 * amplitude), jnp.cos(0.5 * amplitude)
        return 4 * ellipk(s * s, c * c) / jnp.sqrt(square)

    def swing(self, body: MassProperties, start: Turn) -> "Swing":
        """Return the free motion in closed form.

        Let `s = sin ½θ`, `c = cos ½θ` and `w = ½ dθ/dt` at the start, with the angle θ from the
        lowest place, and b the square of the angular frequency of small swings. S, C, D solve `S' =
        CD, C' = −pSD, D' = −bSC` with `p = w² + bs²`: they are Jacobi's sn, cn, dn in a scaling
        that needs neither p > b nor p, b ≠ 0. Then, with `N = C² + w²S²`,

            sin ½θ = (sCD + cwS)/N,   cos ½θ = (cC − swSD)/N,   ½ dθ/dt = (wD − bscSC)/N.

        Small swings, rest, swings over the top and the separatrix are ordinary points. Near the
        separatrix first derivatives grow as the motion's own, e^{√b t}, and second ones lose twice
        as many digits. Where gravity has no moment about the axle at any angle, first derivatives
        are right, and second ones by what would give it one are not.
        """
        moment = self.moment(body, start.angle)
        _, slope, bend = self._pull(body)
        cosine, sine = jnp.cos(start.angle), jnp.sin(start.angle)
        first, second = slope * cosine + bend * sine, bend * cosine - slope * sine
        return Swing(start, first / moment, second / moment)

    def _pull(self, body: MassProperties) -> tuple[Scalar, Scalar, Scalar]:
        """Return the potential's parts, J: minus its constant, and V' and V'' at the angle 0."""
        unit, weight = self.unit, body.mass * self.gravity
        arm = body.com - self.point
        along = dot(arm, unit) * dot(weight, unit)
        return along, -dot(weight, cross(unit, arm)), dot(weight, arm) - along


class Swing(eqx.Module):
    """Hold the free swing of a body on an axle: call the object with times since `start`.

    **Fields:** `start`, the state at the time 0; `first` and `second`, 1/s²: the derivatives there
    of the potential by the angle, over the moment.

    >>> swing = Swing(rj.Turn(0.0, 2.0), jnp.asarray(0.0), jnp.asarray(1.0))  # the separatrix
    >>> float(swing(jnp.asarray(40.0)).angle) == jnp.pi
    True
    """

    start: Turn
    first: Scalar
    second: Scalar

    def __call__(self, since: Float[Array, "*n"]) -> Turn:
        """Return the state at times since the start, s; NaN after 1/eps rad, where no digit is
        known.
        """
        k1, k2, rate = self.first, self.second, self.start.rate
        w, b = 0.5 * rate, _length(k1, k2)
        # Of b s² and b c², whose sum is b, the larger is computed first: the smaller would lose its
        # digits in a difference.
        up = k2 < 0
        large, small = 0.5 * jnp.where(up, b - k2, b + k2), 0.5 * jnp.where(up, b + k2, b - k2)
        small = jnp.where(large > 0, k1 * k1 / (4 * jnp.where(large > 0, large, 1)), small)
        bs, bc = jnp.where(up, large, small), jnp.where(up, small, large)
        p, gap = w * w + bs, w * w - bc
        over = gap >= 0
        big = jnp.where(over, p, b)
        still = big <= 0
        one = jnp.where(still, 1, big)
        pace, m, m1 = jnp.sqrt(one), jnp.where(over, b, p) / one, jnp.abs(gap) / one
        t = jnp.where(jnp.abs(since) * pace <= 1 / jnp.finfo(since.dtype).eps, since, jnp.nan)
        f = functions(pace * t, m, jnp.where(still, 1, m1))
        # Over the top, half a turn of ½θ is taken from it each time: S and C change their signs.
        turns = jnp.where(over, f.half_turns, 0)
        sign = power_of_minus_one(turns)
        S = jnp.where(still, t, f.sn / pace * sign)
        C, D = jnp.where(over, f.cn * sign, f.dn), jnp.where(over, f.dn, f.cn)
        C, D = (jnp.where(still, jnp.ones_like(part), part) for part in (C, D))
        # Near the separatrix C and D are tiny and nearly equal. Their squares must not underflow,
        # and equal errors cancel: the larger is computed from the smaller (`momentum_at` of a free
        # body does the same).
        floor = float(jnp.finfo(t.dtype).tiny) ** 0.48
        C, D = (jnp.where(jnp.abs(part) < floor, floor, part) for part in (C, D))
        apart = gap * S * S
        C, D = (
            jnp.where(apart < 0, jnp.copysign(jnp.sqrt(D * D - jnp.minimum(apart, 0)), C), C),
            jnp.where(apart > 0, jnp.copysign(jnp.sqrt(C * C + jnp.maximum(apart, 0)), D), D),
        )
        near, some = D > 0.5, jnp.where(b > 0, b, 1)
        e = jnp.where(D > 0, S * S / (1 + jnp.maximum(D, 0)), (1 - D) / some)  # (1 − D)/b
        u = jnp.where(near, 1 - bs * e, bc / some + bs / some * D)  # c² + s²D
        turned = jnp.arctan2(w * S * u - 0.5 * k1 * C * e, C * u + 0.5 * k1 * w * S * e)
        turned = 2 * (turned + math.pi * jnp.where(w < 0, -turns, turns))
        rates = (rate * D - k1 * S * C) / (C * C + w * w * S * S)
        return Turn(self.start.angle + turned, rates)

    @property
    def pace(self) -> Scalar:
        """Return a rate, rad/s, that the motion does not exceed."""
        square = 0.25 * self.start.rate**2 + _length(self.first, self.second)
        return 2 * jnp.sqrt(square)


def _length(a: Array, b: Array) -> Array:
    """Return √(a² + b²), at zero with the derivative 0."""
    square = a * a + b * b
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
