"""Bodies drawn from a fit: possible, and of the fit's covariance."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques

T = np.linspace(0.0, 3.0, 151)
BODY = rj.Inertia([[3e-3, 1e-4, -2e-4], [1e-4, 2.5e-3, 3e-4], [-2e-4, 3e-4, 1.5e-3]])


@functools.cache
def fits():
    """A body that a known torque turns, and the same without the torque."""
    out = {}
    for chart, torque in (
        (identify.Tensor(1e-3), torques.ConstantTorque([3e-3, -2e-3, 1e-3])),
        (identify.Ratios(), None),
    ):
        motion = rj.simulate(BODY, rj.Spin([3.0, 1.0, -2.0]), T, torque=torque)
        noise = np.random.default_rng(5).normal(size=(T.size, 3))
        record = identify.Recording(T, (identify.Gyro(0.01), motion.ys.omega + 0.01 * noise))
        model = identify.Model(record, chart, torque=torque)
        out[type(chart).__name__] = identify.fit(model, starts=1, held_out=False)
    return out


@pytest.mark.parametrize("kind", ["Tensor", "Ratios"])
def test_the_covariance_of_draws_is_that_of_the_fit(kind):
    fit = fits()[kind]
    assert fit.ok
    draws = fit.bodies(jax.random.key(1), 10_000)
    assert draws.body.scale == fit.body.scale
    low, middle, high = np.asarray(draws.moments).T
    assert (low > 0).all() and (low + middle >= high).all()
    tensors = np.asarray(draws.body.tensor)[:, *np.triu_indices(3)]
    chart, x = fit.model.charts[0], np.asarray(fit.x)[: fit.model.index.bodies]
    of = lambda x: np.asarray(chart.body(jnp.asarray(x)).tensor)[np.triu_indices(3)]
    steps = 1e-5 * np.eye(x.size)
    slope = np.stack([(of(x + step) - of(x - step)) / 2e-5 for step in steps], axis=1)
    wanted = slope @ np.asarray(fit.covariance)[: x.size, : x.size] @ slope.T
    size = np.sqrt(np.diag(wanted))
    assert (abs(np.cov(tensors.T) - wanted) < 0.02 * np.outer(size, size)).all()
    np.testing.assert_allclose(tensors.mean(0), of(x), atol=0.02 * size.max())
    # The reported deviations, of logarithms of moments or of their ratios.
    logs = np.log(draws.moments)
    logs = logs - logs[:, 2:] if kind == "Ratios" else logs
    for quantity, drawn in zip(fit.quantities, logs.T, strict=False):
        if quantity.positive:
            np.testing.assert_allclose(drawn.std(), quantity.deviation / quantity.value, rtol=0.02)


def test_one_draw_is_no_mean():
    few = fits()["Tensor"].bodies(jax.random.key(1), 2)
    assert few.q.shape == (2, 4) and not np.array_equal(*np.asarray(few.moments))
    again = jax.jit(lambda key: fits()["Tensor"].bodies(key, 2))(jax.random.key(1))
    np.testing.assert_allclose(few.moments, again.moments, rtol=1e-13)


def test_what_the_readings_do_not_show_is_not_drawn():
    fit = fits()["Ratios"]
    unseen = fit.covariance.at[0, 0].set(jnp.inf)
    fit = dataclasses.replace(
        fit, uncertainty=dataclasses.replace(fit.uncertainty, covariance=unseen)
    )
    with pytest.raises(ValueError, match="the readings do not determine the whole body"):
        fit.bodies(jax.random.key(0))
    with pytest.raises(ValueError, match="count: wanted a whole number of at least 1, got 0"):
        fits()["Ratios"].bodies(jax.random.key(0), 0)
