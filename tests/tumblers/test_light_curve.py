"""Tumblers from brightness alone; the oracle is the motion that the light curve was made with."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tumblers import simulated

from rigidjax import identify, tumblers
from rigidjax.identify import Gyro
from rigidjax.identify.data.stacking import pad_to_few
from rigidjax.tumblers import Brightness, lattice_series, two_frequencies
from rigidjax.tumblers.two_frequencies import with_aliases

TS = np.linspace(0.0, 1e5, 300)
RNG = np.random.default_rng(3)


def series(pair, order=1):
    """A random series in two frequencies."""
    rng = np.random.default_rng(7)
    total = np.full(TS.shape, 5.0)
    for j in range(3):
        for k in range(-order, order + 1):
            a, b = rng.normal(size=2)
            angle = 2 * np.pi * (j * pair[0] + k * pair[1]) * TS
            total = total + a * np.cos(angle) + b * np.sin(angle)
    return total


def test_a_series_in_two_frequencies_is_found():
    pair = np.array([8.3e-5, 1.31e-4])
    found = two_frequencies(TS, series(pair) + 0.1 * RNG.normal(size=TS.size), 0.1, shortest=4000.0)
    best = np.abs(found.frequencies[0] - pair).max()
    assert best < 0.05 / TS[-1]
    # χ² of as many readings as are left over.
    assert abs(found.misfits[0] - found.dof) < 5 * np.sqrt(2 * found.dof)
    assert found.misfits[1] > 2 * found.misfits[0]


def daily(seed):
    """Readings at night of a strong f₁ and 2 f₁ and a weak f₂ and its sum with f₁, as in number 70."""
    rng = np.random.default_rng(seed)
    t = simulated.nights(rng)
    day = 24 * simulated.HOUR
    pair = np.array([3.2346, 5.3318]) / day
    y = np.full(t.shape, 5.0)
    for (j, k), size in (((1, 0), 1.0), ((2, 0), 0.8), ((0, 1), 0.15), ((1, 1), 0.2)):
        angle = 2 * np.pi * (j * pair[0] + k * pair[1]) * t + rng.uniform(0, 6)
        y = y + size * np.cos(angle)
    return t, y + 0.1 * rng.normal(size=t.size), pair, day


@pytest.mark.long
def test_daily_aliases_of_a_pair_are_tried():
    t, y, pair, day = daily(0)
    found = two_frequencies(t, y, 0.1, shortest=2 * simulated.HOUR)
    fits = found.misfits < found.misfits[0] + 5.0
    near = np.abs(found.frequencies - pair).max(axis=1) < 0.05 / t[-1]
    assert (near & fits).any() and abs(found.misfits[0] - found.dof) < 5 * np.sqrt(2 * found.dof)
    # What is off by one a day is there, too, and said to fit worse.
    for shift in (1.0, -1.0):
        alias = pair + np.array([0.0, shift / day])
        near = np.abs(found.frequencies - alias).max(axis=1) < 0.3 / t[-1]
        assert found.misfits[near].min() > found.misfits[0] + 20.0


@pytest.mark.parametrize("shift", [(0, -1), (0, 2), (0.5, 1)])
def test_from_any_alias_alone_the_right_pair_is_found(shift):
    t, y, pair, day = daily(1)
    span = t[-1]
    x, sigma = jnp.asarray(t / span), jnp.full(t.size, 0.1)
    light = lattice_series.Light(x, jnp.asarray(y) / sigma, 1 / sigma)
    table = lattice_series.sum_table(light, 610.0)
    wrong = (pair + np.array(shift) / day)[None] * span
    misfits = lattice_series.chi2_of_pairs(table, wrong, 1)
    pairs, misfits = with_aliases(table, wrong, misfits, 100.0, 1)
    best = pairs[misfits < misfits.min() + 5.0] / span
    assert np.abs(best - pair).max(axis=1).min() < 0.05 / span


@pytest.mark.parametrize(("seed", "mode"), [(2, "long"), (7, "short")])
def test_a_tumbler_is_found_blind(seed, mode):
    one = simulated.tumbler(seed, mode)
    found = tumblers.fit_light_curve(simulated.problem(one.recording))
    times, ratios = simulated.off(one, found.aliases[0])
    assert found.ok and times < 1e-3 and ratios < 0.05
    assert found.aliases[0].mode == mode and not found.rivals
    truth = np.log([one.rotation, one.precession, *one.moments[:2]])
    best = found.aliases[0]
    numbers = np.log([best.rotation, best.precession, *best.ratios])
    assert (np.abs(numbers - truth) < 5 * found.deviations).all()
    # The others are listed, and said not to explain it.
    assert len(found.aliases) > 1 and f"{mode}-axis mode" in str(found)


# What depends on the readings themselves, and what JAX compiles to hold an array.
SMALL = {
    "_sums",
    "chi2_of_padded",
    "stage",
    "squeeze",
    "dynamic_slice",
}


def test_another_length_is_the_same_program(caplog):
    one = simulated.tumbler(2, "long")

    def of(size):
        t, reading = np.asarray(one.recording.t)[:size], one.recording.readings[0]
        record = identify.Recording(t, (reading.sensor, np.asarray(reading.values)[:size]))
        return simulated.problem(record)

    tumblers.fit_light_curve(of(400))
    with jax.log_compiles(), caplog.at_level("WARNING"):
        found = tumblers.fit_light_curve(of(380))
    assert set(re.findall(r"Compiling jit\((\w+)\)", caplog.text)) <= SMALL
    assert found.ok and max(simulated.off(one, found.aliases[0])) < 0.05
    # Of the readings as they were given.
    assert found.fit.residuals[0].shape == (380, 1)
    assert found.fit.model.recording.t.shape == (380,)
    errors = pad_to_few(of(380)).errors(found.fit.x)[0]
    np.testing.assert_allclose(errors[:380], found.fit.residuals[0], rtol=0, atol=1e-12)
    assert errors.shape == (432, 1) and not errors[380:].any()


def test_intervals_hold_the_truth_of_a_body_that_is_no_ellipsoid():
    # Once its first ratio was off by twelve of its deviations, and called ok.
    one = simulated.tumbler(8, "long", rough=0.05)
    found = tumblers.fit_light_curve(simulated.problem(simulated.of_unknown_noise(one)))
    error = np.abs(simulated.apart(one, found.aliases[0]))
    assert found.ok and error[2] > 0.02 and (error[:2] < 5e-3).all()
    assert (error < 1.96 * found.deviations).all()
    # They are those of the fit itself, and no wider than the ratios can be known.
    ratio = found.fit.quantities[0]
    assert abs(ratio.deviation / ratio.value / found.deviations[2] - 1) < 1e-6
    assert (found.deviations[2:] < 0.1).all()


def test_the_allowance_for_shape_is_what_such_shapes_do_to_a_fit():
    one = simulated.tumbler(2, "long")
    problem = simulated.problem(one.recording)
    found = tumblers.fit_light_curve(problem)
    reading = one.recording.readings[0]
    n, size = simulated.half_way(one, reading.sensor), 0.002
    total = np.zeros(2)

    def refitted(change):
        values = np.asarray(reading.values) - 2.5 * np.log10(1 + size * change)
        moved = simulated.problem(identify.Recording(one.recording.t, (reading.sensor, values)))
        fitted = identify.fit(moved, starts=1, initial=found.fit.x, tolerance=1e-6)
        return fitted.quantities[:2]

    plain = refitted(np.zeros(n.shape[0]))
    for i in range(3):
        for j in range(i + 1):
            shift = [
                np.log(a.value / b.value)
                for a, b in zip(refitted(n[:, i] * n[:, j]), plain, strict=True)
            ]
            # Off the diagonal there are two of each.
            total += (1 + (i != j)) * np.square(shift) * (0.04 / size) ** 2
    for a, b, wanted in zip(found.fit.quantities[:2], plain, total, strict=True):
        added = (a.deviation / a.value) ** 2 - (b.deviation / b.value) ** 2
        np.testing.assert_allclose(added, wanted, rtol=0.1)


def test_a_light_curve_of_something_else_is_not_called_ok():
    one = simulated.tumbler(2, "long")
    t = np.asarray(one.recording.t)
    two_spots = 12.0 + 0.3 * np.sin(2 * np.pi * t / 21000.0) ** 3 + 0.3 * np.sin(t / 9000.0) ** 5
    sensor = one.recording.readings[0].sensor
    found = tumblers.fit_light_curve(simulated.problem(identify.Recording(t, (sensor, two_spots))))
    assert not found.ok


def test_a_daily_alias_is_not_taken_for_the_rotation():
    # Once its pair of frequencies was not among those tried, and one off by one a day fitted with
    # errors of 1.12 times the noise.
    one = simulated.tumbler(70, "long")
    found = tumblers.fit_light_curve(simulated.problem(one.recording))
    assert simulated.off(one, found.aliases[0])[0] < 1e-3 and found.ok


def problem(*readings, count=1):
    t = np.linspace(0.0, 10.0, 60)
    record = identify.Recording(t, *readings)
    rows: Any = record if count == 1 else [record] * count
    return identify.Model(rows, identify.PrincipalRatios())


def test_what_is_refused():
    light = Brightness([1.0, 0, 0], [0, 1.0, 0], noise=0.1), 2 + np.sin(np.linspace(0, 9, 60))
    gyro = Gyro(0.1), np.ones((60, 3))
    with pytest.raises(ValueError, match="wanted one Brightness sensor, got Gyro"):
        tumblers.fit_light_curve(problem(gyro))
    with pytest.raises(ValueError, match="wanted one recording, got 2"):
        tumblers.fit_light_curve(problem(light, count=2))
    with pytest.raises(ValueError, match="more times than the 17 unknowns, got 5"):
        two_frequencies(TS[:5], TS[:5])
    with pytest.raises(ValueError, match="wanted increasing times"):
        two_frequencies(TS[::-1], TS)
    with pytest.raises(ValueError, match="contain NaN or infinity; leave gaps out"):
        two_frequencies(TS, np.nan * TS)
    with pytest.raises(ValueError, match="noise: wanted positive"):
        two_frequencies(TS, TS, 0.0)
    with pytest.raises(ValueError, match=r"noise: wanted one number or \(T,\)"):
        two_frequencies(TS, TS, np.ones(2))
    with pytest.raises(ValueError, match="their squares are added, got inf; give both in another"):
        two_frequencies(TS, TS, 1e-320)
    with pytest.raises(ValueError, match=r"wanted at most 1e.05 periods in it"):
        two_frequencies(TS, TS, 0.1, shortest=1e-9)


def test_the_typical_rate_is_half_the_strongest_frequency():
    t = np.sort(RNG.uniform(0, 1e5, 200))
    values = 5 + np.sin(2 * np.pi * t / 8000.0)
    sensor = Brightness([1.0, 0, 0], [0, 1.0, 0], noise=0.1)
    found = identify.Model(identify.Recording(t, (sensor, values)), identify.PrincipalRatios())
    np.testing.assert_allclose(found.typical_rate, np.pi / 8000.0, rtol=0.05)
