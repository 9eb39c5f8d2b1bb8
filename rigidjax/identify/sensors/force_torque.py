"""Provide the sensor of a force and a torque between a body and what holds it."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasPose, NumbersLike, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import ClockedSensor, SensorInput
from rigidjax.identify.sensors.tolerance import Tolerance, tolerance_of
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross

Six = Float[Array, "6"]


def _noise(value: NumbersLike | None) -> Six | None:
    """Return the deviations of six channels, of which a user may give two: of force and torque."""
    if value is not None and _checks.numeric_array(value, "noise").shape == (2,):
        value = jnp.repeat(jnp.asarray(value), 3)
    return base.positive_numbers(value, "noise", "a positive standard deviation", 6)


class ForceTorque(ClockedSensor):
    """Measure the force and the torque that a support, such as a robot's wrist, exerts on the body:
    `scale · w + bias`.

    The wrench w is `f = m Rᵀ(a − g)` and `τ = I dΩ/dt + Ω × IΩ − r × f`, turned to the sensor's
    axes by `mounting`. Here m is the mass, R the attitude, a the acceleration of the centre of
    mass, g the gravity, I the inertia about the centre of mass, and r the vector from the centre of
    mass to the sensor's origin, about which the torque is (Newton and Euler; notes, eqs 1, 56). All
    forces on the body but its weight count as the support's.

    **Arguments:**

    - `noise`: the standard deviation of a reading: two numbers (of force, N, and torque, N m), or
      one for each of six channels; `None` estimates the noise.
    - `gravity`: (3,) m/s², **world** frame, such as [0, 0, −9.81]. If a fit explains nothing, look
      here first: some logs have z downwards.
    - `place`: (3,) m, the sensor's origin, body frame; the frame's origin by default.
    - `mounting`: (3,) the rotation vector from the body's axes to the sensor's axes, rad, or
      `None`.
    - `bias`: (6,) N and N m, or `None`.
    - `scale`: (6,) the scale of each channel, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.
    - `tolerance`: a `Tolerance` for scale, axes, bias and clock.

    A sensor that reads what the body exerts on the support has the opposite sign: negate its
    readings. **Raises** `ValueError` for a noise that is not positive, a wrong shape, NaN.

    >>> sensor = ForceTorque((0.05, 0.0025), gravity=[0.0, 0.0, -9.81])
    >>> sensor.noise.tolist(), sensor.reading_shape
    ([0.05, 0.05, 0.05, 0.0025, 0.0025, 0.0025], (6,))
    """

    reading_shape: ClassVar[tuple[int, ...]] = (6,)
    components: ClassVar[int] = 6
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "N, N m"
    suspect: ClassVar[tuple[str, str, str]] = (
        "sign",
        "gravity points the other way in the frame of the poses, or the readings are what the body "
        "does to the support",
        "negate gravity, or all readings, and fit again",
    )
    noise: Six | None = eqx.field(converter=_noise, default=None)
    _: dataclasses.KW_ONLY
    gravity: Vec3 = eqx.field(converter=base.array_field("gravity"), default=None)
    place: Vec3 = eqx.field(converter=base.array_field("place"), default=(0.0, 0.0, 0.0))
    mounting: Vec3 | None = eqx.field(converter=base.optional_array_field("mounting"), default=None)
    bias: Six | None = eqx.field(converter=base.optional_array_field("bias", (6,)), default=None)
    scale: Six | None = eqx.field(converter=base.optional_array_field("scale", (6,)), default=None)
    tolerance: Tolerance | None = eqx.field(converter=tolerance_of, default=None)

    def error(self, motion: SensorInput, reading: Array) -> Six:
        state, rate, tensor = motion.state, motion.rate, motion.body.inertia.tensor
        lifted = quaternion.rotate(quaternion.conjugate(state.q), rate.v - self.gravity)
        force = motion.body.mass * lifted
        torque = apply(tensor, rate.omega) + cross(state.omega, apply(tensor, state.omega))
        parts: list[Any] = [force, torque - cross(motion.lever(self.place), force)]
        if self.mounting is not None:
            parts = [quaternion.rotate(quaternion.exp(-self.mounting), part) for part in parts]
        wrench = jnp.concatenate(parts)
        wrench = wrench if self.scale is None else self.scale * wrench
        return reading - (wrench if self.bias is None else wrench + self.bias)
