"""Sensors that read a vector in their own axes: rate gyro, accelerometer, magnetometer."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasPose, HasSpin, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import ClockedSensor, SensorInput
from rigidjax.identify.sensors.lowpass import LowPass, lowpass_of
from rigidjax.identify.sensors.tolerance import Tolerance
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross


class VectorSensor(ClockedSensor):
    """A sensor that reads a vector in its own axes: `scale · S exp(−mounting) v + bias`."""

    noise: Vec3 | None = eqx.field(converter=base.deviations(), default=None)
    _: dataclasses.KW_ONLY
    bias: Vec3 | None = eqx.field(converter=base.optional("bias"), default=None)
    scale: Vec3 | None = eqx.field(converter=base.optional("scale"), default=None)
    mounting: Vec3 | None = eqx.field(converter=base.optional("mounting"), default=None)
    skew: Vec3 | None = eqx.field(converter=base.optional("skew"), default=None)
    limit: Vec3 | None = eqx.field(
        converter=lambda limit: base.positive(limit, "limit", "a positive full scale", 3),
        default=None,
    )
    lowpass: LowPass | None = eqx.field(converter=lowpass_of, default=None)
    tolerance: Tolerance | None = None

    def _shown(self, truth: Vec3) -> Vec3:
        """The prediction of `truth` v (3,), body frame, with
        `S = [[1, a, b], [0, 1, c], [0, 0, 1]]` of the skew (a, b, c).
        """
        seen = truth
        if self.mounting is not None:
            seen = quaternion.rotate(quaternion.exp(-self.mounting), seen)
        if self.skew is not None:
            (x, y, z), (a, b, c) = seen, self.skew
            seen = jnp.stack([x + a * y + b * z, y + c * z, z])
        if self.scale is not None:
            seen = self.scale * seen
        return seen if self.bias is None else seen + self.bias


class Gyro(VectorSensor):
    """Reads the body rate: `scale · S exp(−mounting) Ω + bias + G f`, rad/s.

    **Arguments:** `noise` standard deviation of a reading, rad/s, one number or (3,); `None`
    estimates it from the residuals. The others are `None` unless the sensor has them (give a value
    to let a `Free` move it): `bias` (3,) rad/s; `scale` (3,) per channel; `mounting` (3,) rotation
    vector from the body's axes to the sensor's, rad; `skew` (3,) the shares of y in its x axis, of
    z in x, and of z in y, for axes that are not orthogonal:
    `S = [[1, a, b], [0, 1, c], [0, 0, 1]]`; `limit` full scale, rad/s, one number or (3,): a
    reading at it counts as "at least that much", `None` finds it from the readings; `offset` s: the
    reading at t belongs to t + offset; `jitter` s the standard deviation of the time stamps, each a
    number of its own, or `"estimated"`; `lowpass` the `LowPass` of the readings; `tolerance` a
    `Tolerance`, how far scale, axes, bias and clock may be off; `g_sensitivity` G (3, 3),
    rad/s per m/s²: the effect on each channel of the specific force f, in the body's axes, at the
    gyro's place: `place` (3,) m and `gravity` (3,) m/s² as for `Accelerometer`, the centre of mass
    and `None` unless given.

    With jitter a reading is also wrong along the change of the prediction, by the change in the
    stamp's error: to first order, for motions that turn little in that time.

    **Raises** `ValueError` for a noise, limit or jitter that is not positive, a wrong shape, NaN.

    >>> Gyro(noise=0.01).noise.shape
    (3,)
    """

    unit: ClassVar[str] = "rad/s"
    _: dataclasses.KW_ONLY
    g_sensitivity: Float[Array, "3 3"] | None = eqx.field(
        converter=base.optional("g_sensitivity", (3, 3)), default=None
    )
    place: Vec3 | None = eqx.field(converter=base.optional("place"), default=None)
    gravity: Vec3 | None = eqx.field(converter=base.optional("gravity"), default=None)
    # Only gravity needs the attitude.
    feels: type = eqx.field(static=True, init=False, default=HasSpin)

    def __post_init__(self) -> None:
        self.feels = HasSpin if self.gravity is None else HasAttitude
        if self.g_sensitivity is None:
            if self.place is not None or self.gravity is not None:
                raise ValueError("Gyro: place and gravity need a g_sensitivity")
        elif self.place is None:
            self.place = jnp.zeros(3)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        seen = self._shown(now.state.omega)
        if self.g_sensitivity is not None:
            assert self.place is not None
            force = specific_force(now, self.place, self.gravity)
            seen = seen + apply(self.g_sensitivity, force)
        return reading - seen


def specific_force(now: SensorInput, place: Vec3, gravity: Vec3 | None) -> Vec3:
    """`Rᵀ(a − g) + dΩ/dt × r + Ω × (Ω × r)` at a place of the body, m/s², body frame."""
    state, rate = now.state, now.rate
    r = now.lever(place)
    force = cross(rate.omega, r) + cross(state.omega, cross(state.omega, r))
    if gravity is None:
        return force
    carried = rate.v if isinstance(state, HasPose) else 0.0
    return force + quaternion.rotate(quaternion.conjugate(state.q), carried - gravity)


class Accelerometer(VectorSensor):
    """Reads the specific force at its place: `scale · S exp(−mounting) f + bias`, m/s².

    `f = Rᵀ(a − g) + dΩ/dt × r + Ω × (Ω × r)` in the body frame (notes, eq 88, seen from the body),
    with r the lever arm from the centre of mass, or from the fixed point of a body on a pivot. A
    body in free fall has a = g: then only the terms of r remain.

    **Arguments:** `noise` m/s², one number or (3,), `None` to estimate it; `place` (3,) the
    sensor's place, m, body frame: from the reference point of the `Inertia`, or in the frame of the
    `MassProperties`; `gravity` (3,) m/s², world frame: `None` for a body in free fall (`Spin`,
    `Attitude`), needed by a body on a pivot and by a `Rigid`; `bias`, `scale`, `mounting`, `skew`,
    `limit`, `offset`, `jitter`, `lowpass`, `tolerance` as for `Gyro`. **Raises** `ValueError` as
    `Gyro`.

    >>> Accelerometer(noise=0.1, place=[0.01, 0.0, 0.0]).unit
    'm/s²'
    """

    # Only gravity needs the attitude.
    feels: ClassVar[Any] = property(lambda self: HasSpin if self.gravity is None else HasAttitude)
    unit: ClassVar[str] = "m/s²"
    _: dataclasses.KW_ONLY
    place: Vec3 = eqx.field(converter=base.required("place"), default=None)
    gravity: Vec3 | None = eqx.field(converter=base.optional("gravity"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        return reading - self._shown(specific_force(now, self.place, self.gravity))


class Magnetometer(VectorSensor):
    """Reads a known field of the world: `scale · S exp(−mounting) Rᵀ b + bias`.

    **Arguments:** `noise` in the field's unit, one number or (3,), `None` to estimate it; `field`
    (3,) b, world frame, any unit; `bias` (the body's own magnetism), `scale`, `mounting`, `skew`,
    `limit`, `offset`, `jitter`, `lowpass`, `tolerance` as for `Gyro`. For a direction without a
    strength use `Direction`. **Raises** `ValueError` as `Gyro`.

    >>> Magnetometer(noise=1e-7, field=[2e-5, 0.0, 4e-5]).reading_shape
    (3,)
    """

    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "of the field"
    _: dataclasses.KW_ONLY
    field: Vec3 = eqx.field(converter=base.required("field"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        seen = quaternion.rotate(quaternion.conjugate(now.state.q), self.field)
        return reading - self._shown(seen)
