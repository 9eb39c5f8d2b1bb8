"""Intervals: none of a negative variance, none of width zero; their digits."""

import json
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify import report
from rigidjax.identify.answer.result import value_and_interval_of
from rigidjax.identify.uncertainty.quantities import (
    quantities_on_host,
    reported_quantities,
    standard_deviations,
)

NONE = np.zeros((0, 2))
TIMES = np.linspace(0.0, 10.0, 80)


def fitted():
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), TIMES)
    record = identify.Recording(TIMES, (identify.Gyro(0.01), motion.ys.omega))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()))


def test_deviations_of_a_good_covariance():
    # √(gᵀCg), by hand; and of two numbers that differ by 1e-6 of what each is unsure by.
    slopes = np.array([[1.0, 0.0], [1.0, -1.0], [0.0, 0.0]])
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_allclose(
        standard_deviations(slopes, covariance, NONE), [2.0, math.sqrt(11.0), 0.0]
    )
    close = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-12]])
    assert standard_deviations(slopes[1], close, NONE) == pytest.approx(1e-6, rel=1e-2)
    # In any units.
    units = np.array([1e-9, 1e6])
    scaled = covariance * np.outer(units, units)
    np.testing.assert_allclose(
        standard_deviations(slopes / units, scaled, NONE), [2.0, math.sqrt(11.0), 0.0], rtol=1e-12
    )
    blind = np.array([[0.0, 1.0]])
    assert standard_deviations(slopes, covariance, blind)[1:].tolist() == [np.inf, 0.0]


def test_a_negative_variance_gives_no_interval():
    slopes = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [0.0, 0.0]])
    found = standard_deviations(slopes, np.diag([1.0, -1.0]), NONE)
    np.testing.assert_array_equal(found, [1.0, np.nan, np.nan, np.nan, 0.0])
    # A positive diagonal hides it: the difference of the two has the variance −1.
    found = standard_deviations(
        np.array([[1.0, 0.0], [1.0, -1.0]]), np.array([[1.0, 1.5], [1.5, 1.0]]), NONE
    )
    assert np.isnan(found).all()
    # What is left of a variance after all digits cancel is none.
    assert np.isnan(standard_deviations(np.array([1.0, -1.0]), np.ones((2, 2)), NONE))


def test_an_indefinite_information_is_told():
    found = fitted()
    seen = np.asarray(found.determined_covariance).copy()
    seen[0, 0] = -seen[0, 0]
    numbers = reported_quantities(
        found.model,
        quantities_on_host(found.model, found.x, None),
        seen,
        np.asarray(found.null_directions),
    )
    wrong = eqx.tree_at(
        lambda f: (f.uncertainty.determined, f.quantities), found, (jnp.asarray(seen), numbers)
    )
    assert np.isnan(wrong.interval()["Ix/Iz"]).all()
    low, high = wrong.interval_of(lambda point: point.body.moments[:1])
    assert np.isnan(low).all() and np.isnan(high).all()
    assert "Ix/Iz is not determined by these data." in wrong.identifiability
    (row,) = [line for line in report.table(report.rows(wrong)).splitlines() if "Ix/Iz" in line]
    assert row.split() == ["Ix/Iz", "0.400000", "not", "determined"]
    assert report.as_dict(wrong)["quantities"]["Ix/Iz"]["interval_95"] == [None, None]
    json.dumps(report.as_dict(wrong), allow_nan=False)
    assert not any(np.isnan(x) for x in (number for q in found.interval().values() for number in q))


def test_a_fitted_number_has_a_width():
    # Exact readings whose noise is estimated: round-off is all there is.
    found = fitted()
    exact = reported_quantities(
        found.model,
        quantities_on_host(found.model, found.x, None),
        1e-40 * np.asarray(found.determined_covariance),
        np.zeros((0, 5)),
    )
    for number in exact:
        low, high = number.interval(0.95)
        assert low < number.value < high
    still = reported_quantities(
        found.model,
        quantities_on_host(found.model, found.x, None),
        np.zeros((5, 5)),
        np.zeros((0, 5)),
    )
    assert all(np.isnan(number.deviation) for number in still)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ((1.23456, 1.2, 1.27), ["1.2346", "1.2000", "1.2700"]),
        ((0.0689, 1e-40, 3e65), ["6.89e-02", "1.00e-40", "3.00e+65"]),
        ((0.0689, 0.0, np.inf), ["0.0689", "0.0000", "inf"]),
        ((0.0689351234567, -np.inf, np.inf), ["0.0689351", "-inf", "inf"]),
        ((0.0689351234567, np.nan, np.nan), ["0.0689351", "nan", "nan"]),
        ((123456.123456, np.nan, np.nan), ["123456", "nan", "nan"]),
        ((2.5e70, 2.4e70, 2.6e70), ["2.500e+70", "2.400e+70", "2.600e+70"]),
        ((1.0, 0.5, 2e8), ["1.00e+00", "5.00e-01", "2.00e+08"]),
        ((0.0, -0.012, 0.012), ["0.0000", "-0.0120", "0.0120"]),
        ((3.0e-7, -1.0e-3, 1.0e-3), ["0.00000", "-0.00100", "0.00100"]),
        ((1.0, 1.0 - 1e-30, 1.0 + 1e-30), ["1.00000", "1.00000", "1.00000"]),
        ((np.nan, np.nan, np.nan), ["nan", "nan", "nan"]),
        ((1e308, 0.0, np.inf), ["1.00e+308", "0.00e+00", "inf"]),
    ],
)
def test_numbers_have_the_digits_that_they_mean(given, wanted):
    assert report.numbers(*given) == wanted


def test_no_number_is_long():
    rng = np.random.default_rng(0)
    for _ in range(300):
        value, scale, wide = 10.0 ** rng.uniform(-300, 300, 3)
        if rng.random() < 0.5:
            value, scale, wide = 10.0 ** rng.uniform(-9, 9, 3)
        low, high = value - scale, value + wide
        shown = report.numbers(value, low, high)
        assert max(len(text) for text in shown) < 22, (value, low, high, shown)
        below, above = value - low, high - value
        if not (below > 0 and above > 0):
            continue
        gaps = (min(below, above), below, above)
        for text, number, gap in zip(shown, (value, low, high), gaps, strict=True):
            assert abs(float(text) - number) <= 0.05 * gap + 1e-12 * max(abs(low), high)


@pytest.mark.parametrize("size", [1e-3, 40.0])
def test_the_deviation_of_a_positive_number_is_in_its_unit(size):
    # The same number, once free itself and once by its logarithm: what is known of it is the same.
    law = rj.torques.Damping([size, size, size])
    body, start = rj.Inertia.from_principal(9 * size, 13 * size, 16 * size), [1.0, 0.2, 0.4]
    motion = rj.simulate(body, rj.Spin(start), TIMES, law).ys
    record = identify.Recording(TIMES, (identify.Gyro(0.01), motion.omega))
    planned = []
    for positive in (False, True):
        scale = 1.0 if positive else size
        where = lambda s: s.torque.coefficient
        free = identify.Free(where, "damping", scale=scale, positive=positive)
        problem = identify.Model(record, identify.Known(body), torque=law, free=[free])
        planned.append(identify.expected_quantities(problem, problem.start(None, start))[3:])
    for plain, positive in zip(*planned, strict=True):
        assert plain.value == pytest.approx(size) == positive.value and positive.positive
        assert 1e-3 < positive.deviation / size < 0.2
        assert positive.deviation == pytest.approx(plain.deviation, rel=1e-9)
        # The interval of the logarithm: its ends are a factor away.
        low, high = positive.interval(0.95)
        reach = 1.959963984540054 * positive.deviation / size
        np.testing.assert_allclose(np.log([high / size, size / low]), reach, rtol=1e-9)


def test_the_deviation_of_a_ratio_is_that_of_its_interval_as_a_function():
    found = fitted()
    ratio = lambda point: point.body.moments[0] / point.body.moments[2]
    low, high = found.interval_of(ratio, level=0.5)
    quantity = found.quantities[0]
    ends = quantity.interval(0.5)
    width = 0.5 * (high - low)
    assert quantity.name == "Ix/Iz" and quantity.value == pytest.approx(0.4, rel=1e-3)
    assert np.log(ends[1] / ends[0]) / 2 * quantity.value == pytest.approx(width, rel=1e-6)
    student = scipy.stats.t.ppf(0.75, quantity.freedom)
    assert quantity.deviation == pytest.approx(width / student, rel=1e-6)


def test_value_and_interval_of_a_later_rate():
    """The value is that of the function itself, its slope that of central differences.

    The value of a motion by steps comes once for each derivative under `vmap`.
    """
    found, law = fitted(), rj.torques.Damping([0.05, 0.1, 0.2])

    @jax.jit
    def later(point):
        body = rj.Inertia(point.body.tensor)  # of unit size
        return rj.simulate(body, point.state0, [0.0, 3.0], law).ys.omega[-1]

    value, low, high = value_and_interval_of(found, later, 0.9)
    at = lambda x: np.asarray(later(found.model.unpack(x)))
    np.testing.assert_allclose(value, at(found.x), rtol=0, atol=1e-12)
    np.testing.assert_array_equal((low, high), found.interval_of(later, 0.9))
    shifts = 1e-5 * jnp.eye(found.x.size)
    slope = np.stack([(at(found.x + d) - at(found.x - d)) / 2e-5 for d in shifts], axis=-1)
    deviation = np.sqrt(np.einsum("in,nm,im->i", slope, found.covariance, slope))
    reach = scipy.stats.t.ppf(0.95, found.uncertainty.degrees_of_freedom(slope))
    np.testing.assert_allclose(high - value, reach * deviation, rtol=1e-6)
    np.testing.assert_allclose(value - low, reach * deviation, rtol=1e-6)
