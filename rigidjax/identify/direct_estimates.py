"""Attitudes and rates directly from readings, without a motion between them: the start of a fit."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from rigidjax.identify.recording import Recording, readings_of
from rigidjax.identify.sensors import AttitudeSensor, Direction, Marker
from rigidjax.rotation import quaternion, so3

# The turn, rad, between two attitudes that give a rate: large against noise, small enough that the
# axis hardly moves.
_TURN = 0.3
# A turn is undetermined if two singular values of Σ world bodyᵀ are below this share of the
# largest.
_FIRM = 1e-3


def attitudes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,), s, and attitudes (n, 4), body → world, that the readings show; n may be 0.

    They come from an attitude sensor. Otherwise, at times with readings of all sensors, they are
    the rotation that best takes the markers' places and directions from the body to the world
    (`rigidjax.so3.wahba`), from at least three markers not in line, or two directions.
    """
    t = np.asarray(recording.t)
    for reading in readings_of(recording, AttitudeSensor):
        q, mounting = np.asarray(reading.values)[reading.seen], reading.sensor.mounting
        if mounting is not None:
            back = quaternion.exp(-mounting)
            q = np.asarray(jax.vmap(quaternion.multiply, (0, None))(jnp.asarray(q), back))
        return t[reading.seen], q
    body, world, seen = [], [], np.ones(t.shape, bool)
    markers = readings_of(recording, Marker)
    if len(markers) >= 3:
        places = np.stack([np.asarray(r.sensor.place) for r in markers])
        there = np.stack([np.asarray(r.values) for r in markers], axis=1)
        size = np.linalg.norm(places - places.mean(axis=0), axis=1).max() or 1.0
        body.append(np.broadcast_to((places - places.mean(axis=0)) / size, there.shape))
        world.append((there - there.mean(axis=1, keepdims=True)) / size)
        seen = seen & np.all([r.seen for r in markers], axis=0)
    for reading in readings_of(recording, Direction):
        along, sensor = np.asarray(reading.values), reading.sensor
        if sensor.mounting is not None:
            along = along @ np.asarray(so3.exp(sensor.mounting)).T
        body.append(along[:, None, :])
        world.append(np.broadcast_to(np.asarray(sensor.world), along.shape)[:, None, :])
        seen = seen & reading.seen
    if not body:
        return np.zeros(0), np.zeros((0, 4))
    rows, sides = np.concatenate(body, axis=1)[seen], np.concatenate(world, axis=1)[seen]
    b = np.einsum("tni,tnj->tij", sides, rows)
    s = np.linalg.svd(b, compute_uv=False)
    firm = s[:, 1] + np.sign(np.linalg.det(b)) * s[:, 2] > _FIRM * s[:, 0]
    if not firm.any():
        return np.zeros(0), np.zeros((0, 4))
    return t[seen][firm], np.asarray(_nearest(rows[firm], sides[firm]))


@jax.jit
def _nearest(body: ArrayLike, world: ArrayLike) -> Array:
    return jax.vmap(lambda a, b: quaternion.from_matrix(so3.wahba(a, b)))(body, world)


def rates(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,), s, and body rates (n, 3), rad/s, between attitudes; n may be 0."""
    return rates_of(*attitudes(recording))


def rates_of(t: np.ndarray, q: np.ndarray | Array) -> tuple[np.ndarray, np.ndarray]:
    """The same of attitudes (n, 4) at times (n,)."""
    if t.size < 2:
        return np.zeros(0), np.zeros((0, 3))
    turned = np.concatenate([[0.0], np.cumsum(np.linalg.norm(_turns(q[:-1], q[1:]), axis=1))])
    first = np.arange(t.size - 1)
    last = np.searchsorted(turned, turned[first] + _TURN, side="right") - 1
    last = np.clip(np.maximum(last, first + 1), 1, t.size - 1)
    gap = t[last] - t[first]
    return 0.5 * (t[first] + t[last]), np.asarray(_turns(q[first], q[last])) / gap[:, None]


@jax.jit
def _turns(p: ArrayLike, q: ArrayLike) -> Array:
    """Rotation vectors (n, 3) from p to q, body axes, the short way, whatever the signs."""

    def turn(a: Array, b: Array) -> Array:
        return quaternion.log(quaternion.multiply(quaternion.conjugate(a), b))

    return jax.vmap(turn)(jnp.asarray(p), jnp.asarray(q))
