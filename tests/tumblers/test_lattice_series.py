"""Series in two frequencies from a table of sums: dense least squares and direct sums."""

import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.tumblers import lattice_series

RNG = np.random.default_rng(3)
T = np.sort(RNG.uniform(0, 1, 100))
Y, SIGMA = RNG.normal(size=100), RNG.uniform(0.5, 2.0, 100)
LIGHT = lattice_series.Light(*(jnp.asarray(v) for v in (T, Y / SIGMA, 1 / SIGMA)))


@pytest.mark.parametrize("order", [1, 2])
def test_its_misfit_is_that_of_dense_least_squares(order):
    pairs = np.array([[7.3, 4.1], [3.2, 9.9], [0.9, 17.2]])
    table = lattice_series.sum_table(LIGHT, 120.0)
    found = lattice_series.chi2_of_pairs(table, pairs, order)
    for pair, misfit in zip(pairs, found, strict=True):
        columns = [np.ones_like(T)]
        for j in range(3):
            for k in range(-order, order + 1):
                if j > 0 or k > 0:
                    angle = 2 * np.pi * (j * pair[0] + k * pair[1]) * T
                    columns += [np.cos(angle), np.sin(angle)]
        rows = np.stack(columns, axis=1) / SIGMA[:, None]
        _, left, *_ = np.linalg.lstsq(rows, Y / SIGMA, rcond=None)
        np.testing.assert_allclose(misfit, left[0], rtol=1e-5)


def test_the_table_is_the_sum_between_its_entries():
    table = lattice_series.sum_table(LIGHT, 60.0)
    f = RNG.uniform(-60.0, 60.0, 200)
    turns = np.exp(2j * np.pi * f[:, None] * (T - 0.5))
    for values, weights in ((table.window, SIGMA**-2), (table.data, Y / SIGMA**2)):
        wanted = turns @ weights
        found = np.asarray(lattice_series._interpolated_sums(values, jnp.asarray(f)))
        np.testing.assert_allclose(found, wanted, atol=1e-8 * np.abs(weights).sum())


def window(days):
    """The table of readings at these times, days, and their span."""
    span = days[-1] - days[0]
    one = jnp.ones(days.size)
    return lattice_series.sum_table(
        lattice_series.Light(jnp.asarray((days - days[0]) / span), one, one), 60.0
    ), span


def test_side_peaks_of_nights_are_at_one_and_two_a_day():
    nights = [np.arange(n, n + RNG.uniform(0.2, 0.3), 0.004) for n in (0, 1, 2, 4, 5, 8, 9)]
    table, span = window(np.concatenate(nights))
    found = lattice_series.highest_side_peaks(table, 60.0) / span
    np.testing.assert_allclose(found, [1.0, 2.0], atol=0.15 / span)


def test_side_peaks_of_two_sites_half_a_turn_apart_are_at_two_a_day():
    nights = [np.arange(n / 2, n / 2 + 0.2, 0.004) for n in range(14)]
    table, span = window(np.concatenate(nights))
    found = lattice_series.highest_side_peaks(table, 60.0) / span
    np.testing.assert_allclose(found, [2.0], atol=0.15 / span)


def test_even_times_have_no_side_peaks():
    table, _ = window(np.linspace(0.0, 8.0, 500))
    assert lattice_series.highest_side_peaks(table, 60.0).size == 0
