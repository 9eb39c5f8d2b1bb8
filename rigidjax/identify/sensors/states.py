"""Provide the sensor of a whole state, for windows of measured states."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, HasSpin
from rigidjax.identify.sensors.base import AbstractSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import minus_small

# _FEELS holds, for each class of state, the protocol of the states from which such a reading can be
# predicted. _SIZES holds two numbers for each class: how many numbers a reading has, and how many
# components its error has (an attitude has 4 numbers, but its error has 3 components).
_FEELS = {Spin: HasSpin, Attitude: HasAttitude, Rigid: HasPose}
_SIZES = {Spin: (3, 3), Attitude: (7, 6), Rigid: (13, 12)}
# A reading is split at these indices into the parts of the state, such as q and Ω.
_CUTS = {Spin: (), Attitude: (4,), Rigid: (3, 6, 10)}


class StateSensor(AbstractSensor):
    """Measure a whole state as a row of numbers: (3,) Ω, (7,) q, Ω, or (13,) x, v, q, Ω.

    Here Ω is the body rate, q the attitude (a quaternion), x the position and v the velocity.

    The error is the difference of the measured state from the predicted state, as in
    `motion.manifold`: it has three numbers for each part of the state. For q the three numbers are
    a rotation vector (body frame, rad).

    **Arguments:**

    - `kind`: the class of the state, `Spin`, `Attitude` or `Rigid`.
    - `noise`: (k,) the standard deviations of the k numbers of the error.
    - `nominal`: whether `noise` holds only units in which the errors are counted; a fit then
      estimates the size of the errors in these units.

    >>> StateSensor(rj.Attitude, jnp.ones(6), False).reading_shape
    (7,)
    """

    kind: type = eqx.field(static=True)
    noise: Float[Array, "*records k"] | None
    nominal: bool = eqx.field(static=True)
    unit: ClassVar[str] = ""

    @property
    def reading_shape(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the shape of a reading of this sensor: (3,), (7,) or (13,), by its `kind` of
        state.
        """
        return (_SIZES[self.kind][0],)

    @property
    def components(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the number of components of an error of this sensor: 3, 6 or 12, by its `kind` of
        state.
        """
        return _SIZES[self.kind][1]

    @property
    def feels(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the protocol, such as `HasPose`, of the states that have all parts that the sensor
        reads.
        """
        return _FEELS[self.kind]

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, " k"]:
        leaves = jnp.split(reading, _CUTS[self.kind])
        return minus_small(self.kind(*leaves), motion.state)
