"""Sensors of position, velocity and distance."""

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.data.reference_states import references

Q = np.array([0.8, 0.4, -0.4, 0.2])
BODY = rj.MassProperties(2.0, [0.1, -0.2, 0.3], np.diag([0.2, 0.3, 0.4]))
STATE = rj.Rigid([1.0, 2.0, -0.5], [0.3, 0.1, -0.2], Q, [0.7, 0.1, -0.4])
PLACE = np.array([0.5, 0.1, -0.2])
HERE = identify.SensorInput(jnp.asarray(0.0), STATE, BODY, lambda t, y, args: y)


def test_errors_against_points_moved_by_hand():
    matrix = np.asarray(rj.quaternion.to_matrix(Q))
    x, v, w = (np.asarray(a) for a in (STATE.x, STATE.v, STATE.omega))
    arm = PLACE - np.asarray(BODY.com)
    bias = np.array([0.1, 0.2, -0.3])
    for sensor, wanted in (
        (identify.Position(), x),
        (identify.Position(bias=bias), x + bias),
        (identify.Velocity(), v),
        (identify.Velocity(place=PLACE), v + matrix @ np.cross(w, arm)),
        (identify.Velocity(mounting=np.zeros(3), bias=bias), matrix.T @ v + bias),
        (
            identify.Velocity(place=PLACE, mounting=[0.1, 0.2, -0.1]),
            np.asarray(rj.so3.exp(jnp.array([0.1, 0.2, -0.1]))).T
            @ matrix.T
            @ (v + matrix @ np.cross(w, arm)),
        ),
        (identify.Range([3.0, 0.0, 1.0]), np.linalg.norm(x - [3.0, 0.0, 1.0])),
        (
            identify.Range([3.0, 0.0, 1.0], place=PLACE, bias=0.25),
            np.linalg.norm(x + matrix @ arm - [3.0, 0.0, 1.0]) + 0.25,
        ),
    ):
        found = sensor.error(HERE, jnp.asarray(wanted))
        assert found.shape == (sensor.components,)
        np.testing.assert_allclose(found, 0.0, rtol=0, atol=1e-15)


STATIONS = np.array([[0.0, 0, 0], [10.0, 0, 0], [0.0, 12, 0], [0.0, 0, 9], [5.0, 5, -4]])
TS = np.linspace(0.0, 1.2, 40)
LAW = rj.torques.UniformGravity([0.0, 0.0, -9.81])
THROWN = rj.Rigid([1.0, 2.0, 1.5], [3.0, 0.5, 4.0], [1.0, 0, 0, 0], [2.0, 6.0, 1.0])


def flight():
    """A thrown body falls on a parabola, whatever it does else."""
    x = np.asarray(THROWN.x) + TS[:, None] * np.asarray(THROWN.v)
    return x - 0.5 * np.array([0, 0, 9.81]) * TS[:, None] ** 2


def ranges(sigma=0.0):
    rng = np.random.default_rng(3)
    lengths = np.linalg.norm(flight()[:, None] - STATIONS, axis=2)
    return [
        (identify.Range(s, sigma or None), length + sigma * rng.normal(size=TS.size))
        for s, length in zip(STATIONS, lengths.T, strict=True)
    ]


def test_a_fit_starts_where_the_readings_are():
    by_range = references([identify.Recording(TS, *ranges())], rj.Rigid)
    np.testing.assert_allclose(by_range.state.x[0], THROWN.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(by_range.state.v[0], THROWN.v, rtol=0, atol=0.7)
    x = flight()
    v = np.gradient(x, TS, axis=0)
    both = identify.Recording(TS, (identify.Position(), x), (identify.Velocity(), v))
    reference = references([both], rj.Rigid)
    np.testing.assert_allclose(reference.state.x[0], THROWN.x, rtol=0, atol=1e-14)
    np.testing.assert_allclose(reference.state.v[0], v[0], rtol=0, atol=1e-14)
    # Three stations in a plane show where in it, and leave the height to their own.
    flat = references([identify.Recording(TS, *ranges()[:3])], rj.Rigid)
    np.testing.assert_allclose(flat.state.x[0], [1.0, 2.0, 0.0], rtol=0, atol=1e-12)


def test_a_throw_is_found_by_distances():
    """Five stations and a gyro: first place and velocity come back within their deviations."""
    states = rj.simulate(BODY, THROWN, TS, LAW).ys
    rng = np.random.default_rng(5)
    rates = np.asarray(states.omega) + 0.01 * rng.normal(size=(40, 3))
    record = identify.Recording(TS, *ranges(0.01), (identify.Gyro(0.01), rates))
    found = identify.fit(identify.Model(record, identify.Known(BODY), torque=LAW), starts=1)
    np.testing.assert_allclose(found.state0.x, THROWN.x, rtol=0, atol=0.02)
    np.testing.assert_allclose(found.state0.v, THROWN.v, rtol=0, atol=0.05)
    np.testing.assert_allclose(found.chi2 / found.dof, 1.0, atol=4 * np.sqrt(2 / found.dof))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: identify.Range([0.0, 0.0]), r"station: wanted shape \(3,\)"),
        (lambda: identify.Range([0.0, 0.0, 0.0], noise=0.0), "noise: wanted a positive"),
        (lambda: identify.Recording(TS, (identify.Range([0.0, 0, 0]), -np.ones(40))), "the distance at index 0 is below zero"),
        (lambda: identify.Recording(TS, (identify.Range([0.0, 0, 0]), np.ones((40, 1)))), r"wanted readings of shape \(40,\)"),
        (lambda: identify.Velocity(place=[1.0]), r"place: wanted shape \(3,\)"),
        (lambda: identify.Position(noise=-1.0), "noise: wanted a positive"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
