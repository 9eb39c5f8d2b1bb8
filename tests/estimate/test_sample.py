"""Motions drawn under random torques: moments that are known, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimate import records

import rigidjax as rj
from rigidjax import estimate

MANY = 4000
# Four standard errors of a variance of so many normal numbers.
FOUR = 4 * np.sqrt(2 / MANY)


def test_white_torque_spreads_rate_and_angle_as_it_should():
    # At rest: Var Ω = S t/I², Var θ = S t³/3I², Cov = S t²/2I², whatever the steps.
    density, moments, t = 0.02, np.array([1.0, 2.0, 2.5]), 0.4
    model = estimate.Model(records.BODY, rj.torques.RandomTorque(density))
    still = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    keys = jax.random.split(jax.random.key(1), MANY)
    ts = jnp.array([0.0, 0.1, t])
    drawn = jax.vmap(lambda key: estimate.sample(key, model, still, ts, substeps=1))(keys)
    omega = np.asarray(drawn.states.omega[:, -1])
    angle = 2 * np.asarray(drawn.states.q[:, -1, 1:])
    scale = density / moments**2
    np.testing.assert_allclose(omega.var(axis=0) / (scale * t), 1, atol=FOUR)
    np.testing.assert_allclose(angle.var(axis=0) / (scale * t**3 / 3), 1, atol=FOUR)
    both = (omega * angle).mean(axis=0) / (scale * t**2 / 2)
    np.testing.assert_allclose(both, 1, atol=1.2 * FOUR)


def test_a_torque_that_remembers_is_stationary_and_forgets():
    density, memory = 0.3, 0.5
    law = rj.torques.CorrelatedTorque(density, memory)
    model = estimate.Model(records.BODY, law)
    keys = jax.random.split(jax.random.key(2), MANY)
    ts = jnp.array([0.0, 0.4, 0.8])
    spin = rj.Spin([0.0, 0.0, 0.0])
    drawn = jax.vmap(lambda key: estimate.sample(key, model, spin, ts, substeps=4))(keys)
    torque = np.asarray(drawn.torques[0])
    variance = density / (2 * memory)
    np.testing.assert_allclose(torque.var(axis=0) / variance, 1, atol=FOUR)
    later = (torque[:, 0] * torque[:, 2]).mean(axis=0) / variance
    np.testing.assert_allclose(later, np.exp(-0.8 / memory), atol=FOUR)
    np.testing.assert_allclose(law.deviation**2, variance)


def test_without_noise_it_is_the_motion_itself_and_simulate_sees_the_mean():
    ts = jnp.linspace(0.0, 2.0, 5)
    model = estimate.Model(records.BODY, rj.torques.RandomTorque(0.0))
    drawn = estimate.sample(jax.random.key(0), model, records.START, ts, substeps=100)
    exact = jax.vmap(rj.exact.FreeBody(records.BODY, records.START))(ts)
    np.testing.assert_allclose(drawn.states.q, exact.q, atol=1e-8)
    noisy = rj.torques.Sum(rj.torques.RandomTorque(1.0), rj.torques.CorrelatedTorque(1.0, 2.0))
    seen = rj.simulate(records.BODY, records.START, ts, noisy).ys
    np.testing.assert_allclose(seen.q, exact.q, atol=1e-7)
    assert rj.conserved(records.BODY, records.START, noisy) == {}


def test_what_is_refused():
    model = estimate.Model(records.BODY)
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="ts: wanted increasing times"):
        estimate.sample(key, model, records.START, [0.0, 0.0])
    with pytest.raises(TypeError, match="key: wanted one random key"):
        estimate.sample(0, model, records.START, [0.0, 1.0])
    with pytest.raises(TypeError, match="walks: wanted"):
        estimate.Model(records.BODY, walks=[1.0])
