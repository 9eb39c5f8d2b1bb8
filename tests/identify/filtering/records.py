"""Motions under random torques, and what sensors read of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import turns

import rigidjax as rj
from rigidjax import identify

BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
START = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, 1.0, 0.2])
SUN = np.array([0.0, 0.6, 0.8])


def truth(key, process, state0, ts, substeps=1, body=BODY):
    return identify.sample(key, body, state0, ts, process=process, substeps=substeps)


def gyro(key, omega, noise):
    return omega + noise * jax.random.normal(key, omega.shape, omega.dtype)


def direction(key, q, world, noise):
    """A unit vector near to where `world` is, each (T, 3)."""
    seen = turns.to_body(q, jnp.asarray(world, q.dtype))
    seen = seen + noise * jax.random.normal(key, seen.shape, q.dtype)
    return seen / jnp.linalg.norm(seen, axis=-1, keepdims=True)


@functools.cache
def tumble(count=200, density=1e-4, seed=0):
    """A body that tumbles under white torque, with a gyro and a direction; and the truth."""
    process = rj.torques.RandomTorque(density)
    keys = jax.random.split(jax.random.key(seed), 3)
    ts = 0.02 * jnp.arange(count, dtype=float)
    real = truth(keys[0], process, START, ts)
    record = identify.Recording(
        ts,
        (identify.Gyro(0.02), gyro(keys[1], real.states.omega, 0.02)),
        (identify.Direction(SUN, 0.05), direction(keys[2], real.states.q, SUN, 0.05)),
    )
    return known(record, process), real


def known(record, process=None, **options):
    """The model of a body that is known."""
    return identify.Model(record, identify.Known(BODY), process=process, **options)


@functools.cache
def spinning(count=20):
    """A gyro alone on a body that nothing turns much: the smallest program."""
    record = tumble()[0].recording
    reading = record.readings[0]
    return identify.Recording(record.t[:count], (reading.sensor, reading.values[:count]))
