"""Rotors on a body without a position: their torques, their momentum, speeds and commands."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import torques

BODY = rj.Inertia(np.array([[2.1e-3, 1e-4, -5e-5], [1e-4, 2.6e-3, 8e-5], [-5e-5, 8e-5, 3.9e-3]]))
PLACES = np.array([[0.08, -0.1, 0.01], [-0.08, -0.1, 0.0], [-0.08, 0.1, 0.01], [0.08, 0.1, 0.0]])
AXES = np.array([[0.0, 0, 1], [0.0, 0.6, 0.8], [0.0, 0, 1], [0.6, 0, 0.8]])
SPINS = np.array([1.0, -1, 1, -1])
K, C, J = np.array([1.4, 1.5, 1.6, 1.5]) * 1e-6, 2.2e-8, np.array([9.0, 8, 7, 9]) * 1e-6
CRAFT = rj.MassProperties(0.6, np.zeros(3), BODY.second_moment)
START, END, LAG = np.array([3.0, -4.0, 5.0]), 0.3, np.array([0.03, 0.04, 0.05, 0.03])


class Swung(eqx.Module):
    """Speeds that swing: 500 + 300 sin(20 t + φ) rad/s."""

    phases: jax.Array

    def __call__(self, t):
        return 500.0 + 300.0 * jnp.sin(20.0 * t + self.phases)


PHASES = np.array([0.0, 1.0, 2.5, 4.0])


def by_scipy(speeds_and_slopes, own=()):
    """The rate at END, and further states, by Hughes' equations of a gyrostat in NumPy."""
    inertia, thrusts = np.asarray(BODY.tensor), np.cross(PLACES, AXES)

    def slope(t, y):
        n, rate = speeds_and_slopes(t, y[3:])
        momentum = inertia @ y[:3] + AXES.T @ (SPINS * J * n)
        torque = thrusts.T @ (K * n**2) - AXES.T @ (SPINS * (C * n**2 + J * rate))
        turned = np.linalg.solve(inertia, torque - np.cross(y[:3], momentum))
        return np.concatenate([turned, rate[: len(own)]])

    start = np.concatenate([START, own])
    return solve_ivp(slope, (0.0, END), start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def rotors(speeds, **change):
    given = dict(thrust=K, drag=C, inertia=J) | change
    return torques.Rotors(PLACES, AXES, SPINS, speeds=speeds, **given)


def simulated(law, state=None):
    state = rj.Spin(START) if state is None else state
    return rj.simulate(
        CRAFT if hasattr(state, "x") else BODY, state, [0.0, END], law, rtol=1e-11, atol=1e-11
    )


def test_thrust_drag_and_momentum_as_scipy_has_them_on_each_state():
    wanted = by_scipy(
        lambda t, _: (
            500 + 300 * np.sin(20 * t + PHASES),
            6000 * np.cos(20 * t + PHASES),
        )
    )
    law, q = rotors(Swung(jnp.asarray(PHASES))), np.array([1.0, 0, 0, 0])
    for state in (None, rj.Attitude(q, START), rj.Rigid(np.zeros(3), np.zeros(3), q, START)):
        found = simulated(law, state).ys.omega[-1]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8)


def test_commands_with_a_lag_as_scipy_has_them():
    """The lagged speeds act with their derivative, although no log has it; a lag of a lag, too."""
    wanted, first = np.array([900.0, 200, 700, 400]), np.full(4, 300.0)
    numbers = by_scipy(lambda t, n: (n, (wanted - n) / LAG), first)
    step = torques.Held(np.linspace(-1.0, 5.0, 200), np.tile(wanted, (200, 1)))
    sol = simulated(rotors(torques.Lagged(step, LAG, first)))
    np.testing.assert_allclose(sol.ys.omega[-1], numbers[:3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(sol.own[0][-1], numbers[3:], rtol=1e-9)
    # Samples that are held, by fixed steps.
    law = rotors(torques.Lagged(torques.Input("u"), LAG, first))
    many, samples = rj.Spin(START[None]), np.broadcast_to(wanted, (1, 600, 4))
    end = rj.batch.rollout(BODY, many, END / 600, 600, law, inputs={"u": samples})
    np.testing.assert_allclose(end.motion.omega[0], numbers[:3], rtol=0, atol=1e-8)


def test_a_rotor_on_its_axis_in_closed_form_with_derivatives_of_both_modes():
    """I ΔΩ = −s (c ∫n² dt + J Δn), of speeds that rise as u (1 − exp(−t/T))."""
    moment, c, j, lag, u = 3.9e-3, 2e-8, 8e-6, 0.04, 800.0

    def closed(c, j, lag):
        fade = np.exp(-END / lag)
        square = END - 2 * lag * (1 - fade) + 0.5 * lag * (1 - fade**2)
        return (c * u**2 * square + j * u * (1 - fade)) / moment

    def turned(c, j, lag):
        speed = torques.Lagged(lambda t: jnp.asarray([u]), lag, jnp.zeros(1))
        law = torques.Rotors(np.zeros((1, 3)), [[0.0, 0, 1]], [-1.0], 1e-6, c, speed, j)
        body = rj.Inertia.from_principal(2e-3, 3e-3, moment)
        end = rj.simulate(body, rj.Spin([0.0, 0, 0]), [0.0, END], law, rtol=1e-11, atol=1e-13)
        return end.ys.omega[-1, 2]

    @jax.jit
    def all_of_it(*numbers):
        backwards = jax.grad(turned, (0, 1, 2))(*numbers)
        return turned(*numbers), backwards, jax.jacfwd(turned, (0, 1, 2))(*numbers)

    numbers = np.array([c, j, lag])
    value, backwards, forwards = all_of_it(*numbers)
    np.testing.assert_allclose(value, closed(*numbers), rtol=1e-9)
    steps = 1e-5 * np.diag(numbers)
    wanted = [(closed(*(numbers + s)) - closed(*(numbers - s))) / (2 * s.sum()) for s in steps]
    np.testing.assert_allclose(forwards, wanted, rtol=1e-7)
    np.testing.assert_allclose(backwards, wanted, rtol=1e-7)


def test_rotors_without_lift_are_flywheels():
    """A flywheel of logged speed (the device of Delft) is a rotor without thrust and drag."""
    t = np.linspace(0.0, END, 31)
    speed = torques.Series(t, 300 * t / END + np.cos(9 * t))
    wheel = torques.Wheel(7e-6, AXES[1], speed, delay=2e-3)
    state = rj.Spin(START)
    early = torques.Delayed(torques.Series(t, speed.values[:, None]), -2e-3)
    one = torques.Rotors(np.zeros((1, 3)), AXES[1:2], [1.0], 0.0, 0.0, early, 7e-6)
    for when in (0.0, 0.013, 0.2):
        np.testing.assert_allclose(
            one(when, state, BODY), torques.Flywheel(wheel)(when, state, BODY), rtol=1e-12
        )


def test_speeds_that_jump_have_no_derivative():
    held = torques.Held([0.0, 1.0], np.ones((2, 4)))
    with pytest.raises(TypeError, match=r"speeds: wanted a function of time without jumps.*Held"):
        rotors(held)
    rotors(held, inertia=None)
    law = torques.bind(rotors(torques.Input("n")), {"n": jnp.ones(4)})
    with pytest.raises(TypeError, match="an Input with held samples"):
        law(0.0, rj.Spin(START), BODY)
    with pytest.raises(ValueError, match=r"inertia: wanted shape \(4,\)"):
        rotors(np.ones(4), inertia=np.ones(3))


def test_no_momentum_is_conserved_under_a_thrust():
    state = rj.Rigid(np.zeros(3), np.ones(3), np.array([1.0, 0, 0, 0]), START)
    assert rj.conserved(CRAFT, state, rotors(np.full(4, 500.0))) == {}
