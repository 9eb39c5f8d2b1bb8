"""A quadrotor from its commands: the figures of notebook 18, by its own cells."""

import json
from pathlib import Path

import numpy as np
import pytest

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
    np.testing.assert_allclose(moments, [1.88, 2.12, 2.21], atol=0.02)
    assert (1.96 * np.asarray(width) < [0.2, 0.3, 0.9]).all()
    np.testing.assert_allclose([50 * craft.lag, 10 * craft.delay], [39.1, 13.5], atol=0.3)
    assert 1.96 * 50 * deviation.lag < 5


def test_deviations_by_windows_are_too_small(cells):
    # About y most of the motion lies in three seconds.
    assert cells["spread"][1] > 2 * cells["by_windows"][1]


def test_rates_are_predicted_at_half_the_error_of_holding_them(cells):
    assert cells["both"] < 0.45
