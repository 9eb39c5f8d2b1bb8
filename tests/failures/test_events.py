"""Events: the flip of a free body in plain diffrax, its time and state there, and their gradients.

Trusted (diffrax#729): derivatives of the time and of the state at the event, both modes, with a
root finder in the event (`optimistix.Newton`) and a crossing that is not a touch; with an adaptive
explicit method of ours or of diffrax. Not trusted: an event without a root finder, which is found
at the end of a step: its time is late by up to a step and its gradient is the step's.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from once import filter_once

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations

BODY = rj.Inertia.from_principal(1.0, 2.0, 3.0)
FIELD = AttitudeEquations(BODY)
Q = jnp.array([1.0, 0.0, 0.0, 0.0])
OMEGA = jnp.array([0.0, 1.0, 1e-2])


def crossed(t, y, args, **kwargs):
    return y.omega[1]


def flip(omega, solver, adjoint):
    """Time, attitude and rate when Ω2 is first zero."""
    out = dfx.diffeqsolve(
        dfx.ODETerm(FIELD), solver, 0.0, 20.0, None, rj.Attitude(Q, omega),
        stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-13), adjoint=adjoint,
        event=dfx.Event(crossed, optx.Newton(1e-12, 1e-12)), max_steps=1024,
    )  # fmt: skip
    return jnp.concatenate([out.ts[-1:], out.ys.q[-1], out.ys.omega[-1]])


def exactly(omega):
    """The same by the closed form and Newton's method in Python floats."""
    motion = jax.jit(rj.exact.free_body)
    t = 9.4255
    for _ in range(6):
        state = motion(BODY, rj.Attitude(Q, omega), t)
        t -= float(state.omega[1] / (state.omega[2] * state.omega[0]))
    state = motion(BODY, rj.Attitude(Q, omega), t)
    return np.concatenate([[t], state.q, state.omega])


@pytest.mark.parametrize(
    ("solver", "mode"),
    [
        pytest.param(rj.solvers.Tsitouras5(), "forward", marks=pytest.mark.slow),
        (rj.solvers.Projected(dfx.Dopri8()), "forward"),
        (rj.solvers.Projected(dfx.Dopri8()), "reverse"),
        pytest.param(rj.solvers.Tsitouras5(), "reverse", marks=pytest.mark.slow),
    ],
    ids=["Tsitouras5-forward", "Dopri8-forward", "Dopri8-reverse", "Tsitouras5-reverse"],
)
def test_time_and_state_at_a_flip_and_their_gradients(solver, mode):
    adjoint, jac = {
        "forward": (dfx.ForwardMode(), jax.jacfwd),
        "reverse": (dfx.RecursiveCheckpointAdjoint(), jax.jacrev),
    }[mode]

    @filter_once
    def both(omega):
        found = flip(omega, solver, adjoint)
        return found, jac(lambda w: flip(w, solver, adjoint))(omega)

    value, slope = both(OMEGA)
    np.testing.assert_allclose(value[0], 9.4255178968436496622, atol=1e-8)
    np.testing.assert_allclose(value, exactly(OMEGA), atol=1e-8)
    step = 1e-5
    wanted = [
        (exactly(OMEGA + step * e) - exactly(OMEGA - step * e)) / (2 * step) for e in np.eye(3)
    ]
    wanted = np.stack(wanted, axis=1)
    np.testing.assert_allclose(slope, wanted, atol=1e-5 * np.abs(wanted).max())
