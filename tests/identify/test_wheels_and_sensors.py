"""Sensors that feel dΩ/dt under laws with states: beside SciPy and differences of its solution."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import identify, torques

LOCKED = rj.Inertia(np.array([[3.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 2.0]]))
AXES = np.array([[1.0, 0, 0], [0, 0.6, 0.8]])
J, SPEEDS, FRICTION = np.array([0.1, 0.2]), np.array([31.0, -20.0]), 0.05
OMEGA = np.array([0.6, -0.9, 0.4])
PLACE = np.array([0.3, -0.2, 0.5])
SENSITIVITY = np.array([[0.02, 0.0, -0.01], [0.03, 0.01, 0.0], [0.0, 0.02, 0.04]])
TS, LATE, SMALL = np.linspace(0.0, 1.5, 31), 0.013, 1e-3


class Motor(eqx.Module):
    """A torque of each motor that swings, N m."""

    size: float = 1.5

    def __call__(self, t):
        return self.size * jnp.stack([jnp.sin(3.0 * t), jnp.cos(2.0 * t)])


def wheels():
    return torques.ReactionWheels(AXES, J, SPEEDS, Motor(), viscous=FRICTION)


class Tachometer(identify.AbstractSensor):
    """Reads the wheels' speeds relative to the body."""

    reading_shape, components, unit = (2,), 2, "rad/s"
    feels, noise = rj.motion.HasSpin, None
    wheels: torques.ReactionWheels

    def error(self, motion, reading):
        return reading - self.wheels.speeds_of(motion.own[0], motion.state)


def of_scipy(times):
    """Rates (T, 3) and wheels' speeds (T, 2) at times: the gyrostat's equations in relative speeds,
    with the wheels locked in the inertia, solved for both as one linear system (Hughes 1986).
    """
    inertia = np.asarray(LOCKED.tensor)
    matrix = np.block([[inertia, AXES.T * J], [J[:, None] * AXES, np.diag(J)]])

    def slope(t, y):
        w, s = y[:3], y[3:]
        u = 1.5 * np.array([np.sin(3.0 * t), np.cos(2.0 * t)]) - FRICTION * s
        momentum = inertia @ w + AXES.T @ (J * s)
        return np.linalg.solve(matrix, np.concatenate([np.cross(momentum, w), u]))

    y0 = np.concatenate([OMEGA, SPEEDS])
    rows = []
    # The equations run backwards as well: differences at the first time need what came before.
    for sign in (-1.0, 1.0):
        side = np.unique(times[sign * times > 0])[:: int(sign)]
        if side.size:
            found = solve_ivp(slope, (0.0, side[-1]), y0, "DOP853", side, rtol=1e-13, atol=1e-13)
            rows += list(zip(side, found.y.T, strict=True))
    table = dict(rows) | {0.0: y0}
    both = np.stack([table[t] for t in times])
    return both[:, :3], both[:, 3:]


@functools.cache
def readings():
    """Rates, those `LATE` later, specific force at `PLACE`, wheels' speeds, (T, …) each."""
    shifts = np.array([0.0, LATE, *(SMALL * np.array([-2, -1, 1, 2]))])
    rates, speeds = of_scipy((TS + shifts[:, None]).ravel())
    omega, late, *near = rates.reshape(6, TS.size, 3)
    change = (near[0] - 8.0 * near[1] + 8.0 * near[2] - near[3]) / (12.0 * SMALL)
    force = np.cross(change, PLACE) + np.cross(omega, np.cross(omega, PLACE))
    # What the wheels do must be felt: else the test says nothing.
    free = np.linalg.solve(LOCKED.tensor, np.cross(omega @ np.asarray(LOCKED.tensor), omega).T).T
    assert np.abs(change - free).max() > 0.5
    return omega, late, force, speeds[: TS.size]


def record(sensors, values):
    return identify.Recording(TS, *zip(sensors, values, strict=True))


@pytest.mark.parametrize("integrator", [identify.FixedSteps(4), identify.Adaptive(1e-11, 1e-13)])
def test_what_sensors_feel_of_the_motors(integrator):
    """Gyro, a gyro that feels the force and is late, accelerometer, a sensor of one's own."""
    omega, late, force, speeds = readings()
    law = wheels()
    sensors = (
        identify.Gyro(0.01),
        identify.Gyro(0.01, offset=LATE),
        identify.Gyro(0.01, g_sensitivity=SENSITIVITY, place=PLACE),
        identify.Accelerometer(0.1, place=PLACE),
        Tachometer(law),
    )
    values = (omega, late, omega + force @ SENSITIVITY.T, force, speeds)
    body = law.without_wheels(LOCKED)
    problem = identify.Model(
        record(sensors, values), identify.Known(body), torque=law, integrator=integrator
    )
    here = problem.start(omega=OMEGA)
    errors, motion = filter_once(lambda p: (problem.errors(p), problem.motion(p)))(here)
    for error, value, within in zip(errors, values, (1e-8, 1e-8, 1e-8, 1e-8, 1e-6), strict=True):
        assert np.abs(value).max() > 0.5
        np.testing.assert_allclose(error, 0, rtol=0, atol=within)
    np.testing.assert_allclose(motion.omega, omega, rtol=0, atol=1e-8)


def test_an_accelerometer_off_the_centre_finds_the_bearings_friction():
    """And where it sits: fitted to its readings and the gyro's, under motors that push."""
    omega, _, force, _ = readings()
    noise = np.random.default_rng(2).normal(size=(2, *omega.shape))
    guess = torques.ReactionWheels(AXES, J, SPEEDS, Motor(), viscous=0.02)
    sensors = (identify.Gyro(1e-3), identify.Accelerometer(0.02, place=[0.2, 0.0, 0.4]))
    values = (omega + 1e-3 * noise[0], force + 0.02 * noise[1])
    free = [
        identify.Free(lambda s: s.torque.viscous, "friction", scale=0.02),
        identify.Free(lambda s: s.sensors[1].place, "place", scale=0.1),
    ]
    body = identify.Known(guess.without_wheels(LOCKED))
    problem = identify.Model(record(sensors, values), body, torque=guess, free=free)
    found = identify.fit(problem, starts=1)
    assert found.ok
    np.testing.assert_allclose(found.values["friction"], FRICTION, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.values["place"], PLACE, rtol=0, atol=0.01)
    low, high = found.interval(0.999)["place x"]
    assert low < PLACE[0] < high
