"""Bind a body to a torsion bar or a wire."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.motion import Turn
from rigidjax.motion.suspension import AbstractSuspension, Friction, moment_about
from rigidjax.motion.torques import base
from rigidjax.rotation.stumpff import stumpff


class TorsionBar(AbstractSuspension):
    """Bind a body to a bar, wire or spring that resists torsion: `V = ½ κγ²`.

    **Arguments:** `axis` (3,), body frame, of any length; `stiffness` κ ≥ 0, N m/rad; `friction`: a
    `Friction`, or `None`; `torque`: any other torque, or `None`. The axis goes through the centre
    of mass of a `MassProperties`, and through the point of an `Inertia`. Gravity has no moment
    about it. Without friction and torque the motion is known in closed form: `γ(t) = γ(0) cos νt +
    γ̇(0) sin νt/ν`, with `ν² = κ/M`. Source: Coulomb 1784.

    >>> bar = TorsionBar([0.0, 0.0, 1.0], 0.08)
    >>> body = rj.Inertia.from_principal(1e-3, 1e-3, 2e-3)
    >>> rj.simulate(body, rj.Turn(0.5, 0.0), [0.0, 0.1], bar).ys.angle[1]
    Array(0.4032892, dtype=float64)
    """

    bodies: ClassVar[tuple[type, ...]] = (Inertia, MassProperties)
    axis: Float[Array, "3"] = eqx.field(converter=base.vector_converter("axis"))
    stiffness: Float[Array, ""] = eqx.field(
        converter=base.positive_converter("stiffness", "κ ≥ 0, N m/rad", allow_zero=True)
    )
    friction: Friction | None = None
    torque: Any = None

    def moment(self, body: Body, angle: ScalarLike) -> Scalar:
        return moment_about(self.unit, body)

    def potential(self, body: Body, angle: ScalarLike) -> Scalar:
        return 0.5 * self.stiffness * angle**2

    def place(self, body: MassProperties, angle: ScalarLike) -> Vec3:
        return body.com

    def period(self, body: Body, amplitude: ScalarLike) -> Scalar:
        """Return `2π √(M/κ)`, the same for every amplitude."""
        same = 2 * jnp.pi * jnp.sqrt(self.moment(body, amplitude) / self.stiffness)
        return jnp.where(jnp.isnan(amplitude), jnp.nan, same)

    def swing(self, body: Body, start: Turn) -> "Twist":
        return Twist(start, self.stiffness / self.moment(body, start.angle))


class Twist(eqx.Module):
    """Hold the free motion of a body on a torsion bar: call the object with times since `start`.

    **Fields:** `start`, the state at the time 0; `square`, 1/s², the stiffness over the moment.

    >>> float(Twist(rj.Turn(0.5, 0.0), jnp.asarray(4.0))(jnp.asarray(0.25 * jnp.pi)).rate)
    -1.0
    """

    start: Turn
    square: Scalar

    def __call__(self, since: Float[Array, "*n"]) -> Turn:
        """Return the state at times since the start, s."""
        angle, rate = self.start.angle, self.start.rate
        phase = self.square * since * since
        cosine, sine = stumpff(0, phase), since * stumpff(1, phase)
        return Turn(angle * cosine + rate * sine, rate * cosine - self.square * angle * sine)

    @property
    def pace(self) -> Scalar:
        """Return a rate, rad/s, at which the motion repeats."""
        return jnp.sqrt(self.square)
