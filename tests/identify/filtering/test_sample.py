"""Motions drawn under random torques: moments that are known, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identify.filtering import records
from once import once

import rigidjax as rj
from rigidjax import identify

MANY = 4000
# Four standard errors of a variance of so many normal numbers.
FOUR = 4 * np.sqrt(2 / MANY)


def test_white_torque_spreads_rate_and_angle_as_it_should():
    # At rest: Var Ω = S t/I², Var θ = S t³/3I², Cov = S t²/2I², whatever the steps.
    density, moments, t = 0.02, np.array([1.0, 2.0, 2.5]), 0.4
    process = rj.torques.RandomTorque(density)
    still = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    keys = jax.random.split(jax.random.key(1), MANY)
    ts = jnp.array([0.0, 0.1, t])
    drawn = jax.vmap(lambda key: records.truth(key, process, still, ts))(keys)
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
    keys = jax.random.split(jax.random.key(2), MANY)
    ts = jnp.array([0.0, 0.4, 0.8])
    spin = rj.Spin([0.0, 0.0, 0.0])
    drawn = once(jax.vmap(lambda key: records.truth(key, law, spin, ts, 4)))(keys)
    torque = np.asarray(drawn.torques[0])
    variance = density / (2 * memory)
    np.testing.assert_allclose(torque.var(axis=0) / variance, 1, atol=FOUR)
    later = (torque[:, 0] * torque[:, 2]).mean(axis=0) / variance
    np.testing.assert_allclose(later, np.exp(-0.8 / memory), atol=FOUR)
    np.testing.assert_allclose(law.deviation**2, variance)


def test_without_noise_it_is_the_motion_itself_and_simulate_sees_the_mean():
    ts = jnp.linspace(0.0, 2.0, 5)
    silent = rj.torques.RandomTorque(0.0)
    drawn = records.truth(jax.random.key(0), silent, records.START, ts, 100)
    exact = jax.vmap(rj.exact.FreeBody(records.BODY, records.START))(ts)
    np.testing.assert_allclose(drawn.states.q, exact.q, atol=1e-8)
    noisy = rj.torques.Sum(rj.torques.RandomTorque(1.0), rj.torques.CorrelatedTorque(1.0, 2.0))
    seen = rj.simulate(records.BODY, records.START, ts, noisy).ys
    np.testing.assert_allclose(seen.q, exact.q, atol=1e-7)
    assert rj.conserved(records.BODY, records.START, noisy) == {}


def test_a_known_torque_acts_beside_the_random_one():
    ts, torque = jnp.linspace(0.0, 1.0, 3), rj.torques.Damping([0.1, 0.2, 0.3])
    drawn = identify.sample(
        jax.random.key(0), records.BODY, records.START, ts,
        process=rj.torques.RandomTorque(0.0), torque=torque, substeps=50,
    )  # fmt: skip
    wanted = rj.simulate(records.BODY, records.START, ts, torque).ys
    np.testing.assert_allclose(drawn.states.omega, wanted.omega, atol=1e-8)


@pytest.mark.usefixtures("unhooked")
def test_what_is_refused():
    process, key = rj.torques.RandomTorque(1.0), jax.random.key(0)

    def sample(key=key, ts=(0.0, 1.0), process=process, torque=None):
        return identify.sample(key, records.BODY, records.START, ts, process=process, torque=torque)

    with pytest.raises(ValueError, match="ts: wanted increasing times"):
        sample(ts=[0.0, 0.0])
    with pytest.raises(TypeError, match="key: wanted one random key"):
        sample(key=0)
    with pytest.raises(TypeError, match="process: wanted a RandomTorque"):
        sample(process=None)
    with pytest.raises(TypeError, match="torque: wanted the known torque"):
        sample(torque=process)
