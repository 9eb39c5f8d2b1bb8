"""The times that a filter stops at: those of the readings, and some between where they are far."""

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

# Radians turned in a step of the classical method of order 4: it errs by 5e-8 of the turn.
TURN_A_STEP = 0.05
# Of the memory of a torque.
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
    """The times to stop at; `None` where those of the recording will do.

    **Raises:** `ValueError` for a recording that begins before the belief that it starts from.
    """
    t, t0 = recording.t, first.t
    if _checks.known((t, t0)):
        early = bool(np.asarray(t)[0] < np.asarray(t0))
        _checks.refuse(
            t,
            early,
            f"recording: readings are out of order: the first is at {np.asarray(t)[0]:g} s, before "
            f"the time of the belief it starts from, {np.asarray(t0):g} s",
        )
    if substeps is not None:
        pieces = _checks.whole(substeps, "substeps", 1)
        if pieces == 1:
            return None
        before = jnp.concatenate([t0[None], t[:-1]])
        part = jnp.arange(1, pieces + 1, dtype=t.dtype) / pieces
        inner = before[:, None] + (t - before)[:, None] * part[None]
        inner = inner.at[:, -1].set(t)
        count = t.shape[0]
        real = jnp.tile(jnp.arange(pieces) == pieces - 1, count)
        index = jnp.repeat(jnp.arange(count), pieces)
        return Grid(inner.reshape(-1), index, real, jnp.arange(1, count + 1) * pieces - 1)
    if not _checks.known((t, t0, first.x.motion.omega, model.coloured)):
        return None
    longest = _longest(model, recording, first)
    stops, before = np.asarray(t), np.concatenate([[float(t0)], np.asarray(t)[:-1]])
    counts = np.maximum(1, np.ceil((stops - before) / longest * (1 - 1e-9))).astype(int)
    if (counts == 1).all():
        return None
    index = np.repeat(np.arange(stops.size), counts)
    rows = np.cumsum(counts) - 1
    part = (np.arange(index.size) - np.repeat(rows - counts, counts)) / np.repeat(counts, counts)
    times = before[index] + (stops - before)[index] * part
    times[rows] = stops
    real = np.zeros(index.size, bool)
    real[rows] = True
    return Grid(
        jnp.asarray(times, t.dtype), jnp.asarray(index), jnp.asarray(real), jnp.asarray(rows)
    )


def _longest(model: Model, recording: Recording, first: Belief) -> float:
    """The longest step, s."""
    rate = float(np.linalg.norm(np.asarray(first.x.motion.omega, float)))
    for reading in recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values, float)[reading.seen]
            rate = max(rate, float(np.quantile(np.linalg.norm(values, axis=1), 0.99)))
    longest = TURN_A_STEP / rate if rate > 0 else math.inf
    for law in model.coloured:
        longest = min(longest, MEMORY_A_STEP * float(law.time))
    return longest


def gathered(grid: Grid | None, t: Array, values: Any, masks: Any) -> tuple[Array, Any, Any]:
    """Times, values and masks at each stop."""
    if grid is None:
        return t, values, masks
    return (
        grid.t,
        tuple(v[grid.source] for v in values),
        tuple(m[grid.source] & grid.real for m in masks),
    )
