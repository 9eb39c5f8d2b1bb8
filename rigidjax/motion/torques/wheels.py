"""Define wheels inside the body (a gyrostat): with a known momentum, or with speeds that are
states.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties, OneBody, tensor_of, with_tensor
from rigidjax.body.symmetric3 import outer
from rigidjax.motion.torques import base
from rigidjax.motion.torques.inputs import require_no_jumps
from rigidjax.motion.torques.states import contains_own_states
from rigidjax.rotation.linalg3 import cross

# A torque that would bring a wheel beyond its top speed falls to zero over the last part of the
# speeds below the top speed; this number is the length of that part, as a fraction of the top
# speed.
_FADE = 0.05


class Flywheel(base.AbstractTimeTorque):
    """Apply the torque of internal wheels to the body: `τ = h × Ω − dh/dt`.

    **Arguments:** `momentum` h, N m s, body frame, the sum over all wheels: (3,) for wheels of
    constant speed, or a function of time, t → (3,), that is an `equinox.Module`, such as
    `Linear(times, values)` (straight lines between samples), but not a function that jumps, such as
    `Held` or an `Input` with samples that are held until the next one, because dh/dt acts on the
    body.

    The inertia I of the body and h must belong together. If I is the inertia of the body with its
    wheels locked, h is the momentum of the wheels relative to the body. If the moments of inertia J
    of the wheels about their axes a are subtracted from this inertia (I − Σ J a aᵀ), h is the whole
    momentum of the wheels along their axes, the rotation of the body included, and dh/dt is the
    torque of the motors.

    The momentum in the world frame, `R (IΩ + h)`, is conserved, with the attitude R and the body
    rate Ω; so is the energy `½ Ω·IΩ` if h is constant. Source: Zhukovsky 1885, Volterra 1898;
    Hughes, Spacecraft Attitude Dynamics, chs. 3, 6.

    >>> Flywheel([0.0, 0.0, 2.0]).internal_momentum(0.0)
    Array([0., 0., 2.], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    momentum: eqx.Module | Float[Array, "3"]

    def __init__(self, momentum: object):
        self.momentum = base.checked_source(momentum, "momentum")
        if contains_own_states(momentum):
            raise TypeError(
                "Flywheel: wanted a momentum whose derivative with respect to time is known, got "
                "one with states; see ReactionWheels"
            )
        require_no_jumps(momentum, "momentum")

    def internal_momentum(self, t: ScalarLike) -> Vec3:
        """Return the momentum h (3,) of the wheels at the time `t`, s, N m s, body frame."""
        return base.vector_at(self.momentum, t, "momentum")

    def energy(self, t: ScalarLike, state: HasSpin, body: object) -> Scalar:
        """Return the potential energy of the wheels, J, which is zero: their torque h × Ω, with
        their momentum h and the body rate Ω, does no work on the body.
        """
        return jnp.zeros((), state.omega.dtype)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        source: Any = self.momentum
        if not callable(source):
            return cross(source, state.omega)
        require_no_jumps(source, "momentum")
        t = jnp.asarray(t, state.omega.dtype)
        h, rate = jax.jvp(self.internal_momentum, (t,), (jnp.ones_like(t),))
        return cross(h, state.omega) - rate


class ReactionWheels(base.AbstractTorque):
    """Apply the torque of wheels on motors inside the body (a gyrostat): `τ = (Σ h a) × Ω − Σ u a`,
    `dh/dt = u`.

    **Arguments:** for R wheels

    - `axes` a (R, 3), body frame, unit; `inertia` J (R,) kg m² about them; `speeds` s (R,) rad/s
      relative to the body, at the start.
    - `motor`: the torque of each motor on its wheel (R,), N m, positive if it increases s:
      constant, a function of time such as `Held(times, values)`, `Input("motor")` (a signal whose
      values are given when a motion is computed), or `None`.
    - `feedback`: a function `(t, state, speeds) → (R,)`, N m, added to `motor`; or `None`.
    - `max_torque` N m, `max_speed` rad/s, each one number, (R,), or `None` for no limit. The torque
      of motor and feedback is limited to `max_torque`. A torque that would bring a wheel beyond
      `max_speed` is multiplied by 6 x⁵ − 15 x⁴ + 10 x³, where x falls from 1 to 0 over the last 5 %
      of the speed below `max_speed`. With this smooth factor the derivatives of runs that reach
      `max_speed` are accurate to the tolerance of the run (with the factor x their error would be
      1e-4 at `rtol=1e-9`).
    - `viscous` c, N m s/rad, and `coulomb` d, N m, of the bearings, each one number, (R,), or
      `None`: the friction is `−c s − d tanh(s/s₀)`.
    - `turn_over`: s₀, rad/s. Coulomb friction changes its sign smoothly over about this speed, so
      that derivatives exist and steps can be long.

    The states of this torque are the momenta of the wheels along their axes, `h = J (s + a·Ω)`, the
    body rate Ω included; u is the torque of motor and bearing on a wheel. The inertia I of the body
    must be **without** the wheels' moments J a aᵀ: `without_wheels` subtracts these terms from an
    inertia with the wheels locked. The equations are exact for balanced wheels that are symmetric
    about their axes. `R (IΩ + Σ h a)`, with the attitude R, is conserved for any motor torque; the
    energy `½ Ω·IΩ + Σ h²/2J` changes at the rate `Σ u s`.

    Source: Markley and Crassidis 2014, Fundamentals of Spacecraft Attitude Determination and
    Control, §3.3.5, doi:10.1007/978-1-4939-0802-8; friction: §4.8 there, after Bialke 1998, with
    tanh instead of sign (Andersson, Söderberg and Björklund 2007,
    doi:10.1016/j.triboint.2005.11.014).

    **Raises:** `ValueError` for an axis that is not a unit vector, or an inertia, limit or
    turn-over that is not positive.

    >>> wheels = ReactionWheels([[0.0, 0, 1]], [0.1], [0.0], motor=[0.2])
    >>> body = wheels.without_wheels(rj.Inertia.from_principal(1.0, 2.0, 2.1))
    >>> sol = rj.simulate(body, rj.Spin([0.0, 0, 0]), [0.0, 5.0], wheels)
    >>> [round(float(w), 9) for w in (sol.ys.omega[-1, 2], sol.own[0][-1, 0])]
    [-0.5, 1.0]
    """

    feels: ClassVar[type] = HasSpin
    axes: Float[Array, "wheels 3"]
    inertia: Float[Array, " wheels"]
    speeds: Float[Array, " wheels"]
    motor: eqx.Module | Float[Array, " wheels"] | None
    feedback: Callable[..., Any] | None
    max_torque: Array | None
    max_speed: Array | None
    viscous: Array | None
    coulomb: Array | None
    turn_over: Float[Array, ""]

    def __init__(
        self,
        axes: NumbersLike,
        inertia: NumbersLike,
        speeds: NumbersLike,
        motor: NumbersLike | Callable[..., Any] | None = None,
        *,
        feedback: object = None,
        max_torque: NumbersLike | None = None,
        max_speed: NumbersLike | None = None,
        viscous: NumbersLike | None = None,
        coulomb: NumbersLike | None = None,
        turn_over: ScalarLike = 1.0,
    ):
        count = base.row_count(axes, "axes", "wheel")
        self.axes = base.unit_rows(axes, "axes", count)
        inertia = _checks.finite_array(inertia, (count,), "inertia")
        self.inertia = _checks.check_if_known(_checks.require_positive, inertia, "inertia", "> 0")
        self.speeds = _checks.finite_array(speeds, (count,), "speeds")
        self.motor = None if motor is None else base.checked_source(motor, "motor", count)
        words = "(t, state, speeds) → torques (R,), N m"
        self.feedback = (
            None if feedback is None else _checks.require_function(feedback, "feedback", words)
        )
        self.max_torque = _checked_property(max_torque, count, "max_torque", "> 0")
        self.max_speed = _checked_property(max_speed, count, "max_speed", "> 0")
        self.viscous = _checked_property(viscous, count, "viscous", "≥ 0")
        self.coulomb = _checked_property(coulomb, count, "coulomb", "≥ 0")
        turn_over = _checks.finite_array(turn_over, (), "turn_over")
        self.turn_over = _checks.check_if_known(
            _checks.require_positive, turn_over, "turn_over", "> 0"
        )

    @property
    def steady(self) -> bool:
        """Return whether no torque acts on the wheels about their axes (no motor, feedback or
        friction): their momenta are then constant, and the energy is conserved.
        """
        parts = (self.motor, self.feedback, self.viscous, self.coulomb)
        return all(part is None for part in parts)

    jump_times = property(base.field_jumps)

    def without_wheels(self, body: OneBody) -> OneBody:
        """Return the body with the inertia I − Σ J a aᵀ: the moments of inertia J of the wheels
        about their axes a are subtracted from the inertia I of `body`.

        - `body`: an `Inertia` or `MassProperties` whose inertia I includes the locked wheels
        """
        body = validation.require_single_body(body, (Inertia, MassProperties), "body")
        rows = (j * outer(a, a) for j, a in zip(self.inertia, self.axes, strict=True))
        taken = sum(rows, jnp.zeros((3, 3), self.axes.dtype))
        return with_tensor(body, tensor_of(body) - taken)

    def speeds_of(self, own: Array, state: HasSpin) -> Float[Array, " wheels"]:
        """Return the speeds (R,) of the wheels relative to the body, rad/s.

        - `own`: (R,) N m s, the axial momenta of the wheels, which are the states of this torque
        - `state`: a state of motion, with the body rate
        """
        own = _checks.array_of_shape(own, self.inertia.shape, "own")
        omega = _checks.require_unbatched_instance(
            state, HasSpin, "state", requirement="a Spin, Attitude or Rigid"
        ).omega
        along = jnp.stack([a[0] * omega[0] + a[1] * omega[1] + a[2] * omega[2] for a in self.axes])
        return own / self.inertia - along

    def torques_of(self, t: ScalarLike, own: Array, state: HasSpin) -> Float[Array, " wheels"]:
        """Return the torque of motor and bearing on each wheel about its axis, (R,), N m.

        - `t`: s, the time
        - `own`: (R,) N m s, the axial momenta of the wheels, which are the states of this torque
        - `state`: a state of motion, with the body rate
        """
        speeds, t = self.speeds_of(own, state), _checks.array_of_shape(t, (), "t")
        count, total = self.inertia.shape[0], jnp.zeros_like(speeds)
        if self.motor is not None:
            total = total + base.vector_at(self.motor, t, "motor", count).astype(total.dtype)
        if self.feedback is not None:
            feedback = self.feedback(t, state, speeds)
            total = total + _checks.array_of_shape(feedback, (count,), "feedback(t, state, speeds)")
        if self.max_torque is not None:
            total = jnp.clip(total, -self.max_torque, self.max_torque)
        if self.max_speed is not None:
            top = self.max_speed
            room = jnp.where(total > 0, top - speeds, top + speeds)
            # A smooth step from 0 to 1, whose first two derivatives vanish at both ends.
            x = jnp.clip(room / (_FADE * top), 0, 1)
            total = total * (x * x * x * (10.0 + x * (6.0 * x - 15.0)))
        if self.viscous is not None:
            total = total - self.viscous * speeds
        if self.coulomb is not None:
            total = total - self.coulomb * jnp.tanh(speeds / self.turn_over)
        return total

    def state0(self, t: ScalarLike, state: HasSpin, body: object) -> Array:
        """Return the axial momenta of the wheels at the start, (R,), N m s, from their speeds and
        the body rate in `state`; `t` and `body` are not used.
        """
        still = self.speeds_of(jnp.zeros_like(self.inertia), state)
        return self.inertia * (self.speeds - still)

    def rate(self, t: ScalarLike, own: Array, state: HasSpin, body: object) -> Array:
        """Return the derivatives of the axial momenta of the wheels with respect to time, (R,), N
        m: the torques of motors and bearings.

        - `t`: s, the time
        - `own`: (R,) N m s, the axial momenta of the wheels
        - `state`: a state of motion, with the body rate
        - `body`: not used
        """
        return self.torques_of(t, own, state)

    def internal_momentum(self, t: ScalarLike, own: Array) -> Vec3:
        """Return the momentum of the wheels Σ h a, (3,), N m s, body frame, with the axes a of the
        wheels and their axial momenta h = `own` (R,), N m s.
        """
        return self._along_axes(own)

    def energy(self, t: ScalarLike, state: HasSpin, body: object, own: Array) -> Scalar:
        """Return the kinetic energy of the wheels about their axes, Σ h²/2J, in joules, with their
        axial momenta h = `own` (R,), N m s, and their moments of inertia J, kg m².
        """
        return jnp.sum(own * own / (2.0 * self.inertia))

    def __call__(self, t: ScalarLike, state: HasSpin, body: object, own: Array) -> Vec3:  # pyright: ignore[reportIncompatibleMethodOverride]
        motors = self._along_axes(self.torques_of(t, own, state))
        return cross(self._along_axes(own), state.omega) - motors

    def _along_axes(self, axial_components: Float[Array, " wheels"]) -> Vec3:
        """Return Σ xᵢ aᵢ, body frame, a sum over the wheels with their axes aᵢ."""
        # The sum is written out wheel by wheel: there are few wheels, and in a batch of bodies
        # `jnp.sum` is slow.
        total = jnp.zeros(3, axial_components.dtype)
        for i in range(self.axes.shape[0]):
            total = total + axial_components[i] * self.axes[i]
        return total


def _checked_property(
    value: NumbersLike | None, count: int, name: str, requirement: str
) -> Array | None:
    """Return a property of the wheels after checks, one number or one for each wheel."""
    if value is None:
        return None
    numbers = base.one_or_each(value, count, name)
    return _checks.check_if_known(
        _checks.require_positive, numbers, name, requirement, allow_zero=requirement == "≥ 0"
    )
