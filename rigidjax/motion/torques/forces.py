"""Forces on a body that moves: uniform gravity, a centre of attraction, drag."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasPose, Scalar, ScalarLike, Vec3
from rigidjax.body._types import Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.motion.torques.base import AbstractForce, Wrench, given, length_or_zero
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot


class UniformGravity(AbstractForce):
    """The same acceleration everywhere: `F = m g`, no torque about the centre, `U = −m g·x`.

    **Arguments:** `gravity` (3,) g, m/s², world frame, such as [0, 0, −9.81].

    Source: notes, eq 84.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> UniformGravity([0.0, 0.0, -9.8])(0.0, state, body).force.tolist()  # N
    [0.0, 0.0, -19.6]
    """

    feels: ClassVar[type] = HasPose
    gravity: Float[Array, "3"]

    def __init__(self, gravity: Vector):
        self.gravity = given(
            gravity, (3,), "gravity", hint="a vector in world axes, such as [0, 0, -9.81]"
        )

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def energy(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Scalar:
        """Potential energy, J: `U = −m g·x`, zero at the world's origin."""
        return -body.mass * dot(self.gravity, state.x)

    def internal_momentum(self, t: ScalarLike) -> Vec3:
        """Zero, N m s: it does not turn the body, and nothing turns inside."""
        return jnp.zeros_like(self.gravity)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        return Wrench(body.mass * self.gravity)


class CentralGravity(AbstractForce):
    """A centre of attraction at the world's origin, on a body of some size.

    `U = −μ m/r − (μ/2r³)(Tr I − 3 r̂·I_w r̂)` (MacCullagh's formula), with its force and its torque,
    so that the energy and the momentum about the origin are kept. `I_w = R I Rᵀ`.

    **Arguments:** `mu` μ = G M, m³/s². Source: Hughes, Spacecraft Attitude Dynamics, §8.1.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], 1e-9 * jnp.eye(3))
    >>> state = rj.Rigid([2.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> round(float(CentralGravity(8.0)(0.0, state, body).force[0]), 6)  # N, −m μ/r²
    -4.0
    """

    feels: ClassVar[type] = HasPose
    mu: Float[Array, ""]

    def __init__(self, mu: ScalarLike):
        self.mu = given(mu, (), "mu")

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def energy(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Scalar:
        """Potential energy, J, zero far away."""
        r = jnp.sqrt(dot(state.x, state.x))
        tensor = body.inertia.tensor
        up = quaternion.rotate_inverse(state.q, state.x / r)
        size = tensor[0, 0] + tensor[1, 1] + tensor[2, 2] - 3 * dot(up, apply(tensor, up))
        return -(self.mu / r) * (body.mass + 0.5 * size / r / r)

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        r = jnp.sqrt(dot(state.x, state.x))
        tensor = body.inertia.tensor
        up = quaternion.rotate_inverse(state.q, state.x / r)
        pull = apply(tensor, up)
        strength = self.mu / r / r
        trace, along = tensor[0, 0] + tensor[1, 1] + tensor[2, 2], dot(up, pull)
        # −∂U/∂x in body axes: the part along r, and the part of I r̂ across it.
        radial = -strength * (body.mass + 1.5 * (trace - 5 * along) / r / r)
        force = radial * up - 3 * strength / r / r * pull
        return Wrench(quaternion.rotate(state.q, force), cross(3 * strength / r * up, pull))


class Drag(AbstractForce):
    """Drag of a fluid: `F = −k |u| u`, `u = v − wind`, at a point of the body.

    **Arguments:** `coefficient` k = ½ ρ C_d A, kg/m; `centre` (3,) the point where it acts, m, body
    frame, from the centre of mass (there `τ = c × RᵀF`); `wind` (3,) the fluid's velocity, m/s,
    world frame. The body's own turning is not counted in u: that is `Damping`, `QuadraticDamping`.

    Source: Newton, Principia, Book II, Section II. At u = 0 the first derivative is right, and
    zero; a second does not exist there.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> body = rj.MassProperties(2.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([0.0, 0, 0], [3.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> float(Drag(0.5)(0.0, state, body).force[0])  # N, −0.5 · 3²
    -4.5
    """

    feels: ClassVar[type] = HasPose
    coefficient: Float[Array, ""]
    centre: Float[Array, "3"]
    wind: Float[Array, "3"]

    def __init__(
        self,
        coefficient: ScalarLike,
        centre: Vector = (0.0, 0.0, 0.0),
        wind: Vector = (0.0, 0.0, 0.0),
    ):
        self.coefficient = given(coefficient, (), "coefficient")
        self.centre = given(centre, (3,), "centre")
        self.wind = given(wind, (3,), "wind")

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        u = state.v - self.wind
        force = -self.coefficient * length_or_zero(u) * u
        return Wrench(force, cross(self.centre, quaternion.rotate_inverse(state.q, force)))
