"""How sure a fit is, where the data hardly see a direction: a real toss of a flat body."""

import csv
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify import report
from rigidjax.identify.search.stages import blocks_at
from rigidjax.identify.uncertainty.covariance import (
    correlation_times,
    covariance_root,
    linearise,
    robust_covariance,
)

TOSSES = Path(__file__).parents[3] / "shared" / "data" / "tennis_racket" / "tosses.csv"


@pytest.fixture(scope="module")
def toss():
    if not TOSSES.exists():
        pytest.skip("shared/data/tennis_racket/tosses.csv is not beside this checkout")
    with TOSSES.open() as file:
        rows = [row for row in csv.DictReader(file) if (row["round"], row["toss"]) == ("3", "32")]
    rows = np.array([[float(row[k]) for k in ("t", "wx", "wy", "wz")] for row in rows])[:60]
    return identify.Recording(rows[:, 0], (identify.Gyro(), rows[:, 1:]))


def test_a_real_flat_body_has_intervals_with_a_width(toss):
    found = identify.fit(identify.Model(toss, identify.Ratios()))
    for low, high in found.interval().values():
        assert low < high
    values = np.linalg.eigvalsh(np.asarray(found.determined_covariance))
    assert values.min() > -1e-15 * values.max()
    # In principal axes nothing is so weakly seen: deviations of the same ratios, same order.
    other = identify.fit(identify.Model(toss, identify.PrincipalRatios()))
    wide, wanted = (q.deviation / q.value for q in (found.quantities[0], other.quantities[1]))
    assert 0.5 * wanted < wide < 2.5 * wanted
    assert all(len(cell) < 12 for row in report.rows(found) for cell in report.numbers(*row[1:4]))


def test_the_sandwich_is_that_of_its_definition(toss):
    # H⁻¹ M H⁻¹ from the slopes themselves where nothing is weakly seen, M's errors in time by hand.
    found = identify.fit(identify.Model(toss, identify.PrincipalRatios()))
    blocks = blocks_at(found.model, found.x)
    linear = linearise(found.model, found.x, found.noises, blocks)
    times = correlation_times(linear)
    got = robust_covariance(linear, times)
    slopes = linear.slopes[0][0] * np.sqrt(linear.weights[0][0])[:, None, None]
    inverse = np.linalg.inv(np.einsum("tki,tkj->ij", slopes, slopes))
    apart = np.abs(np.subtract.outer(np.arange(60), np.arange(60)))
    candidates = []
    for span in (2.0, 4.0, 8.0, 16.0, 32.0):
        meat = 0.0
        for channel in range(3):
            error = linear.errors[0][0, :, channel]
            scatter = np.mean(np.diff(error, 2) ** 2) / 6
            variance = np.mean(error**2)
            share = np.clip(1 - scatter / variance, 0, 1)
            time = share * np.exp(-apart / span) + (1 - share) * np.eye(60)
            meat = meat + variance * slopes[:, channel].T @ time @ slopes[:, channel]
        candidates.append(inverse @ meat @ inverse)
    best = max(candidates, key=lambda c: np.mean(np.diag(c) / np.diag(inverse)))
    scale = np.sqrt(np.outer(np.diag(best), np.diag(best)))
    of_spread = np.sqrt(np.outer(np.diag(got.determined), np.diag(got.determined)))
    np.testing.assert_allclose(got.determined / of_spread, best / scale, atol=1e-9)
    grown = np.diag(got.determined) / np.diag(best)
    assert (grown > 1 - 1e-9).all()


def test_what_an_information_does_not_show_is_not_made_up():
    rows = np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.0, 2.0]])
    root, null = covariance_root(rows)
    np.testing.assert_allclose((root @ root.T)[2], [0.0, 0.0, 0.25], atol=1e-15)
    np.testing.assert_allclose(np.abs(null), [[0.5**0.5, 0.5**0.5, 0.0]], atol=1e-12)
    units = np.array([1e-6, 1.0, 1e6])
    good = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 4.0]])
    root, null = covariance_root(np.linalg.cholesky(good).T * units)
    wanted = np.linalg.inv(good) / np.outer(units, units)
    np.testing.assert_allclose(root @ root.T, wanted, rtol=1e-12)
    assert null.shape == (0, 3)


def test_what_a_prior_tells_is_as_sure_beside_errors_that_are_autocorrelated():
    # Rates show moments and a wheel only up to one factor, which the wheel's prior knows to 5 %.
    ts = np.linspace(0.0, 2.0, 120)
    speed = rj.torques.Series(ts, 500.0 + 100.0 * np.sin(ts))
    law = rj.torques.Flywheel(rj.torques.Wheel(2e-6, [0.0, 0.6, 0.8], speed))
    body = rj.Inertia.from_principal(2e-4, 3e-4, 4e-4)
    rates = np.asarray(rj.simulate(body, rj.Spin([2.0, 5.0, 1.0]), ts, law).ys.omega)
    rng = np.random.default_rng(0)
    errors = rng.normal(size=rates.shape)
    for k in range(1, len(errors)):
        errors[k] = 0.8 * errors[k - 1] + 0.6 * errors[k]
    record = identify.Recording(ts, (identify.Gyro(0.01), rates + 0.01 * errors))
    wheel = identify.Free(lambda s: s.torque.momentum.inertia, "wheel", positive=True, prior=0.05)
    model = identify.Model(record, identify.Principal(3e-4), torque=law, free=[wheel])
    found = identify.fit(model, starts=1)
    assert found.covariance_kind.startswith("sandwich")

    def half(power):
        low, high = found.interval_of(
            lambda p: jnp.mean(jnp.log(p.body.moments)) + power * jnp.log(p.values["wheel"])
        )
        return float(high - low) / 2

    alone, product, ratio = half(0.0), half(1.0), half(-1.0)
    print(alone, product, ratio)
    assert alone == pytest.approx(1.96 * 0.05, rel=0.1)
    assert product == pytest.approx(2 * alone, rel=0.05) and ratio < 0.2 * alone
