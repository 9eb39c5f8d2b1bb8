"""Provide the sensor of a whole state, for windows of measured states."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, HasSpin
from rigidjax.identify.sensors.base import AbstractSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import minus_small

_FEELS = {Spin: HasSpin, Attitude: HasAttitude, Rigid: HasPose}
_SIZES = {Spin: (3, 3), Attitude: (7, 6), Rigid: (13, 12)}
# Each part of the state but the first begins at this index of a reading.
_CUTS = {Spin: (), Attitude: (4,), Rigid: (3, 6, 10)}


class StateSensor(AbstractSensor):
    """Measure a whole state as a row of numbers: (3,) Ω, (7,) q, Ω, or (13,) x, v, q, Ω.

    The error is the change from the predicted state to the measured state, as `motion.manifold`
    counts it: three numbers for each part of the state; for q they are a rotation vector (body
    frame, rad).

    **Arguments:**

    - `kind`: the class of the state, `Spin`, `Attitude` or `Rigid`.
    - `noise`: (k,) the standard deviations of the k numbers of the error.
    - `nominal`: whether `noise` holds no more than units, and the size of the errors is estimated.

    >>> StateSensor(rj.Attitude, jnp.ones(6), False).reading_shape
    (7,)
    """

    kind: type = eqx.field(static=True)
    noise: Float[Array, "*records k"] | None
    nominal: bool = eqx.field(static=True)
    unit: ClassVar[str] = ""

    @property
    def reading_shape(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the shape of a reading."""
        return (_SIZES[self.kind][0],)

    @property
    def components(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the number of components of an error."""
        return _SIZES[self.kind][1]

    @property
    def feels(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the protocol of the smallest state with all the parts that the sensor reads."""
        return _FEELS[self.kind]

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, " k"]:
        leaves = jnp.split(reading, _CUTS[self.kind])
        return minus_small(self.kind(*leaves), motion.state)
