"""Bicycles that were hung and timed: published tensors give the measured periods, and back."""

import importlib.util
from pathlib import Path

import jax
import numpy as np
import pytest

FILE = Path(__file__).parents[2] / "notebooks" / "bicycles.py"
_spec = importlib.util.spec_from_file_location("bicycles", FILE)
bicycles = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(bicycles)
NAMES = sorted(bicycles.BICYCLES)
SLOPES = jax.jit(jax.jacfwd(bicycles.classical))


@pytest.mark.parametrize("name", NAMES)
def test_published_tensors_give_the_measured_periods(name):
    # Traced: the frame of one bicycle is flatter than any body, by seven deviations of I_yy.
    measured = bicycles.numbers(name, "measured")
    bodies = bicycles.bodies_of(measured, bicycles.numbers(name, "published"))
    wanted = [measured[key] for key in bicycles.TIMED]
    np.testing.assert_allclose(bicycles.periods(measured, bodies), wanted, rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_measured_periods_give_the_published_numbers_with_their_deviations(name):
    measured, width = (bicycles.numbers(name, "measured", which) for which in (0, 1))
    published, stated = (bicycles.numbers(name, "published", which) for which in (0, 1))
    found, slopes = bicycles.classical(measured), SLOPES(measured)
    assert len(bicycles.WANTED) == 16
    for key in bicycles.WANTED:
        # The bars are a tenth of the published deviation, and 5 %.
        assert abs(found[key] - published[key]) < 1e-6 * stated[key], key
        deviation = np.sqrt(sum((float(s) * width[k]) ** 2 for k, s in slopes[key].items()))
        np.testing.assert_allclose(deviation, stated[key], rtol=1e-6, err_msg=key)


def test_one_fit_of_all_parts_takes_the_best_of_its_plumb_lines():
    fit, off, wide = bicycles.compared("Crescendo")
    assert fit.ok
    for body in fit.body.values():
        assert (np.linalg.eigvalsh(body.second_moment) > 0).all()
    # A wheel has as many periods as moments: nothing changes. Three plumb lines show two numbers of
    # a centre of mass, and the classical reduction takes the mean of the places where they meet.
    np.testing.assert_allclose(off[:4], 0.0, rtol=0, atol=0.01)
    np.testing.assert_allclose(wide[:4], 1.0, rtol=0, atol=0.01)
    assert np.abs(off).max() < 1.6
    assert (wide < 1.005).all()
    assert wide.min() == pytest.approx(0.85, abs=0.01)
