"""Charts of which some numbers are known: what is known stays, what is free comes back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import turns
from once import once

import rigidjax as rj
from rigidjax import identify

BOX = rj.MassProperties(2.0, [0.1, 0.2, -0.3], [[1.0, 0.1, 0.0], [0.1, 2.0, 0.2], [0.0, 0.2, 1.5]])
SIZES = {"mass": 1, "com": 3, "inertia": 6}


@pytest.mark.parametrize("free", [["mass"], ["inertia"], ["com", "mass"]])
def test_what_is_known_stays(free):
    chart = identify.Mass(BOX, free)
    assert chart.size == sum(SIZES[name] for name in free)
    vector = 0.3 * np.cos(np.arange(chart.size))
    body, slopes = once(lambda v: (chart.body(v), jax.jacfwd(chart.body)(v)))(vector)
    if "mass" not in free:
        np.testing.assert_allclose(body.mass, 2.0, rtol=1e-14)
    if "com" not in free:
        np.testing.assert_array_equal(body.com, BOX.com)
    if "inertia" not in free:
        # The ratios to the mass: a load of known shape.
        np.testing.assert_allclose(
            body.second_moment / body.mass, np.asarray(BOX.second_moment) / 2.0, atol=1e-14
        )
    # Every free number moves the body, and no two the same way.
    columns = np.concatenate(
        [np.asarray(a).reshape(-1, chart.size) for a in jax.tree.leaves(slopes)]
    )
    assert np.linalg.matrix_rank(columns) == chart.size
    assert np.linalg.eigvalsh(body.second_moment).min() > 0
    assert chart.logs(body).shape == (len(chart.log_names),)
    assert chart.plain(body).shape == (len(chart.plain_names),)
    np.testing.assert_allclose(chart.body(chart.vector(BOX.inertia)).com, BOX.com, atol=1e-14)


def test_all_is_free_by_default():
    chart = identify.Mass(BOX)
    assert chart.size == 10
    assert (*chart.log_names, *chart.plain_names) == (
        "mass",
        "I1",
        "I2",
        "I3",
        "com x",
        "com y",
        "com z",
        *("Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy"),
    )


def test_a_free_centre_is_found_from_where_a_body_turns_about():
    """Markers and attitudes of a free flight; all but the centre is known."""
    guess = rj.MassProperties(BOX.mass, [0.0, 0.0, 0.0], BOX.second_moment)
    start = rj.Rigid([0.0, 0, 0], [1.0, 0.5, 0.2], [1.0, 0, 0, 0], [1.0, 3.0, -2.0])
    ts = jnp.linspace(0.0, 2.0, 41)
    states = rj.simulate(BOX, start, ts).ys
    rng = np.random.default_rng(1)
    place = jnp.array([0.3, 0.1, 0.2])
    seen = states.x + turns.to_world(states.q, place - BOX.com)
    record = identify.Recording(
        ts,
        (identify.Marker(place, 1e-3), np.asarray(seen) + 1e-3 * rng.normal(size=(41, 3))),
        (identify.AttitudeSensor(1e-3), states.q),
    )
    law = rj.torques.UniformGravity([0.0, 0.0, 0.0])
    model = identify.Model(record, identify.Mass(guess, ["com"]), torque=law)
    found = identify.fit(model, starts=1)
    np.testing.assert_allclose(found.body.com, BOX.com, rtol=0, atol=3e-3)
    np.testing.assert_allclose(found.body.second_moment, BOX.second_moment, rtol=0, atol=1e-13)
    for axis, value in zip("xyz", BOX.com, strict=True):
        low, high = found.interval(0.999)[f"com {axis}"]
        assert low < value < high
        assert high - low < 0.02


@pytest.mark.parametrize(
    ("free", "words"),
    [
        (["masse"], "free: wanted one of mass, com, inertia, got 'masse'"),
        ([], "got none; see Known"),
    ],
)
def test_mistakes_are_named(free, words):
    with pytest.raises(ValueError, match=words):
        identify.Mass(BOX, free)


def test_bodies_with_and_without_a_scale_in_one_problem():
    """Only what a user gets says so: within a fit a torque on a body of ratios is no mistake."""
    ts = jnp.linspace(0.0, 3.0, 12)
    law = rj.torques.Damping([0.1, 0.1, 0.1])
    omega = rj.simulate(rj.Inertia.from_principal(1.0, 1.6, 2.1), rj.Spin([1.0, 2, 0.3]), ts, law).ys.omega  # fmt: skip
    record = identify.Recording(ts, (identify.Gyro(0.01), omega))
    known = rj.Inertia(jnp.diag(jnp.array([0.5, 0.7, 0.8])), "arbitrary")
    charts = {"a": identify.Ratios(), "b": identify.Tensor(1.0), "c": identify.PrincipalRatios()}
    steps = identify.Adaptive(1e-6, 1e-9)
    records = {name: record for name in charts}
    problem = identify.Model(records, charts, torque=law, integrator=steps)
    start = problem.start()
    assert np.isfinite(once(lambda x: problem.errors(x)[0])(start)).all()
    bodies = problem.unpack(start).body
    assert [bodies[name].scale for name in "abc"] == ["arbitrary", None, "arbitrary"]
    mixed = {"a": identify.Known(known), "b": identify.Tensor(1.0)}
    problem = identify.Model({name: record for name in mixed}, mixed, torque=law)
    assert np.isfinite(once(lambda x: problem.errors(x)[0])(problem.start())).all()
    assert problem.bodies(problem.start())["a"].scale == "arbitrary"
