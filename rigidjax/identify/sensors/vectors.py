"""Provide sensors that read a vector in their own axes: rate gyro, accelerometer, magnetometer."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, HasSpin, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import ClockedSensor, SensorInput
from rigidjax.identify.sensors.tolerance import Tolerance, tolerance_of
from rigidjax.motion.torques.carried import relative_acceleration
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply


class VectorSensor(ClockedSensor):
    """Define a sensor that reads a vector v in its own axes: `scale · S exp(−mounting) v + bias`.

    S follows from the field `skew` (see `Gyro`).
    """

    noise: Vec3 | None = eqx.field(converter=base.deviations_field(), default=None)
    _: dataclasses.KW_ONLY
    bias: Vec3 | None = eqx.field(converter=base.optional_array_field("bias"), default=None)
    scale: Vec3 | None = eqx.field(converter=base.optional_array_field("scale"), default=None)
    mounting: Vec3 | None = eqx.field(converter=base.optional_array_field("mounting"), default=None)
    skew: Vec3 | None = eqx.field(converter=base.optional_array_field("skew"), default=None)
    limit: Vec3 | None = eqx.field(
        converter=lambda limit: base.positive_numbers(limit, "limit", "a positive full scale", 3),
        default=None,
    )
    tolerance: Tolerance | None = eqx.field(converter=tolerance_of, default=None)

    def _read(self, vector: Vec3) -> Vec3:
        """Return the predicted reading of a `vector` in the body frame."""
        reading = vector
        if self.mounting is not None:
            reading = quaternion.rotate(quaternion.exp(-self.mounting), reading)
        if self.skew is not None:
            (x, y, z), (a, b, c) = reading, self.skew
            reading = jnp.stack([x + a * y + b * z, y + c * z, z])
        if self.scale is not None:
            reading = self.scale * reading
        return reading if self.bias is None else reading + self.bias


class Gyro(VectorSensor):
    """Measure the body rate with a rate gyro: `scale · S exp(−mounting) Ω + bias + G f`, rad/s.

    **Arguments**, each `None` by default; except for `noise` and `limit`, `None` means that the
    sensor does not have this error or property. A fit can estimate a number that is not `None` (see
    `Free`):

    - `noise`: the standard deviation of a reading, rad/s, one number or (3,); `None` estimates it
      from the residuals.
    - `bias`: (3,) rad/s.
    - `scale`: (3,) the scale of each channel.
    - `mounting`: (3,) the rotation vector from the body's axes to the sensor's axes, rad.
    - `skew`: (3,) three fractions (a, b, c), for axes that are not orthogonal. The x channel also
      reads the fraction a of the y component and the fraction b of the z component, and the y
      channel also reads the fraction c of the z component: `S = [[1, a, b], [0, 1, c], [0, 0, 1]]`.
    - `limit`: the full scale, rad/s, one number or (3,). A reading at full scale says only that the
      true value is at least this large. `None` finds the full scale from the readings.
    - `offset`: the clock offset, s: the reading with the time stamp t was taken at t + offset.
    - `jitter`: the standard deviation of the time stamps, s. The errors of time
      stamps are independent. An error of a time stamp changes the reading; this change is computed
      as the error times the time derivative of the prediction. The result is right if the body
      turns little in a time as long as the jitter.
    - `tolerance`: a `Tolerance` for scale, axes, bias and clock, or a word for one: "phone",
      "consumer", "industrial", "calibrated".
    - `g_sensitivity`: (3, 3) the matrix G, in rad/s per m/s², whose product with f is added to the
      reading. The vector f is the specific force at the gyro, in the body's axes.
    - `place`: (3,) the place of the gyro, in metres, as for `Accelerometer`; it needs
      `g_sensitivity`, with which the default is zero.
    - `gravity`: (3,) the gravity, in m/s², as for `Accelerometer`; it needs `g_sensitivity`.

    **Raises** `ValueError` for a noise, limit or jitter that is not positive, a wrong shape, NaN.

    >>> Gyro(noise=0.01).noise.shape
    (3,)
    """

    unit: ClassVar[str] = "rad/s"
    _: dataclasses.KW_ONLY
    g_sensitivity: Float[Array, "3 3"] | None = eqx.field(
        converter=base.optional_array_field("g_sensitivity", (3, 3)), default=None
    )
    place: Vec3 | None = eqx.field(converter=base.optional_array_field("place"), default=None)
    gravity: Vec3 | None = eqx.field(converter=base.optional_array_field("gravity"), default=None)
    # `feels` is the state that the gyro needs, which `__post_init__` sets: the body rate, and the
    # attitude only if there is a gravity to turn into the body frame.
    feels: type = eqx.field(static=True, init=False, default=HasSpin)

    def __post_init__(self) -> None:
        self.feels = HasSpin if self.gravity is None else HasAttitude
        if self.g_sensitivity is None:
            if self.place is not None or self.gravity is not None:
                raise ValueError(
                    "Gyro: place and gravity need a g_sensitivity, which was not given; without it "
                    "they have no effect on the reading"
                )
        elif self.place is None:
            self.place = jnp.zeros(3)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        prediction = self._read(motion.state.omega)
        if self.g_sensitivity is not None:
            assert self.place is not None
            force = specific_force(motion, self.place, self.gravity)
            prediction = prediction + apply(self.g_sensitivity, force)
        return reading - prediction


def specific_force(motion: SensorInput, place: Vec3, gravity: Vec3 | None) -> Vec3:
    """Return the specific force at a place of the body, m/s², body frame: `Rᵀ(a − g) + dΩ/dt × r +
    Ω × (Ω × r)`.

    Here a is the acceleration of the reference point of `SensorInput.lever`, and r the vector from
    it to the `place`. Without `gravity` the result is only the terms with r.
    """
    state, rate = motion.state, motion.rate
    r = motion.lever(place)
    force = relative_acceleration(state.omega, rate.omega, r)
    if gravity is None:
        return force
    acceleration = rate.v if isinstance(state, HasPose) else 0.0
    return force + quaternion.rotate(quaternion.conjugate(state.q), acceleration - gravity)


class Accelerometer(VectorSensor):
    """Measure the specific force with an accelerometer: `scale · S exp(−mounting) f + bias`, m/s².

    The specific force is `f = Rᵀ(a − g) + dΩ/dt × r + Ω × (Ω × r)` in the body frame (notes, eq 88,
    seen from the body). Here R is the rotation from body to world axes, Ω the body rate, and g the
    gravity. The vector r leads to the sensor from the centre of mass, or from the pivot of a body
    on a pivot, and a is the acceleration of this point. A body in free fall has a = g, so that only
    the terms with r remain.

    **Arguments:**

    - `noise`: the standard deviation, m/s², one number or (3,); `None` estimates the noise.
    - `place`: (3,) the sensor's place, m, body frame: from the reference point of the `Inertia`, or
      in the frame of the `MassProperties`.
    - `gravity`: (3,) m/s², world frame; `None` for a body in free fall (`Spin`, `Attitude`). A body
      on a pivot and a `Rigid` need it.
    - `bias`, `scale`, `mounting`, `skew`, `limit`, `offset`, `jitter`, `tolerance`: as
      for `Gyro`.

    **Raises** `ValueError` for a noise, limit or jitter that is not positive, a wrong shape, NaN.

    >>> Accelerometer(noise=0.1, place=[0.01, 0.0, 0.0]).unit
    'm/s²'
    """

    # `feels` is the state that the accelerometer needs: the body rate, and the attitude only if
    # there is a gravity to turn into the body frame.
    feels: ClassVar[Any] = property(lambda self: HasSpin if self.gravity is None else HasAttitude)
    unit: ClassVar[str] = "m/s²"
    _: dataclasses.KW_ONLY
    place: Vec3 = eqx.field(converter=base.array_field("place"), default=None)
    gravity: Vec3 | None = eqx.field(converter=base.optional_array_field("gravity"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        return reading - self._read(specific_force(motion, self.place, self.gravity))


class Magnetometer(VectorSensor):
    """Measure a known magnetic field with a magnetometer: `scale · S exp(−mounting) Rᵀ b + bias`.

    Here b is the field in the world frame, and Rᵀ turns b to body axes; the matrix S is that of
    `skew` in `Gyro`.

    For a sensor that measures only the direction of the field use `Direction`.

    **Arguments:**

    - `noise`: the standard deviation of a reading, in the field's unit, one number or (3,); `None`
      estimates the noise.
    - `field`: (3,) b, world frame, any unit.
    - `bias`: (3,) the body's own magnetism, in the field's unit.
    - `scale`, `mounting`, `skew`, `limit`, `offset`, `jitter`, `tolerance`: as for
      `Gyro`.

    **Raises** `ValueError` for a noise, limit or jitter that is not positive, a wrong shape, NaN.

    >>> Magnetometer(noise=1e-7, field=[2e-5, 0.0, 4e-5]).reading_shape
    (3,)
    """

    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "of the field"
    _: dataclasses.KW_ONLY
    field: Vec3 = eqx.field(converter=base.array_field("field"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        field = quaternion.rotate(quaternion.conjugate(motion.state.q), self.field)
        return reading - self._read(field)
