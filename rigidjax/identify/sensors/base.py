"""The base class of sensors: the prediction of a motion at one time, and the error of a reading."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, Vec3
from rigidjax.body.inertia import MassProperties


class SensorInput(eqx.Module):
    """The input of a sensor: a motion at one time.

    **Fields:** `t` s; `state` of the kind that the model needs; `body` the `Inertia` or
    `MassProperties`; `field` the equations of motion `f(t, state, args)`, with the states of its
    laws put in as they are at `t`; `own` those states, as `Solution.own` orders them: for
    a sensor of one's own that reads a wheel or a motor.

    >>> body, state = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.0, 1.0])
    >>> now = SensorInput(jnp.asarray(0.0), state, body, rj.equations_of_motion(body, state, None))
    >>> rj.identify.Gyro(0.1).error(now, jnp.array([0.0, 0.0, 1.5])).tolist()
    [0.0, 0.0, 0.5]
    """

    t: Scalar
    state: Any
    body: Any
    field: Callable[..., Any]
    own: tuple[Any, ...] = ()

    @property
    def rate(self) -> Any:
        """The derivative of the state in time: `.omega` is dΩ/dt, `.v` the acceleration."""
        return self.field(self.t, self.state, None)

    def lever(self, place: Vec3) -> Vec3:
        """From the reference point of the state to a `place` (3,) in the body frame, m."""
        return place - self.body.com if isinstance(self.body, MassProperties) else place


class AbstractSensor(eqx.Module):
    """A sensor: the shape of its readings, the state it needs, and the error of a reading.

    Subclass it for your own sensor: set `reading_shape`, `feels` (`HasSpin`, `HasAttitude` or
    `HasPose`), the number of `components` of the error and its `unit`, `noise` (k,) the standard
    deviation of each component, or `None` to estimate it; and write `error`.

    Optional members: `offset`, s: the sensor's clock is behind, its reading at t belongs to t +
    offset; `limit` (k,): the full scale of a channel, in the unit of the error; `lowpass` a
    `LowPass`, if the error is reading minus prediction; a method `refusal(values)`: the rows that
    cannot be readings, (T,) true where wrong, and why; a method `typical_rate(t, values)`: the
    rough rate of the body, rad/s, from the unmasked readings, if no other sensor shows it; a method
    `reading_of(now, error)`, the reading with this error, for `simulate_readings`, if the error is
    not reading minus prediction; `suspect`: name, words and remedy of the cause that a fit names
    for its errors if it finds no other.

    >>> class Tachometer(AbstractSensor):  # the size of the body rate, rad/s
    ...     reading_shape, components, unit = (), 1, "rad/s"
    ...     feels, noise = rj.motion.HasSpin, None
    ...     def error(self, now, reading):
    ...         return (reading - jnp.sqrt(jnp.sum(now.state.omega**2)))[None]
    >>> rj.identify.Recording([0.0, 1.0], (Tachometer(), [3.0, 3.0])).readings[0].values.shape
    (2,)
    """

    reading_shape: eqx.AbstractClassVar[tuple[int, ...]]
    components: eqx.AbstractClassVar[int]
    feels: eqx.AbstractVar[type]
    unit: eqx.AbstractClassVar[str]
    noise: eqx.AbstractVar[Array | None]

    @abc.abstractmethod
    def error(self, now: SensorInput, reading: Array) -> Float[Array, " k"]:
        """Reading minus prediction (k,), in the sensor's unit."""


def required(name: str, shape: tuple[int, ...] = (3,)) -> Callable[[Any], Array]:
    """A converter to finite numbers, which a fit may move, for `equinox.field(converter=…)`."""

    def converted(value: Any) -> Array:
        if value is None:
            raise ValueError(f"{name}: wanted three numbers, got None")
        return _checks.finite(_checks.floating(value, shape, name), name)

    return converted


def optional(name: str, shape: tuple[int, ...] = (3,)) -> Callable[[Any], Array | None]:
    """The same for a field that may be `None`."""
    converted = required(name, shape)
    return lambda value: None if value is None else converted(value)


def deviations(size: int = 3) -> Callable[[Any], Array | None]:
    """A converter of one number or `size` numbers to standard deviations (size,); `None` stays."""
    return lambda value: positive(value, "noise", "a positive standard deviation", size)


def positive(value: Any, name: str, wanted: str, size: int) -> Array | None:
    """One number or `size` as (size,) positive numbers; `None` stays."""
    if value is None:
        return None
    numbers = _checks.numbers(value, name).astype(jnp.result_type(float))
    if numbers.shape not in ((), (size,)):
        count = {1: "one", 2: "two", 3: "three"}.get(size, str(size))
        raise ValueError(f"{name}: wanted one number or {count}, got shape {numbers.shape}")
    numbers = jnp.broadcast_to(numbers, (size,))
    return _checks.refuse(numbers, ~(numbers > 0), f"{name}: wanted {wanted}")


class Jitter(eqx.Module):
    """The standard deviation of time stamps, s: as given, or to be `estimated`."""

    deviation: Scalar
    estimated: bool = eqx.field(static=True)


def jitter_of(given: Any) -> Jitter | None:
    """The jitter of a positive number, s, or of `"estimated"`; `None` stays."""
    if given is None or isinstance(given, Jitter):
        return given
    wanted = 'a positive number of seconds or "estimated"'
    if isinstance(given, str):
        if given != "estimated":
            raise ValueError(f"jitter: wanted {wanted}, got {given!r}")
        return Jitter(jnp.zeros(()), True)
    return Jitter(jnp.asarray(_checks.positive(given, "jitter", wanted)), False)


class ClockedSensor(AbstractSensor):
    """A sensor whose clock may be behind, and whose time stamps may scatter (`jitter`); it reads a
    vector (3,) unless it says otherwise.
    """

    reading_shape: ClassVar[tuple[int, ...]] = (3,)
    components: ClassVar[int] = 3
    _: dataclasses.KW_ONLY
    offset: Scalar | None = eqx.field(converter=optional("offset", ()), default=None)
    jitter: Jitter | None = eqx.field(converter=jitter_of, default=None)
