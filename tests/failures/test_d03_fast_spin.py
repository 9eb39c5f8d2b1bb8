"""Row D3: a spin too fast for equal steps is an error or a drift that is seen, never a reset."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj

EXPLICIT = [dfx.Dopri8(), rj.solvers.RungeKutta4(), rj.solvers.Tsitouras5()]
SLOW = pytest.param(rj.solvers.DormandPrince8(), marks=pytest.mark.slow)
STEP, COUNT = 0.1, 200


def spun(solver, speed, throw=False):
    """200 steps with h |Ω| = 0.1 `speed`."""
    start = rj.Attitude(Q, speed * OMEGA / np.linalg.norm(OMEGA))
    ts = jnp.array([0.0, 0.5, 1.0]) * STEP * COUNT
    return rj.simulate(
        BODY, start, ts, TOP, solver=solver, throw=throw, dt0=STEP,
        stepsize_controller=dfx.ConstantStepSize(),
    )  # fmt: skip


@pytest.mark.parametrize("solver", [*EXPLICIT, SLOW], ids=lambda s: type(s).__name__)
def test_the_clock_is_right_and_what_is_wrong_is_seen(solver):
    slow, fast, wild = (spun(solver, speed) for speed in (3.0, 10.0, 100.0))
    assert slow.result == dfx.RESULTS.successful
    assert int(slow.stats["num_steps"]) == int(fast.stats["num_steps"]) == COUNT
    # h |Ω| = 1: an answer whose energy says how bad it is; the energy that is lost is no reset.
    away = [float(run.drift["energy"]) for run in (slow, fast)]
    assert 0 < away[0] < away[1]
    assert float(jnp.linalg.norm(fast.ys.omega[-1])) > 0.3
    # h |Ω| = 10: no number comes out.
    assert wild.result == dfx.RESULTS.nonfinite
    assert np.isnan(wild.ys.omega[-1]).all()


def test_the_error_says_what_to_do():
    with pytest.raises(Exception, match=r"became NaN or infinite.*short enough for this spin"):
        spun(dfx.Dopri8(), 100.0, throw=True)


def test_a_splitting_does_not_mind():
    for speed in (10.0, 100.0):
        run = spun(rj.solvers.Splitting4(), speed)
        assert run.result == dfx.RESULTS.successful
        assert float(run.drift["energy"]) < 2e-2
