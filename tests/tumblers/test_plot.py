"""A light curve in the picture is the one given: against time, and folded."""

import matplotlib as mpl
import numpy as np
import pytest

import rigidjax as rj

mpl.use("Agg")
import matplotlib.pyplot as plt

TS = np.concatenate([np.linspace(0.0, 1e4, 30), np.linspace(8e4, 9e4, 30)])
VALUES = 15.0 + 0.2 * np.cos(2 * np.pi * TS / 5000.0)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_it_shows_what_was_read_and_folds_it():
    model = VALUES + 0.01
    above, below = rj.tumblers.plot.light_curve(TS, VALUES, 5000.0, model=model, time_unit="h")[:2]
    np.testing.assert_allclose(above.lines[0].get_xdata(), TS / 3600)
    np.testing.assert_allclose(above.lines[0].get_ydata(), VALUES)
    drawn = above.lines[1].get_ydata()
    # The last reading before the gap has no line on to the next.
    assert np.isnan(drawn[29]) and np.isnan(drawn).sum() == 1
    phase, value = below.collections[0].get_offsets().T
    assert phase.size == 2 * TS.size and phase.min() >= 0 and phase.max() < 2
    # One period: one curve.
    np.testing.assert_allclose(value, 15.0 + 0.2 * np.cos(2 * np.pi * phase), atol=1e-10)
    assert above.yaxis_inverted() and below.yaxis_inverted()
    assert above.get_ylabel() == "magnitude"


def test_a_flux_is_not_upside_down_and_no_period_is_no_fold():
    (only,) = rj.tumblers.plot.light_curve(TS, VALUES, quantity="flux")
    assert not only.yaxis_inverted() and only.get_ylabel() == "flux"


@pytest.mark.parametrize(
    ("given", "options", "words"),
    [
        ((TS, VALUES[1:]), {}, r"values: wanted \(T,\) as ts has"),
        ((TS, np.nan * VALUES), {}, "values: nothing to draw"),
        ((TS, VALUES, -1.0), {}, "periods: wanted positive periods"),
        ((TS, VALUES), {"model": VALUES[1:]}, r"model: wanted \(T,\)"),
        ((TS, VALUES), {"quantity": "light"}, "quantity: wanted one of mag, flux"),
        ((TS, VALUES), {"time_unit": "year"}, "time_unit: wanted one of"),
    ],
)
def test_words_on_mistakes(given, options, words):
    with pytest.raises(ValueError, match=words):
        rj.tumblers.plot.light_curve(*given, **options)
