"""Forces on flying machines: rotors, and drag along the axes of the body."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import HasPose, ScalarLike
from rigidjax.body import validation
from rigidjax.body._types import Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.motion.torques.base import (
    AbstractForce,
    Wrench,
    constant_or_callable,
    given,
    jumps_of,
    vector_at,
)
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross


class Rotors(AbstractForce):
    """Propellers: thrust `F_i = k_i n_i² d_i` at r_i, and the reaction `τ_i = −s_i c_i n_i² d_i`.

    **Arguments:** `positions` r (R, 3) m, body frame, from the centre of mass; `directions` d
    (R, 3) of the thrusts, body frame, unit; `spins` s (R,), 1 where a rotor turns about d by the
    right-hand rule, −1 where it turns the other way; `thrust` k, N s²/rad², and `drag` c,
    N m s²/rad², each one number or (R,); `speeds` n (R,) rad/s: constant, a callable Module of
    time such as `Held(times, values)`, or `Input("speeds")`.

    Source: Mahony, Kumar and Corke 2012, Multirotor aerial vehicles, eqs 4–6,
    doi:10.1109/MRA.2012.2206474.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype; `ValueError` for a direction
    that is not a unit vector, or a spin that is not 1 or −1.

    >>> from rigidjax import Rigid, shapes
    >>> up = Rotors([[0.1, 0.0, 0.0]], [[0.0, 0.0, 1.0]], [1.0], 2.0, 0.5, [3.0])
    >>> rest = Rigid([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> up(0.0, rest, shapes.sphere(1.0, 1.0)).torque.tolist()
    [0.0, -1.8, -4.5]
    """

    feels: ClassVar[type] = HasPose
    positions: Float[Array, "rotors 3"]
    directions: Float[Array, "rotors 3"]
    spins: Float[Array, " rotors"]
    thrust: Float[Array, "*rotors"]
    drag: Float[Array, "*rotors"]
    speeds: eqx.Module | Float[Array, " rotors"]

    def __init__(
        self,
        positions: Float[ArrayLike, "rotors 3"] | Any,
        directions: Float[ArrayLike, "rotors 3"] | Any,
        spins: Float[ArrayLike, " rotors"] | Any,
        thrust: Float[ArrayLike, "*rotors"] | Any,
        drag: Float[ArrayLike, "*rotors"] | Any,
        speeds: Any,
    ):
        shape = _checks.numbers(positions, "positions").shape
        if len(shape) != 2 or shape[1] != 3 or not shape[0]:
            raise ValueError(f"positions: wanted (R, 3), one row a rotor, got shape {shape}")
        count = shape[0]
        self.positions = given(positions, (count, 3), "positions")
        self.directions = given(directions, (count, 3), "directions")
        self.spins = given(spins, (count,), "spins")
        if validation.known(self.directions):
            lengths = np.linalg.norm(np.asarray(self.directions, float), axis=1)
            if abs(lengths - 1).max() > 1e-6:
                raise ValueError(f"directions: wanted unit vectors, got lengths {lengths}")
        if validation.known(self.spins) and (abs(np.asarray(self.spins)) != 1).any():
            raise ValueError(f"spins: wanted 1 or -1 for each rotor, got {np.asarray(self.spins)}")
        alone = _checks.numbers(thrust, "thrust").ndim, _checks.numbers(drag, "drag").ndim
        self.thrust = given(thrust, (count,) if alone[0] else (), "thrust")
        self.drag = given(drag, (count,) if alone[1] else (), "drag")
        self.speeds = constant_or_callable(speeds, "speeds", count)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the speeds jump or have a kink."""
        return jumps_of(self.speeds)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        n = vector_at(self.speeds, t, "speeds", self.spins.shape[0]).astype(self.spins.dtype)
        square = n * n
        lift, twist = self.thrust * square, self.spins * self.drag * square
        # Written out, rotor by rotor: few, and sums of arrays are slow in a batch.
        force, torque = jnp.zeros(3, lift.dtype), jnp.zeros(3, lift.dtype)
        for i in range(self.spins.shape[0]):
            along = self.directions[i]
            force = force + lift[i] * along
            torque = torque + lift[i] * cross(self.positions[i], along) - twist[i] * along
        return Wrench(quaternion.rotate(state.q, force), torque)


class BodyDrag(AbstractForce):
    """Drag along the body's axes: `F = −R (a ∘ u + b ∘ |u| u)`, `τ = c × RᵀF`, `u = Rᵀ (v − wind)`.

    **Arguments:** `linear` a (3,) kg/s, such as of rotors in a cross-flow; `quadratic` b (3,) kg/m;
    `centre` c (3,) the point where it acts, m, body frame, from the centre of mass; `wind` (3,) the
    air's velocity, m/s, world frame. For a sphere see `Drag`.

    Source: Faessler, Franchi and Scaramuzza 2018, eq 5, doi:10.1109/LRA.2017.2776353, for the
    linear part; Hoerner 1965, Fluid-Dynamic Drag, for the other. |u| u is taken axis by axis.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> from rigidjax import Rigid, shapes
    >>> fast = Rigid([0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> BodyDrag([1.0, 1, 1], [0.5, 0, 0])(0.0, fast, shapes.sphere(1.0, 1.0)).force.tolist()
    [-4.0, 0.0, 0.0]
    """

    feels: ClassVar[type] = HasPose
    linear: Float[Array, "3"]
    quadratic: Float[Array, "3"]
    centre: Float[Array, "3"]
    wind: Float[Array, "3"]

    def __init__(
        self,
        linear: Vector,
        quadratic: Vector = (0.0, 0.0, 0.0),
        centre: Vector = (0.0, 0.0, 0.0),
        wind: Vector = (0.0, 0.0, 0.0),
    ):
        self.linear = given(linear, (3,), "linear")
        self.quadratic = given(quadratic, (3,), "quadratic")
        self.centre = given(centre, (3,), "centre")
        self.wind = given(wind, (3,), "wind")

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        u = quaternion.rotate_inverse(state.q, state.v - self.wind)
        force = -(self.linear + self.quadratic * jnp.abs(u)) * u
        return Wrench(quaternion.rotate(state.q, force), cross(self.centre, force))
