"""Hold a recording: times, the readings of each sensor, and logged inputs."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike
from rigidjax.cli.logs.units import RATE_UNITS, TIME_UNITS, UNITS, common_unit
from rigidjax.identify.sensors import AbstractSensor, Gyro
from rigidjax.identify.sensors.base import extras
from rigidjax.motion.torques import Held


class Reading(eqx.Module):
    """Hold the readings of one sensor; inside a `Model` with a leading axis of recordings."""

    sensor: AbstractSensor
    values: Float[Array, "..."]
    # True where there is a reading.
    mask: Bool[Array, "*records times"]
    # For a sensor with jitter the error of a reading whose time stamp is one standard deviation
    # late, along the motion of the last fit.
    jitter_error: Float[Array, "*records times k"] | None = None

    def __post_init__(self) -> None:
        if self.jitter_error is None and extras(self.sensor).jitter is not None:
            shape = (*np.shape(self.mask), self.sensor.components)
            self.jitter_error = jnp.asarray(np.zeros(shape, self.values.dtype))

    @property
    def host_mask(self) -> np.ndarray:
        """Return the `mask` as a NumPy array, for work outside of `jit`."""
        return np.asarray(self.mask)

    @property
    def usable(self) -> np.ndarray:
        """Return a mask (…, T, k), true where a component is neither masked nor at full scale."""
        mask = np.broadcast_to(
            self.host_mask[..., None], (*self.mask.shape, self.sensor.components)
        )
        limit = extras(self.sensor).limit
        if limit is None:
            return mask
        return mask & (np.abs(self.values) < np.asarray(limit)[..., None, :] * (1 - 1e-6))

    @property
    def has_known_noise(self) -> bool:
        """Return whether the noise is given, and no jitter adds errors that depend on the fit."""
        return self.sensor.noise is not None and self.jitter_error is None


class Recording(eqx.Module):
    """Hold the times and readings of one motion.

    **Arguments:**

    - `t`: (T,) increasing times, s. If sensors were read at different times, `t` is the union of
      the times of all sensors.
    - `readings`: for each sensor a pair `(sensor, values)` or a triple `(sensor, values, mask)`:
      `values` (T, 3) for a `Gyro`, (T, 4) or (T, 3, 3) for an `AttitudeSensor`, as the sensor's
      `reading_shape` says; `mask` (T,) true where there is a reading (masked values may be NaN).
    - `inputs`: a dict of name → input with what else was logged, such as the speed of a wheel or
      the commands of motors. An input is a function of time such as
      `rigidjax.torques.Series(times, speeds)`, or an array of samples (T, …) at the times `t`; each
      sample is held until the next one. The torque of a `Model` reads an input by its name,
      `rigidjax.torques.Input("speed")`.

    A time at which no sensor was read is dropped, unless an input is an array of samples. If
    `values` or `mask` is a NumPy masked array, a row with a masked entry counts as not read. Its
    time is kept if it lies between the first and the last reading. `t` may not be masked.

    **Raises:** `TypeError` for traced numbers, because the readings decide which times are kept,
    and for anything but a sensor in place of a sensor. `ValueError` for times that do not increase,
    also after rounding to float32; for a wrong shape; for an unmasked NaN or infinity, whose index
    the error gives; and for a quaternion that is not of unit length. It warns if rounding the times
    to float32 changes a step by more than a tenth.

    >>> Recording([0.0, 1.0], (rj.identify.Gyro(0.01), [[1.0, 0, 0], [1.0, 0, 0]])).t.shape
    (2,)
    """

    t: Float[Array, "*records times"]
    readings: tuple[Reading, ...]
    inputs: dict[str, Any]
    dropped: int = eqx.field(static=True)

    def __init__(self, t: NumbersLike, *readings: tuple, inputs: Mapping[str, Any] | None = None):
        for pair in readings:
            if not isinstance(pair, tuple) or len(pair) not in (2, 3):
                raise TypeError(
                    "Recording: wanted pairs (sensor, values) or (sensor, values, mask) after the "
                    f"times, got {type(pair).__name__}; as in Recording(t, (sensor, values))"
                )
        if not _checks.is_known((t, [reading[1:] for reading in readings])):
            raise TypeError(
                "Recording: wanted known numbers for t and the readings, got traced ones; make the "
                "recording outside of jit, vmap and grad, and give it to them as an argument"
            )
        t = _checks.host_array(t, "t")
        if t.ndim != 1 or t.size < 2:
            raise ValueError(f"t: wanted at least two times, shape (T,), got shape {t.shape}")
        if not np.isfinite(t).all():
            index = int(np.argmin(np.isfinite(t)))
            raise ValueError(f"t: contains NaN or infinity at index {index}, wanted finite times")
        if (np.diff(t) <= 0).any():
            index = int(np.argmax(np.diff(t) <= 0)) + 1
            raise ValueError(f"t: wanted increasing times; t[{index}] is not above t[{index - 1}]")
        if not readings:
            raise ValueError("Recording: wanted at least one pair (sensor, values)")
        rows = [_reading(t, *reading) for reading in readings]
        self.inputs = _inputs(t, {} if inputs is None else inputs)
        read = np.any([row.mask for row in rows], axis=0)
        if read.sum() < 2:
            raise ValueError(
                "Recording: wanted readings at two times at least, got readings at "
                f"{int(read.sum())}; all others are masked"
            )
        # The motion starts at the first reading and ends at the last one: the times of rows that a
        # masked array hides before the first reading or after the last one are dropped.
        within = np.maximum.accumulate(read) & np.maximum.accumulate(read[::-1])[::-1]
        used = read | (within & np.any([row.hidden for row in rows], axis=0))
        if any(not callable(source) for source in self.inputs.values()):
            # Drop no time if an input is an array of samples: each sample is held until the next
            # one, so that every sample is needed.
            used = np.ones(t.size, bool)
        # The attribute `dropped` is only for reports; a fit does not use it.
        self.dropped = int((~used).sum())
        # If no time is dropped, index with a slice: it makes no copy of a long recording.
        kept = used if self.dropped else slice(None)
        self.t = jnp.asarray(t[kept])
        # NumPy is used: within a trace the numbers of a new JAX array are not known.
        steps, held = np.diff(t[kept]), np.diff(t[kept].astype(self.t.dtype).astype(float))
        off = np.abs(held / steps - 1)
        index = int(np.argmax(off))
        words = (
            f"t: {self.t.dtype} changes the step of {steps[index]:.3g} s after {t[kept][index]} s "
            f"to {held[index]:.3g} s; {_checks.advice_on_times(self.t.dtype)}"
        )
        if off[index] >= 1:
            raise ValueError(words)
        if off[index] > 0.1:
            warnings.warn(words, stacklevel=4)
        self.readings = tuple(
            Reading(row.sensor, jnp.asarray(row.values[kept]), jnp.asarray(row.mask[kept]))
            for row in rows
        )

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        t: str,
        gyro: Sequence[str],
        unit: str | None = None,
        noise: NumbersLike | None = None,
    ) -> "Recording":
        """Return the recording of a gyro in a table of pandas, polars or xarray, or in a dictionary
        of columns.

        **Arguments:**

        - `frame`: what gives a column by its name, `frame["wx"]`. NaN marks a gap.
        - `t`: the name of the column of the times: dates, or numbers in s if the name does not say
          another unit, as `time (ms)` does.
        - `gyro`: the names of the columns of the rates about x, y and z, body frame.
        - `unit`: rad/s, deg/s, mdeg/s or rpm; `None` for the unit that the names say, as in
          `x (deg/s)`, else rad/s.
        - `noise`: the standard deviation of a reading as of `identify.Gyro`, rad/s.

        **Raises:** `ValueError` for a unit that contradicts the names, and as `Recording`.

        >>> rates = {"t": [0.0, 0.5], "x": [90, 0], "y": [0, 90], "z": [0, 0]}
        >>> Recording.from_frame(rates, t="t", gyro=["x", "y", "z"], unit="deg/s").t.shape
        (2,)
        """
        times, *rates = (np.asarray(frame[name]) for name in (t, *gyro))
        if times.dtype.kind in "mM":
            times = (times - times[0]) / np.timedelta64(1, "s")
        else:
            times = times * UNITS[common_unit([t], None, TIME_UNITS, "Recording.from_frame")]
        allowed = (*RATE_UNITS, "rpm")
        factor = UNITS[common_unit(gyro, unit, allowed, "Recording.from_frame")]
        values = factor * np.stack(rates, axis=1)
        return cls(times, (Gyro(noise), values, np.isfinite(values).all(axis=1)))

    def between(self, start: float, end: float) -> "Recording":
        """Return the part of this recording from the time `start` to the time `end`, both in s.

        Times count on; an input that is a function of time is kept whole.

        **Raises:** `ValueError` as `Recording`, for fewer than two readings.

        >>> record = Recording([0.0, 1.0, 2.0], (rj.identify.Gyro(0.01), np.ones((3, 3))))
        >>> record.between(0.5, 2.0).t.shape
        (2,)
        """
        t = np.asarray(self.t)
        rows = (t >= start) & (t <= end)
        return Recording(
            t[rows],
            *(
                (one.sensor, np.asarray(one.values)[rows], one.host_mask[rows])
                for one in self.readings
            ),
            inputs={
                name: source if callable(source) else np.asarray(source)[rows]
                for name, source in self.inputs.items()
            },
        )

    def __repr__(self) -> str:
        if not _checks.is_known(self) or np.ndim(self.t) != 1:
            return eqx.tree_pformat(self)
        t = np.asarray(self.t)
        ends = " … ".join(_show.time_as_text(end, t[-1] - t[0]) for end in (t[0], t[-1])) + " s"
        parts = [f"{self.t.shape[0]} times {ends}"]
        for reading in self.readings:
            first = _show.as_text(np.asarray(reading.values)[int(np.argmax(reading.host_mask))])
            name, count = type(reading.sensor).__name__, int(reading.host_mask.sum())
            parts.append(f"{name}: {count} readings from {first}")
        if self.inputs:
            parts.append(f"inputs: {', '.join(self.inputs)}")
        return f"Recording({'; '.join(parts)})"

    @property
    def size(self) -> int:
        """Return how many numbers all sensors read together.

        One sensor reads the number of its unmasked readings times the number of components of its
        error.
        """
        return sum(numbers_read(reading) for reading in self.readings)

    @property
    def sensors(self) -> tuple[AbstractSensor, ...]:
        """Return the sensors of this recording, in the order of its readings."""
        return tuple(reading.sensor for reading in self.readings)


def unchecked_recording(
    t: Array, readings: tuple[Reading, ...], inputs: dict[str, Any]
) -> Recording:
    """Return a `Recording` without the checks of `Recording(…)`, perhaps with a leading axis."""
    record = object.__new__(Recording)
    parts = {"t": t, "readings": readings, "inputs": inputs, "dropped": 0}
    for name, part in parts.items():
        object.__setattr__(record, name, part)
    return record


def readings_of(recording: Recording, sensor_class: type) -> list[Any]:
    """Return the `Reading` of each sensor of a class."""
    return [reading for reading in recording.readings if isinstance(reading.sensor, sensor_class)]


def input_functions(recording: Recording) -> dict[str, Callable[[Any], Any]]:
    """Return inputs as functions of time, which hold each sample until the next.

    If an input is samples, the times must be evenly spaced.
    """
    t, out = recording.t, {}
    for name, source in recording.inputs.items():
        if not callable(source):
            # The last sample belongs to the last time of the recording. The inputs of a window may
            # begin before the window: there are then more samples than times, and the first samples
            # belong to times before `t[0]`.
            steps = jnp.arange(t.size - len(source), t.size, dtype=t.dtype)
            source = Held(t[0] + (t[1] - t[0]) * steps, source)
        out[name] = source
    return out


def numbers_read(reading: Reading) -> int:
    """Return the number of unmasked readings times the components of the sensor's error."""
    return reading.sensor.components * int(reading.host_mask.sum())


def _inputs(t: np.ndarray, inputs: Any) -> dict[str, Any]:
    """Return the inputs of a recording after checks, samples as JAX arrays."""
    _checks.require_instance(
        inputs, Mapping, "inputs", requirement="samples or functions of time by name"
    )
    out = {}
    for name, source in inputs.items():
        _checks.require_instance(name, str, "inputs: name")
        if not callable(source):
            samples = _checks.host_array(source, f"inputs[{name!r}]")
            if samples.shape[:1] != t.shape:
                raise ValueError(
                    f"inputs[{name!r}]: wanted a sample for each of {t.size} times, got shape "
                    f"{samples.shape}; for samples at other times give a function of time such as "
                    "rigidjax.torques.Series(times, samples)"
                )
            source = jnp.asarray(_checks.require_finite(samples, f"inputs[{name!r}]"))
        out[name] = source
    return out


class _Rows(NamedTuple):
    """Hold the readings of a sensor, with a row for each time of the user."""

    sensor: AbstractSensor
    # A valid reading is filled in where there is none, so that no NaN is left.
    values: np.ndarray
    # True where there is a reading.
    mask: Bool[np.ndarray, " times"]
    # True where a masked array hides the reading.
    hidden: Bool[np.ndarray, " times"]


def _reading(
    t: np.ndarray, sensor: AbstractSensor, values: Any, mask: NumbersLike | None = None
) -> _Rows:
    """Return the readings of a sensor after checks; `values` and `mask` may be masked arrays."""
    name = type(sensor).__name__
    if not isinstance(sensor, AbstractSensor):
        raise TypeError(f"Recording: wanted pairs (sensor, values), got {name} for a sensor")
    if sensor.noise is not None and np.shape(sensor.noise) != (sensor.components,):
        raise ValueError(
            f"{name}: noise: wanted an array of shape ({sensor.components},), a standard deviation "
            f"for each component of the error, or None, got shape {np.shape(sensor.noise)}"
        )
    values, no_value = _checks.data_and_mask(values)
    values = _checks.host_array(values, f"{name}: readings")
    rows_hidden = None if no_value is None else no_value.reshape(len(no_value), -1).any(axis=1)
    if rows_hidden is not None:
        values[rows_hidden] = np.nan
    # A sensor may convert its readings: attitude matrices, for example, become quaternions.
    convert = extras(sensor).readings
    values = values if convert is None else convert(values)
    wanted = (t.size, *sensor.reading_shape)
    if values.shape != wanted:
        turned = "; transposed?" if values.shape == wanted[::-1] else ""
        many = f"; t has {t.size} times" if values.shape[1:] == wanted[1:] else turned
        raise ValueError(f"{name}: wanted readings of shape {wanted}, got {values.shape}{many}")
    mask, no_flag = _checks.data_and_mask(mask)
    try:
        flags = np.ones(t.size, bool) if mask is None else np.asarray(mask)
    except ValueError as error:
        raise ValueError(f"{name}: wanted a mask (T,), got rows of different lengths") from error
    if flags.dtype.kind not in "biu":
        raise TypeError(f"{name}: wanted a mask of true and false, got {flags.dtype}")
    mask = flags.astype(bool)
    if mask.shape != t.shape:
        raise ValueError(f"{name}: wanted a mask of shape {t.shape}, got {mask.shape}")
    hidden = np.zeros(t.shape, bool)
    for absent in (rows_hidden, no_flag):
        hidden = hidden if absent is None else hidden | absent
    mask = mask & ~hidden
    across = tuple(range(1, values.ndim))
    bad = mask & ~np.isfinite(values).all(axis=across)
    if bad.any():
        index = int(np.argmax(bad))
        what = "contains NaN" if np.isnan(values[index]).any() else "is infinite"
        raise ValueError(f"{name}: the reading at index {index} {what}; mask it if it is a gap")
    if not mask.any():
        raise ValueError(
            f"{name}: wanted at least one reading, but every reading is masked; a mask is true "
            "where there is a reading"
        )
    # Replace masked values by a valid reading: a NaN would make derivatives NaN, since 0 · NaN is
    # NaN.
    if not mask.all():
        shaped = mask.reshape(-1, *(1 for _ in across))
        values = np.where(shaped, values, values[int(np.argmax(mask))])
    refusal = extras(sensor).refusal
    if refusal is not None:
        wrong, why = refusal(values)
        if wrong.any():
            raise ValueError(f"{name}: {why.format(index=int(np.argmax(wrong)))}")
    return _Rows(sensor, values, mask, hidden)
