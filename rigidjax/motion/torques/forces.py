"""Define forces on a body that moves: gravity, a centre of attraction, drag, rotors."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasPose, HasSpin, Mat3, NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import MassProperties
from rigidjax.motion.torques import base
from rigidjax.motion.torques.inputs import require_no_jumps
from rigidjax.motion.torques.states import FrozenLaw, has_own_states
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot

_NONE: Any = (0.0, 0.0, 0.0)


class UniformGravity(base.AbstractForce):
    """Apply uniform gravity: the force `F = m g` on a body of mass m, without a torque about the
    centre of mass.

    The potential energy is `U = −m g·x`, with the position x of the centre of mass. **Arguments:**
    `gravity` (3,) g, m/s², world frame, such as [0, 0, −9.81]. Source: notes, eq 84.

    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> UniformGravity([0.0, 0.0, -9.8])(0.0, state, body).force.tolist()  # N
    [0.0, 0.0, -19.6]
    """

    feels: ClassVar[type] = HasPose
    steady: ClassVar[bool] = True
    gravity: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("gravity", hint=base.GRAVITY_HINT)
    )

    def energy(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Scalar:
        """Return the potential energy, J: `U = −m g·x`, with the mass m of the body, gravity g and
        the position x of the centre of mass; it is zero at the world's origin.
        """
        return -body.mass * dot(self.gravity, state.x)

    def internal_momentum(self, t: ScalarLike) -> Vec3:
        """Return zero (3,), N m s: no momentum is inside the body. This method tells `conserved`
        that gravity has no torque about the centre of mass.
        """
        return jnp.zeros_like(self.gravity)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> base.Wrench:
        return base.Wrench(body.mass * self.gravity)


class CentralGravity(base.AbstractForce):
    """Attract a body of some size to a centre at the world's origin.

    The potential energy is `U = −μ m/r − (μ/2r³)(Tr I_w − 3 r̂·I_w r̂)` (MacCullagh's formula).
    Here m is the mass of the body, r and r̂ are the length and the direction of the vector from the
    origin to the centre of mass, and `I_w = R I Rᵀ` is the inertia in world axes, with the inertia
    I in body axes and the attitude R. Both the force and the torque of this potential act on the
    body, so that the energy and the angular momentum about the origin are conserved. **Arguments:**
    `mu` μ, m³/s², the constant of gravitation times the mass of the centre. Source: Hughes,
    Spacecraft Attitude Dynamics, §8.1.

    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], 1e-9 * jnp.eye(3))
    >>> state = rj.Rigid([2.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> round(float(CentralGravity(8.0)(0.0, state, body).force[0]), 6)  # N, −m μ/r²
    -4.0
    """

    feels: ClassVar[type] = HasPose
    steady: ClassVar[bool] = True
    mu: Float[Array, ""] = eqx.field(converter=base.number_converter("mu"))

    def energy(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Scalar:
        """Return the potential energy of the body in the gravity of the centre, J, which is zero at
        an infinite distance from the centre.
        """
        r, up, pull, trace = _centre(state, body.inertia.tensor)
        return -(self.mu / r) * (body.mass + 0.5 * (trace - 3 * dot(up, pull)) / r / r)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> base.Wrench:
        r, up, pull, trace = _centre(state, body.inertia.tensor)
        strength, along = self.mu / r / r, dot(up, pull)
        # In body axes the force, minus the gradient of the potential energy, is the sum of two
        # vectors: one along r̂, and one along I r̂.
        radial = -strength * (body.mass + 1.5 * (trace - 5 * along) / r / r)
        force = radial * up - 3 * strength / r / r * pull
        return base.Wrench(quaternion.rotate(state.q, force), cross(3 * strength / r * up, pull))


class _Centre(NamedTuple):
    """Hold the terms of MacCullagh's formula for the gravity of a centre at the world's origin."""

    # The distance r of the centre of mass from the origin, m.
    distance: Scalar
    # The unit vector r̂ from the origin to the centre of mass, body axes.
    direction: Vec3
    # The product I r̂, kg m², body axes, and the trace of I, kg m².
    product: Vec3
    trace: Scalar


def _centre(state: HasPose, inertia_tensor: Mat3) -> _Centre:
    r = jnp.sqrt(dot(state.x, state.x))
    up = quaternion.rotate_inverse(state.q, state.x / r)
    trace = inertia_tensor[0, 0] + inertia_tensor[1, 1] + inertia_tensor[2, 2]
    return _Centre(r, up, apply(inertia_tensor, up), trace)


class Drag(base.AbstractForce):
    """Apply the drag of a fluid at a point of the body: `F = −k |u| u`, where `u = v − wind` is the
    velocity of the centre of mass relative to the fluid.

    **Arguments:**

    - `coefficient`: k = ½ ρ C_d A, kg/m, with the density ρ of the fluid, the drag coefficient C_d
      and the area A.
    - `centre`: c (3,), m, body frame, the point where the drag acts, from the centre of mass; the
      torque is `τ = c × RᵀF`, with the attitude R.
    - `wind`: (3,) m/s, world frame, the velocity of the fluid.

    The rotation of the body does not enter u; for the drag on the rotation take `Damping` or
    `QuadraticDamping`. At u = 0 the first derivative of F with respect to u is zero, and the second
    derivative does not exist. Source: Newton, Principia, Book II, Section II.

    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([0.0, 0, 0], [3.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> float(Drag(0.5)(0.0, state, body).force[0])  # N, −0.5 · 3²
    -4.5
    """

    feels: ClassVar[type] = HasPose
    steady: ClassVar[bool] = True
    coefficient: Float[Array, ""] = eqx.field(converter=base.number_converter("coefficient"))
    centre: Float[Array, "3"] = eqx.field(converter=base.vector_converter("centre"), default=_NONE)
    wind: Float[Array, "3"] = eqx.field(converter=base.vector_converter("wind"), default=_NONE)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> base.Wrench:
        u = state.v - self.wind
        force = -self.coefficient * base.length_or_zero(u) * u
        return base.Wrench(force, cross(self.centre, quaternion.rotate_inverse(state.q, force)))


class Rotors(base.AbstractForce):
    """Apply the forces of R propellers: the thrust `F_i = k_i n_i² d_i` at the place r_i, the
    reaction of the drag of the blades, the torque `τ_i = −s_i c_i n_i² d_i`, and the torque of what
    turns, `h_i × Ω − dh_i/dt` with its momentum `h_i = s_i J_i n_i d_i` and the body rate Ω.

    On a `Spin` or `Attitude`, which has no position, the torques act alone, about the point that
    the body turns about: the log of a thrown drone has a gyro and speeds. Without a thrust or an
    inertia that is known a gyro shows only the ratios of k, c, J and the moments of the body.

    **Arguments:**

    - `positions`: r (R, 3), m, body frame, from the centre of mass.
    - `directions`: d (R, 3), unit vectors along the thrusts, body frame.
    - `spins`: s (R,), 1 for a rotor that turns about d by the right-hand rule, −1 for a rotor that
      turns in the opposite sense.
    - `thrust`: k, N s²/rad², one number or (R,).
    - `drag`: c, N m s²/rad², one number or (R,).
    - `speeds`: n (R,), rad/s, relative to the body: constant, a function of time that is an
      `equinox.Module`, such as `Series(times, values)`, or `Input("speeds")`, whose values are
      given when a motion is computed. Of commands it is `Lagged(Input("commands"), 0.03)`, where
      commands may have any unit that is proportional to the speed: this unit then replaces rad/s
      in k, c and J.
    - `inertia`: J, kg m², of propeller and bell about d, one number or (R,), or `None` for none.
      With it `speeds` may be `Lagged`, but not jump (`Held`, held samples), since dh/dt acts on the
      body. The inertia of the body includes the locked rotors.

    Source: Mahony, Kumar and Corke 2012, Multirotor aerial vehicles, eqs 4–6,
    doi:10.1109/MRA.2012.2206474; the momentum: Hughes, Spacecraft Attitude Dynamics, ch. 3.

    **Raises:** `ValueError` for a direction that is not a unit vector, or a spin that is not 1 or
    −1; `TypeError` for an inertia with speeds that jump.

    >>> up = Rotors([[0.1, 0.0, 0.0]], [[0.0, 0.0, 1.0]], [1.0], 2.0, 0.5, [3.0])
    >>> up(0.0, rj.Spin([0.0, 0, 0]), rj.Inertia(jnp.eye(3))).tolist()
    [0.0, -1.8, -4.5]
    """

    feels: ClassVar[type] = HasSpin
    positions: Float[Array, "rotors 3"]
    directions: Float[Array, "rotors 3"]
    spins: Float[Array, " rotors"]
    thrust: Float[Array, "*k"]
    drag: Float[Array, "*c"]
    speeds: eqx.Module | Float[Array, " rotors"]
    inertia: Float[Array, "*j"] | None

    def __init__(
        self,
        positions: NumbersLike,
        directions: NumbersLike,
        spins: NumbersLike,
        thrust: NumbersLike,
        drag: NumbersLike,
        speeds: NumbersLike | Callable[..., Any],
        inertia: NumbersLike | None = None,
    ):
        count = base.row_count(positions, "positions", "rotor")
        self.positions = _checks.finite_array(positions, (count, 3), "positions")
        self.directions = base.unit_rows(directions, "directions", count)
        self.spins = _checks.finite_array(spins, (count,), "spins")
        if _checks.is_known(self.spins) and (abs(np.asarray(self.spins)) != 1).any():
            raise ValueError(f"spins: wanted 1 or -1 for each rotor, got {np.asarray(self.spins)}")
        self.thrust, self.drag = (
            base.one_or_each(thrust, count, "thrust"),
            base.one_or_each(drag, count, "drag"),
        )
        self.speeds = base.checked_source(speeds, "speeds", count)
        self.inertia = None if inertia is None else base.one_or_each(inertia, count, "inertia")
        if inertia is not None and not has_own_states(speeds):
            require_no_jumps(speeds, "speeds")

    jump_times = property(base.field_jumps)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Any:
        count, dtype = self.spins.shape[0], self.spins.dtype
        n = base.vector_at(self.speeds, t, "speeds", count).astype(dtype)
        square = n * n
        lift, twist = self.thrust * square, self.spins * self.drag * square
        spun = None
        if self.inertia is not None:
            axial = self.spins * self.inertia
            spun = axial * n
            twist = twist + axial * self._acceleration(t, state, body).astype(dtype)
        # The sum is written out rotor by rotor: there are few rotors, and in a batch of bodies
        # `jnp.sum` is slow.
        force, torque = jnp.zeros(3, lift.dtype), jnp.zeros(3, lift.dtype)
        for i in range(count):
            along = self.directions[i]
            force = force + lift[i] * along
            torque = torque + lift[i] * cross(self.positions[i], along) - twist[i] * along
            if spun is not None:
                torque = torque + spun[i] * cross(along, state.omega)
        if not isinstance(state, HasPose):
            return torque
        return base.Wrench(quaternion.rotate(state.q, force), torque)

    def _acceleration(self, t: ScalarLike, state: HasSpin, body: object) -> Array:
        """Return the derivatives of the speeds with respect to time, (R,), rad/s²."""
        source: Any = self.speeds
        if not callable(source):
            return jnp.zeros_like(source)
        t = jnp.asarray(t, state.omega.dtype)
        one = jnp.ones_like(t)
        if isinstance(source, FrozenLaw):
            own = source.own[0]
            slope = source.law.rate(t, own, state, body)
            return jax.jvp(source.law, (t, own), (one, slope))[1]
        require_no_jumps(source, "speeds")
        return jax.jvp(source, (t,), (one,))[1]


def rotors_of(torque: object) -> list[Rotors]:
    """Return all `Rotors` in a torque, or in a tree of torques."""
    is_rotors = lambda node: isinstance(node, Rotors)  # noqa: E731
    return list(filter(is_rotors, jax.tree.leaves(torque, is_leaf=is_rotors)))


class BodyDrag(base.AbstractForce):
    """Apply a drag that differs along the axes of the body: `Fᵢ = −(aᵢ + bᵢ |uᵢ|) uᵢ` along body
    axis i.

    Here `u = Rᵀ (v − wind)` is the velocity of the centre of mass relative to the air, in body
    axes, and R the attitude. The torque is `τ = c × F` in body axes. For a sphere see `Drag`.
    **Arguments:**

    - `linear`: a (3,), kg/s, such as the drag of rotors in a cross-flow.
    - `quadratic`: b (3,), kg/m.
    - `centre`: c (3,), m, body frame, the point where the drag acts, from the centre of mass.
    - `wind`: (3,) m/s, world frame, the velocity of the air.

    Source: Faessler, Franchi and Scaramuzza 2018, eq 5, doi:10.1109/LRA.2017.2776353, for the
    linear part; Hoerner 1965, Fluid-Dynamic Drag, for the quadratic part.

    >>> fast = rj.Rigid([0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> BodyDrag([1.0, 1, 1], [0.5, 0, 0])(0.0, fast, rj.shapes.sphere(1.0, 1.0)).force.tolist()
    [-4.0, 0.0, 0.0]
    """

    feels: ClassVar[type] = HasPose
    steady: ClassVar[bool] = True
    linear: Float[Array, "3"] = eqx.field(converter=base.vector_converter("linear"))
    quadratic: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("quadratic"), default=_NONE
    )
    centre: Float[Array, "3"] = eqx.field(converter=base.vector_converter("centre"), default=_NONE)
    wind: Float[Array, "3"] = eqx.field(converter=base.vector_converter("wind"), default=_NONE)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> base.Wrench:
        u = quaternion.rotate_inverse(state.q, state.v - self.wind)
        force = -(self.linear + self.quadratic * jnp.abs(u)) * u
        return base.Wrench(quaternion.rotate(state.q, force), cross(self.centre, force))
