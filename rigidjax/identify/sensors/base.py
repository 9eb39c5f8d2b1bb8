"""Define the base class of sensors, and the motion at one time from which a sensor predicts."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike, Scalar, Vec3
from rigidjax.body.inertia import MassProperties


class SensorInput(eqx.Module):
    """Hold the motion at one time, from which a sensor predicts its reading.

    **Fields:**

    - `t`: the time, s.
    - `state`: a `Spin`, `Attitude` or `Rigid`.
    - `body`: the `Inertia` or `MassProperties`.
    - `field`: the equations of motion `f(t, state, args)`. If a torque has states of its own, such
      as the speed of a wheel, these equations use the values of these states at `t`.
    - `own`: the own states of the torques at `t`, in the order of `Solution.own`, for a sensor of a
      wheel or a motor.

    >>> body, state = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.0, 1.0])
    >>> field = rj.equations_of_motion(body, state, None)
    >>> motion = SensorInput(jnp.asarray(0.0), state, body, field)
    >>> rj.identify.Gyro(0.1).error(motion, jnp.array([0.0, 0.0, 1.5])).tolist()
    [0.0, 0.0, 0.5]
    """

    t: Scalar
    state: Any
    body: Any
    field: Callable[..., Any]
    own: tuple[Any, ...] = ()

    @property
    def rate(self) -> Any:
        """Return the time derivative of the state, as an object of the same type: its `.omega` is
        dΩ/dt and, for a `Rigid`, its `.v` is the acceleration of the centre of mass.
        """
        return self.field(self.t, self.state, None)

    def lever(self, place: Vec3) -> Vec3:
        """Return the vector (3,), m, from the reference point of the body to a `place`.

        The reference point is the centre of mass if the body is a `MassProperties`. If the body is
        an `Inertia`, it is the origin of the body frame, such as the pivot. The vector and the
        `place` (3,), m, are in the body frame.
        """
        return place - self.body.com if isinstance(self.body, MassProperties) else place


class AbstractSensor(eqx.Module):
    """Define a sensor: the shape of its readings, the state that it needs, and the error of a
    reading.

    To make a sensor of your own, write a subclass with the method `error` and these members:

    - `reading_shape`: the shape of one reading.
    - `feels`: the protocol of the states that the sensor can read: `HasSpin` if it needs only the
      body rate, `HasAttitude` if it needs the attitude too, `HasPose` if it needs also position and
      velocity.
    - `components`, `unit`: the number k of components of an error, and the unit of an error.
    - `noise`: (k,) the standard deviation of each component; `None` if a fit shall estimate it.

    Optional members:

    - `offset`: the clock offset, s: the reading with the time stamp t was taken at t + offset.
    - `limit`: (k,) the full scale of each channel, in the unit of the error.
    - `refusal(values)`: a method that returns for T rows of values a mask (T,), true for a row that
      cannot be a reading, and the reason in words.
    - `typical_rate(t, values)`: a method that returns the rough rate of the body, rad/s, from the
      unmasked readings; it is used if no other sensor gives the rate.
    - `reading_of(motion, error)`: a method that returns the reading whose error is `error`, for
      `simulate_readings`; it is needed if the error is not reading minus prediction.
    - `suspect`: three texts about a possible cause of large errors of this sensor: its name, a
      description, and a remedy. A fit names this cause if it finds no other cause.

    >>> class Tachometer(AbstractSensor):  # the size of the body rate, rad/s
    ...     reading_shape, components, unit = (), 1, "rad/s"
    ...     feels, noise = rj.motion.HasSpin, None
    ...     def error(self, motion, reading):
    ...         return (reading - jnp.sqrt(jnp.sum(motion.state.omega**2)))[None]
    >>> rj.identify.Recording([0.0, 1.0], (Tachometer(), [3.0, 3.0])).readings[0].values.shape
    (2,)
    """

    reading_shape: eqx.AbstractClassVar[tuple[int, ...]]
    components: eqx.AbstractClassVar[int]
    feels: eqx.AbstractVar[type]
    unit: eqx.AbstractClassVar[str]
    noise: eqx.AbstractVar[Array | None]

    __repr__ = _show.fields_as_text

    @abc.abstractmethod
    def error(self, motion: SensorInput, reading: Array) -> Float[Array, " k"]:
        """Return the error (k,) of a `reading`, such as reading − prediction, in the sensor's
        unit.
        """


def array_field(name: str, shape: tuple[int, ...] = (3,)) -> Callable[[Any], Array]:
    """Return a converter, for `eqx.field`, to an array of finite numbers of this `shape`."""

    def convert(value: NumbersLike) -> Array:
        if value is None:
            raise ValueError(f"{name}: wanted three numbers, got None")
        return _checks.require_finite(_checks.array_of_shape(value, shape, name), name)

    return convert


def optional_array_field(name: str, shape: tuple[int, ...] = (3,)) -> Callable[[Any], Array | None]:
    """Return the converter of `array_field` that leaves `None` unchanged."""
    converted = array_field(name, shape)
    return lambda value: None if value is None else converted(value)


def deviations_field(size: int = 3) -> Callable[[Any], Array | None]:
    """Return a converter, for `eqx.field`, to standard deviations (size,), or `None`."""
    return lambda value: positive_numbers(value, "noise", "a positive standard deviation", size)


def positive_numbers(
    value: NumbersLike | None, name: str, requirement: str, size: int
) -> Array | None:
    """Return one number, or `size` numbers, as a checked array (size,); `None` stays `None`."""
    if value is None:
        return None
    numbers = _checks.numeric_array(value, name).astype(jnp.result_type(float))
    if numbers.shape not in ((), (size,)):
        count = {1: "one", 2: "two", 3: "three"}.get(size, str(size))
        raise ValueError(f"{name}: wanted one number or {count}, got shape {numbers.shape}")
    numbers = jnp.broadcast_to(numbers, (size,))
    return _checks.error_if(numbers, ~(numbers > 0), f"{name}: wanted {requirement}")


def _jitter_field(jitter: object) -> Array | None:
    if jitter is None or isinstance(jitter, Array):
        return jitter
    return jnp.asarray(_checks.positive_float(jitter, "jitter", "a positive number of seconds"))


class Extras(NamedTuple):
    """Hold the optional members of a sensor, as `AbstractSensor` describes them, or `None`."""

    offset: Scalar | None
    jitter: Float[Array, "*records"] | None
    limit: Float[Array, "*records k"] | None
    tolerance: Any
    refusal: Callable[[np.ndarray], tuple[np.ndarray, str]] | None
    typical_rate: Callable[[np.ndarray, np.ndarray], float] | None
    reading_of: Callable[[SensorInput, Array], Array] | None
    suspect: tuple[str, str, str] | None
    # Convert the readings of the user to the form of this sensor.
    readings: Callable[[np.ndarray], np.ndarray] | None
    # Whether the noise holds only units of errors whose size is unknown.
    nominal: bool | None


def extras(sensor: AbstractSensor) -> Extras:
    """Return the optional members of a sensor.

    They are no members of `AbstractSensor`, whose value a field of a subclass without a default
    would take for its default.
    """
    return Extras(*(getattr(sensor, name, None) for name in Extras._fields))


class ClockedSensor(AbstractSensor):
    """Define a sensor whose time stamps may have a constant error `offset` and a random `jitter`.

    It reads a vector (3,), unless a subclass sets another shape.
    """

    reading_shape: ClassVar[tuple[int, ...]] = (3,)
    components: ClassVar[int] = 3
    _: dataclasses.KW_ONLY
    offset: Scalar | None = eqx.field(converter=optional_array_field("offset", ()), default=None)
    jitter: Scalar | None = eqx.field(converter=_jitter_field, default=None)
