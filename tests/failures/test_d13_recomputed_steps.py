"""Row D13, found by the work–precision run: reverse mode at tight tolerances recomputes other steps.

Reverse mode in bounded memory runs parts of the motion again. Compiled in another place, the same
step rounds differently; where the error that steers the steps is near round-off, their lengths then
differ, and the parts no longer meet. Measured on the heavy top, T = 50, relative error of the
gradient (forward mode: 9e-11 at 1e-11, 7e-13 at 1e-13):

| | rtol 1e-9 | 1e-11 | 1e-13 |
| --- | --- | --- | --- |
| simulate, default adjoint | 1.3e-8 | 7.0e-6 | 4.4e-5 |
| simulate, max_steps=4096 | 2.2e-7 | 7.0e-6 | 1.7e-3 |
| DormandPrince8 (reverse) | 2.2e-8 | 1.4e-6 | 3.1e-6 |
| plain diffrax.Dopri8 | 1.1e-8 | 8.4e-11 | 6.5e-13 |

Bar of the row: 1e3 × tolerance. Missed by us below 1e-10; met by forward mode, and by plain diffrax.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.workprecision import scenes

SCENE = scenes()["heavy-top"]()
RIGHT = np.asarray(SCENE.reference.gradient)
MISSED = pytest.mark.xfail(
    strict=False, reason="steps recomputed in reverse mode differ from those taken"
)


def away(rtol, mode=jax.grad, **how):
    def loss(numbers):
        body, start = SCENE.assembled(numbers)
        ts = jnp.array([0.0, SCENE.end])
        ys = rj.simulate(body, start, ts, SCENE.torque, rtol=rtol, atol=1e-3 * rtol, **how).ys
        return SCENE.loss(jnp.concatenate([ys.q[-1], ys.omega[-1]]))

    found = np.asarray(jax.jit(mode(loss))(SCENE.numbers))
    return float(np.linalg.norm(found - RIGHT) / np.linalg.norm(RIGHT))


def test_at_the_default_tolerance_reverse_mode_is_right():
    assert away(1e-9) < 1e3 * 1e-9


@pytest.mark.slow
def test_forward_mode_is_right_at_every_tolerance():
    for rtol in (1e-9, 1e-11, 1e-13):
        assert away(rtol, jax.jacfwd, adjoint=dfx.ForwardMode()) < 1e3 * rtol


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, rj.solvers.DormandPrince8()], ids=["default", "lean"])
@MISSED
def test_reverse_mode_at_1e_11(solver):
    found = away(1e-11, solver=solver)
    print(f"D13 reverse at 1e-11: {found:.1e}")
    assert found < 1e3 * 1e-11
