"""Describe a body that turns about one axis: its state, its suspension, its equation of motion."""

import abc
from typing import Any, ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Body, Inertia, MassProperties, apply, tensor_of
from rigidjax.motion.equations import Attitude, Rigid, Turn
from rigidjax.motion.torques import base
from rigidjax.motion.torques.states import require_no_own_states
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import dot


class Friction(eqx.Module):
    """Describe the friction of a suspension: the torque about its axis `−c₁γ̇ − c₂|γ̇|γ̇ − c₀
    tanh(γ̇/w)`, where γ̇ is the rate.

    **Arguments:** `viscous` c₁, N m s/rad, of a fluid; `quadratic` c₂, N m s²/rad², of the air;
    `coulomb` c₀, N m, of a dry bearing; `width` w, rad/s, the rate at which dry friction has 76 %
    of its strength. Coulomb's law is a step at γ̇ = 0, where no number of steps of a solver is
    enough: it is smoothed, and a body at rest on a dry bearing creeps by less than w.

    >>> Friction(0.1, coulomb=0.02)(2.0)
    Array(-0.22, dtype=float64)
    """

    viscous: Float[Array, ""] = eqx.field(converter=base.number_converter("viscous"), default=0.0)
    quadratic: Float[Array, ""] = eqx.field(
        converter=base.number_converter("quadratic"), default=0.0
    )
    coulomb: Float[Array, ""] = eqx.field(converter=base.number_converter("coulomb"), default=0.0)
    width: Float[Array, ""] = eqx.field(converter=base.number_converter("width"), default=0.01)

    __repr__ = _show.fields_as_text

    def __call__(self, rate: ScalarLike) -> Scalar:
        """Return the torque about the axis, N m, at the `rate`, rad/s."""
        rate = _checks.array_of_shape(rate, (), "rate")
        linear, square, dry, width = (
            part.astype(rate.dtype)
            for part in (self.viscous, self.quadratic, self.coulomb, self.width)
        )
        return -(linear + square * jnp.abs(rate)) * rate - dry * jnp.tanh(rate / width)


class AbstractSuspension(eqx.Module):
    """Define how a body is bound, so that one angle γ says where it is: `simulate` takes one in the
    place of the torque of a `Turn`.

    The body turns about `axis`, a fixed direction in the body and in the world, whose axes are
    those of the body at γ = 0. With the moment `M(γ) = Tr(J_yᵀJ_y 𝔖) + m |dx/dγ|²`, where y is the
    unit vector along the axis and x the place of the centre of mass, the potential V(γ) and the
    torque Q of friction and of the law `torque` along the motion, Lagrange's equation is `M γ̈ + ½
    M' γ̇² + V' = Q`. (The kinetic energy is `½ Tr(J'ᵀJ'𝔖) + ½ m |dx/dt|²` with `J' = γ̇ J_y`; notes,
    eqs 17, 18, 57, 65.) A subclass has these fields:

    - `axis` (3,), body frame, of any length;
    - `friction`: a `Friction`, or `None`;
    - `torque`: any torque or force of `rigidjax.torques` or callable `(t, state, body) → (3,)`,
      which gets the state that the method `state` returns; or `None`. It has no states of its own.

    and these methods: `moment`, `potential`, `place`, `period`; `swing(body, start)` returns the
    motion in closed form, or `None` if the class has `solvable = False`. A suspension that may end
    a run has two more, as a scene of a `Point` has: `ends(t, turn, body)` and `end_words(t, turn)`.

    >>> isinstance(rj.suspensions.TorsionBar([0.0, 0.0, 1.0], 0.4), AbstractSuspension)
    True
    """

    bodies: ClassVar[tuple[type, ...]] = (MassProperties,)
    # Whether the free motion is known in closed form; if not, `swing` returns `None`.
    solvable: ClassVar[bool] = True
    axis: eqx.AbstractVar[Float[Array, "3"]]

    __repr__ = _show.fields_as_text

    def __check_init__(self) -> None:
        # `friction` and `torque` are not declared here: type checkers would put them before the
        # fields of a subclass.
        law, name = cast(Any, self), type(self).__name__
        if _checks.is_known(self.axis) and not np.any(self.axis):
            raise ValueError("axis: wanted a direction, got zero")
        if law.friction is not None:
            _checks.require_instance(law.friction, Friction, f"{name}.friction")
        if law.torque is not None:
            base.require_torque(law.torque)
            require_no_own_states(law.torque, name)

    @abc.abstractmethod
    def moment(self, body: PyTree, angle: ScalarLike) -> Scalar:
        """Return M(γ), kg m², for which the kinetic energy is ½ M γ̇²."""

    @abc.abstractmethod
    def potential(self, body: PyTree, angle: ScalarLike) -> Scalar:
        """Return the potential energy V(γ), J."""

    @abc.abstractmethod
    def place(self, body: PyTree, angle: ScalarLike) -> Vec3:
        """Return the place of the centre of mass, m, world frame."""

    @abc.abstractmethod
    def period(self, body: PyTree, amplitude: ScalarLike) -> Scalar:
        """Return the period, s, of the free swing with this amplitude, rad, about the rest."""

    @abc.abstractmethod
    def swing(self, body: PyTree, start: Turn) -> Any:
        """Return the free motion from `start`, a Module `(time since start, s) → Turn`."""

    @property
    def closed_form(self) -> bool:
        """Return whether the motion is known in closed form."""
        law: Any = self
        return self.solvable and law.friction is None and law.torque is None

    @property
    def unit(self) -> Vec3:
        """Return the unit vector along the axis."""
        return self.axis / jnp.sqrt(dot(self.axis, self.axis))

    def require_body(self, body: PyTree) -> Any:
        """Return the `body`; raise an error unless it is one of the classes in `bodies`, and this
        suspension is that of one body.
        """
        base.require_single(self)
        hint = "gravity needs the mass and its place" if isinstance(body, Inertia) else ""
        return _checks.require_unbatched_instance(body, self.bodies, "body", hint=hint)

    def state(self, body: Body, turn: Turn) -> Attitude | Rigid:
        """Return attitude and rate, also place and velocity of a body with mass (a `Rigid`)."""
        unit = self.unit.astype(turn.angle.dtype)
        q, omega = quaternion.exp(turn.angle * unit), turn.rate * unit
        if not isinstance(body, MassProperties):
            return Attitude(q, omega)
        x, v = jax.jvp(lambda a: self.place(body, a), (turn.angle,), (turn.rate,))
        return Rigid(x, v, q, omega)

    def energy(self, body: Body, turn: Turn) -> Scalar:
        """Return the energy `½ M γ̇² + V`, J, without that of the law `torque`."""
        kinetic = 0.5 * self.moment(body, turn.angle) * turn.rate**2
        return kinetic + self.potential(body, turn.angle)


# What acts on a body in a recording: a torque, or of a `Turn` its suspension.
Law = base.Torque | AbstractSuspension


class TurnEquations(eqx.Module):
    """Evaluate the equation of motion of a body about one axis as a vector field `f(t, y, args)` of
    a `Turn`.
    """

    body: Any
    suspension: AbstractSuspension

    def __call__(self, t: ScalarLike, y: Turn, args: object = None) -> Turn:
        dtype, angle = y.angle.dtype, y.angle
        body, law = base.in_precision((self.body, self.suspension), dtype)
        one = jnp.ones_like(angle)
        moment, change = jax.jvp(lambda a: law.moment(body, a), (angle,), (one,))
        slope = jax.grad(lambda a: law.potential(body, a))(angle)
        push = -slope - 0.5 * change * y.rate**2
        if law.friction is not None:
            push = push + law.friction(y.rate)
        force, torque = applied(law, t, y, body)
        if torque is not None:
            push = push + dot(torque, law.unit)
        if force is not None:
            push = push + dot(force, jax.jvp(lambda a: law.place(body, a), (angle,), (one,))[1])
        return Turn(y.rate, push / moment)


def applied(
    suspension: Any, t: ScalarLike, turn: Turn, body: Body
) -> tuple[Vec3 | None, Vec3 | None]:
    """Return force (N, world) and torque (N m, body) of the law `torque`, `None` if there are
    none.
    """
    if suspension.torque is None:
        return None, None
    return base.force_and_torque(suspension.torque, t, suspension.state(body, turn), body)


def moment_about(axis: Vec3, body: Body) -> Scalar:
    """Return the moment, kg m², about a unit vector through the centre of mass."""
    return dot(axis, apply(tensor_of(body), axis))


def period(
    body: Inertia | MassProperties, suspension: AbstractSuspension, amplitude: ScalarLike = 0.0
) -> Scalar:
    """Return the period of a free swing, s.

    **Arguments:** `body`, `suspension` as for `simulate`; `amplitude`, rad: the largest angle from
    the place of rest, less than π. 0 gives the period of small swings; it is an ordinary point. The
    friction and the law `torque` of the suspension are not counted. For an `Axle` the period is
    `4K/ω₀`, by the arithmetic–geometric mean; for `Strings` an integral, with the energy of the
    lift. First and second derivatives by all numbers are right. **Raises:** `ValueError` for an
    amplitude of π or more, and if the body cannot swing so far; `TypeError` if body and suspension
    do not fit together.

    >>> plate = rj.shapes.box(1.2, [0.3, 0.3, 0.02])
    >>> bifilar = rj.suspensions.Strings(2, 0.1, 0.1, 0.8)
    >>> [round(float(period(plate, bifilar, a)), 6) for a in (0.0, 0.5)]
    [2.197911, 2.232517]
    """
    _checks.require_instance(suspension, AbstractSuspension, "suspension")
    body = suspension.require_body(body)
    angle = _checks.finite_array(amplitude, (), "amplitude", unit="rad")
    if _checks.is_known(angle) and not abs(angle) < np.pi:
        raise ValueError(f"amplitude: wanted an angle below π, rad, got {float(angle):.6g}")
    dtype = tensor_of(body).dtype
    found = base.in_precision(suspension, dtype).period(body, angle.astype(dtype))
    if _checks.is_known(found) and np.isnan(found):
        raise ValueError(
            f"period: {suspension} does not swing this body by {float(angle):.4g} rad: are its "
            "axis, gravity and stiffness not zero, and its strings long enough?"
        )
    return found
