"""The sensor of a whole state, for windows of measured states."""

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
# The index in a reading at which each part of the state but the first begins.
_CUTS = {Spin: (), Attitude: (4,), Rigid: (3, 6, 10)}


class StateSensor(AbstractSensor):
    """A sensor that reads a whole state as a row of numbers: (3,) Ω, (7,) q, Ω, (13,) x, v, q, Ω.

    The error is the change from the predicted state to the one that was read, as `motion.manifold`
    counts it: three numbers for each part, for q a rotation vector (body frame, rad).

    **Arguments:**

    - `kind`: the class of the state, `Spin`, `Attitude` or `Rigid`.
    - `noise`: (k,) the standard deviations of the k numbers of the error.
    - `nominal`: whether these are no more than units, and the errors are estimated.

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
        """Return the protocol of the smallest state that has the parts that are read."""
        return _FEELS[self.kind]

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, " k"]:
        leaves = jnp.split(reading, _CUTS[self.kind])
        return minus_small(self.kind(*leaves), motion.state)
