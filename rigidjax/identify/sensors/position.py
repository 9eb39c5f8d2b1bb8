"""Sensors of the position and the velocity of the body."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax._types import HasPose, Scalar, Vec3
from rigidjax.identify.sensors.base import (
    AbstractSensor,
    SensorInput,
    deviations,
    optional,
    required,
)
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot


class Position(AbstractSensor):
    """Reads the centre of mass, in the world: `x + bias`, m. Use `Marker` for another point.

    **Arguments:** `noise` m, one number or (3,), `None` to estimate it; `bias` (3,) m, world frame,
    or `None`; `offset` s as for `Gyro`. For a `Rigid`.

    **Raises** `ValueError` as `Gyro`.

    >>> Position(noise=0.01).unit
    'm'
    """

    reading_shape: ClassVar[tuple[int, ...]] = (3,)
    components: ClassVar[int] = 3
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    noise: Vec3 | None = eqx.field(converter=deviations(), default=None)
    _: dataclasses.KW_ONLY
    bias: Vec3 | None = eqx.field(converter=optional("bias"), default=None)
    offset: Scalar | None = eqx.field(converter=optional("offset", ()), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        place = now.state.x
        return reading - (place if self.bias is None else place + self.bias)


class Velocity(AbstractSensor):
    """Reads the velocity of a point of the body: `v + R (Ω × r)`, in the world or in its own axes.

    **Arguments:** `noise` m/s, one number or (3,), `None` to estimate it; `place` (3,) the point,
    m, in the frame of the `MassProperties` (r is the vector to it from the centre of mass); `None`
    for the centre of mass itself; `mounting` (3,) rotation vector that turns the body's axes onto
    the sensor's, rad, for a sensor on the body, such as a Doppler log (zeros for the body's axes);
    `None` for the world's axes, as in satellite navigation; `bias` (3,) m/s
    or `None`; `offset` s as for `Gyro`. For a `Rigid`.

    Source: velocity of a point of a rigid body, Landau and Lifshitz, Mechanics, eq 31.2.

    **Raises** `ValueError` as `Gyro`.

    >>> Velocity(noise=0.1, mounting=[0.0, 0.0, 0.0]).unit
    'm/s'
    """

    reading_shape: ClassVar[tuple[int, ...]] = (3,)
    components: ClassVar[int] = 3
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m/s"
    noise: Vec3 | None = eqx.field(converter=deviations(), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=optional("place"), default=None)
    mounting: Vec3 | None = eqx.field(converter=optional("mounting"), default=None)
    bias: Vec3 | None = eqx.field(converter=optional("bias"), default=None)
    offset: Scalar | None = eqx.field(converter=optional("offset", ()), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        state = now.state
        seen = state.v
        if self.place is not None:
            arm = now.lever(self.place)
            seen = seen + quaternion.rotate(state.q, cross(state.omega, arm))
        if self.mounting is not None:
            turn = quaternion.multiply(state.q, quaternion.exp(self.mounting))
            seen = quaternion.rotate_inverse(turn, seen)
        return reading - (seen if self.bias is None else seen + self.bias)


class Range(AbstractSensor):
    """Reads the distance from a station to a point of the body: `|x + R r − s| + bias`, m.

    **Arguments:** `station` s (3,) m, world frame; `noise` m, `None` to estimate it; `place` (3,)
    the point, m, in the frame of the `MassProperties`; `None` for the centre of mass; `bias`
    m, or `None`; `offset` s as for `Gyro`. Readings (T,). For a `Rigid`.

    **Raises** `ValueError` as `Gyro`, and for a reading below zero.

    >>> Range([0.0, 0.0, 100.0], noise=0.05).reading_shape
    ()
    """

    reading_shape: ClassVar[tuple[int, ...]] = ()
    components: ClassVar[int] = 1
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    station: Vec3 = eqx.field(converter=required("station"), default=None)
    noise: Float[Array, "1"] | None = eqx.field(converter=deviations(1), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=optional("place"), default=None)
    bias: Scalar | None = eqx.field(converter=optional("bias", ()), default=None)
    offset: Scalar | None = eqx.field(converter=optional("offset", ()), default=None)

    def error(self, now: SensorInput, reading: Array) -> Float[Array, "1"]:
        state = now.state
        line = state.x - self.station
        if self.place is not None:
            line = line + quaternion.rotate(state.q, now.lever(self.place))
        # There is no direction at the station itself, and no derivative: it is set to 0.
        square = dot(line, line)
        length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
        found = length if self.bias is None else length + self.bias
        return (reading - found)[None]

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        if self.bias is not None:
            return np.zeros(values.shape, bool), ""
        return values < 0, "the distance at index {index} is below zero"
