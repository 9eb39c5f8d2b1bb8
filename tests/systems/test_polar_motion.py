"""The Earth's polar motion: a made one whose numbers are known, and the measured one."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def polar():
    spec = importlib.util.spec_from_file_location(
        "polar_motion", ROOT / "notebooks/polar_motion.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_free_pole_turns_once_in_its_period_and_decays(polar):
    v = {"period": 433.0, "damping": 0.01, "white": 1e-6, "floor": 1.0, "season": 0.1, "mean": 0.1}
    v = {name: jnp.asarray(value) for name, value in v.items()}
    model, _ = polar.model_of(v, np.ones((2, 2)), 433.0)
    wanted = np.exp(-2 * np.pi * 0.01) * np.eye(2)
    np.testing.assert_allclose(model.transition[:2, :2], wanted, atol=1e-9)
    quarter, _ = polar.model_of(v, np.ones((2, 2)), 433.0 / 4)
    moved = quarter.transition[:2, :2] @ np.array([1.0, 0.0])
    assert moved[1] > 0.98 and abs(moved[0]) < 1e-9
    year, _ = polar.model_of(v, np.ones((2, 2)), polar.YEAR / 4)
    np.testing.assert_allclose(year.transition[5, 4], 1, atol=1e-12)
    np.testing.assert_allclose(year.transition[7, 6], -1, atol=1e-12)
    # White excitation kicks the pole: 2 mas/√d for a tenth of a day, each way.
    noisy, _ = polar.model_of(v | {"white": jnp.asarray(2.0)}, np.ones((2, 2)), 0.1)
    gathered = noisy.noise[:2, :2] @ noisy.noise[:2, :2].T
    np.testing.assert_allclose(np.diagonal(gathered), 4.0 * 0.1, rtol=1e-4)


def test_the_likelihood_knows_the_period_of_a_made_pole(polar):
    v = {
        "period": 433.0,
        "damping": 0.004,
        "white": 1.0,
        "floor": 1.0,
        "season": 0.01,
        "mean": 0.1,
    }
    v = {name: jnp.asarray(value) for name, value in v.items()}
    count, step = 250, 30.0
    model, root = polar.model_of(v, np.ones((count, 2)), step)
    rng = np.random.default_rng(0)
    z, readings = np.asarray(root) @ rng.normal(size=polar.SIZE), []
    for k in range(count):
        readings.append(model.matrix @ z + model.deviation[k] * rng.normal(size=2))
        z = model.transition @ z + model.noise @ rng.normal(size=model.noise.shape[1])
    readings = jnp.asarray(np.array(readings))

    def score(period):
        there, first = polar.model_of(v | {"period": period}, np.ones((count, 2)), step)
        return polar.kalman_filter(there, readings, first).log_likelihood

    many = once(jax.vmap(score))
    periods = jnp.array([305.0, 400.0, 425.0, 429.0, 433.0, 437.0, 441.0, 470.0])
    found = np.asarray(many(periods))
    assert abs(float(periods[np.argmax(found)]) - 433) <= 8
    assert found.max() - found[0] > 50


@pytest.mark.slow
def test_the_measured_pole(polar):
    t, readings, errors = polar.read()
    v, covariance, best, value, x = polar.fit(polar.MODELS["red"], readings, errors)
    period = float(v["period"])
    assert abs(period - 432.1) < 3 * period * np.sqrt(covariance[0, 0])
    rigid = np.array(x)
    rigid[0] = np.log(305 / polar.START["period"])
    assert best + float(value(rigid)) > 20
    past = t < 46066
    v = polar.fit(polar.MODELS["red"], readings[past], errors[past])[0]
    bars = {30: 11, 90: 22, 180: 32, 365: 37}
    for days, (off, spread) in polar.forecasts(v, t, readings, errors).items():
        assert polar.rms(off) < bars[days]
        assert 0.6 <= (np.abs(off) < spread).mean() <= 0.75
    assert polar.rms(polar.harmonics(t, readings)[365]) > bars[365]
