"""Sensors of the attitude, of directions, and of the positions of points of the body."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, Scalar, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import ClockedSensor, SensorInput
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot


class AttitudeSensor(ClockedSensor):
    """Reads the attitude as a quaternion (w, x, y, z), body → world; q and −q read the same.

    The error is the rotation vector, in the sensor's axes, that takes the predicted attitude to the
    reading, `log((q exp(mounting))⁻¹ q_read)`: its length is the angle between them. Readings
    are quaternions (T, 4) or rotation matrices (T, 3, 3); of Euler angles (T, 3) in degrees
    `jax.vmap(lambda a: rj.euler.to_quaternion(a, "ZYX"))(jnp.deg2rad(angles))` makes them.

    **Arguments:** `noise` standard deviation of each component of that vector, rad, one number or
    (3,); `None` estimates it; `mounting` (3,) rotation vector from the body's axes to the sensor's,
    rad, or `None`; `offset` s, `jitter` as for `Gyro`. **Raises** `ValueError` for a noise that is
    not positive, a wrong shape, NaN; the recording for a matrix that is no rotation.

    >>> AttitudeSensor(noise=0.01).reading_shape
    (4,)
    """

    reading_shape: ClassVar[tuple[int, ...]] = (4,)
    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "rad"
    noise: Vec3 | None = eqx.field(converter=base.deviations(), default=None)
    _: dataclasses.KW_ONLY
    mounting: Vec3 | None = eqx.field(converter=base.optional("mounting"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        q = _mounted(now.state.q, self.mounting)
        return quaternion.log(quaternion.multiply(quaternion.conjugate(q), reading))

    def reading_of(self, now: SensorInput, error: Vec3) -> Float[Array, "4"]:
        """The reading (4,) whose error (3,) rad is this one."""
        q = _mounted(now.state.q, self.mounting)
        return quaternion.multiply(q, quaternion.exp(error))

    def readings(self, values: np.ndarray) -> np.ndarray:
        """Readings (T, 4), also of matrices (T, 3, 3)."""
        return _quaternions(values) if values.shape[1:] == (3, 3) else values

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        wanted = "wanted (w, x, y, z) with the scalar first"
        return _not_unit(values), f"the quaternion at index {{index}} is not unit; {wanted}"


def _quaternions(matrices: np.ndarray) -> np.ndarray:
    seen = np.isfinite(matrices).all(axis=(1, 2))
    filled = np.where(seen[:, None, None], matrices, np.eye(3))
    off = np.abs(filled @ filled.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (off > 1e-6) | (np.linalg.det(filled) < 0)
    if wrong.any():
        index = int(np.argmax(wrong))
        raise ValueError(
            f"AttitudeSensor: the matrix at index {index} is no rotation: R Rᵀ − 1 is "
            f"{off[index]:.2g}, det = {np.linalg.det(filled[index]):.3g}"
        )
    out = np.asarray(jax.vmap(quaternion.from_matrix)(jnp.asarray(filled)))
    return np.where(seen[:, None], out, np.nan)


def _mounted(q: Array, mounting: Vec3 | None) -> Array:
    """The attitude of a sensor's axes."""
    return q if mounting is None else quaternion.multiply(q, quaternion.exp(mounting))


def _unit(world: Any) -> Vec3:
    vector = base.required("world")(world)
    length = jnp.sqrt(dot(vector, vector))
    words = "world: wanted a direction, got a vector of length zero"
    return vector / _checks.refuse(length, ~(length > 0), words)


class Direction(ClockedSensor):
    """Reads the direction, in its own axes, of an object with a known direction in the world.

    Examples: a sun sensor, a star, the vertical. The error is the chord from the prediction to the
    reading, taken in the plane across the reading (two numbers, rad for small errors, 2 at most).

    **Arguments:** `world` (3,) the direction in the world frame, any length; `noise` rad across the
    line of sight, one number or (2,), `None` to estimate it; `mounting`, `offset`, `jitter` as for
    `AttitudeSensor`. Readings (T, 3) are unit vectors. **Raises** `ValueError` for a direction of
    length zero, a noise that is not positive, NaN.

    >>> Direction([0.0, 0.0, 2.0], noise=0.01).world
    Array([0., 0., 1.], dtype=float64)
    """

    components: ClassVar[int] = 2
    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "rad"
    world: Vec3 = eqx.field(converter=_unit)
    noise: Float[Array, "2"] | None = eqx.field(converter=base.deviations(2), default=None)
    _: dataclasses.KW_ONLY
    mounting: Vec3 | None = eqx.field(converter=base.optional("mounting"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Float[Array, "2"]:
        seen = self._seen(now)
        # Two axes across the reading, which is data: no derivative passes through them.
        first, second = _across(reading)
        # sin θ / cos ½θ = 2 sin ½θ, the chord; guarded where the two are opposite.
        half = jnp.sqrt(jnp.maximum(0.5 * (1.0 + dot(seen, reading)), 1e-12))
        return -jnp.stack([dot(first, seen), dot(second, seen)]) / half

    def reading_of(self, now: SensorInput, error: Float[Array, "2"]) -> Vec3:
        """A reading (3,) with an error of the same length as this one (2,), and equal for small
        errors.

        The two axes across the prediction are the axes across the reading, turned by the angle
        between.
        """
        seen = self._seen(now)
        first, second = _across(seen)
        # |error| is a chord: cos θ = 1 − ½ |error|², sin θ = |error| cos ½θ.
        square = jnp.minimum(error[0] * error[0] + error[1] * error[1], 4.0)
        half = jnp.sqrt(1.0 - 0.25 * square)
        return (1.0 - 0.5 * square) * seen + half * (error[0] * first + error[1] * second)

    def _seen(self, now: SensorInput) -> Vec3:
        return quaternion.rotate_inverse(_mounted(now.state.q, self.mounting), self.world)

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        return _not_unit(values), "the direction at index {index} is not of length 1"


def _not_unit(rows: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(rows, axis=1) - 1) > 1e-6


def _across(line: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors orthogonal to a unit vector and to each other."""
    least = jnp.eye(3, dtype=line.dtype)[jnp.argmin(jnp.abs(line))]
    first = cross(line, least)
    first = first / jnp.sqrt(dot(first, first))
    return first, cross(line, first)


class Marker(ClockedSensor):
    """Reads the position, in the world, of a point fixed in the body: `x + R r`, m.

    **Arguments:** `place` (3,) the point, m, body frame; `noise` m, one number or (3,), `None` to
    estimate it; `origin` (3,) m, world frame: the fixed point of a body on a pivot; `None` for a
    body that moves (`Rigid`, with `MassProperties`; `place` is then in their frame); `offset` s as
    for `Gyro`. **Raises** `ValueError` as `Gyro`.

    >>> body = rj.MassProperties(1.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([2.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> now = rj.identify.SensorInput(jnp.asarray(0.0), state, body, lambda t, y, args: y)
    >>> Marker([0.5, 0.0, 0.0]).error(now, jnp.array([2.75, 0.0, 0.0])).tolist()
    [0.25, 0.0, 0.0]
    """

    # A body on a pivot need not move.
    feels: ClassVar[Any] = property(lambda self: HasPose if self.origin is None else HasAttitude)
    unit: ClassVar[str] = "m"
    place: Vec3 = eqx.field(converter=base.required("place"), default=None)
    noise: Vec3 | None = eqx.field(converter=base.deviations(), default=None)
    _: dataclasses.KW_ONLY
    origin: Vec3 | None = eqx.field(converter=base.optional("origin"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        state = now.state
        start = state.x if self.origin is None else self.origin
        return reading - (start + quaternion.rotate(state.q, now.lever(self.place)))


class Position(ClockedSensor):
    """Reads the centre of mass, in the world: `x + bias`, m. Use `Marker` for another point.

    **Arguments:** `noise` m, one number or (3,), `None` to estimate it; `bias` (3,) m, world frame,
    or `None`; `offset` s, `jitter` as for `Gyro`. For a `Rigid`. **Raises** `ValueError` as `Gyro`.

    >>> Position(noise=0.01).unit
    'm'
    """

    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    noise: Vec3 | None = eqx.field(converter=base.deviations(), default=None)
    _: dataclasses.KW_ONLY
    bias: Vec3 | None = eqx.field(converter=base.optional("bias"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        place = now.state.x
        return reading - (place if self.bias is None else place + self.bias)


class Velocity(ClockedSensor):
    """Reads the velocity of a point of the body: `v + R (Ω × r)`, in the world or in its own axes.

    **Arguments:** `noise` m/s, one number or (3,), `None` to estimate it; `place` (3,) the point,
    m, in the frame of the `MassProperties` (r is the vector to it from the centre of mass); `None`
    for the centre of mass itself; `mounting` (3,) rotation vector that turns the body's axes onto
    the sensor's, rad, for a sensor on the body, such as a Doppler log (zeros for the body's axes);
    `None` for the world's axes, as in satellite navigation; `bias` (3,) m/s or `None`; `offset` s,
    `jitter` as for `Gyro`. For a `Rigid`. **Raises** `ValueError` as `Gyro`. Source: Landau and
    Lifshitz, Mechanics, eq 31.2.

    >>> Velocity(noise=0.1, mounting=[0.0, 0.0, 0.0]).unit
    'm/s'
    """

    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m/s"
    noise: Vec3 | None = eqx.field(converter=base.deviations(), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=base.optional("place"), default=None)
    mounting: Vec3 | None = eqx.field(converter=base.optional("mounting"), default=None)
    bias: Vec3 | None = eqx.field(converter=base.optional("bias"), default=None)

    def error(self, now: SensorInput, reading: Array) -> Vec3:
        state = now.state
        seen = state.v
        if self.place is not None:
            arm = now.lever(self.place)
            seen = seen + quaternion.rotate(state.q, cross(state.omega, arm))
        if self.mounting is not None:
            seen = quaternion.rotate_inverse(_mounted(state.q, self.mounting), seen)
        return reading - (seen if self.bias is None else seen + self.bias)


class Range(ClockedSensor):
    """Reads the distance from a station to a point of the body: `|x + R r − s| + bias`, m.

    **Arguments:** `station` s (3,) m, world frame; `noise` m, `None` to estimate it; `place` (3,)
    the point, m, in the frame of the `MassProperties`; `None` for the centre of mass; `bias` m, or
    `None`; `offset` s, `jitter` as for `Gyro`. Readings (T,). For a `Rigid`. **Raises**
    `ValueError` as `Gyro`, and for a reading below zero.

    >>> Range([0.0, 0.0, 100.0], noise=0.05).reading_shape
    ()
    """

    reading_shape: ClassVar[tuple[int, ...]] = ()
    components: ClassVar[int] = 1
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    station: Vec3 = eqx.field(converter=base.required("station"), default=None)
    noise: Float[Array, "1"] | None = eqx.field(converter=base.deviations(1), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=base.optional("place"), default=None)
    bias: Scalar | None = eqx.field(converter=base.optional("bias", ()), default=None)

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
