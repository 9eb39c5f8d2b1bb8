"""Find a reference state of each recording from its first readings.

The parameters of an initial state are changes of this reference state.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

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
from rigidjax.identify.sensors.base import extras
from rigidjax.motion import Attitude, Rigid, Spin, Turn
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


class Samples(NamedTuple):
    """Hold a quantity that readings show at some times."""

    # In s.
    t: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n k"]


def attitudes(recording: Recording) -> Samples:
    """Return the attitudes (quaternions body → world) that the readings show, if any.

    They are the readings of an attitude sensor, or computed from at least three markers or two
    directions in the way of `rigidjax.so3.wahba`.
    """
    t = np.asarray(recording.t)
    for reading in readings_of(recording, AttitudeSensor):
        q, mounting = np.asarray(reading.values)[reading.host_mask], reading.sensor.mounting
        if mounting is not None:
            back = quaternion.exp(-mounting)
            q = np.asarray(jax.vmap(quaternion.multiply, (0, None))(jnp.asarray(q), back))
        return Samples(t[reading.host_mask], q)
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
    none = Samples(np.zeros(0), np.zeros((0, 4)))
    if not body:
        return none
    rows, sides = np.concatenate(body, axis=1)[mask], np.concatenate(world, axis=1)[mask]
    b = np.einsum("tni,tnj->tij", sides, rows)
    s = np.linalg.svd(b, compute_uv=False)
    known = s[:, 1] + np.sign(np.linalg.det(b)) * s[:, 2] > _DETERMINED * s[:, 0]
    return Samples(t[mask][known], np.asarray(_wahba(b[known]))) if known.any() else none


@jax.jit
def _wahba(sums: Float[ArrayLike, "n 3 3"]) -> Float[Array, "n 4"]:
    """Return the attitudes that solve Wahba's problem for each sum Σ w bᵀ over directions w in the
    world and b in the body.

    It is `so3.wahba` without its check: a `Model` calls it within `jax.ensure_compile_time_eval`,
    where `equinox.error_if` in a compiled function always raises an error.
    """
    return jax.vmap(lambda one: quaternion.from_matrix(nearest_rotation(one)))(sums)


def rates(recording: Recording) -> Samples:
    """Return the body rates, rad/s, that a gyro reads or that the attitudes show, if any."""
    for reading in readings_of(recording, Gyro):
        mask = reading.host_mask
        return Samples(np.asarray(recording.t)[mask], np.asarray(reading.values)[mask])
    return mean_rates(*attitudes(recording))


def require_turning(rates: np.ndarray, name: str) -> None:
    """Raise `ValueError` if the body `rates`, rad/s, are all zero or round-off."""
    if rates.size and np.abs(rates).max() < 1e-14:
        raise ValueError(
            f"{name} are all zero: a body at rest shows nothing of its inertia, or the sensor was "
            "off; take other columns, or another part of the recording"
        )


def swing_axis(rates: np.ndarray) -> Float[np.ndarray, " 3"] | None:
    """Return the axis of body `rates` that go there and back about it, as those of a free body
    never do, or `None`.
    """
    if len(rates) < 10:
        return None
    axis = np.linalg.eigh(rates.T @ rates)[1][:, -1]
    along = rates @ axis
    across = np.linalg.norm(rates - along[:, None] * axis, axis=1)
    size = np.sqrt(np.mean(along**2))
    turning = np.abs(along) < 0.2 * size
    still = (
        turning.any() and max(np.mean(across[turning] ** 2), np.mean(across**2)) < 0.04 * size**2
    )
    there_and_back = along.min() < -0.3 * size and along.max() > 0.3 * size
    return axis * np.sign(axis[np.argmax(np.abs(axis))]) if there_and_back and still else None


def require_no_swing(rates: np.ndarray, name: str) -> None:
    """Raise `ValueError` if the body `rates`, rad/s, are those of a swing."""
    if (axis := swing_axis(rates)) is not None:
        raise ValueError(
            f"{name} are those of a swing, there and back about one axis, "
            f"[{', '.join(f'{part:.3g}' for part in axis)}]: no free body turns so, and all that "
            "they show is the moment about this axis, if what brings the body back is known. Say "
            "what it is: Model(recording, Moment(guess, law), torque=law) with an Axle, TorsionBar "
            "or Strings of rigidjax.suspensions as the law; or run python -m rigidjax swing --log"
        )


def mean_rates(t: Float[np.ndarray, " n"], q: Float[np.ndarray | Array, "n 4"]) -> Samples:
    """Return the mean body rates, rad/s, between attitudes that differ by a turn of about 0.3 rad.

    The time of a mean rate is the middle between those of its attitudes.
    """
    if t.size < 2:
        return Samples(np.zeros(0), np.zeros((0, 3)))
    steps = np.linalg.norm(_turns(q[:-1], q[1:]), axis=1)
    turned = np.concatenate([[0.0], np.cumsum(steps)])
    first = np.arange(t.size - 1)
    last = np.searchsorted(turned, turned[first] + _TURN, side="right") - 1
    last = np.clip(np.maximum(last, first + 1), 1, t.size - 1)
    gap = t[last] - t[first]
    turns = np.asarray(_turns(q[first], q[last]))
    return Samples(0.5 * (t[first] + t[last]), turns / gap[:, None])


@jax.jit
def _turns(first: Float[ArrayLike, "n 4"], last: Float[ArrayLike, "n 4"]) -> Float[Array, "n 3"]:
    """Return the rotation vectors, rad, body axes, of the shortest turns between attitudes."""

    def turn(a: Array, b: Array) -> Array:
        return quaternion.log(quaternion.multiply(quaternion.conjugate(a), b))

    return jax.vmap(turn)(jnp.asarray(first), jnp.asarray(last))


class ReferenceStates(eqx.Module):
    """Hold the reference state of each recording: its initial state is a change of this state."""

    # A `Spin`, `Attitude`, `Rigid` or `Turn`.
    state: PyTree
    # The typical body rate, rad/s.
    rate: Float[Array, "*records"]
    # The change of the state for each parameter of the initial state that is one.
    units: Float[Array, "*records n"]

    def initial(self, change: Float[Array, " n"]) -> PyTree:
        """Return the initial state at its parameters, which are empty if it is known."""
        return plus(self.state, self.units * change) if change.size else self.state


def references(recordings: Sequence[Recording], state_type: type) -> ReferenceStates:
    """Return a reference state for each recording, at the rate zero, from its first readings."""
    turns = [[*attitudes(r).values, np.array([1.0, 0.0, 0.0, 0.0])][0] for r in recordings]
    places = [_first_motion(r) for r in recordings]
    dtype = recordings[0].t.dtype
    # Use arrays: with Python floats a program would be compiled for each recording.
    x, v, length = (jnp.asarray(np.stack(part), dtype) for part in zip(*places, strict=True))
    q, still = jnp.asarray(np.stack(turns), dtype), jnp.zeros_like(x)
    typical = jnp.asarray([_typical_rate(r) for r in recordings], dtype)
    zero, one = jnp.zeros_like(typical), jnp.ones_like(typical)
    if state_type is Turn:
        return ReferenceStates(Turn(zero, zero), typical, jnp.stack([one, typical], -1))
    states = {Spin: Spin(still), Attitude: Attitude(q, still), Rigid: Rigid(x, v, q, still)}
    sizes = {"x": length, "v": length * typical, "q": one, "omega": typical}
    state = states[state_type]
    units = [sizes[name] for name in leaf_names(state)]
    return ReferenceStates(state, typical, jnp.repeat(jnp.stack(units, -1), 3, -1))


def _typical_rate(recording: Recording) -> float:
    """Return the typical size of the body rate, rad/s, or 1 if the readings show no rate.

    It is the root mean square of the readings of a gyro, else the size of the first mean rate
    between attitudes, else the estimate of the first sensor that has a method `typical_rate`.
    """
    _, w = rates(recording)
    if readings_of(recording, Gyro):
        return float(np.sqrt(np.mean(np.sum(w**2, axis=1)))) or 1.0
    rate = float(np.linalg.norm(w[0])) if len(w) else 0.0
    # If there is no rate, take the estimate of the first sensor that can estimate a typical rate.
    for reading in recording.readings if rate == 0 else ():
        estimate = extras(reading.sensor).typical_rate
        if estimate is not None:
            t, values = np.asarray(recording.t), np.asarray(reading.values)
            rate = estimate(t[reading.host_mask], values[reading.host_mask])
            break
    return rate if rate > 0 else 1.0


class _Motion(NamedTuple):
    """Hold the first motion of the centre of mass, or with markers of the body frame's origin.

    A vector that no sensor shows is zero; the length is then 1.
    """

    # In m, and m/s.
    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    # The largest distance of a position from the mean position, m.
    length: float


def _first_motion(recording: Recording) -> _Motion:
    """Return the first position and velocity that the readings show, and a typical length."""
    t, when, x = np.asarray(recording.t), np.zeros(0), np.zeros((0, 3))
    positions, markers = readings_of(recording, Position), readings_of(recording, Marker)
    ranges = readings_of(recording, Range)
    speeds = [r for r in readings_of(recording, Velocity) if r.sensor.mounting is None]
    if positions:
        when, x = t[positions[0].host_mask], np.asarray(positions[0].values)[positions[0].host_mask]
    elif markers:
        when, x = _origins(recording, markers)
    elif ranges:
        mask = np.all([r.host_mask for r in ranges], axis=0)
        stations = np.stack([np.asarray(r.sensor.station) for r in ranges])
        lengths = np.stack([np.asarray(r.values) for r in ranges], axis=1)[mask]
        # For each station s the distance d obeys |x|² − 2 s·x + |s|² = d². If the mean over the
        # stations is subtracted, |x|² cancels, and the equation is linear in x. A component of x
        # that the stations do not determine, as in one plane, is taken from their mean position.
        centre = stations.mean(axis=0)
        s = stations - centre
        sides = (s * s).sum(axis=1)[None] - lengths**2
        sides = 0.5 * (sides - sides.mean(axis=1, keepdims=True))
        when, x = t[mask], centre + np.linalg.lstsq(s, sides.T, rcond=1e-9)[0].T
    if speeds and (positions or not markers):
        v = np.asarray(speeds[0].values)[speeds[0].host_mask][0]
    else:
        # The velocity is the slope of a straight line through the first five positions.
        few = slice(0, max(2, min(5, when.size)))
        v = np.polyfit(when[few] - when[0], x[few], 1)[0] if when.size > 1 else np.zeros(3)
    x = x if when.size else np.zeros((1, 3))
    # The typical length is the largest distance from the mean position, or 1 if all positions are
    # the same.
    length = float(np.linalg.norm(x - x.mean(axis=0), axis=1).max()) or 1.0
    return _Motion(x[0], v, length)


def _origins(recording: Recording, markers: Sequence[Any]) -> Samples:
    """Return the positions, m, of the origin of the body frame, from those of markers on the body.

    If no time has readings of all markers, only the first one is used. If the attitude is unknown
    at any of the times, the mean of the markers takes the place of the origin.
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
    return Samples(t, x)


def first_rates(
    records: Recording, counts: Int[Array | np.ndarray, " records"]
) -> Float[Array, "records 3"]:
    """Return the first body rate, rad/s, that each recording shows, or zero.

    They are zero for traced recordings without a gyro. `counts` is as for `stacking.on_host`.
    """
    for reading in readings_of(records, Gyro):
        xp: Any = np if _checks.is_known(reading) else jnp
        first = xp.argmax(xp.asarray(reading.mask), axis=1)[:, None, None]
        return jnp.asarray(xp.take_along_axis(xp.asarray(reading.values), first, axis=1)[:, 0])
    if not _checks.is_known(records):
        return jnp.zeros((len(counts), 3), records.t.dtype)
    each = [rates(recording).values for recording in stacking.on_host(records, counts)]
    first = np.stack([w[0] if len(w) else np.zeros(3) for w in each])
    return jnp.asarray(first, records.t.dtype)
