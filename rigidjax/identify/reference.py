"""Where the first states of a fit are counted from: the first readings of each recording."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import AttitudeSensor, Gyro, Marker
from rigidjax.motion import Rigid, Spin
from rigidjax.rotation import quaternion


class Reference(eqx.Module):
    """Where the first state of a recording is counted from, and in which units."""

    q: Float[Array, "*records 4"] | None
    x: Float[Array, "*records 3"] | None
    v: Float[Array, "*records 3"] | None
    rate: Float[Array, "*records"]
    length: Float[Array, "*records"]


def reference_of(recordings: Sequence[Recording], rung: type) -> Reference:
    """From the first readings of each recording, as far as the rung needs it."""
    turns = [_first_attitude(r) for r in recordings]
    places = [_first_place(r) for r in recordings]
    dtype = recordings[0].t.dtype
    # Arrays, not floats: another recording must not compile again.
    return Reference(
        None if rung is Spin else jnp.asarray(np.stack(turns), dtype),
        jnp.asarray(np.stack([x for x, _, _ in places]), dtype) if rung is Rigid else None,
        jnp.asarray(np.stack([v for _, v, _ in places]), dtype) if rung is Rigid else None,
        jnp.asarray([_typical_rate(r) for r in recordings], dtype),
        jnp.asarray([length for _, _, length in places], dtype),
    )


def _typical_rate(recording: Recording) -> float:
    for reading in recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values)[reading.seen]
            rate = float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
            break
    else:
        rate = float(np.linalg.norm(attitude_rate(recording)))
    return rate if rate > 0 else 1.0


def _first_attitude(recording: Recording) -> np.ndarray:
    for reading in recording.readings:
        if isinstance(reading.sensor, AttitudeSensor):
            return np.asarray(reading.values[int(np.argmax(reading.seen))])
    return np.array([1.0, 0.0, 0.0, 0.0])


def _first_place(recording: Recording) -> tuple[np.ndarray, np.ndarray, float]:
    """Position and velocity of the first marker, m and m/s, and a typical length, m."""
    for reading in recording.readings:
        if isinstance(reading.sensor, Marker):
            seen = np.flatnonzero(reading.seen)
            x, t = np.asarray(reading.values)[seen], np.asarray(recording.t)[seen]
            few = slice(0, max(2, min(5, seen.size)))
            v = np.polyfit(t[few] - t[0], x[few], 1)[0] if seen.size > 1 else np.zeros(3)
            length = float(np.linalg.norm(x - x.mean(axis=0), axis=1).max())
            return x[0], v, length if length > 0 else 1.0
    return np.zeros(3), np.zeros(3), 1.0


def attitude_rate(recording: Recording) -> np.ndarray:
    """A first body rate (3,), rad/s, from the first two attitudes; zero where there are none."""
    for reading in recording.readings:
        if isinstance(reading.sensor, AttitudeSensor):
            seen = np.flatnonzero(reading.seen)[:2]
            if seen.size == 2:
                first, second = reading.values[seen[0]], reading.values[seen[1]]
                turn = quaternion.log(quaternion.multiply(quaternion.conjugate(first), second))
                return np.asarray(turn) / float(recording.t[seen[1]] - recording.t[seen[0]])
    return np.zeros(3)
