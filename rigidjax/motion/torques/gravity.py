"""Gravity on what only turns: a heavy top about its fixed point, and the gradient of a far body."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, Scalar, ScalarLike, Vec3
from rigidjax.body import validation
from rigidjax.body._types import Vector
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion.torques.base import (
    AbstractTorque,
    constant_or_callable,
    given,
    jumps_of,
    stays,
    tensor_of,
    vector_at,
)
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot


class HeavyTop(AbstractTorque):
    """Gravity on a body with a fixed point: `τ = c × m Rᵀg`, `U = −m g·Rc`.

    **Arguments:** `mass` m, kg; `com` (3,) c, from the fixed point to the centre of mass, m, body
    frame; `gravity` (3,) g, m/s², world frame, such as [0, 0, −9.81]. The body's `Inertia` is the
    one **about the fixed point** (`MassProperties.inertia_about`, `Inertia.shifted`). Any top:
    Lagrange's, Kovalevskaya's, Goryachev–Chaplygin's, a general one, and the physical pendulum.

    Keeps the energy and the momentum along g. Source: Landau and Lifshitz, Mechanics, §35;
    Arnold, Mathematical Methods of Classical Mechanics, §30.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype; `TypeError` on a `Rigid`,
    which has no fixed point.

    >>> top = HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    >>> from rigidjax import Attitude, Inertia
    >>> top.energy(0.0, Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), Inertia(jnp.eye(3)))
    Array(9.81, dtype=float64)
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    mass: Float[Array, ""]
    com: Float[Array, "3"]
    gravity: Float[Array, "3"]

    def __init__(self, mass: ScalarLike, com: Vector, gravity: Vector):
        self.mass = given(mass, (), "mass")
        self.com = given(com, (3,), "com")
        self.gravity = given(
            gravity, (3,), "gravity", hint="a vector in world axes, such as [0, 0, -9.81]"
        )

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    @property
    def axis(self) -> Vec3:
        """The direction about which there is no torque: gravity's, world frame."""
        return self.gravity

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J: `U = −m g·Rc`, zero where c is level with the pivot."""
        return -self.mass * dot(self.com, quaternion.rotate_inverse(state.q, self.gravity))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        if isinstance(state, HasPose):
            raise TypeError(
                "HeavyTop turns about a fixed point, got a state that moves "
                f"({type(state).__name__}); with Rigid use UniformGravity, or take an Attitude and "
                "the inertia about the fixed point"
            )
        return cross(self.mass * self.com, quaternion.rotate_inverse(state.q, self.gravity))


class GravityGradient(AbstractTorque):
    """The torque of a far central body: `τ = (3μ/r³) r̂' × I r̂'`, `r̂' = Rᵀ r̂`.

    **Arguments:** `mu` μ = G M of the central body, m³/s²; `position` r (3,) m, world frame, from
    the central body to the body or back (the sign does not matter): constant, or a callable Module
    of time, t → (3,), for an orbit.

    `U = (μ/2r³)(3 r̂'·I r̂' − Tr I)`, the second term of MacCullagh's formula; the orbit itself is
    not changed by it. Source: Hughes, Spacecraft Attitude Dynamics, §8.1; Goldstein, Poole and
    Safko, Classical Mechanics, eq 5.86.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype; `ValueError` for no distance.

    >>> import rigidjax as rj
    >>> law, body = GravityGradient(1.0, [1.0, 1.0, 0.0]), rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> round(float(law(0.0, state, body)[2]), 6)  # 3/r³ · ½ (I₂ − I₁), r = √2
    0.53033
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    mu: Float[Array, ""]
    position: eqx.Module | Float[Array, "3"]

    def __init__(self, mu: ScalarLike, position: object):
        self.mu = given(mu, (), "mu")
        self.position = constant_or_callable(position, "position")
        at: Any = self.position
        if not callable(at) and validation.known(at) and not np.asarray(at).any():
            raise ValueError(
                "position: wanted the vector between the body and the central body, got zero"
            )

    @property
    def steady(self) -> bool:
        """Whether the central body stays where it is."""
        return not callable(self.position)

    @property
    def axis(self) -> Vec3 | None:
        """The direction without torque about it, world frame, if it stays: the position's."""
        return stays(self.position)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the position jumps or has a kink."""
        return jumps_of(self.position)

    def energy(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Scalar:
        """Potential energy of the attitude, J: `U = (μ/2r³)(3 r̂'·I r̂' − Tr I)`."""
        tensor = tensor_of(body)
        down, strength = self._down(t, state)
        trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
        return 0.5 * strength * (3 * dot(down, apply(tensor, down)) - trace)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Vec3:
        down, strength = self._down(t, state)
        return cross(3 * strength * down, apply(tensor_of(body), down))

    def _down(self, t, state):
        """Direction of the central body in body axes, and μ/r³."""
        r = vector_at(self.position, t, "position")
        distance = jnp.sqrt(dot(r, r))
        # r³ overflows in float32 beyond 7e12 m: divide by r three times instead.
        return (
            quaternion.rotate_inverse(state.q, r / distance),
            self.mu / distance / distance / distance,
        )
