"""A magnet in a field."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, Scalar, ScalarLike, Vec3
from rigidjax.body._types import Vector
from rigidjax.motion.torques.base import (
    AbstractTorque,
    constant_or_callable,
    given,
    jumps_of,
    stays,
    vector_at,
)
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot


class MagneticDipole(AbstractTorque):
    """A magnetic moment fixed in the body, in a uniform field: `τ = m × RᵀB`, `U = −m·RᵀB`.

    **Arguments:** `moment` (3,) m, A m², body frame; `field` B, T, world frame: (3,), or a callable
    Module of time, t → (3,), for a field that changes along an orbit.

    Source: Jackson, Classical Electrodynamics, eqs 5.71, 5.72.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import rigidjax as rj
    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> MagneticDipole([0.0, 0.0, 2.0], [3.0, 0.0, 0.0])(0.0, state, None).tolist()  # z × x = y
    [0.0, 6.0, 0.0]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    moment: Float[Array, "3"]
    field: eqx.Module | Float[Array, "3"]

    def __init__(self, moment: Vector, field: object):
        self.moment = given(moment, (3,), "moment")
        self.field = constant_or_callable(field, "field")

    @property
    def steady(self) -> bool:
        """Whether the field stays the same."""
        return not callable(self.field)

    @property
    def axis(self) -> Vec3 | None:
        """The direction about which there is no torque, world frame, if it stays: the field's."""
        return stays(self.field)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the field jumps or has a kink."""
        return jumps_of(self.field)

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J: `U = −m·RᵀB`."""
        return -dot(self.moment, self._field_in_body(t, state))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        return cross(self.moment, self._field_in_body(t, state))

    def _field_in_body(self, t, state):
        return quaternion.rotate_inverse(state.q, vector_at(self.field, t, "field"))
