"""Row D16: states saved between steps are on the group, and as good as the steps (10 tolerances).

What the interpolation adds: the saved state against the motion from the step before it.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, START, TOP

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.solve import fixed

FIELD = AttitudeEquations(BODY, TOP)
TS = jnp.linspace(0.0, 20.0, 301)


@jax.jit
@jax.vmap
def carried(t0, y, t):
    ys = fixed(rj.solvers.Tsitouras5(), FIELD, jnp.stack([t0, t]), y, 40)
    return jax.tree.map(lambda leaf: leaf[-1], ys)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [rj.solvers.Projected(dfx.Dopri8()), rj.solvers.Projected(dfx.Tsit5()), rj.solvers.Tsitouras5(),
     pytest.param(rj.solvers.DormandPrince8(), marks=pytest.mark.slow)],
    ids=["Dopri8", "Tsit5", "Tsitouras5", "DormandPrince8"],
)  # fmt: skip
def test_what_the_interpolation_adds(solver):
    subs = (dfx.SubSaveAt(steps=True, t0=True), dfx.SubSaveAt(ts=TS))

    @jax.jit
    def run(tolerance):
        return dfx.diffeqsolve(
            dfx.ODETerm(FIELD), solver, TS[0], TS[-1], None, START, max_steps=1024,
            saveat=dfx.SaveAt(subs=subs),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=1e-3 * tolerance),
        )  # fmt: skip

    for tolerance in (1e-6, 1e-9):
        out = run(jnp.array(tolerance))
        (steps, _), (at_steps, saved) = out.ts, out.ys
        i = jnp.clip(jnp.searchsorted(steps, TS, side="right") - 1, 0, steps.shape[0] - 1)
        exact = carried(steps[i], jax.tree.map(lambda leaf: leaf[i], at_steps), TS)
        assert float(jnp.abs(saved.q - exact.q).max()) < 10 * tolerance
        size = jnp.abs(exact.omega).max()
        assert float(jnp.abs(saved.omega - exact.omega).max()) < 10 * tolerance * size
        assert float(jnp.abs(jnp.linalg.norm(saved.q, axis=1) - 1).max()) < 1e-14


@pytest.mark.slow
def test_what_simulate_saves_is_as_good_as_where_it_ends():
    for rtol in (1e-6, 1e-9, 1e-11):
        fine = rj.simulate(BODY, START, TS, TOP, rtol=rtol, atol=1e-3 * rtol).ys
        # The same run, looked at in one place only, and not at its end.
        for i in (77, 200):
            ts = jnp.stack([TS[0], TS[i]])
            one = rj.simulate(BODY, START, ts, TOP, rtol=rtol, atol=1e-3 * rtol).ys
            best = rj.simulate(BODY, START, ts, TOP, rtol=1e-13, atol=1e-16).ys
            alone = float(jnp.abs(one.q[-1] - best.q[-1]).max())
            among = float(jnp.abs(fine.q[i] - best.q[-1]).max())
            assert among < 5 * alone + 30 * rtol
    np.testing.assert_allclose(jnp.linalg.norm(fine.q, axis=1), 1.0, rtol=0, atol=1e-14)


def test_saved_states_beside_a_closed_form():
    # About a principal axis Ω = Ω₀ exp(−c t/I): few long steps, 300 times between them.
    ts, law = jnp.linspace(0.0, 10.0, 301), rj.torques.Damping([0.3, 0.2, 0.5])
    body = rj.Inertia.from_principal(1.6, 2.0, 3.0)
    for solver in (rj.solvers.RungeKutta4(), rj.solvers.Tsitouras5(), rj.solvers.DormandPrince8()):
        for rtol in (1e-5, 1e-9):
            ys = rj.simulate(
                body, rj.Spin([0.0, 0.0, 3.0]), ts, law, solver=solver, rtol=jnp.asarray(rtol),
                atol=1e-3 * rtol,
            ).ys  # fmt: skip
            error = jnp.abs(ys.omega[:, 2] - 3.0 * jnp.exp(-0.5 * ts / 3.0)).max()
            assert error < 10 * rtol * 3.0


def test_single_precision_is_on_the_group():
    single = lambda tree: jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)
    q = rj.simulate(single(BODY), single(START), TS.astype(jnp.float32), TOP).ys.q
    assert q.dtype == jnp.float32
    assert float(jnp.abs(jnp.linalg.norm(q, axis=1) - 1).max()) < 2e-7
