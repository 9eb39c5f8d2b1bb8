"""Rows D1, D2: the order of the attitude under projection, and a motion that is right, not only conserved.

D1 for our own methods: tests/solve/steps/test_explicit.py, test_splitting.py. Here: diffrax's, projected.
Measured slopes: Bosh3 2.94, Tsit5 5.03. D2: what is conserved to 1e-10 can still be wrong; so the
rate itself is compared, against 50 digits, and has to fall with the step as the order says.
"""

import sys
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from systems.tumble import Nothing

import rigidjax as rj
from rigidjax.motion.equations import EulerEquations

sys.path.insert(0, str(Path(__file__).parents[1] / "exact"))
import twin

BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
Q = np.array([0.8, -0.2, 0.4, 0.4]) / np.linalg.norm([0.8, -0.2, 0.4, 0.4])
OMEGA = np.array([1.3, 0.7, -1.6])
LATE = 4.0


def right(late=LATE):
    with mp.workdps(50):
        q, omega = twin.free_body(
            np.diag([1.0, 2.0, 2.5]).tolist(), Q.tolist(), OMEGA.tolist(), late
        )
    return np.array([float(c) for c in q]), np.array([float(c) for c in omega])


@eqx.filter_jit
def run(solver, h, late=LATE):
    return rj.simulate(
        BODY, rj.Attitude(Q, OMEGA), jnp.array([0.0, late]), Nothing(), solver=solver, dt0=h,
        stepsize_controller=dfx.ConstantStepSize(),
    ).ys  # fmt: skip


@pytest.mark.parametrize(
    "solver",
    [pytest.param(dfx.Bosh3(), marks=pytest.mark.slow), dfx.Tsit5()],
    ids=["Bosh3", "Tsit5"],
)
def test_d01_projection_keeps_the_order(solver):
    q, _ = right()
    steps = LATE / np.array([100, 150, 225])
    gaps = [
        min(np.linalg.norm(end - q), np.linalg.norm(end + q))
        for end in (np.asarray(run(solver, jnp.asarray(h)).q[-1]) for h in steps)
    ]
    order = np.polyfit(np.log(steps), np.log(gaps), 1)[0]
    print(f"D1 {type(solver).__name__}: {order:.2f}")
    assert abs(order - solver.order(None)) < 0.1


@pytest.mark.parametrize(
    ("solver", "most"),
    [pytest.param(rj.solvers.RungeKutta4(), 2e-6, marks=pytest.mark.slow), (rj.solvers.Tsitouras5(), 2e-8),
     (rj.solvers.Splitting4(), 5e-12),
     pytest.param(rj.solvers.DormandPrince8(), 1e-12, marks=pytest.mark.slow)],
    ids=["RungeKutta4", "Tsitouras5", "Splitting4", "DormandPrince8"],
)  # fmt: skip
def test_d02_the_rate_itself_is_right(solver, most):
    _, omega = right(20.0)
    away = []
    for h in (0.02, 0.01):
        ys = run(solver, jnp.asarray(h), 20.0)
        away.append(float(np.abs(ys.omega[-1] - omega).max()))
        drift = rj.drift(jnp.array([0.0, 20.0]), ys, BODY)
        assert float(drift["energy"]) < most and float(drift["momentum"]) < most
    print(f"D2 {type(solver).__name__}: {away}")
    assert away[1] < most
    # Smaller steps, smaller error, unless it is round-off.
    assert away[1] < away[0] / 2 ** (solver.order(None) - 1) or away[0] < 1e-12


def test_d02_a_body_that_keeps_its_rate_is_caught():
    """Constant Ω keeps the energy to the last digit and is wrong by more than a radian."""
    q, _ = right(20.0)
    wrong = rj.quaternion.multiply(jnp.asarray(Q), rj.quaternion.exp(20.0 * jnp.asarray(OMEGA)))
    gap = rj.quaternion.multiply(rj.quaternion.conjugate(jnp.asarray(q)), wrong)
    assert float(rj.quaternion.angle(gap)) > 1.0
    found = rj.simulate(BODY, rj.Attitude(Q, OMEGA), [0.0, 20.0]).ys.q[-1]
    apart = rj.quaternion.multiply(rj.quaternion.conjugate(jnp.asarray(q)), found)
    assert float(rj.quaternion.angle(apart)) < 1e-13


def test_d02_the_gyroscopic_term_is_differentiated_too():
    """d(dΩ/dt)/dΩ of a free body against the formula, at a spin where it is large."""
    field = EulerEquations(BODY)
    found = jax.jacfwd(lambda w: field(0.0, rj.Spin(w), None).omega)(jnp.asarray(OMEGA))
    i1, i2, i3 = 1.0, 2.0, 2.5
    x, y, z = OMEGA
    wanted = np.array(
        [
            [0, (i2 - i3) / i1 * z, (i2 - i3) / i1 * y],
            [(i3 - i1) / i2 * z, 0, (i3 - i1) / i2 * x],
            [(i1 - i2) / i3 * y, (i1 - i2) / i3 * x, 0],
        ]
    )
    np.testing.assert_allclose(found, wanted, atol=1e-15)
