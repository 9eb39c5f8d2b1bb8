"""The part held out against fits of shortened data, and against covariances written out in full."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

TIMES = jnp.linspace(0.0, 3.0, 60)
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)


def record(seed, count=60, torque=None, noise=0.03):
    rate = np.random.default_rng(seed).normal(size=3)
    start = rj.Spin(3.0 * rate / np.linalg.norm(rate))
    sensor = identify.Gyro(noise)
    key = jax.random.key(seed)
    rates = identify.simulate_readings(sensor, BODY, start, TIMES, torque, key=key)
    mask = np.arange(60) < count
    return identify.Recording(TIMES, (sensor, rates, mask), inputs={"all": np.ones(60)})


def model(*records):
    return identify.Model(records, identify.PrincipalRatios())


@pytest.fixture(scope="module")
def clean():
    return identify.fit(model(record(1)), starts=1)


def rms(errors):
    return float(np.sqrt(np.mean(np.sum(np.asarray(errors) ** 2, axis=-1))))


def test_the_last_quarter_is_predicted_by_the_fit_of_the_rest(clean):
    assert clean.ok
    (pair,) = clean.held_out.pairs
    rest = identify.fit(model(record(1, count=45)), starts=1, held_out=False)
    # The unit of x is the typical rate, which another number of readings changes.
    whole = eqx.tree_at(lambda m: m.records, rest.model, clean.model.records)
    errors, slopes = (np.asarray(f(rest.x)[0]) for f in (whole.errors, jax.jacfwd(whole.errors)))
    np.testing.assert_allclose(
        [pair.fitted, pair.held_out], [rms(errors[:45]), rms(errors[45:])], rtol=5e-3
    )
    e, J = errors[45:].ravel() / 0.03, slopes[45:].reshape(45, -1) / 0.03
    wide = np.eye(45) + J @ np.asarray(rest.covariance) @ J.T
    ratio = np.sqrt(e @ np.linalg.solve(wide, e) / 45)
    np.testing.assert_allclose(clean.held_out.ratio, ratio, rtol=1e-2)


def test_only_the_start_of_a_recording_held_out_is_fitted_to_it():
    records = [record(seed) for seed in (1, 2, 3)]
    found = identify.fit(model(*records), starts=1, held_out=[1])
    others = identify.fit(model(records[0], records[2]), starts=1, held_out=False)
    known = identify.Model(records[1], identify.Known(others.body))
    alone = identify.fit(known, starts=1, held_out=False)
    (pair,) = found.held_out.pairs
    np.testing.assert_allclose(pair.held_out, alone.rms[0], rtol=1e-3)
    assert found.held_out.part == "recordings 1" and 0.8 < found.held_out.ratio < 1.2


def test_a_missing_drag_shows_in_the_part_held_out_and_the_body_before_is_compared():
    drag = rj.torques.Damping([0.02] * 3)
    read = model(record(1, torque=drag, noise=0.01))
    before = rj.Inertia.from_principal(1.0, 2.0, 2.2)
    found = identify.fit(read, starts=1, before=before)
    (pair,) = found.held_out.pairs
    assert found.held_out.chance < 1e-6 and found.held_out.ratio > 1.3
    assert pair.before > 2 * pair.held_out > 2 * pair.fitted
    words = f"a fit of the rest does not predict {found.held_out}"
    assert words in found.status and f"before {pair.before:.3g}" in words
    assert f"held out: {found.held_out}" in str(found)
    shown = identify.report.as_dict(found)["held_out"]
    assert shown["pairs"][0]["before"] == pair.before
    assert words.split(":")[0] in identify.report.as_html(found)


def test_every_fourth_recording_or_stretch_is_held_out_of_many(clean):
    rates = rj.Spin(np.asarray(clean.model.records.readings[0].values)[0])
    windows = identify.windows(
        TIMES, rates, length=5, noise={"omega": 0.03}, starts={"omega": 0.03}
    )
    found = identify.fit(identify.Model(windows, identify.PrincipalRatios()), starts=1)
    assert found.ok and found.held_out.part == "every 4th stretch of windows"
    assert 0.8 < found.held_out.ratio < 1.2
    found = identify.fit(model(*map(record, range(1, 6))), starts=1)
    assert found.ok and found.held_out.part == "every 4th recording"


def test_what_may_be_held_out(clean):
    read = clean.model
    half = identify.fit(read, starts=1, initial=clean.x, held_out=0.5).held_out
    assert half.part == "the last 50 % of the record"
    off = identify.fit(read, starts=1, initial=clean.x, held_out=False)
    assert off.held_out is None and "held out" not in str(off)
    for wrong, words in ((1.5, "between 0 and 1"), ([3], "at most 0")):
        with pytest.raises(ValueError, match=words):
            identify.fit(read, held_out=wrong)
    with pytest.raises(ValueError, match="held_out leaves none"):
        identify.fit(read, held_out=False, before=BODY)
    with pytest.raises(ValueError, match="wanted a body for each"):
        identify.fit(read, before={"moon": BODY})
    with pytest.raises(TypeError, match="known"):
        identify.fit(read, before=3.0)


def test_the_starts_of_a_model_that_fails_end_at_one_misfit():
    rates = np.random.default_rng(0).normal(size=(60, 3))
    wrong = identify.Recording(TIMES, (identify.Gyro(), rates), inputs={"all": np.ones(60)})
    found = identify.fit(model(wrong), starts=2)
    assert found.explanation.word == "does not explain the readings"
    assert " 0 of 2" not in str(found) and "within 1 % of the least misfit" in str(found)
