"""Row D15: which derivative goes with which adjoint; what is read where it does not.

The default of `simulate` has both modes. Through a solver of diffrax the adjoint says which
(diffrax#336); least squares of a forced recording, which wants forward mode, picks it itself.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from once import once
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj
from rigidjax import identify

FORWARD = dfx.ForwardMode()
TS = jnp.array([0.0, 1.0])


def end(omega, **how):
    return rj.simulate(BODY, rj.Attitude(Q, omega), TS, TOP, **how).ys.omega[-1]


def test_d15_both_modes_through_the_default():
    omega = jnp.asarray(OMEGA)
    forward, reverse = once(lambda w: (jax.jacfwd(end)(w), jax.jacrev(end)(w)))(omega)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-12)


def test_d15_a_plain_least_squares_solver_through_the_default():
    """optimistix's Levenberg–Marquardt with its own defaults: it takes forward mode."""
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)

    @once
    def found(omega):
        wanted = end(omega)
        return optx.least_squares(lambda w, _: end(w) - wanted, solver, omega + 0.05).value

    np.testing.assert_allclose(found(jnp.asarray(OMEGA)), OMEGA, atol=1e-8)


@pytest.mark.parametrize(
    "solver",
    [dfx.Tsit5(), pytest.param(dfx.Dopri5(), marks=pytest.mark.slow)],
    ids=["Tsit5", "Dopri5"],
)
def test_d15_each_mode_with_its_adjoint(solver):
    omega = jnp.asarray(OMEGA)
    forward = once(jax.jacfwd(lambda w: end(w, solver=solver, adjoint=FORWARD)))(omega)
    reverse = once(jax.jacrev(lambda w: end(w, solver=solver)))(omega)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "loss", [pytest.param(None, marks=pytest.mark.slow), pytest.param(identify.Huber(), marks=pytest.mark.slow),
             pytest.param(identify.SoftL1(), marks=pytest.mark.slow)],
    ids=["squares", "Huber", "SoftL1"],
)  # fmt: skip
def test_d15_a_forced_recording_is_fitted(loss):
    ts, body = jnp.linspace(0.0, 4.0, 25), rj.Inertia.from_principal(1.0, 1.6, 2.1)
    law = rj.torques.ConstantTorque([0.3, -0.2, 0.5])
    truth = rj.simulate(body, rj.Spin([0.4, 1.2, -0.3]), ts, law).ys.omega
    record = identify.Recording(ts, (identify.Gyro(1e-3), truth))
    options = {} if loss is None else {"loss": loss}
    model = identify.Model(record, identify.Principal(1.5), torque=law, **options)
    found = identify.fit(model, starts=1)
    moments = np.asarray(found.body.moments)
    np.testing.assert_allclose(np.sort(moments), [1.0, 1.6, 2.1], rtol=1e-5)
