"""A quadrotor from its commands: the figures of notebook 18, by its own cells."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from rigidjax import identify

ROOT = Path(__file__).parents[2]
LOGS = ROOT.parent / "shared" / "data" / "crazyflie"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not LOGS.exists(), reason="the logs are not beside this checkout"),
]


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
    assert cells["found"].converged and cells["again"].converged
    np.testing.assert_allclose(cells["moments"](cells["again"].value), cells["i"], rtol=5e-3)


def test_moments_lag_and_delay(cells):
    (moments, craft), (width, deviation) = cells["last"].value, cells["last"].deviation
    low, high = (end[0] for end in cells["last"].interval())
    np.testing.assert_allclose(moments, [1.88, 2.12, 2.21], atol=0.02)
    np.testing.assert_allclose((high - low)[:2] / 2, [0.27, 1.25], rtol=0.05)
    np.testing.assert_allclose([50 * craft.lag, 10 * craft.delay], [39.1, 13.5], atol=0.3)
    assert 2.2 * 50 * deviation.lag < 8
    # About z nearly all of the motion lies in three seconds: without them Iz is not determined.
    assert high[2] - low[2] > 10 and width[2] > 10 * width[0]
    assert "number 1 (without windows 488 … 548 it is 2." in cells["last"].message


def test_one_step_leaves_a_stretch_out_as_a_fit_does(cells):
    fit, last = cells["fit"], cells["last"]
    stretch = np.arange(fit.count) * 12 // fit.count
    moments = []
    for k in range(12):
        few = jax.tree.map(lambda a, k=k: a[stretch != k], fit)
        again = identify.fit_windows(
            few, cells["scene"], cells["found"].value, noise=cells["NOISE"]
        )
        moments.append(cells["moments"](again.value))
    off = np.array(moments) - np.asarray(last.value[0])
    by_fits, deviation = np.sqrt(11 / 12 * np.sum(off**2, 0)), np.asarray(last.deviation[0])
    np.testing.assert_allclose(deviation[:2], by_fits[:2], rtol=0.3)
    # Where a stretch has nearly all that shows a number, the step is longer than that of a fit.
    assert deviation[2] > by_fits[2] > 5 * deviation[0]


def test_rates_are_predicted_at_half_the_error_of_holding_them(cells):
    assert cells["both"] < 0.45
