"""Windows whose starts are not exactly known: beside SciPy's fit of all unknowns together."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import turns
from scipy.optimize import least_squares

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify import Free, Known, Model

H, T, LENGTH = 0.05, 81, 10
BODY = rj.Inertia.from_principal(1.0, 1.0, 1.0)
# Readings of a sphere that a damping slows, each channel by its own.
TRUE = np.array([0.5, 0.9, 1.3])
SIGMA = 0.02
RNG = np.random.default_rng(4)
TIMES = H * np.arange(T)
READ = np.exp(-np.outer(TIMES, TRUE)) * [1.0, -2.0, 1.5] + SIGMA * RNG.normal(size=(T, 3))
RATES = Free(lambda s: s.torque.coefficient, "rates")


def cut_with(**options):
    return identify.windows(
        TIMES, rj.Spin(READ), length=LENGTH, stride=LENGTH + 1, **{"noise": {"omega": SIGMA}, **options}
    )  # fmt: skip


def fitted(cut):
    model = Model(cut, Known(BODY), torque=torques.Damping(jnp.ones(3)), free=[RATES])
    return identify.fit(model, tolerance=1e-5)


def best_cost(fit):
    return min(start.cost for start in fit.starts)


def together(deviation):
    """The rates and all starts at once, in closed form exp(−k t), by `least_squares`."""
    cut = cut_with()
    starts, wanted = np.asarray(cut.starts.omega), np.asarray(cut.wanted.omega)
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
    found = fitted(cut_with(starts={"omega": deviation}))
    rates, cost = together(deviation)
    assert found.search.word == "found"
    # Steps of order 4 lack (k h)⁵/120 of the exponential: the rates take it up.
    lack = rates * (rates * H) ** 4 / 120
    wide = np.array([quantity.deviation for quantity in found.quantities])
    # A fit ends at steps of 1e-5 deviations.
    assert np.all(np.abs(found.values["rates"] - rates - lack) < 1e-5 * wide)
    np.testing.assert_allclose(best_cost(found), cost, rtol=1e-6)
    # Noise of the starts that is not allowed for shows in the errors that are left.
    assert best_cost(fitted(cut_with())) > 1.2 * best_cost(found)


def test_starts_of_every_kind_move():
    """A flight whose measured starts are off in place, velocity, attitude and rate: its drag comes
    back all the same, and nothing is left over.
    """
    body = rj.MassProperties(1.0, np.zeros(3), np.diag([0.5, 0.6, 0.7]))
    start = rj.Rigid([0.0, 0, 0], [3.0, 1.0, -2.0], [1.0, 0, 0, 0], [1.0, 2.0, -1.0])
    ts = H * np.arange(41)
    ys = rj.simulate(body, start, ts, torques.Drag(0.3), rtol=1e-11, atol=1e-12).ys
    noise = {"x": 1e-3, "v": 1e-3, "q": 1e-3, "omega": 1e-3}
    free = dict.fromkeys(noise, np.inf)
    cut = identify.windows(ts, ys, length=8, stride=8, noise=noise, starts=free)
    rng = np.random.default_rng(0)
    n = cut.count
    turned = jnp.asarray(rng.normal(size=(n, 3)) * 0.03)
    moved = rj.Rigid(
        cut.starts.x + 0.05 * rng.normal(size=(n, 3)),
        cut.starts.v + 0.05 * rng.normal(size=(n, 3)),
        turns.perturbed(cut.starts.q, turned),
        cut.starts.omega + 0.05 * rng.normal(size=(n, 3)),
    )
    wrong = dataclasses.replace(cut, starts=moved)
    drag = Free(lambda s: s.torque.coefficient, "drag")
    model = Model(wrong, Known(body), torque=torques.Drag(0.1), free=[drag])
    assert model.size == 1 + 12 * n
    found = identify.fit(model)
    np.testing.assert_allclose(found.values["drag"], 0.3, rtol=0, atol=1e-6)
    np.testing.assert_allclose(best_cost(found), 0.0, atol=1e-4)
    states = found.state0
    np.testing.assert_allclose(states.v, cut.starts.v, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (dict(noise=None, starts={"omega": 0.1}), "starts: .*give noise"),
        (dict(starts={"q": 0.1}), r"starts: wanted a number for each of \('omega',\), got \('q',\)"),
        (dict(starts={"omega": 0.0}), r"starts\['omega'\]: wanted a positive deviation"),
    ],
)  # fmt: skip
def test_mistakes_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        cut_with(**options)
