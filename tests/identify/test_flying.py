"""Bodies that move as well as turn: what cameras see of them, and what that fixes."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import turns

import rigidjax as rj
from rigidjax import identify

TS = jnp.linspace(0.0, 1.2, 40)
SIGMA = 1e-3
PLACES = ([0.15, 0.1, 0.05], [-0.15, 0.1, -0.05], [0.15, -0.1, 0.05], [-0.15, -0.1, 0.05])
START = rj.Rigid([0.0, 1.0, 2.0], [3.0, 0.5, 4.0], [1.0, 0.0, 0.0, 0.0], [2.0, 6.0, 1.0])
FREE_FALL = rj.torques.UniformGravity([0.0, 0.0, -9.81])


@functools.cache
def loaded_box():
    """The frame of the markers is not at the centre of mass: a corner load."""
    load = rj.shapes.sphere(0.3, 0.02).shift([0.15, 0.1, 0.0])
    return rj.shapes.box(2.0, [0.3, 0.2, 0.1]) + load


def seen(law, start=START):
    states = rj.simulate(loaded_box(), start, TS, law).ys
    rng = np.random.default_rng(4)
    readings = []
    for place in PLACES:
        arm = jnp.asarray(place) - loaded_box().com
        clean = states.x + turns.to_world(states.q, arm)
        readings.append((identify.Marker(place, SIGMA), clean + SIGMA * rng.normal(size=(40, 3))))
    return readings


@pytest.mark.slow
def test_a_known_body_in_flight():
    problem = identify.Model(
        identify.Recording(TS, *seen(FREE_FALL)), identify.Known(loaded_box()), torque=FREE_FALL
    )
    found = identify.fit(problem, starts=2)
    assert found.ok
    # Forty frames of four markers: a tenth of the noise or so.
    np.testing.assert_allclose(found.state0.x, START.x, atol=SIGMA)
    np.testing.assert_allclose(found.state0.v, START.v, atol=3 * SIGMA)
    np.testing.assert_allclose(found.state0.omega, START.omega, atol=0.05)
    between = rj.quaternion.multiply(rj.quaternion.conjugate(START.q), found.state0.q)
    assert float(rj.quaternion.angle(between)) < 0.02
    np.testing.assert_allclose(found.chi2 / found.dof, 1.0, atol=4 * np.sqrt(2 / found.dof))


@pytest.mark.slow
def test_mass_centre_and_shape_where_a_known_drag_shows_the_scale():
    law = rj.torques.Sum(FREE_FALL, rj.torques.Drag(0.2, [0.05, 0.0, 0.02], [0.5, 0.0, 0.0]))
    guess = rj.shapes.box(1.7, [0.35, 0.2, 0.12])
    problem = identify.Model(identify.Recording(TS, *seen(law)), identify.Mass(guess), torque=law)
    found = identify.fit(problem, starts=3)
    assert found.ok
    bounds = found.interval(0.99)
    truth = {"mass": float(loaded_box().mass)}
    truth |= {f"com {a}": float(c) for a, c in zip("xyz", loaded_box().com, strict=True)}
    for name, value in truth.items():
        low, high = bounds[name]
        assert low <= value <= high
    assert bounds["mass"][1] - bounds["mass"][0] < 0.2 * truth["mass"]


def test_without_a_force_that_feels_it_the_mass_is_said_to_be_unseen():
    problem = identify.Model(
        identify.Recording(TS, *seen(FREE_FALL)),
        identify.Mass(rj.shapes.box(1.7, [0.35, 0.2, 0.12])),
        torque=FREE_FALL,
    )
    found = identify.fit(problem, starts=2)
    low, high = found.interval(0.95)["mass"]
    assert low == 0.0 and np.isinf(high)
    assert found.ok
    assert "mass is not determined by these data." in found.identifiability
    # Neither the fall nor the turning of a free body depends on the scale of mass or inertia.
    words = (
        "Mass is not determined: no reading changes with it.",
        "I1, I2 and I3 rise together: only their ratios are determined.",
    )
    assert set(words) <= set(found.identifiability)
    told = identify.report.as_dict(found)["undetermined"]
    assert tuple(one["words"] for one in told) == words
    assert {name: round(c["change"], 6) for name, c in told[1]["changes"].items()} == dict.fromkeys(
        ("I1", "I2", "I3"), 0.01
    )
    # What the motion does show is found all the same.
    for name, value in zip(("com x", "com y", "com z"), loaded_box().com, strict=True):
        low, high = found.interval(0.99)[name]
        assert low <= value <= high and high - low < 2e-3
