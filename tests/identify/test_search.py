"""What the search does where the motion is lost: it goes back, and says where it stands."""

import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax import identify
from rigidjax.identify import search
from rigidjax.identify.checkpoint import Position, Tried
from rigidjax.identify.search import climb, fresh, settle

TS = np.linspace(0.0, 1.0, 8)


@pytest.fixture
def problem():
    record = identify.Recording(TS, (identify.Gyro(0.1), np.ones((8, 3))))
    return identify.Problem(record, identify.PrincipalRatios())


def at(problem, value):
    point = problem.start()
    return type(point)(jnp.full_like(point.body, value), point.shared, point.own)


def place(point):
    return float(point.body[0])


def test_a_stride_that_is_lost_leaves_where_it_began_and_its_misfit(problem, monkeypatch):
    def lost(start, *_):
        return Tried(start, jnp.asarray(jnp.inf), jnp.asarray(False))

    monkeypatch.setattr(search, "least_squares", lost)
    monkeypatch.setattr(search, "cost_of", lambda point, *_: 7.0)
    seen = []

    def note(tried, strides, over):
        seen.append((strides, over))

    out = settle(fresh(at(problem, 2.0)), problem, (), jnp.ones((1, 8)), 1e-4, 100, note)
    assert place(out.parameters) == 2.0 and float(out.cost) == 7.0
    assert not bool(out.converged) and seen == [(1, True)]


@pytest.mark.parametrize(("beyond", "kept"), [(np.nan, 0.0), (np.inf, 0.0), (1e4, 0.0), (2.0, 1.0)])
def test_a_part_is_not_fitted_at_the_cost_of_the_whole(problem, monkeypatch, beyond, kept):
    # Each search of a part goes from 0 to 1, where the whole has the misfit `beyond`.
    begun = []

    def step(start, problem, noise, weights, *_):
        begun.append((place(start), float(weights.mean())))
        # Far above what explains 24 readings.
        return Tried(at(problem, 1.0), jnp.asarray(1e3), jnp.asarray(True))

    monkeypatch.setattr(search, "least_squares", step)
    monkeypatch.setattr(search, "cost_of", lambda point, *_: 1.0 if place(point) == 0.0 else beyond)
    climb(Position(0, 0, fresh(at(problem, 0.0))), problem, (), 1e-4, 25)
    assert [shown for _, shown in begun] == [1.0, 0.25, 0.5, 1.0]
    assert [start for start, _ in begun] == [0.0, 0.0, kept, kept]


def test_what_explains_the_whole_record_at_once_is_not_fitted_in_parts(problem, monkeypatch):
    begun = []

    def step(start, problem, noise, weights, *_):
        begun.append(float(weights.mean()))
        return Tried(at(problem, 1.0), jnp.asarray(12.0), jnp.asarray(True))

    monkeypatch.setattr(search, "least_squares", step)
    out = climb(Position(0, 0, fresh(at(problem, 0.0))), problem, (), 1e-4, 25)
    assert begun == [1.0] and place(out.parameters) == 1.0 and bool(out.converged)
