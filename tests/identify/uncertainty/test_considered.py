"""Errors of a sensor that no residual shows: considered in the covariance, or said in words."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

T = np.linspace(0.0, 3.0, 60)
MOMENTS = np.array([1.1, 1.7, 2.3])
BODY = rj.Inertia.from_principal(*MOMENTS)
RATES = np.asarray(rj.simulate(BODY, rj.Spin([2.0, 4.0, -3.0]), T).ys.omega)
RATIOS = dict(zip(("Ix/Iz", "Iy/Iz"), MOMENTS[:2] / MOMENTS[2], strict=True))
TOLERANCE = identify.Tolerance(scale=0.01, cross_axis=0.01)


def fitted(readings, free=(), chart=None, **options):
    record = identify.Recording(T, (identify.Gyro(0.01, **options), readings))
    chart = identify.PrincipalRatios() if chart is None else chart
    return identify.fit(identify.Model(record, chart, free=free), starts=1)


def test_the_stated_move_is_that_of_a_refit():
    """Readings without noise, one axis off: the ratios of another fit are the judge."""
    clean = fitted(RATES)
    words = clean.advice
    assert "do not allow for a Gyro that is off" in words
    moved = {name: [] for name in RATIOS}
    for axis in range(3):
        off = fitted(RATES * (1.0 + 0.01 * np.eye(3)[axis]))
        for name in RATIOS:
            moved[name].append(abs(np.mean(off.interval()[name]) - RATIOS[name]))
    scale = words[words.index("1 % in the scale") : words.index(";")]
    for name, sizes in moved.items():
        stated = float(re.search(rf"{name} by ([0-9.e-]+)", scale)[1])
        np.testing.assert_allclose(stated, max(sizes), rtol=0.1)


def test_a_tolerance_widens_the_interval_by_the_moves_of_independent_errors():
    """Nine independent errors of 1 %: the variance that they add is the sum of the squared moves,
    each found by a refit of readings that are off."""
    noise = 0.01 * np.random.default_rng(0).normal(size=RATES.shape)
    plain, wide = fitted(RATES + noise), fitted(RATES + noise, tolerance=TOLERANCE)
    np.testing.assert_allclose(plain.x, wide.x, rtol=0, atol=1e-12)
    ways = [np.outer(np.eye(3)[i], np.eye(3)[j]) for i in range(3) for j in range(3)]
    moves = {name: 0.0 for name in RATIOS}
    for way in ways:
        off = fitted((RATES + noise) @ (np.eye(3) + 1e-3 * way).T)
        for name in RATIOS:
            middle, before = (np.mean(np.log(f.interval()[name])) for f in (off, plain))
            moves[name] += (10.0 * (middle - before)) ** 2
    reach = 1.959963984540054
    for name, added in moves.items():
        before, after = (
            np.diff(np.log(f.interval()[name]))[0] / (2 * reach) for f in (plain, wide)
        )
        np.testing.assert_allclose(after**2, before**2 + added, rtol=0.03)
    assert "They allow for a Gyro off by 1 % of scale, 0.573° between axes" in wide.advice


def test_a_free_scale_has_the_tolerance_as_prior_and_is_not_considered_again():
    free = identify.Free(lambda s: s.sensors[0].scale, "scale", scale=0.02)
    sensor = identify.Gyro(0.01, scale=[1.0, 1, 1], tolerance=identify.Tolerance(scale=0.01))
    noise = 0.01 * np.random.default_rng(1).normal(size=RATES.shape)
    record = identify.Recording(T, (sensor, RATES + noise))
    model = identify.Model(record, identify.PrincipalRatios(), free=[free])
    np.testing.assert_allclose(model.slots[0].prior, 0.5)
    found = identify.fit(model, starts=1)
    assert found.uncertainty.considered == ()
    # Free motion does not show a common scale: the mean of the three is as uncertain as its prior.
    low, high = found.interval_of(lambda point: jnp.mean(point.values["scale"]))
    np.testing.assert_allclose((high - low) / 2 / 1.96, 0.01 / np.sqrt(3), rtol=0.05)


def test_biases_and_clocks_are_considered():
    """A bias of each channel, and a clock: beside refits of readings that are off by them."""
    attitude = rj.Attitude([1.0, 0, 0, 0], [2.0, 4.0, -3.0])
    law = rj.torques.Damping([0.3, 0.2, 0.4])
    rates = np.asarray(rj.simulate(BODY, attitude, T, law).ys.omega)
    free = [identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.1)]

    def drag(readings, **options):
        record = identify.Recording(T, (identify.Gyro(0.01, **options), readings))
        guess = rj.torques.Damping([0.25, 0.25, 0.35])
        model = identify.Model(record, identify.Known(BODY), torque=guess, free=free)
        return identify.fit(model, starts=1)

    def deviations(found):
        low, high = found.interval_of(lambda point: point.values["drag"])
        return (high - low) / (2 * 1.959963984540054)

    plain = drag(rates)
    late = np.append(0.0, T + 2e-3)
    off = [
        (identify.Tolerance(bias=0.02), [rates + 0.02 * np.eye(3)[i] for i in range(3)]),
        (
            identify.Tolerance(clock=2e-3),
            [np.asarray(rj.simulate(BODY, attitude, late, law).ys.omega)[1:]],
        ),
    ]
    for tolerance, readings in off:
        moved = [np.asarray(drag(one).values["drag"] - plain.values["drag"]) for one in readings]
        added = np.sum(np.square(moved), axis=0)
        wide = drag(rates, tolerance=tolerance)
        np.testing.assert_allclose(deviations(wide) ** 2, deviations(plain) ** 2 + added, rtol=0.05)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_intervals_hold_with_a_scale_off_by_one_percent(axis):
    held = total = 0
    for seed in range(6):
        rng = np.random.default_rng(10 * axis + seed)
        start = rng.normal(size=3)
        start *= 5.0 / np.linalg.norm(start)
        rates = np.asarray(rj.simulate(BODY, rj.Spin(start), T).ys.omega)
        rates = rates * (1.0 + 0.01 * np.eye(3)[axis]) + 0.01 * rng.normal(size=rates.shape)
        found = fitted(rates, tolerance=TOLERANCE)
        interval = found.interval()
        held += sum(interval[name][0] < value < interval[name][1] for name, value in RATIOS.items())
        total += len(RATIOS)
    assert held >= total - 1


@pytest.mark.parametrize("value", [0.0, -0.01, np.nan])
def test_mistakes_are_named(value):
    with pytest.raises(
        ValueError, match="Tolerance: scale: wanted a positive standard deviation; leave scale out"
    ):
        identify.Tolerance(scale=value)


def test_a_large_bias_without_a_prior_is_told():
    """A gyro whose every reading is 2 rad/s off: a fit may find this, and a person should hear it."""
    off = np.array([0.0, 0.0, 2.0])
    free = identify.Free(lambda s: s.sensors[0].bias, "gyro bias")
    large, small = (
        fitted(RATES + size * off, free=(free,), bias=np.zeros(3)).advice for size in (1.0, 0.01)
    )
    assert "'gyro bias', a bias without a prior, came out as 2 rad/s" in large
    assert "without a prior" not in small
    known = identify.Free(lambda s: s.sensors[0].bias, "gyro bias", prior=2.0)
    assert "without a prior" not in fitted(RATES + off, free=(known,), bias=np.zeros(3)).advice


@pytest.mark.parametrize("size", [-0.1, 0.1])
def test_a_damping_below_zero_is_told(size):
    """Rates of a body that a torque along its rate drives: what a damping makes of them."""
    law = rj.torques.Damping(size * np.ones(3))
    noise = 0.01 * np.random.default_rng(0).normal(size=RATES.shape)
    rates = np.asarray(rj.simulate(BODY, rj.Spin([2.0, 4.0, -3.0]), T, law).ys.omega) + noise
    record = identify.Recording(T, (identify.Gyro(0.01), rates))
    free = [identify.Free(lambda s: s.torque.coefficient, "air", scale=0.1)]
    zero = rj.torques.Damping(np.zeros(3))
    model = identify.Model(record, identify.PrincipalRatios(), torque=zero, free=free)
    told = "'air', a damping, came out as -0.0" in identify.fit(model, starts=1).advice
    assert told == (size < 0)


def test_an_entry_that_is_estimated_is_not_considered_once_more():
    """The scale of one axis is free, with the tolerance as its prior: the same as all that are."""
    gyro = identify.Gyro(0.01, tolerance=TOLERANCE, scale=[1.0, 1.0, 1.0], skew=[0.0, 0.0, 0.0])
    record = identify.Recording(T, (gyro, RATES))
    free = [
        identify.Free(lambda s: s.sensors[0].scale[1], "scale y", scale=0.01),
        identify.Free(lambda s: s.sensors[0].skew[0], "skew xy", scale=0.01),
    ]
    model = identify.Model(record, identify.PrincipalRatios(), free=free)
    found = identify.fit(model, starts=1)
    scale, skew = (np.abs(part.shifts).max(axis=0) > 0 for part in found.uncertainty.considered)
    np.testing.assert_array_equal(scale, [True, False, True])
    np.testing.assert_array_equal(skew, [False, True, True, True, True, True])
    assert all(slot.prior is not None for slot in model.slots)
