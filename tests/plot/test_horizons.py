"""The picture of errors by horizon shows the numbers that it was given."""

import matplotlib as mpl
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

mpl.use("Agg")
import matplotlib.pyplot as plt

T = np.linspace(0.0, 1.0, 21)
# A body that falls and turns evenly: a prediction that holds the start errs by v t and g t.
FALL = rj.Rigid(
    np.stack([2.0 * T, 0 * T, -5.0 * T**2], 1),
    np.stack([2.0 + 0 * T, 0 * T, -10.0 * T], 1),
    np.stack([np.cos(T / 2), 0 * T, 0 * T, np.sin(T / 2)], 1),
    np.tile([0.0, 0.0, 1.0], (21, 1)),
)
CUT = identify.windows(T, FALL, length=10, stride=1)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_lines_are_the_errors():
    ax = rj.plot.horizons(
        {"held": CUT.held_horizons(), "again": CUT.held_horizons()}, step=0.05, measure="rms"
    )
    assert [one.get_ylabel() for one in ax] == [
        "position, m", "velocity, m/s", "attitude, rad", "body rate, rad/s",
    ]  # fmt: skip
    velocity = ax[1].lines[0]
    np.testing.assert_allclose(velocity.get_xdata(), T[:11], atol=1e-14)
    np.testing.assert_allclose(velocity.get_ydata(), 10.0 * T[:11], atol=1e-12)
    assert [one.get_label() for one in ax[0].lines] == ["held", "again"]
    assert ax[0].get_xlabel() == "time ahead, s"
    alone = rj.plot.horizons(CUT.held_horizons())
    assert alone[0].get_xlabel() == "steps ahead"
    # A third of the rms of a vector with one component.
    np.testing.assert_allclose(alone[1].lines[0].get_ydata(), 10.0 * T[:11] / 3, atol=1e-12)
    assert rj.plot.horizons(CUT.held_horizons(), ax=ax) is not None


SPIN = identify.windows(T, rj.Spin(FALL.omega), length=10).held_horizons()


@pytest.mark.parametrize(
    ("given", "kind", "words"),
    [
        (dict(results={}), ValueError, "at least one Horizons"),
        (dict(results=CUT), TypeError, "wanted a Horizons of rigidjax.identify.*got Windows"),
        (dict(results={"a": CUT.held_horizons(), "b": SPIN}), ValueError, "the same kinds of errors"),
        (dict(results=SPIN, measure="worst"), ValueError, "measure: wanted one of mean_absolute, mean_norm"),
        (dict(results=SPIN, step=0.0), ValueError, "step: wanted a positive time"),
        (dict(results=SPIN, ax=[None, None]), ValueError, "wanted 1 axes in a row"),
    ],
)  # fmt: skip
def test_mistakes_are_named(given, kind, words):
    with pytest.raises(kind, match=words):
        rj.plot.horizons(**given)
