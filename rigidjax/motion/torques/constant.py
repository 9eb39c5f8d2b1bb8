"""Torques that stay the same: in the body, or in space."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasSpin, ScalarLike, Vec3
from rigidjax.body._types import Vector
from rigidjax.motion.torques.base import (
    AbstractTorque,
    constant_or_callable,
    given,
    jumps_of,
    vector_at,
)
from rigidjax.rotation import quaternion


class ConstantTorque(AbstractTorque):
    """A torque that stays the same in the body, such as a thruster: `τ = const`.

    **Arguments:** `torque` (3,) N m, body frame. About a principal axis it spins the body up
    linearly (Euler 1758); for one in space see `InSpace`.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> ConstantTorque([0.0, 0.0, 1.0])(0.0, rj.Spin([0.0, 0.0, 5.0]), None).tolist()
    [0.0, 0.0, 1.0]
    """

    feels: ClassVar[type] = HasSpin
    rate_free: ClassVar[bool] = True
    torque: Float[Array, "3"]

    def __init__(self, torque: Vector):
        self.torque = given(torque, (3,), "torque")

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return self.torque


class InSpace(AbstractTorque):
    """A torque whose direction is given in space: `τ = Rᵀ τ_w`.

    **Arguments:** `torque` τ_w, N m, world frame: (3,), or a callable Module of time, t → (3,),
    such as `Linear(times, values)`.

    A constant τ_w keeps the angular momentum across it, and adds τ_w t along it.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> turned = rj.Attitude([0.0, 1.0, 0.0, 0.0], [0.0, 0, 0])  # half a turn about x
    >>> InSpace([0.0, 0.0, 1.0])(0.0, turned, None).tolist()  # in body axes
    [0.0, 0.0, -1.0]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    torque: eqx.Module | Float[Array, "3"]

    def __init__(self, torque: object):
        self.torque = constant_or_callable(torque, "torque")

    @property
    def steady(self) -> bool:
        """Whether it does not depend on time."""
        return not callable(self.torque)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the torque jumps or has a kink."""
        return jumps_of(self.torque)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        return quaternion.rotate_inverse(state.q, vector_at(self.torque, t, "torque"))
