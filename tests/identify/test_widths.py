"""Widths of deviations that are estimated: against the balanced one-way model in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

TIMES = jnp.linspace(0.0, 1.0, 20)


def spread_of(random, width, count=8, noise=0.02):
    """What the deviations of a gyro's bias are found to be, and what the closed form says.

    The body is a sphere and its attitude is read nearly without error: the mean of a recording's
    rates, less the turn, is its bias with an error of noise/√20 in each channel.
    """
    sphere, starts = rj.Inertia.from_principal(1.0, 1.0, 1.0), random.normal(size=(count, 3))
    bias = np.array([0.1, 0.0, -0.1]) + width * random.normal(size=(count, 3))
    records, means = [], []
    for omega, own in zip(starts, bias, strict=True):
        states = rj.simulate(sphere, rj.Attitude([1.0, 0, 0, 0], omega), TIMES).ys
        error = noise * random.normal(size=(20, 3))
        gyro = identify.Gyro(noise, bias=[0.0, 0, 0])
        rates = np.asarray(states.omega) + own + error
        records.append(
            identify.Recording(TIMES, (identify.AttitudeSensor(1e-4), states.q), (gyro, rates))
        )
        means.append(own + error.mean(axis=0))
    move = identify.Free(lambda s: s.sensors[1].bias, "bias", scale=0.1, spread="estimated")
    chart = identify.Known(sphere)
    found = identify.fit(identify.Model(records, chart, free=[move]), starts=1)
    means = np.stack(means)
    between = np.sum((means - means.mean(axis=0)) ** 2) / (3 * (count - 1))
    return found, np.sqrt(max(between - noise**2 / 20, 0.0))


def test_the_width_is_that_of_the_one_way_model():
    found, wanted = spread_of(np.random.default_rng(0), 0.05)
    np.testing.assert_allclose(found.spreads["bias"], wanted, rtol=0.01)
    assert found.values["bias, own"].shape == (8, 3)
    none, wanted = spread_of(np.random.default_rng(2), 0.0)
    # Deviations within what the noise makes of them: no width, or one far below noise/√20.
    assert none.spreads["bias"] < max(1.1 * wanted, 0.5 * 0.02 / 20**0.5)


def test_a_given_spread_stays_and_mistakes_are_named():
    rates = jnp.ones((20, 3))
    records = [identify.Recording(TIMES, (identify.Gyro(0.1, bias=[0, 0, 0]), rates))] * 3
    bias = lambda s: s.sensors[0].bias
    given = identify.Free(bias, "bias", spread=0.3)
    problem = identify.Model(records, identify.PrincipalRatios(), free=[given])
    assert not problem.slots[0].estimated
    estimated = identify.Free(bias, "bias", spread="estimated")
    with pytest.raises(
        ValueError, match="wanted three recordings or more to estimate a spread, got 2"
    ):
        identify.Model(records[:2], identify.PrincipalRatios(), free=[estimated])
    for wrong in ("guessed", -1.0):
        with pytest.raises((TypeError, ValueError), match="Free 'bias': spread: wanted"):
            identify.Free(bias, "bias", spread=wrong)
