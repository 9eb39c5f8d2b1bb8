"""The times of a filter's steps: those of the readings, and some between if they are far apart."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rigidjax import _checks
from rigidjax.estimate.belief import Belief
from rigidjax.estimate.scene import Model
from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import Gyro

# The turn in a step of the classical method of order 4, rad: its error is 5e-8 of the turn.
TURN_A_STEP = 0.05
# The longest step as a fraction of a torque's correlation time.
MEMORY_A_STEP = 0.25


class Grid(NamedTuple):
    """**Fields:** `t` (N,) s; `source` (N,) which row of the recording is next; `real` (N,) whether
    it is of this time; `rows` (T,) where each time of the recording is.
    """

    t: Float[Array, " n"]
    source: Int[Array, " n"]
    real: Bool[Array, " n"]
    rows: Int[Array, " t"]


def grid_of(model: Model, recording: Recording, first: Belief, substeps: int | None) -> Grid | None:
    """The times of the steps; `None` if the recording's own times are enough.

    **Raises:** `ValueError` for a recording that begins before the belief that it starts from.
    """
    t, t0 = recording.t, first.t
    if _checks.known((t, t0)):
        begin = np.asarray(t)[0]
        words = (
            f"recording: readings are out of order: the first is at {begin:g} s, before the time "
            f"of the belief it starts from, {np.asarray(t0):g} s"
        )
        _checks.refuse(t, begin < np.asarray(t0), words)
    if substeps is not None:
        counts = np.full(t.shape, _checks.whole(substeps, "substeps", 1))
    elif _checks.known((t, t0, first.x.motion.omega, model.coloured)):
        gaps = np.diff(np.concatenate([[float(t0)], np.asarray(t)]))
        counts = steps_of(gaps, longest_step(model, _fastest(recording, first)))
    else:
        return None
    if (counts == 1).all():
        return None
    xp = _checks.namespace((t, t0))
    index = np.repeat(np.arange(counts.size), counts)
    rows = np.cumsum(counts) - 1
    part = (np.arange(index.size) - np.repeat(rows - counts, counts)) / counts[index]
    t, t0 = xp.asarray(t), xp.asarray(t0)
    before = xp.concatenate([t0[None], t[:-1]])
    times = before[index] + (t - before)[index] * xp.asarray(part, t.dtype)
    times = xp.where(part == 1, t[index], times)
    return Grid(*map(jnp.asarray, (times, index, part == 1, rows)))


def longest_step(model: Model, rate: float) -> float:
    """The longest step, s, of a body that turns at `rate` rad/s."""
    times = [MEMORY_A_STEP * float(law.time) for law in model.coloured]
    return min([TURN_A_STEP / rate if rate > 0 else math.inf, *times])


def steps_of(span: Any, longest: float) -> Any:
    """The number of fixed steps of at most `longest` in an interval of `span` s."""
    return np.maximum(1, np.ceil(span / longest * (1 - 1e-9))).astype(int)


def _fastest(recording: Recording, first: Belief) -> float:
    """The largest rate that the initial state and the gyros show, rad/s."""
    rate = float(np.linalg.norm(np.asarray(first.x.motion.omega, float)))
    for reading in recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values, float)[reading.seen]
            rate = max(rate, float(np.quantile(np.linalg.norm(values, axis=1), 0.99)))
    return rate
