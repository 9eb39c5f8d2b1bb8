"""A quadrotor from its commands: the figures of notebook 18, by its own cells."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cells():
    """The names that the notebook defines, in its short form."""
    pytest.importorskip("matplotlib").use("Agg")
    notebook = json.loads((ROOT / "notebooks" / "18_crazyflie.ipynb").read_text(encoding="utf-8"))
    names = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RIGIDJAX_SHORT", "1")
        patch.chdir(ROOT / "notebooks")
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                exec("".join(cell["source"]), names)
    return names


def test_it_converges_from_a_factor_of_two(cells):
    found, again = cells["found"], cells["again"]
    assert found.search.word == again.search.word == "found"
    np.testing.assert_allclose(cells["moments"](again), cells["moments"](found), rtol=5e-3)


def test_moments_lag_and_delay(cells):
    found = cells["found"]
    low, high = found.interval_of(cells["moments"])
    np.testing.assert_allclose(cells["moments"](found), [1.88, 2.12, 2.21], atol=0.02)
    np.testing.assert_allclose((high - low)[:2] / 2, [0.27, 1.25], rtol=0.05)
    late = [1e3 * found.values[name] for name in ("lag", "delay")]
    np.testing.assert_allclose(late, [39.1, 13.5], atol=0.3)
    least, most = found.interval()["lag"]
    assert most - least < 16e-3
    # About z nearly all of the motion lies in three seconds: without them Iz is not determined.
    assert high[2] - low[2] > 10 * (high[0] - low[0])
    assert "Iy hangs on one stretch (without windows 488 … 548 it is 2." in found.status


def test_one_step_leaves_a_stretch_out_as_a_fit_does(cells):
    fit, found = cells["fit"], cells["found"]
    stretch = np.arange(fit.count) * 12 // fit.count
    moments = []
    for k in range(12):
        few = jax.tree.map(lambda a, k=k: a[stretch != k], fit)
        again = cells["fitted"](few, cells["law"], cells["Moments"](cells["second"]))
        moments.append(cells["moments"](again))
    off = np.array(moments) - np.asarray(cells["moments"](found))
    by_fits = np.sqrt(11 / 12 * np.sum(off**2, 0))
    low, high = found.interval_of(cells["moments"])
    # Student's with 11 degrees of freedom.
    deviation = (high - low) / 2 / 2.201
    np.testing.assert_allclose(deviation[:2], by_fits[:2], rtol=0.3)
    # Where a stretch has nearly all that shows a number, the step is longer than that of a fit.
    assert deviation[2] > by_fits[2] > 5 * deviation[0]


def test_rates_are_predicted_at_half_the_error_of_holding_them(cells):
    assert cells["both"] < 0.45
