"""Find the reference of the initial states of a fit from the first readings of each recording."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from rigidjax import _checks
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, readings_of
from rigidjax.identify.sensors import (
    AttitudeSensor,
    Direction,
    Gyro,
    Marker,
    Position,
    Range,
    Velocity,
)
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import names, plus
from rigidjax.rotation import quaternion, so3
from rigidjax.rotation.fitting import nearest_rotation

# A rate is taken between two attitudes that differ by this turn, rad: it is large against noise,
# but so small that the axis hardly moves.
_TURN = 0.3
# Directions do not determine an attitude if two singular values of Σ world bodyᵀ are below this
# share of the largest.
_DETERMINED = 1e-3


def attitudes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,), s, and the attitudes (n, 4), body → world, that the readings show.

    They are those of an attitude sensor or, as by `rigidjax.so3.wahba`, of three markers or two
    directions. Without such sensors n is 0.
    """
    t = np.asarray(recording.t)
    for reading in readings_of(recording, AttitudeSensor):
        q, mounting = np.asarray(reading.values)[reading.host_mask], reading.sensor.mounting
        if mounting is not None:
            back = quaternion.exp(-mounting)
            q = np.asarray(jax.vmap(quaternion.multiply, (0, None))(jnp.asarray(q), back))
        return t[reading.host_mask], q
    body, world, mask = [], [], np.ones(t.shape, bool)
    markers = readings_of(recording, Marker)
    if len(markers) >= 3:
        places = np.stack([np.asarray(r.sensor.place) for r in markers])
        there = np.stack([np.asarray(r.values) for r in markers], axis=1)
        size = np.linalg.norm(places - places.mean(axis=0), axis=1).max() or 1.0
        body.append(np.broadcast_to((places - places.mean(axis=0)) / size, there.shape))
        world.append((there - there.mean(axis=1, keepdims=True)) / size)
        mask = mask & np.all([r.host_mask for r in markers], axis=0)
    for reading in readings_of(recording, Direction):
        along, sensor = np.asarray(reading.values), reading.sensor
        if sensor.mounting is not None:
            along = along @ np.asarray(so3.exp(sensor.mounting)).T
        body.append(along[:, None, :])
        world.append(np.broadcast_to(np.asarray(sensor.world), along.shape)[:, None, :])
        mask = mask & reading.host_mask
    if not body:
        return np.zeros(0), np.zeros((0, 4))
    rows, sides = np.concatenate(body, axis=1)[mask], np.concatenate(world, axis=1)[mask]
    b = np.einsum("tni,tnj->tij", sides, rows)
    s = np.linalg.svd(b, compute_uv=False)
    known = s[:, 1] + np.sign(np.linalg.det(b)) * s[:, 2] > _DETERMINED * s[:, 0]
    if not known.any():
        return np.zeros(0), np.zeros((0, 4))
    return t[mask][known], np.asarray(_attitudes_of(b[known]))


@jax.jit
def _attitudes_of(sums: ArrayLike) -> Array:
    """Return the attitudes (n, 4) that fit directions best, from the matrix Σ world bodyᵀ (3, 3) of
    each of n times.

    This is `so3.wahba` without its check: `equinox.error_if` always raises in a compiled function
    that is called within `jax.ensure_compile_time_eval`, as the model calls this one.
    """
    return jax.vmap(lambda one: quaternion.from_matrix(nearest_rotation(one)))(sums)


def rates(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,), s, and the body rates (n, 3), rad/s, of a gyro, or else of the turns
    between attitudes.

    If the readings show neither, n is 0.
    """
    for reading in readings_of(recording, Gyro):
        return np.asarray(recording.t)[reading.host_mask], np.asarray(reading.values)[
            reading.host_mask
        ]
    return rates_of(*attitudes(recording))


def rates_of(t: np.ndarray, q: np.ndarray | Array) -> tuple[np.ndarray, np.ndarray]:
    """Return times (m,) and body rates (m, 3) between the attitudes q (n, 4) at the times t (n,).

    Each rate is the mean one over about `_TURN`, at the middle of its interval of time.
    """
    if t.size < 2:
        return np.zeros(0), np.zeros((0, 3))
    steps = np.linalg.norm(_rotation_vectors(q[:-1], q[1:]), axis=1)
    turned = np.concatenate([[0.0], np.cumsum(steps)])
    first = np.arange(t.size - 1)
    last = np.searchsorted(turned, turned[first] + _TURN, side="right") - 1
    last = np.clip(np.maximum(last, first + 1), 1, t.size - 1)
    gap = t[last] - t[first]
    turns = np.asarray(_rotation_vectors(q[first], q[last]))
    return 0.5 * (t[first] + t[last]), turns / gap[:, None]


@jax.jit
def _rotation_vectors(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the shortest rotation vectors (n, 3), in body axes, from the quaternions p to the
    quaternions q (n, 4).

    The signs of the quaternions do not matter.
    """

    def turn(a: Array, b: Array) -> Array:
        return quaternion.log(quaternion.multiply(quaternion.conjugate(a), b))

    return jax.vmap(turn)(jnp.asarray(p), jnp.asarray(q))


class ReferenceStates(eqx.Module):
    """Hold the reference state of a recording, from which the initial state of a fit is counted.

    **Fields:**

    - `state`: a `Spin`, `Attitude` or `Rigid`.
    - `rate`: the typical body rate, rad/s.
    - `units`: (n,) the size of each number of a change of the state: free numbers count in it.
    """

    state: PyTree
    rate: Float[Array, "*records"]
    units: Float[Array, "*records n"]

    def start_at(self, change: Float[Array, " n"]) -> PyTree:
        """Return the initial state of one recording for the free numbers `change`.

        An empty `change` belongs to a known initial state, which is the reference.
        """
        return plus(self.state, self.units * change) if change.size else self.state


def reference_of(recordings: Sequence[Recording], state_type: type) -> ReferenceStates:
    """Return the reference states, of the type `state_type`, from the first readings of
    recordings.
    """
    turns = [[*attitudes(r)[1], np.array([1.0, 0.0, 0.0, 0.0])][0] for r in recordings]
    places = [_first_position(r) for r in recordings]
    dtype = recordings[0].t.dtype
    # Make arrays: with floats each recording would compile a program of its own.
    x, v, length = (jnp.asarray(np.stack(part), dtype) for part in zip(*places, strict=True))
    q, still = jnp.asarray(np.stack(turns), dtype), jnp.zeros_like(x)
    states = {Spin: Spin(still), Attitude: Attitude(q, still), Rigid: Rigid(x, v, q, still)}
    typical = jnp.asarray([_typical_rate(r) for r in recordings], dtype)
    sizes = {"x": length, "v": length * typical, "q": jnp.ones_like(typical), "omega": typical}
    state = states[state_type]
    units = [sizes[name] for name in names(state)]
    return ReferenceStates(state, typical, jnp.repeat(jnp.stack(units, -1), 3, -1))


def _typical_rate(recording: Recording) -> float:
    """Return a typical length of the body rate, rad/s, or 1 if the readings show none."""
    _, w = rates(recording)
    if readings_of(recording, Gyro):
        return float(np.sqrt(np.mean(np.sum(w**2, axis=1)))) or 1.0
    rate = float(np.linalg.norm(w[0])) if len(w) else 0.0
    # Without rates take the estimate of the first sensor that can make one.
    for reading in recording.readings if rate == 0 else ():
        sensor: Any = reading.sensor
        if hasattr(sensor, "typical_rate"):
            t, values = np.asarray(recording.t), np.asarray(reading.values)
            rate = sensor.typical_rate(t[reading.host_mask], values[reading.host_mask])
            break
    return rate if rate > 0 else 1.0


def _first_position(recording: Recording) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the first position, m, the first velocity, m/s, and a typical length, m, of a
    recording.

    They are those of the centre of mass, or of the origin of the body frame if only markers were
    read.
    """
    t, when, x = np.asarray(recording.t), np.zeros(0), np.zeros((0, 3))
    positions, markers = readings_of(recording, Position), readings_of(recording, Marker)
    ranges = readings_of(recording, Range)
    speeds = [r for r in readings_of(recording, Velocity) if r.sensor.mounting is None]
    if positions:
        when, x = t[positions[0].host_mask], np.asarray(positions[0].values)[positions[0].host_mask]
    elif markers:
        when, x = _places_by_markers(recording, markers)
    elif ranges:
        mask = np.all([r.host_mask for r in ranges], axis=0)
        stations = np.stack([np.asarray(r.sensor.station) for r in ranges])
        lengths = np.stack([np.asarray(r.values) for r in ranges], axis=1)[mask]
        when, x = t[mask], _places_by_ranges(stations, lengths)
    if speeds and (positions or not markers):
        v = np.asarray(speeds[0].values)[speeds[0].host_mask][0]
    else:
        v = _first_velocity(when, x)
    x = x if when.size else np.zeros((1, 3))
    # The length is the largest distance from the mean place, or 1 if all places are the same.
    return x[0], v, float(np.linalg.norm(x - x.mean(axis=0), axis=1).max()) or 1.0


def _places_by_markers(
    recording: Recording, markers: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) and the places (n, 3) of the origin of the body, found from its markers.

    If the markers are never all read at once, the first one stands for all.
    """
    mask = np.all([r.host_mask for r in markers], axis=0)
    if not mask.any():
        markers, mask = markers[:1], markers[0].host_mask
    t = np.asarray(recording.t)[mask]
    x = np.mean([np.asarray(r.values)[mask] for r in markers], axis=0)
    place = np.mean([np.asarray(r.sensor.place) for r in markers], axis=0)
    known, q = attitudes(recording)
    if np.isin(t, known).all():
        arms = jax.vmap(lambda turn: quaternion.rotate(turn, place))(q[np.isin(known, t)])
        x = x - np.asarray(arms)
    return t, x


def _first_velocity(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the slope (3,) of a line through the first of the places x (n, 3), or zero for one
    place.
    """
    few = slice(0, max(2, min(5, t.size)))
    return np.polyfit(t[few] - t[0], x[few], 1)[0] if t.size > 1 else np.zeros(3)


def _places_by_ranges(stations: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the places x (n, 3) at the distances d = `lengths` (n, k) from k stations.

    The equations `|x|² − 2 s·x + |s|² = d²` are linear in x once their mean over the stations s is
    subtracted. A component of x that they do not determine is taken from the centre of the
    stations.
    """
    centre = stations.mean(axis=0)
    s = stations - centre
    sides = (s * s).sum(axis=1)[None] - lengths**2
    sides = 0.5 * (sides - sides.mean(axis=1, keepdims=True))
    return centre + np.linalg.lstsq(s, sides.T, rcond=1e-9)[0].T


def first_rates(
    records: Recording, counts: Int[Array | np.ndarray, " records"]
) -> Float[Array, "records 3"]:
    """Return the `first_rate` of each of several recordings with a leading axis, or zero if they
    are traced.

    The rates that a gyro reads are returned for traced recordings as well.
    """
    for reading in readings_of(records, Gyro):
        xp: Any = np if _checks.is_known(reading) else jnp
        first = xp.argmax(xp.asarray(reading.mask), axis=1)[:, None, None]
        return jnp.asarray(xp.take_along_axis(xp.asarray(reading.values), first, axis=1)[:, 0])
    if not _checks.is_known(records):
        return jnp.zeros((len(counts), 3), records.t.dtype)
    each = [first_rate(recording) for recording in stacking.recordings_on_host(records, counts)]
    return jnp.asarray(np.stack(each), records.t.dtype)


def first_rate(recording: Recording) -> np.ndarray:
    """Return the first body rate (3,), rad/s, that `rates` finds, or zero if the readings show
    none.
    """
    _, w = rates(recording)
    return w[0] if len(w) else np.zeros(3)
