"""Windows whose starts are not exactly known: beside SciPy's fit of all unknowns together."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import rigidjax as rj
from rigidjax import identify, torques

H, T, LENGTH = 0.05, 81, 10
BODY = rj.Inertia.from_principal(1.0, 1.0, 1.0)
# Readings of a sphere that a damping slows, each channel by its own.
TRUE = np.array([0.5, 0.9, 1.3])
SIGMA = 0.02
RNG = np.random.default_rng(4)
TIMES = H * np.arange(T)
READ = np.exp(-np.outer(TIMES, TRUE)) * [1.0, -2.0, 1.5] + SIGMA * RNG.normal(size=(T, 3))
CUT = identify.windows(TIMES, rj.Spin(READ), length=LENGTH, stride=LENGTH + 1)


def scene(rates):
    return BODY, torques.Damping(rates)


def together(deviation):
    """The rates and all starts at once, in closed form exp(−k t), by `least_squares`."""
    starts, wanted = np.asarray(CUT.starts.omega), np.asarray(CUT.wanted.omega)
    ahead = H * np.arange(1, LENGTH + 1)

    def residual(z):
        rates, begin = z[:3], z[3:].reshape(starts.shape)
        run = begin[:, None] * np.exp(-ahead[:, None] * rates)
        off = (begin - starts) / deviation
        return np.concatenate([((run - wanted) / SIGMA).ravel(), off.ravel()])

    z = np.concatenate([TRUE, starts.ravel()])
    found = least_squares(residual, z, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return found.x[:3], found.cost


@pytest.mark.parametrize("deviation", [SIGMA, np.inf])
def test_rates_are_those_of_the_whole_problem(deviation):
    found = identify.fit_windows(
        CUT, scene, jnp.ones(3), noise={"omega": SIGMA}, starts={"omega": deviation}
    )
    rates, cost = together(deviation)
    assert found.converged
    # Steps of order 4 lack (k h)⁵/120 of the exponential: the rates take it up.
    lack = rates * (rates * H) ** 4 / 120
    # A fit ends at steps of 1e-5 deviations.
    assert np.all(np.abs(found.value - rates - lack) < 1e-5 * np.asarray(found.deviation))
    np.testing.assert_allclose(found.cost * CUT.count * LENGTH, cost, rtol=1e-6)
    known = identify.fit_windows(CUT, scene, jnp.ones(3), noise={"omega": SIGMA})
    # Noise of the starts that is not allowed for shows in the errors that are left.
    assert known.cost > 1.2 * found.cost


def test_starts_of_every_kind_move():
    """A flight whose measured starts are off in place, velocity, attitude and rate: its drag comes
    back all the same, and nothing is left over.
    """
    body = rj.MassProperties(1.0, np.zeros(3), np.diag([0.5, 0.6, 0.7]))
    start = rj.Rigid([0.0, 0, 0], [3.0, 1.0, -2.0], [1.0, 0, 0, 0], [1.0, 2.0, -1.0])
    ts = H * np.arange(41)
    ys = rj.simulate(body, start, ts, torques.Drag(0.3), rtol=1e-11, atol=1e-12).ys
    cut = identify.windows(ts, ys, length=8, stride=8)
    rng = np.random.default_rng(0)
    n = cut.count
    noise = {"x": 1e-3, "v": 1e-3, "q": 1e-3, "omega": 1e-3}
    turns = rng.normal(size=(n, 3)) * 0.03
    off = rj.Rigid(
        cut.starts.x + 0.05 * rng.normal(size=(n, 3)),
        cut.starts.v + 0.05 * rng.normal(size=(n, 3)),
        np.stack(
            [
                np.asarray(rj.quaternion.multiply(q, rj.quaternion.exp(jnp.asarray(turn))))
                for q, turn in zip(cut.starts.q, turns, strict=True)
            ]
        ),
        cut.starts.omega + 0.05 * rng.normal(size=(n, 3)),
    )
    wrong = identify.Windows(cut.step, off, cut.wanted, cut.inputs)
    free = dict.fromkeys(noise, np.inf)
    found = identify.fit_windows(
        wrong, lambda k: (body, torques.Drag(k)), jnp.asarray(0.1), noise=noise, starts=free
    )
    np.testing.assert_allclose(found.value, 0.3, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.cost, 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (dict(noise=None, starts={"omega": 0.1}), ValueError, "starts: .*give noise"),
        (dict(starts={"q": 0.1}), ValueError, r"starts: wanted a number for each of \('omega',\), got \('q',\)"),
        (dict(starts={"omega": 0.0}), ValueError, r"starts\['omega'\]: wanted a positive deviation"),
    ],
)  # fmt: skip
def test_mistakes_are_named(change, kind, words):
    given = {"noise": {"omega": SIGMA}, **change}
    with pytest.raises(kind, match=words):
        identify.fit_windows(CUT, scene, jnp.ones(3), **given)
