"""What the search does where the motion is lost: it goes back, and says where it stands."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.model.terms import half_sum, residuals
from rigidjax.identify.search import least_squares, stages
from rigidjax.identify.search.least_squares import Search, Settings
from rigidjax.identify.model.normal import Normal
from rigidjax.identify.search.stages import (
    SearchState,
    Task,
    Tried,
    climb,
    descend,
    horizon,
    settle,
    whole,
)

TS = np.linspace(0.0, 1.0, 8)


@pytest.fixture
def problem():
    record = identify.Recording(TS, (identify.Gyro(0.1), np.ones((8, 3))))
    return identify.Model(record, identify.PrincipalRatios())


def at(problem, value):
    point = problem.start()
    return type(point)(jnp.full_like(point.body, value), point.shared, point.own)


def an_end(first):
    """A search that began at a cost of `first`, and keeps nothing of where it ended."""
    one, line, no = jnp.asarray(first), jnp.zeros(5), jnp.asarray(False)
    return Search(
        one, line, one, Normal(jnp.zeros((5, 5))), line, line, one, one, one, jnp.asarray(1), no, no, (), no, one
    )  # fmt: skip


def place(point):
    return float(point.body[0])


def test_a_stride_that_is_lost_leaves_where_it_began_and_its_misfit(problem, monkeypatch):
    def lost(start, *_):
        return Tried(start, jnp.asarray(jnp.inf), jnp.asarray(False))

    monkeypatch.setattr(stages, "least_squares", lost)
    monkeypatch.setattr(stages, "cost_of", lambda point, *_: 7.0)
    seen = []

    def note(tried, strides, over):
        seen.append((strides, over))

    out = settle(Tried(at(problem, 2.0)), Task(problem, (), 1e-4, 100), jnp.ones((1, 8)), note)
    assert place(out.x) == 2.0 and float(out.cost) == 7.0
    assert not bool(out.converged) and seen == [(1, True)]


@pytest.mark.parametrize(("beyond", "kept"), [(np.nan, 0.0), (np.inf, 0.0), (1e4, 0.0), (2.0, 1.0)])
def test_a_part_is_not_fitted_at_the_cost_of_the_whole(problem, monkeypatch, beyond, kept):
    # Each search of a part goes from 0 to 1, where the whole has the misfit `beyond`.
    begun = []

    def step(start, problem, noise, weights, *_):
        begun.append((place(start), float(weights.mean())))
        # Far above what explains 24 readings.
        tried = Tried(at(problem, 1.0), jnp.asarray(1e3), jnp.asarray(True))
        return tried, an_end(1.0)

    monkeypatch.setattr(stages, "descend", step)
    monkeypatch.setattr(stages, "cost_of", lambda point, *_: 1.0 if place(point) == 0.0 else beyond)
    climb(SearchState(0, 0, Tried(at(problem, 0.0))), Task(problem, (), 1e-4, 25))
    assert [shown for _, shown in begun] == [1.0, 0.25, 0.5, 1.0]
    assert [start for start, _ in begun] == [0.0, 0.0, kept, kept]


def test_what_explains_the_whole_record_at_once_is_not_fitted_in_parts(problem, monkeypatch):
    begun = []

    def step(start, problem, noise, weights, *_):
        begun.append(float(weights.mean()))
        tried = Tried(at(problem, 1.0), jnp.asarray(12.0), jnp.asarray(True))
        return tried, an_end(1.0)

    monkeypatch.setattr(stages, "descend", step)
    out = climb(SearchState(0, 0, Tried(at(problem, 0.0))), Task(problem, (), 1e-4, 25))
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
        record = identify.Recording(ts, (identify.Gyro(0.01), read), torque=torque)
        chart = identify.Principal(1.5)
        return identify.Model(record, chart, integrator=identify.FixedSteps(2))

    return problem


@eqx.filter_jit
def searched(problem, weights, settings):
    noise = (jnp.full((1, 3), 0.01),)
    start = problem.start(rj.Inertia.from_principal(1.3, 1.9, 2.5))
    return descend(start, problem, noise, weights, settings)


def test_a_part_of_the_record_is_followed_no_further_than_that(pushed):
    of = pushed(9.0)
    part, all_of_it = horizon(of, 0.25), whole(of)
    once = Settings(1e-4, 1.0, 0)
    # Beyond the part nothing is computed: what is not finite there does no harm.
    lost = pushed(1.5)
    here, there = searched(of, part, once)[1], searched(lost, part, once)[1]
    assert np.isfinite(float(here.cost))
    assert not np.isfinite(float(searched(lost, all_of_it, once)[1].cost))
    np.testing.assert_allclose(there.cost, here.cost, rtol=1e-12)
    # The misfit and its derivatives are those of the whole motion, looked at in part.
    noise = (jnp.full((1, 3), 0.01),)
    start = of.start(rj.Inertia.from_principal(1.3, 1.9, 2.5))
    for weights in (part, all_of_it):
        found = searched(of, weights, once)[1]
        cost = half_sum(residuals(start, (of, noise, weights)))
        np.testing.assert_allclose(found.cost, cost, rtol=1e-12)
        np.testing.assert_allclose(found.first, cost, rtol=1e-12)
        slope = jax.grad(lambda p, of=of: half_sum(residuals(p, (of, noise, weights))))(start)
        np.testing.assert_allclose(found.slope, ravel_pytree(slope)[0], rtol=1e-9)


def test_a_search_may_end_near(pushed):
    of = pushed(9.0)
    seen = whole(of)
    _, end = searched(of, seen, Settings(1e-4, 1.0, 60))
    least = float(end.cost)
    _, early = searched(of, seen, Settings(1e-4, 1.0, 60, near=1.5 * least))
    assert bool(end.converged) and not bool(early.converged)
    assert least < float(early.cost) <= 1.5 * least
    assert int(early.taken) < int(end.taken)


def test_a_search_ends_in_the_noise_of_its_cost():
    """Adaptive steps give it: the misfit jumps where the number of steps changes."""
    scale = jnp.array([1.0, 10.0, 100.0])

    def evaluated(x):
        error = scale * (x - 0.5)
        cost = 1e3 + 0.5 * jnp.sum(error**2) + 0.1 * jnp.sin(7e11 * x.sum())
        return (), cost, Normal(jnp.diag(scale**2)), scale * error

    settings = Settings(1e-15, 1.0, 100)
    end = jax.jit(lambda x: least_squares.search(evaluated, x, jnp.ones(3), settings, ()))(
        jnp.zeros(3)
    )
    assert bool(end.converged) and int(end.taken) < 15
    np.testing.assert_allclose(scale * (end.point - 0.5), 0, atol=0.5)
