"""Provide the sensor of a whole state, for windows of measured states."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, HasSpin
from rigidjax.identify.sensors.base import AbstractSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import minus_small

# For each class of state, _FEELS holds the protocol of the states from which such a reading can be
# predicted, and _SIZES how many numbers a reading has, and how many components its error.
_FEELS = {Spin: HasSpin, Attitude: HasAttitude, Rigid: HasPose}
_SIZES = {Spin: (3, 3), Attitude: (7, 6), Rigid: (13, 12)}
# A reading is split at these indices into the parts of the state, such as q and Ω.
_CUTS = {Spin: (), Attitude: (4,), Rigid: (3, 6, 10)}


class StateSensor(AbstractSensor):
    """Measure a whole state as a row of numbers: (3,) Ω, (7,) q, Ω, or (13,) x, v, q, Ω.

    The error is the difference from the predicted state as in `motion.manifold`, for q a rotation
    vector (body frame, rad).
    """

    # `Spin`, `Attitude` or `Rigid`.
    kind: type = eqx.field(static=True)
    noise: Float[Array, "*records k"] | None
    # Whether `noise` holds only units, in which a fit estimates the size of the errors.
    nominal: bool = eqx.field(static=True)
    unit: ClassVar[str] = ""

    @property
    def reading_shape(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (_SIZES[self.kind][0],)

    @property
    def components(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return _SIZES[self.kind][1]

    @property
    def feels(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        return _FEELS[self.kind]

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, " k"]:
        leaves = jnp.split(reading, _CUTS[self.kind])
        return minus_small(self.kind(*leaves), motion.state)
