"""Row D8: the clock of a long run in float32: steps are counted, not added up, and short ones named.

Documented limit: float32 holds seven digits of a time, 1e-3 s at t = 1e4 s. A law that depends on
time sees that; nothing accumulates, but what happens faster than that is not seen.
"""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, Nothing

import rigidjax as rj

SPHERE = rj.Inertia(jnp.eye(3, dtype=jnp.float32))
REST = rj.Spin(jnp.zeros(3, jnp.float32))
EQUAL = dfx.ConstantStepSize()


class Push(rj.torques.AbstractTorque):
    """A torque that swings: on a unit sphere from rest Ω = sin t."""

    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        return jnp.cos(t) * jnp.array([0.0, 0.0, 1.0], state.omega.dtype)


def test_steps_are_counted():
    ts = jnp.array([0.0, 1000.0], jnp.float32)
    out = rj.simulate(
        SPHERE, REST, ts, Push(), dt0=0.01, stepsize_controller=EQUAL, solver=dfx.Midpoint()
    )
    assert int(out.stats["num_steps"]) == 100_000
    assert abs(float(out.ys.omega[-1, 2]) - np.sin(1000.0)) < 1e-4


@pytest.mark.parametrize(
    ("ts", "dt0", "words"),
    [
        ([1.7e9, 1.7e9 + 1], 0.01, r"increasing times; ts\[1\] is not above the one before"),
        (
            [86400.0, 86401.0],
            1e-3,
            r"steps of 0.001 s are too short for float32, .* 0.0078 s apart",
        ),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_steps_that_cannot_be_told_apart_are_refused(ts, dt0, words):
    with pytest.raises(ValueError, match=words):
        rj.simulate(
            SPHERE, REST, np.asarray(ts, np.float32), Push(), dt0=dt0,
            stepsize_controller=EQUAL, solver=dfx.Midpoint(),
        )  # fmt: skip


def test_double_precision_knows_the_time_of_day():
    start, t0 = rj.Spin([0.9, -1.1, 0.4]), 1.7e9
    late = rj.simulate(
        BODY, start, [t0, t0 + 1], Nothing(), dt0=1e-3, stepsize_controller=EQUAL,
        solver=dfx.Midpoint(),
    )  # fmt: skip
    # 1.7e9 is off by 1e-7 of a step of 1e-3.
    assert int(late.stats["num_steps"]) in (1000, 1001)
    wanted = rj.exact.free_body(BODY, start, 1.0).omega
    np.testing.assert_allclose(late.ys.omega[-1], wanted, atol=1e-6)
