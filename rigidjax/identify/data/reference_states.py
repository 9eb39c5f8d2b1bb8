"""Find a reference state of each recording from its first readings.

The free numbers of an initial state are changes of this reference state.
"""

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
from rigidjax.motion.manifold import leaf_names, plus
from rigidjax.rotation import quaternion, so3
from rigidjax.rotation.fitting import nearest_rotation

# A mean body rate is computed between two attitudes that differ by a turn of about this angle, rad.
# The angle is large compared with the noise of attitudes, but so small that the axis of rotation
# hardly moves during the turn.
_TURN = 0.3
# Directions w in the world and the same directions b in the body determine an attitude if s₂ + s₃
# is above this fraction of s₁. Here s₁ ≥ s₂ ≥ |s₃| are the singular values of the sum Σ w bᵀ, and
# s₃ has the sign of the determinant of this sum.
_DETERMINED = 1e-3


def attitudes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,), s, and the attitudes (n, 4), quaternions body → world, that the
    readings of a `recording` show.

    The attitudes are the readings of an attitude sensor. Without such a sensor they are computed
    from at least three markers or two directions, in the way of `rigidjax.so3.wahba`. If the
    readings show no attitude, n is 0.
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
    return t[mask][known], np.asarray(_attitudes_by_wahba(b[known]))


@jax.jit
def _attitudes_by_wahba(sums: ArrayLike) -> Array:
    """Return the attitudes (n, 4), quaternions body → world, that best (in the least-squares sense)
    turn directions in the body into directions in the world.

    The argument `sums` (n, 3, 3) holds for each of n times the sum Σ w bᵀ over several directions,
    where w is a direction in the world, and b is the same direction in the body. The function is
    `so3.wahba` without the check of `so3.wahba`: a `Model` calls this function within
    `jax.ensure_compile_time_eval`, where `equinox.error_if` in a compiled function always raises an
    error.
    """
    return jax.vmap(lambda one: quaternion.from_matrix(nearest_rotation(one)))(sums)


def rates(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,), s, and the body rates (n, 3), rad/s, that the readings of a
    `recording` show.

    The rates are the readings of a gyro. Without a gyro they are computed from the turns between
    attitudes. If the readings show no rate, n is 0.
    """
    for reading in readings_of(recording, Gyro):
        return np.asarray(recording.t)[reading.host_mask], np.asarray(reading.values)[
            reading.host_mask
        ]
    return rates_between_attitudes(*attitudes(recording))


def require_turning(rates: np.ndarray, name: str) -> None:
    """Raise `ValueError` if the body rates (n, 3), rad/s, are all zero, or so small that they are
    round-off; the text `name` names them in the message.
    """
    if rates.size and np.abs(rates).max() < 1e-14:
        raise ValueError(
            f"{name} are all zero: a body at rest shows nothing of its inertia, or the sensor was "
            "off; take other columns, or another part of the recording"
        )


def rates_between_attitudes(t: np.ndarray, q: np.ndarray | Array) -> tuple[np.ndarray, np.ndarray]:
    """Return two things: times (m,), s; and for each of these times the mean body rate (m, 3),
    rad/s, between two attitudes.

    The quaternions q (n, 4), body → world, are the attitudes at the times t (n,), s. The two
    attitudes differ by a turn of about 0.3 rad. The time of a mean rate is the middle between the
    times of the two attitudes.
    """
    if t.size < 2:
        return np.zeros(0), np.zeros((0, 3))
    steps = np.linalg.norm(_rotation_vectors_between(q[:-1], q[1:]), axis=1)
    turned = np.concatenate([[0.0], np.cumsum(steps)])
    first = np.arange(t.size - 1)
    last = np.searchsorted(turned, turned[first] + _TURN, side="right") - 1
    last = np.clip(np.maximum(last, first + 1), 1, t.size - 1)
    gap = t[last] - t[first]
    turns = np.asarray(_rotation_vectors_between(q[first], q[last]))
    return 0.5 * (t[first] + t[last]), turns / gap[:, None]


@jax.jit
def _rotation_vectors_between(first: ArrayLike, last: ArrayLike) -> Array:
    """Return the rotation vectors (n, 3), rad, in body axes, of the turns from n attitudes to n
    other attitudes.

    The arguments `first` and `last` (n, 4) are the attitudes before and after each turn, as
    quaternions body → world. Each turn is the shortest one, so that the sign of a quaternion does
    not matter.
    """

    def turn(a: Array, b: Array) -> Array:
        return quaternion.log(quaternion.multiply(quaternion.conjugate(a), b))

    return jax.vmap(turn)(jnp.asarray(first), jnp.asarray(last))


class ReferenceStates(eqx.Module):
    """Hold the reference state of a recording.

    A fit finds the initial state of the recording as a change of the reference state: the free
    numbers of the initial state are zero at the reference state.

    **Fields:**

    - `state`: the reference state, of the type of the states of the model: `Spin` (body rate),
      `Attitude` (attitude and body rate) or `Rigid` (with position and velocity, too).
    - `rate`: the typical body rate of the motion, rad/s.
    - `units`: (n,) for each free number of the initial state the change of the state if the number
      is one. The whole change of the state is `units` times the free numbers.

    For several recordings all arrays have a leading axis.
    """

    state: PyTree
    rate: Float[Array, "*records"]
    units: Float[Array, "*records n"]

    def initial_state_at(self, change: Float[Array, " n"]) -> PyTree:
        """Return the initial state of one recording at the free numbers `change` (n,): the
        reference state changed by `units` times `change`.

        If the initial state is known, `change` is empty, and the reference state is returned.
        """
        return plus(self.state, self.units * change) if change.size else self.state


def reference_states_of(recordings: Sequence[Recording], state_type: type) -> ReferenceStates:
    """Return the reference state of each recording, found from its first readings.

    A fit finds the initial state of a recording as a change of its reference state. The body rate
    of each reference state is zero.

    - `recordings`: R recordings; the result has a leading axis (R,).
    - `state_type`: the type of the states: `Spin` (body rate), `Attitude` (attitude and body rate)
      or `Rigid` (with position and velocity, too).
    """
    turns = [[*attitudes(r)[1], np.array([1.0, 0.0, 0.0, 0.0])][0] for r in recordings]
    places = [_first_motion_and_typical_length(r) for r in recordings]
    dtype = recordings[0].t.dtype
    # Use arrays: with Python floats a program would be compiled for each recording.
    x, v, length = (jnp.asarray(np.stack(part), dtype) for part in zip(*places, strict=True))
    q, still = jnp.asarray(np.stack(turns), dtype), jnp.zeros_like(x)
    states = {Spin: Spin(still), Attitude: Attitude(q, still), Rigid: Rigid(x, v, q, still)}
    typical = jnp.asarray([_typical_rate(r) for r in recordings], dtype)
    sizes = {"x": length, "v": length * typical, "q": jnp.ones_like(typical), "omega": typical}
    state = states[state_type]
    units = [sizes[name] for name in leaf_names(state)]
    return ReferenceStates(state, typical, jnp.repeat(jnp.stack(units, -1), 3, -1))


def _typical_rate(recording: Recording) -> float:
    """Return the typical size of the body rate in a `recording`, rad/s, or 1 if its readings show
    no rate.

    With a gyro the typical size is the root mean square of the length of its readings. Without a
    gyro it is the size of the first mean rate between two attitudes. If attitudes show no rate, or
    this rate is zero, it is the estimate of the first sensor that has a method `typical_rate`.
    """
    _, w = rates(recording)
    if readings_of(recording, Gyro):
        return float(np.sqrt(np.mean(np.sum(w**2, axis=1)))) or 1.0
    rate = float(np.linalg.norm(w[0])) if len(w) else 0.0
    # If there is no rate, take the estimate of the first sensor that can estimate a typical rate.
    for reading in recording.readings if rate == 0 else ():
        sensor: Any = reading.sensor
        if hasattr(sensor, "typical_rate"):
            t, values = np.asarray(recording.t), np.asarray(reading.values)
            rate = sensor.typical_rate(t[reading.host_mask], values[reading.host_mask])
            break
    return rate if rate > 0 else 1.0


def _first_motion_and_typical_length(recording: Recording) -> tuple[np.ndarray, np.ndarray, float]:
    """Return three things that the readings of a `recording` show: the first position (3,), m; the
    first velocity (3,), m/s; and a typical length, m.

    Position and velocity belong to the centre of mass or, if markers take the place of a position
    sensor, to the origin of the body frame. The typical length is the largest distance of a
    position from the mean position. A position or velocity that no sensor shows is zero; a length
    that no sensor shows is 1.
    """
    t, when, x = np.asarray(recording.t), np.zeros(0), np.zeros((0, 3))
    positions, markers = readings_of(recording, Position), readings_of(recording, Marker)
    ranges = readings_of(recording, Range)
    speeds = [r for r in readings_of(recording, Velocity) if r.sensor.mounting is None]
    if positions:
        when, x = t[positions[0].host_mask], np.asarray(positions[0].values)[positions[0].host_mask]
    elif markers:
        when, x = _origins_by_markers(recording, markers)
    elif ranges:
        mask = np.all([r.host_mask for r in ranges], axis=0)
        stations = np.stack([np.asarray(r.sensor.station) for r in ranges])
        lengths = np.stack([np.asarray(r.values) for r in ranges], axis=1)[mask]
        when, x = t[mask], _positions_by_ranges(stations, lengths)
    if speeds and (positions or not markers):
        v = np.asarray(speeds[0].values)[speeds[0].host_mask][0]
    else:
        v = _first_velocity(when, x)
    x = x if when.size else np.zeros((1, 3))
    # The typical length is the largest distance from the mean position, or 1 if all positions are
    # the same.
    return x[0], v, float(np.linalg.norm(x - x.mean(axis=0), axis=1).max()) or 1.0


def _origins_by_markers(
    recording: Recording, markers: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (n,), s, and the positions (n, 3), m, of the origin of the body frame,
    computed from the positions of markers on the body.

    If no time has readings of all markers, only the first marker is used. If the attitude is
    unknown at any of the n times, the mean position of the markers is returned in place of the
    origin.

    - `recording`: the recording, which holds the times and the readings that show the attitudes.
    - `markers`: a sequence with the `Reading` of each marker.
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
    """Return the first velocity (3,), m/s, of a body from its positions x (n, 3), m, at the times t
    (n,), s.

    The velocity is the slope of the straight line that fits the first five positions (or all, if
    there are fewer) best. It is zero for fewer than two positions.
    """
    few = slice(0, max(2, min(5, t.size)))
    return np.polyfit(t[few] - t[0], x[few], 1)[0] if t.size > 1 else np.zeros(3)


def _positions_by_ranges(stations: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the positions x (n, 3), m, of a body from its distances to k stations.

    For each station the equation `|x|² − 2 s·x + |s|² = d²` holds, where s is the position of the
    station and d is the distance of the body from it. The mean of the equations of all stations is
    subtracted from each equation, which removes |x|² and makes the equation linear in x. If the
    stations do not determine a component of x, as with stations in one plane, the component is
    taken from the mean position of the stations.

    - `stations`: (k, 3) the positions of the stations, m.
    - `lengths`: (n, k) the distance to each station, m, at each of n times.
    """
    centre = stations.mean(axis=0)
    s = stations - centre
    sides = (s * s).sum(axis=1)[None] - lengths**2
    sides = 0.5 * (sides - sides.mean(axis=1, keepdims=True))
    return centre + np.linalg.lstsq(s, sides.T, rcond=1e-9)[0].T


def first_rates(
    records: Recording, counts: Int[Array | np.ndarray, " records"]
) -> Float[Array, "records 3"]:
    """Return the first body rate (R, 3), rad/s, that the readings of each of R recordings show.

    A rate is zero if the readings show no rate. The rates are zero for recordings without a gyro
    that JAX traces. The argument `records` holds the recordings with a leading axis, and `counts`
    (R,) the number of samples in time of each recording without padding.
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
    """Return the first body rate (3,), rad/s, that the readings of a `recording` show, or zero if
    they show no rate.
    """
    _, w = rates(recording)
    return w[0] if len(w) else np.zeros(3)
