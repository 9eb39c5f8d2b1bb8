"""What the search does where the motion is lost: it goes back, and says where it stands."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from once import filter_once

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.model.model import all_errors
from rigidjax.identify.model.normal import NormalMatrix
from rigidjax.identify.search import least_squares, stages
from rigidjax.identify.search.least_squares import LMState, Settings
from rigidjax.identify.search.stages import (
    Attempt,
    Task,
    first_weights,
    fit_in_stages,
    marquardt,
    search_whole,
    whole_weights,
)

TS = np.linspace(0.0, 1.0, 8)


@pytest.fixture
def problem():
    record = identify.Recording(TS, (identify.Gyro(0.1), np.ones((8, 3))))
    return identify.Model(record, identify.PrincipalRatios())


def at(problem, value):
    return problem.start().at[0].set(value)


def an_end(point, cost, converged):
    """A search that began at a cost of one, and keeps nothing of where it ended."""
    one, line, no = jnp.asarray(1.0), jnp.zeros(5), jnp.asarray(False)
    return LMState(
        one, point, jnp.asarray(cost), NormalMatrix(jnp.zeros((5, 5))), line, line, one, one, one,
        jnp.asarray(1), no, jnp.asarray(converged), (), no, one,
    )  # fmt: skip


def place(x):
    return float(x[0])


def test_a_stride_that_is_lost_leaves_where_it_began_and_its_misfit(problem, monkeypatch):
    def lost(model, x, *_):
        return an_end(x, np.inf, False)

    monkeypatch.setattr(stages, "marquardt", lost)
    monkeypatch.setattr(stages, "cost_of", lambda *_: 7.0)
    seen = []
    out = search_whole(Attempt(at(problem, 2.0)), Task(problem, (), 1e-4, 100), watch=seen.append)
    assert place(out.x) == 2.0 and float(out.cost) == 7.0
    # No other stride follows.
    assert not bool(out.converged) and len(seen) == 1 and seen[0] is out


@pytest.mark.parametrize(("beyond", "kept"), [(np.nan, 0.0), (np.inf, 0.0), (1e4, 0.0), (2.0, 1.0)])
def test_a_part_is_not_fitted_at_the_cost_of_the_whole(problem, monkeypatch, beyond, kept):
    # Each search of a part goes from 0 to 1, where the whole has the misfit `beyond`.
    begun = []

    def step(model, x, noise, weights, *_):
        begun.append((place(x), float(weights.mean())))
        # Far above what explains 24 readings.
        return an_end(at(model, 1.0), 1e3, True)

    monkeypatch.setattr(stages, "marquardt", step)
    monkeypatch.setattr(stages, "cost_of", lambda _, x, *rest: 1.0 if place(x) == 0.0 else beyond)
    fit_in_stages(at(problem, 0.0), Task(problem, (), 1e-4, 25))
    assert [shown for _, shown in begun] == [1.0, 0.25, 0.5, 1.0]
    assert [start for start, _ in begun] == [0.0, 0.0, kept, kept]


def test_what_explains_the_whole_record_at_once_is_not_fitted_in_parts(problem, monkeypatch):
    begun = []

    def step(model, x, noise, weights, *_):
        begun.append(float(weights.mean()))
        return an_end(at(model, 1.0), 12.0, True)

    monkeypatch.setattr(stages, "marquardt", step)
    out = fit_in_stages(at(problem, 0.0), Task(problem, (), 1e-4, 25))
    assert begun == [1.0] and place(out.x) == 1.0 and bool(out.converged)


class Blast(rj.torques.AbstractTorque):
    """None at first; after a time it is not finite."""

    feels: ClassVar[type] = rj.motion.HasSpin
    since: Array

    def __call__(self, t, state, body):
        return jnp.where(t > self.since, jnp.nan, 0.0) * state.omega


@pytest.fixture(scope="module")
def pushed():
    ts = np.linspace(0.0, 4.0, 41)
    body, law = rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.Damping(0.05 * np.ones(3))
    read = np.asarray(rj.simulate(body, rj.Spin([1.0, 0.2, 1.0]), ts, law).ys.omega)
    read = read + 0.01 * np.random.default_rng(0).normal(size=read.shape)

    def problem(lost_after):
        torque = rj.torques.Sum(law, Blast(jnp.asarray(lost_after)))
        record = identify.Recording(ts, (identify.Gyro(0.01), read))
        chart, steps = identify.Principal(1.5), identify.FixedSteps(2)
        return identify.Model(record, chart, torque=torque, integrator=steps)

    return problem


@filter_once
def searched(problem, weights, settings):
    noise = (jnp.full((1, 3), 0.01),)
    start = problem.start(rj.Inertia.from_principal(1.3, 1.9, 2.5))
    return marquardt(problem, start, noise, weights, settings)


def test_a_part_of_the_record_is_followed_no_further_than_that(pushed):
    of = pushed(9.0)
    part, all_of_it = first_weights(of, 0.25), whole_weights(of)
    once = Settings(1e-4, 1.0, 0)
    # Beyond the part nothing is computed: what is not finite there does no harm.
    lost = pushed(1.5)
    here, there = searched(of, part, once), searched(lost, part, once)
    assert np.isfinite(float(here.cost))
    assert not np.isfinite(float(searched(lost, all_of_it, once).cost))
    np.testing.assert_allclose(there.cost, here.cost, rtol=1e-12)
    # The misfit and its derivatives are those of the whole motion, looked at in part.
    start = of.start(rj.Inertia.from_principal(1.3, 1.9, 2.5))

    def misfit(x, weights):
        return 0.5 * jnp.sum((all_errors(of, x)[0] / 0.01 * weights[..., None]) ** 2)

    for weights in (part, all_of_it):
        found = searched(of, weights, once)
        cost = misfit(start, weights)
        np.testing.assert_allclose(found.cost, cost, rtol=1e-12)
        np.testing.assert_allclose(found.first, cost, rtol=1e-12)
        np.testing.assert_allclose(found.slope, jax.grad(misfit)(start, weights), rtol=1e-9)


def test_a_search_may_end_near(pushed):
    of = pushed(9.0)
    seen = whole_weights(of)
    end = searched(of, seen, Settings(1e-4, 1.0, 60))
    least = float(end.cost)
    early = searched(of, seen, Settings(1e-4, 1.0, 60, near=1.5 * least))
    assert bool(end.converged) and not bool(early.converged)
    assert least < float(early.cost) <= 1.5 * least
    assert int(early.taken) < int(end.taken)


def test_a_search_ends_in_the_noise_of_its_cost():
    """Adaptive steps give it: the misfit jumps where the number of steps changes."""
    scale = jnp.array([1.0, 10.0, 100.0])

    def evaluated(x):
        error = scale * (x - 0.5)
        cost = 1e3 + 0.5 * jnp.sum(error**2) + 0.1 * jnp.sin(7e11 * x.sum())
        return (), cost, NormalMatrix(jnp.diag(scale**2)), scale * error

    settings = Settings(1e-15, 1.0, 100)
    end = jax.jit(lambda x: least_squares.minimise(evaluated, x, jnp.ones(3), settings, ()))(
        jnp.zeros(3)
    )
    assert bool(end.converged) and int(end.taken) < 15
    np.testing.assert_allclose(scale * (end.point - 0.5), 0, atol=0.5)
