"""A recording: times, and what each sensor read then."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax.identify.sensors import AbstractSensor, AttitudeSensor


class Reading(eqx.Module):
    """What one sensor read: `values` (T, …) and `mask` (T,), true where there is a reading."""

    sensor: AbstractSensor
    values: Float[Array, "times ..."]
    mask: Bool[Array, " times"]

    @property
    def seen(self) -> np.ndarray:
        """The mask as a NumPy array, for what happens outside `jit`."""
        return np.asarray(self.mask)


class Recording(eqx.Module):
    """Times and readings of one motion.

    **Arguments:** `t` (T,) increasing times, s; then, for each sensor, a pair `(sensor, values)` or
    a triple `(sensor, values, mask)`: `values` (T, 3) for a `Gyro`, (T, 4) for an
    `AttitudeSensor`; `mask` (T,) true where there is a reading (what it masks may be NaN).

    **Raises** `ValueError` for times that do not increase, a wrong shape, an unmasked NaN (with its
    index), or a quaternion that is not unit.

    >>> import rigidjax as rj
    >>> Recording([0.0, 1.0], (rj.identify.Gyro(0.01), [[1.0, 0, 0], [1.0, 0, 0]])).t.shape
    (2,)
    """

    t: Float[Array, " times"]
    readings: tuple[Reading, ...]

    def __init__(self, t: Any, *readings: tuple):
        t = np.asarray(t, float)
        if t.ndim != 1 or t.size < 2:
            raise ValueError(f"t: wanted at least two times, shape (T,), got shape {t.shape}")
        if not np.isfinite(t).all():
            raise ValueError(f"t: contains NaN at index {int(np.argmin(np.isfinite(t)))}")
        if (np.diff(t) <= 0).any():
            index = int(np.argmax(np.diff(t) <= 0)) + 1
            raise ValueError(f"t: wanted increasing times; t[{index}] is not above the one before")
        if not readings:
            raise ValueError("Recording: wanted at least one pair (sensor, values)")
        self.t = jnp.asarray(t)
        self.readings = tuple(_reading(t, *reading) for reading in readings)

    @property
    def size(self) -> int:
        """How many numbers were read, three for each reading."""
        return sum(3 * int(reading.seen.sum()) for reading in self.readings)


def _reading(t: np.ndarray, sensor: AbstractSensor, values: Any, mask: Any = None) -> Reading:
    name = type(sensor).__name__
    if not isinstance(sensor, AbstractSensor):
        raise TypeError(f"Recording: wanted pairs (sensor, values), got {name} for a sensor")
    values = np.asarray(values, float)
    wanted = (t.size, *sensor.reading_shape)
    if values.shape != wanted:
        raise ValueError(f"{name}: wanted readings of shape {wanted}, got {values.shape}")
    mask = np.ones(t.size, bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != t.shape:
        raise ValueError(f"{name}: wanted a mask of shape {t.shape}, got {mask.shape}")
    bad = mask & ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{name}: the reading at index {int(np.argmax(bad))} contains NaN; mask it if it is "
            "a gap"
        )
    if isinstance(sensor, AttitudeSensor):
        length = np.linalg.norm(values, axis=1)
        bad = mask & (np.abs(length - 1) > 1e-6)
        if bad.any():
            raise ValueError(
                f"{name}: the quaternion at index {int(np.argmax(bad))} is not unit; wanted "
                "(w, x, y, z) with the scalar first"
            )
    # What is masked must not reach a derivative: 0 · NaN is NaN.
    filler = np.eye(1, values.shape[1]) if isinstance(sensor, AttitudeSensor) else 0.0
    values = np.where(mask[:, None], values, filler)
    return Reading(sensor, jnp.asarray(values), jnp.asarray(mask))
