"""Stochastic descent: what a few recordings at a time reach, and what it refuses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.search.stages import cost_of
from rigidjax.identify.search.stochastic_gradient import cost_of_recordings, with_recordings

TS = jnp.linspace(0.0, 4.0, 25)
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
SIGMA = 0.02


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(2)
    records = []
    for _ in range(24):
        omega = rng.normal(size=3)
        clean = rj.simulate(BODY, rj.Spin(omega), TS).ys.omega
        read = clean + SIGMA * rng.normal(size=clean.shape)
        records.append(identify.Recording(TS, (identify.Gyro(SIGMA), read)))
    return identify.Model(records, identify.PrincipalRatios())


NOISE = (jnp.full((24, 3), SIGMA),)


@pytest.mark.oldest
def test_few_recordings_show_the_whole_cost_without_bias(problem):
    # Every recording once in batches of one: their mean is the cost of all.
    point = problem.start(rj.Inertia.from_principal(1.2, 1.5, 1.9)) + 0.1
    of = eqx.filter_jit(cost_of_recordings)
    parts = [of(point, problem, NOISE, jnp.array([row])) for row in range(24)]
    whole = 0.5 * np.sum((np.asarray(problem.errors(point)[0]) / SIGMA) ** 2)
    np.testing.assert_allclose(np.mean(parts), whole, rtol=1e-12)


@pytest.mark.slow
def test_the_slope_is_that_of_differences(problem):
    point = problem.start(BODY) + 0.1
    rows = jnp.array([3, 7])
    slope = eqx.filter_jit(jax.grad(cost_of_recordings))(point, problem, NOISE, rows)
    of = eqx.filter_jit(cost_of_recordings)
    # Two numbers of the body, one of a recording that counts, one of a recording that does not.
    for index in (0, 1, 2 + 3 * 3, 2):
        step = jnp.zeros(point.size).at[index].set(1e-5)
        below, above = (float(of(point + s * step, problem, NOISE, rows)) for s in (-1, 1))
        np.testing.assert_allclose(slope[index], (above - below) / 2e-5, rtol=1e-6, atol=1e-7)


def test_a_batch_holds_the_recordings_it_names(problem):
    rows = jnp.array([5, 2])
    few = with_recordings(problem, rows)
    assert few.count == 2
    # Times, readings and masks of both, in the order in which they are named.
    kept, whole = (jax.tree.leaves(eqx.filter(p.records, eqx.is_array)) for p in (few, problem))
    for a, b in zip(kept, whole, strict=True):
        np.testing.assert_array_equal(a, b[rows])
    # The whole cost as both show it is the mean of what each shows alone.
    point = problem.start(BODY)
    alone = [float(cost_of_recordings(point, problem, NOISE, row[None])) for row in rows]
    assert not np.isclose(*alone, rtol=1e-3)
    both = float(cost_of_recordings(point, problem, NOISE, rows))
    np.testing.assert_allclose(both, np.mean(alone), rtol=1e-12)


@pytest.mark.slow
def test_descent_alone_comes_near_and_a_fit_ends_at_the_bottom(problem):
    how = identify.Descent(optax.adam(optax.cosine_decay_schedule(3e-2, 4000)), steps=4000, batch=6)
    blind = problem.start().at[:2].add(0.8)
    said = []
    key = jax.random.key(3)
    near = identify.descend(problem, how, initial=blind, key=key, progress=said.append)
    before, after = (cost_of(problem, x, NOISE) for x in (blind, near))
    # 1800 readings: the bottom is at 900; descent in noise of its own stays a little above.
    assert after < 1.5 * 900 < 0.01 * before
    assert said[-1].startswith("descent 4000/4000")
    start = identify.fit(problem, starts=1, initial=near, max_steps=50)
    assert start.ok
    plain = identify.fit(problem, starts=1)
    np.testing.assert_allclose(start.body.moments, plain.body.moments, rtol=1e-6)


@pytest.mark.slow
def test_where_the_cost_is_lost_the_point_before_is_kept(problem):
    how = identify.Descent(optax.sgd(1e300), steps=100, batch=2)
    start = problem.start(BODY)
    kept = identify.descend(problem, how, initial=start)
    assert np.isfinite(kept).all()


def test_mistakes_are_told(problem):
    with pytest.raises(TypeError, match="optimiser"):
        identify.Descent("adam", steps=1, batch=1)
    with pytest.raises(ValueError, match="at least 1"):
        identify.Descent(optax.sgd(1.0), steps=0, batch=1)
    with pytest.raises(ValueError, match="at most 24 recordings, got 25"):
        identify.descend(problem, identify.Descent(optax.sgd(1.0), steps=1, batch=25))
    with pytest.raises(TypeError, match="Descent"):
        identify.descend(problem, optax.sgd(1.0))


def test_too_many_numbers_for_least_squares_are_named():
    class Wide(eqx.Module):
        weights: jax.Array
        feels = rj.motion.HasSpin

        def __call__(self, t, state, body):
            return 1e-3 * jnp.sum(self.weights, axis=0)

    record = identify.Recording(np.arange(4.0), (identify.Gyro(0.1), np.ones((4, 3))))
    free = [identify.Free(lambda s: s.torque.weights, "weights")]
    law = Wide(jnp.zeros((400, 3)))
    wide = identify.Model(record, identify.Known(BODY), torque=law, free=free)
    with pytest.raises(ValueError, match=r"1200 parameters .* Use identify\.descend"):
        identify.fit(wide)
