"""Row D13, found by the work–precision run: reverse mode at tight tolerances recomputed other steps.

Reverse mode in bounded memory runs parts of the motion again. Compiled in another place, the same
step can round differently (roots and quotients do, sums of products do not); where the error that
steers the steps is near round-off, their lengths then differ, and the parts no longer meet: 7e-6 off
at a tolerance of 1e-11 on the heavy top, 2e-4 at 1e-13 under the gravity gradient. Now attitudes are
scaled by products and sums alone, and below 1e-10 the start of every step is kept. Measured, relative
error of the gradient, T = 50 (`diffrax.Dopri8`, and our own loop, the default):

| | rtol 1e-9 | 1e-11 | 1e-13 |
| --- | --- | --- | --- |
| heavy top | 1.3e-8, 2.2e-8 | 9.4e-11, 1.4e-10 | 6.7e-13, 9.9e-13 |
| gravity gradient | 3.2e-9, 6.0e-9 | 1.4e-11, 4.0e-11 | 6.0e-14, 1.8e-13 |

Bar of the row: 1e3 × tolerance. Limit: a run of more than 4096 steps (2048 in our own loop) at a
tolerance below 1e-10 is still run again in parts.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.workprecision import scenes

NAMES = ("heavy-top", "gravity-gradient")


def away(name, rtol, mode=jax.grad, **how):
    scene = scenes()[name]()

    def loss(numbers):
        body, start = scene.assemble(numbers)
        ts = jnp.array([0.0, scene.end])
        ys = rj.simulate(body, start, ts, scene.torque, rtol=rtol, atol=1e-3 * rtol, **how).ys
        return scene.loss(jnp.concatenate([ys.q[-1], ys.omega[-1]]))

    right = np.asarray(scene.reference.gradient)
    found = np.asarray(once(mode(loss))(scene.numbers))
    return float(np.linalg.norm(found - right) / np.linalg.norm(right))


@pytest.mark.parametrize("rtol", [pytest.param(1e-9, marks=pytest.mark.slow), 1e-11])
def test_reverse_mode_of_a_top(rtol):
    assert away("heavy-top", rtol) < 1e3 * rtol


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("solver", [None, dfx.Dopri8()], ids=["default", "Dopri8"])
@pytest.mark.parametrize("rtol", [1e-9, 1e-11, 1e-13])
def test_reverse_mode_at_every_tolerance(name, solver, rtol):
    found = away(name, rtol, solver=solver)
    print(f"D13 {name} {rtol:.0e} {solver}: {found:.1e}")
    assert found < 1e3 * rtol


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("adjoint", [None, dfx.ForwardMode()], ids=["default", "ForwardMode"])
def test_forward_mode_is_right_at_every_tolerance(name, adjoint):
    for rtol in (1e-9, 1e-11, 1e-13):
        assert away(name, rtol, jax.jacfwd, adjoint=adjoint) < 1e3 * rtol
