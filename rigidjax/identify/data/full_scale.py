"""Find readings at full scale, and describe them in a report."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from rigidjax.identify.data.recording import Reading, Recording
from rigidjax.identify.sensors import Gyro

# Readings are cut off only if at least this number of readings in a row have the largest value.
RUN = 3
# No gyro reads rates above this number, rad/s: the full scale of the fastest ones is 4000 deg/s.
FASTEST = 70.0
# If more than this fraction of the readings of a channel have the largest value, the channel is
# taken as constant, not as cut off.
MOST = 0.7


def runs(
    x: np.ndarray, breaks: Bool[np.ndarray, " gaps"] | None = None
) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each run of equal values, of a mask where it is true.

    A run also ends at the index i if `breaks[i]` is true.
    """
    new = x[1:] != x[:-1]
    new = new if breaks is None else new | breaks
    edges = np.concatenate([[0], np.flatnonzero(new) + 1, [x.size]])
    for i, j in itertools.pairwise(edges):
        if x.dtype != bool or x[i]:
            yield int(i), int(j) - 1


def full_scale_of(values: np.ndarray) -> float | None:
    """Return the full scale of one channel of a sensor if its readings are cut off, else `None`.

    Readings count as cut off if many readings in a row have the largest value: at least twice as
    many as at the top of a smooth wave. There about 1 + 2 √(2d/a) readings in a row are equal,
    where d is the smallest change between successive readings (the last digit), and a is the
    typical second difference.
    """
    size = np.abs(values)
    top = float(size.max(initial=0.0))
    at = size >= top * (1 - 1e-9)
    if not top > 0 or at.sum() < RUN or at.mean() > MOST:
        return None
    steps = np.abs(np.diff(values))
    bends = np.abs(np.diff(values, 2))[~at[1:-1]]
    bend = float(np.median(bends)) if bends.size else 0.0
    if not (steps > 0).any() or not bend > 0:
        return None
    smooth = 1.0 + 2.0 * np.sqrt(2.0 * steps[steps > 0].min() / bend)
    longest = max(last - first + 1 for first, last in runs(at))
    return top if longest >= max(RUN, 2.0 * smooth) else None


def with_limits(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with the full scale as the `limit` of each sensor that was cut off.

    A sensor that has a `limit` already keeps it.
    """
    out = list(recordings)
    for index in range(max(len(r.readings) for r in recordings)):
        limits_by_place = {}
        for place, recording in enumerate(recordings):
            for reading in recording.readings[index : index + 1]:
                sensor: Any = reading.sensor
                plain = sensor.reading_shape == (sensor.components,)
                if plain and getattr(sensor, "limit", 0) is None:
                    values = np.asarray(reading.values)[reading.host_mask]
                    levels = [full_scale_of(channel) for channel in values.T]
                    limits_by_place[place] = np.array(
                        [np.inf if one is None else one for one in levels]
                    )
        if not any(np.isfinite(limits).any() for limits in limits_by_place.values()):
            continue
        for place, limits in limits_by_place.items():
            out[place] = eqx.tree_at(
                lambda r, i=index: r.readings[i].sensor.limit,
                out[place],
                jnp.asarray(limits, out[place].t.dtype),
                is_leaf=lambda node: node is None,
            )
    return out


def beyond_gyros(readings: Sequence[Reading]) -> float | None:
    """Return the largest reading of a gyro, rad/s, if no gyro reads so much, else `None`."""
    sizes = [
        float(np.abs(np.asarray(one.values)[one.host_mask]).max(initial=0.0))
        for one in readings
        if isinstance(one.sensor, Gyro)
    ]
    return max(sizes, default=0.0) if max(sizes, default=0.0) > FASTEST else None


def describe_full_scale(readings: Sequence[Reading]) -> list[str]:
    """Describe how many readings are at full scale, in one sentence for each such sensor."""
    out = []
    for reading in readings:
        count = (reading.host_mask[..., None] & ~reading.usable).sum(axis=(0, 1))
        if not count.any():
            continue
        sensor: Any = reading.sensor
        level = np.asarray(sensor.limit)
        parts = []
        for channel in np.flatnonzero(count):
            sizes = level[:, channel][np.isfinite(level[:, channel])]
            name = "xyz"[channel] if channel < 3 else str(channel)
            parts.append(f"{count[channel]} of {name} at {sizes.min():.4g} {sensor.unit}")
        out.append(
            f"Readings of the {type(sensor).__name__} at full scale ({', '.join(parts)}) count as "
            "at least that much."
        )
    return out
