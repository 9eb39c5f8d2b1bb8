"""Provide sensors of the attitude, of directions, of points of the body, and of whole states."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, HasSpin, NumbersLike, Scalar, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import AbstractSensor, ClockedSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import minus_small
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot


class AttitudeSensor(ClockedSensor):
    """Measure the attitude as a quaternion (w, x, y, z), body → world; q and −q mean the same
    attitude.

    The error is the rotation vector, in the sensor's axes, from the predicted attitude to the
    reading. It stands on the right, `q_read = q exp(mounting) exp(error)`, where q is the predicted
    attitude of the body and q_read the reading: its length is the angle between the two attitudes.
    Readings are quaternions (T, 4) or rotation matrices (T, 3, 3). Euler angles (T, 3) in degrees
    become quaternions by
    `jax.vmap(lambda a: rj.euler.to_quaternion(a, "ZYX"))(jnp.deg2rad(angles))`.

    **Arguments:**

    - `noise`: the standard deviation of each component of the rotation vector, rad, one number or
      (3,); `None` estimates the noise.
    - `mounting`: (3,) the rotation vector from the body's axes to the sensor's, rad, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a noise that is not positive, a wrong shape, NaN; a `Recording`
    raises `ValueError` for a matrix that is no rotation.

    >>> AttitudeSensor(noise=0.01).reading_shape
    (4,)
    """

    reading_shape: ClassVar[tuple[int, ...]] = (4,)
    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "rad"
    noise: Vec3 | None = eqx.field(converter=base.deviations_field(), default=None)
    _: dataclasses.KW_ONLY
    mounting: Vec3 | None = eqx.field(converter=base.optional_array_field("mounting"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        q = _sensor_attitude(motion.state.q, self.mounting)
        return quaternion.log(quaternion.multiply(quaternion.conjugate(q), reading))

    def reading_of(self, motion: SensorInput, error: Vec3) -> Float[Array, "4"]:
        """Return the quaternion (4,) that this attitude sensor reads for a given `motion` if its
        error is the rotation vector `error` (3,), rad.
        """
        q = _sensor_attitude(motion.state.q, self.mounting)
        return quaternion.multiply(q, quaternion.exp(error))

    def readings(self, values: np.ndarray) -> np.ndarray:
        """Return the attitudes `values`, which are quaternions (T, 4) or rotation matrices (T, 3,
        3), as quaternions (T, 4), the form of the readings of this sensor.
        """
        if values.shape[1:] != (3, 3):
            return values
        # The quaternion of a matrix with NaN is NaN.
        finite = np.isfinite(values).all(axis=(1, 2))
        filled = np.where(finite[:, None, None], values, np.eye(3))
        off = np.abs(filled @ filled.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = (off > 1e-6) | (np.linalg.det(filled) < 0)
        if wrong.any():
            index = int(np.argmax(wrong))
            raise ValueError(
                f"AttitudeSensor: the matrix at index {index} is no rotation: R Rᵀ − 1 is "
                f"{off[index]:.2g}, det = {np.linalg.det(filled[index]):.3g}"
            )
        out = np.asarray(jax.vmap(quaternion.from_matrix)(jnp.asarray(filled)))
        return np.where(finite[:, None], out, np.nan)

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a mask (T,), true for each row of `values` that is not a unit quaternion, and the
        reason in words.
        """
        words = "is not unit; wanted (w, x, y, z) with the scalar first"
        return _not_unit(values), f"the quaternion at index {{index}} {words}"


def _sensor_attitude(q: Array, mounting: Vec3 | None) -> Array:
    """Return the attitude of the axes of a sensor mounted on a body of attitude q."""
    return q if mounting is None else quaternion.multiply(q, quaternion.exp(mounting))


def _unit_vector(world: NumbersLike) -> Vec3:
    """Return the unit vector along `world`; raise an error if `world` has the length zero."""
    vector = base.array_field("world")(world)
    length = jnp.sqrt(dot(vector, vector))
    words = "world: wanted a direction, got a vector of length zero"
    return vector / _checks.error_if(length, ~(length > 0), words)


class Direction(ClockedSensor):
    """Measure the direction, in the sensor's axes, of an object of known direction in the world.

    Examples are a sun sensor, a tracker of one star, a sensor of the vertical. The error is a
    vector with two components, in the plane orthogonal to the reading. The error points from the
    prediction to the reading, and its length is the chord between the two unit vectors: the angle
    in rad for small errors, 2 at most. Readings (T, 3) are unit vectors.

    **Arguments:**

    - `world`: (3,) the direction in the world frame, of any length.
    - `noise`: the standard deviation of each component of the error, rad, one number or (2,);
      `None` estimates the noise.
    - `mounting`: (3,) the rotation vector from the body's axes to the sensor's, rad, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a direction of length zero, a noise that is not positive, NaN.

    >>> Direction([0.0, 0.0, 2.0], noise=0.01).world
    Array([0., 0., 1.], dtype=float64)
    """

    components: ClassVar[int] = 2
    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "rad"
    world: Vec3 = eqx.field(converter=_unit_vector)
    noise: Float[Array, "2"] | None = eqx.field(converter=base.deviations_field(2), default=None)
    _: dataclasses.KW_ONLY
    mounting: Vec3 | None = eqx.field(converter=base.optional_array_field("mounting"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, "2"]:
        predicted = self._predicted(motion)
        # The axes orthogonal to the reading are data, so that no derivative passes through these
        # axes. Axes orthogonal to the prediction would jump as the motion changes.
        first, second = _orthogonal_pair(reading)
        # With the angle θ between prediction and reading, `half` is cos ½θ, and the chord is sin θ
        # / cos ½θ = 2 sin ½θ. The lower bound prevents a division by zero for opposite directions.
        half = jnp.sqrt(jnp.maximum(0.5 * (1.0 + dot(predicted, reading)), 1e-12))
        return -jnp.stack([dot(first, predicted), dot(second, predicted)]) / half

    def reading_of(self, motion: SensorInput, error: Float[Array, "2"]) -> Vec3:
        """Return a reading (3,) whose error has the length of `error` (2,).

        The two components of this error equal those of the argument `error` only to first order.
        The reason is the choice of axes: here `error` is taken along axes orthogonal to the
        prediction, but the method `error` uses axes orthogonal to the reading.
        """
        predicted = self._predicted(motion)
        first, second = _orthogonal_pair(predicted)
        # The length of `error` is the chord of the angle θ between prediction and reading: cos θ =
        # 1 − ½ |error|², sin θ = |error| cos ½θ.
        square = jnp.minimum(error[0] * error[0] + error[1] * error[1], 4.0)
        half = jnp.sqrt(1.0 - 0.25 * square)
        return (1.0 - 0.5 * square) * predicted + half * (error[0] * first + error[1] * second)

    def _predicted(self, motion: SensorInput) -> Vec3:
        """Return the direction in the axes of the sensor that it is predicted to read."""
        return quaternion.rotate_inverse(
            _sensor_attitude(motion.state.q, self.mounting), self.world
        )

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a mask (T,), true for each row of `values` that is not a unit vector, and the
        reason in words.
        """
        return _not_unit(values), "the direction at index {index} is not of length 1"


def _not_unit(rows: np.ndarray) -> np.ndarray:
    """Return a mask, true where the length of a row differs from 1 by more than 1e-6."""
    return np.abs(np.linalg.norm(rows, axis=1) - 1) > 1e-6


def _orthogonal_pair(line: Vec3) -> tuple[Vec3, Vec3]:
    """Return unit vectors that are orthogonal to each other and to the unit vector `line`."""
    least = jnp.eye(3, dtype=line.dtype)[jnp.argmin(jnp.abs(line))]
    first = cross(line, least)
    first = first / jnp.sqrt(dot(first, first))
    return first, cross(line, first)


class Marker(ClockedSensor):
    """Measure the position, in the world, of a point that is fixed in the body: `x + R r`, m.

    Here R is the rotation from body to world axes. For a `Rigid`, x is the position of the centre
    of mass, and r leads from the centre of mass to the point. For a body on a pivot, x is the
    position of the pivot, and r leads from the pivot to the point.

    **Arguments:**

    - `place`: (3,) the point, m, in the frame of the `MassProperties`; for an `Inertia`, the vector
      r from the pivot, body frame.
    - `noise`: the standard deviation, m, one number or (3,); `None` estimates the noise.
    - `origin`: (3,) the position of the pivot of a body that turns about a fixed point, m, world
      frame; `None` for a `Rigid`, whose position is part of its state.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a noise or jitter that is not positive, a wrong shape, NaN.

    >>> body = rj.MassProperties(1.0, [0.0, 0, 0], jnp.eye(3))
    >>> state = rj.Rigid([2.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> motion = rj.identify.SensorInput(jnp.asarray(0.0), state, body, lambda t, y, args: y)
    >>> Marker([0.5, 0.0, 0.0]).error(motion, jnp.array([2.75, 0.0, 0.0])).tolist()
    [0.25, 0.0, 0.0]
    """

    # With an `origin`, the known position of the pivot about which the body turns, the attitude
    # alone gives the position of the marker. Without an `origin` the sensor needs the position of
    # the body, too.
    feels: ClassVar[Any] = property(lambda self: HasPose if self.origin is None else HasAttitude)
    unit: ClassVar[str] = "m"
    place: Vec3 = eqx.field(converter=base.array_field("place"), default=None)
    noise: Vec3 | None = eqx.field(converter=base.deviations_field(), default=None)
    _: dataclasses.KW_ONLY
    origin: Vec3 | None = eqx.field(converter=base.optional_array_field("origin"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        state = motion.state
        start = state.x if self.origin is None else self.origin
        return reading - (start + quaternion.rotate(state.q, motion.lever(self.place)))


class Position(ClockedSensor):
    """Measure the position x of the centre of mass of a `Rigid`, in the world: `x + bias`, m.

    Use `Marker` for another point.

    **Arguments:**

    - `noise`: the standard deviation, m, one number or (3,); `None` estimates the noise.
    - `bias`: (3,) m, world frame, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a noise or jitter that is not positive, a wrong shape, NaN.

    >>> Position(noise=0.01).unit
    'm'
    """

    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    noise: Vec3 | None = eqx.field(converter=base.deviations_field(), default=None)
    _: dataclasses.KW_ONLY
    bias: Vec3 | None = eqx.field(converter=base.optional_array_field("bias"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        x = motion.state.x
        return reading - (x if self.bias is None else x + self.bias)


class Velocity(ClockedSensor):
    """Measure the velocity of a point of a `Rigid`, `v + R (Ω × r)`, in world or sensor axes.

    Here v is the velocity of the centre of mass, R the rotation from body to world axes, Ω the body
    rate, and r the vector from the centre of mass to the point.

    Source: Landau and Lifshitz, Mechanics, eq 31.2.

    **Arguments:**

    - `noise`: the standard deviation, m/s, one number or (3,); `None` estimates the noise.
    - `place`: (3,) the point, m, in the frame of the `MassProperties`; `None` for the centre of
      mass.
    - `mounting`: (3,) the rotation vector from the body's axes to the sensor's, rad, for a sensor
      on the body, such as a Doppler log; zeros for the body's axes. `None` for the world's axes, as
      in satellite navigation.
    - `bias`: (3,) m/s, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a noise or jitter that is not positive, a wrong shape, NaN.

    >>> Velocity(noise=0.1, mounting=[0.0, 0.0, 0.0]).unit
    'm/s'
    """

    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m/s"
    noise: Vec3 | None = eqx.field(converter=base.deviations_field(), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=base.optional_array_field("place"), default=None)
    mounting: Vec3 | None = eqx.field(converter=base.optional_array_field("mounting"), default=None)
    bias: Vec3 | None = eqx.field(converter=base.optional_array_field("bias"), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Vec3:
        state = motion.state
        velocity = state.v
        if self.place is not None:
            arm = motion.lever(self.place)
            velocity = velocity + quaternion.rotate(state.q, cross(state.omega, arm))
        if self.mounting is not None:
            velocity = quaternion.rotate_inverse(_sensor_attitude(state.q, self.mounting), velocity)
        return reading - (velocity if self.bias is None else velocity + self.bias)


class Range(ClockedSensor):
    """Measure the distance of a point of a `Rigid` from a station: `|x + R r − p| + bias`, m.

    Here x is the position of the centre of mass, R the rotation from body to world axes, r the
    vector from the centre of mass to the point, and p the position of the station. Readings are
    (T,).

    **Arguments:**

    - `station`: (3,) the position p of the station, m, world frame.
    - `noise`: the standard deviation, m; `None` estimates the noise.
    - `place`: (3,) the point, m, in the frame of the `MassProperties`; `None` for the centre of
      mass.
    - `bias`: m, or `None`.
    - `offset`, `jitter`: the clock offset and the deviation of the time stamps, s, as for `Gyro`.

    **Raises** `ValueError` for a noise or jitter that is not positive, a wrong shape, NaN; a
    `Recording` raises `ValueError` for a reading below zero if there is no bias.

    >>> Range([0.0, 0.0, 100.0], noise=0.05).reading_shape
    ()
    """

    reading_shape: ClassVar[tuple[int, ...]] = ()
    components: ClassVar[int] = 1
    feels: ClassVar[type] = HasPose
    unit: ClassVar[str] = "m"
    station: Vec3 = eqx.field(converter=base.array_field("station"), default=None)
    noise: Float[Array, "1"] | None = eqx.field(converter=base.deviations_field(1), default=None)
    _: dataclasses.KW_ONLY
    place: Vec3 | None = eqx.field(converter=base.optional_array_field("place"), default=None)
    bias: Scalar | None = eqx.field(converter=base.optional_array_field("bias", ()), default=None)

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, "1"]:
        state = motion.state
        line = state.x - self.station
        if self.place is not None:
            line = line + quaternion.rotate(state.q, motion.lever(self.place))
        # At the station itself the distance has no derivative; the derivative is set to 0.
        square = dot(line, line)
        length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
        predicted = length if self.bias is None else length + self.bias
        return (reading - predicted)[None]

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a mask (T,), true for each of the distances `values` that is below zero, and the
        reason in words.

        A sensor with a bias may read distances below zero, so that the mask is then false
        everywhere.
        """
        if self.bias is not None:
            return np.zeros(values.shape, bool), ""
        return values < 0, "the distance at index {index} is below zero"


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
