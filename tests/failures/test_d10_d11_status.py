"""Rows D10, D11: what a run that ended early returns, and what one bad body does to a batch."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj
from rigidjax.solve.engine.loop import NONFINITE

TS = jnp.array([0.0, 5.0, 20.0])
SOLVERS = pytest.mark.parametrize("solver", [None, dfx.Dopri8()], ids=["default", "Dopri8"])


class Breaks(rj.torques.AbstractTorque):
    """A torque that is NaN from a time on."""

    feels = rj.motion.HasSpin
    when: jax.Array

    def __call__(self, t, state, body):
        return jnp.where(t < self.when, 0.1, jnp.nan) * jnp.ones(3)


@SOLVERS
def test_states_not_reached_are_no_numbers(solver):
    start = rj.Attitude(Q, OMEGA)
    out = rj.simulate(BODY, start, TS, TOP, solver=solver, max_steps=60, throw=False)
    assert out.result == dfx.RESULTS.max_steps_reached
    assert np.isfinite(out.ys.q[1]).all()
    assert np.isnan(out.ys.q[2]).all() and np.isnan(out.ys.omega[2]).all()
    with pytest.raises(Exception, match="maximum number of solver steps"):
        rj.simulate(BODY, start, TS, TOP, solver=solver, max_steps=60)


@SOLVERS
@pytest.mark.parametrize(("when", "most"), [(-1.0, 2), (7.0, 300)])
def test_a_torque_that_breaks_ends_the_run(solver, when, most):
    law = Breaks(jnp.array(when))
    out = rj.simulate(BODY, rj.Spin(OMEGA), TS, law, solver=solver, throw=False)
    assert out.result == NONFINITE
    assert int(out.stats["num_steps"]) <= most
    assert np.isnan(out.ys.omega[2]).all() and np.isfinite(out.ys.omega[1]).all() == (when > 5)
    with pytest.raises(Exception, match="became NaN or infinite"):
        rj.simulate(BODY, rj.Spin(OMEGA), TS, law, solver=solver)


@SOLVERS
def test_a_bad_body_in_a_batch_is_alone(solver):
    rates = OMEGA * np.linspace(0.5, 1.5, 6)[:, None]
    bad = rates.copy()
    bad[2, 1], bad[4] = np.nan, 1e200

    @eqx.filter_jit
    def run(rates):
        def one(omega):
            out = rj.simulate(
                BODY, rj.Attitude(Q, omega), TS, TOP, solver=solver, throw=False, max_steps=2000
            )
            return out.ys, out.result, out.stats["num_steps"]

        return eqx.filter_vmap(one)(rates)

    (good, fine, _), (ys, result, steps) = run(jnp.asarray(rates)), run(jnp.asarray(bad))
    others = np.array([0, 1, 3, 5])
    assert bool(jnp.all(fine == dfx.RESULTS.successful))
    assert list(np.flatnonzero(result == dfx.RESULTS.successful)) == list(others)
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(ys), strict=True):
        assert np.array_equal(a[others], b[others])
        # The first row is the start as it was given.
        assert np.isnan(b[[2, 4], 1:]).all()
    assert int(steps[2]) <= 2 and bool((result == NONFINITE)[2])


@pytest.mark.parametrize(
    "solver",
    [None, pytest.param(dfx.Dopri8(), marks=pytest.mark.slow)],
    ids=["default", "Dopri8"],
)
def test_gradients_of_the_others_are_finite_and_the_same(solver):
    rates = OMEGA * np.linspace(0.5, 1.0, 3)[:, None]

    @filter_once
    @jax.grad
    def slope(rates):
        def one(omega):
            start = rj.Attitude(Q, omega)
            out = rj.simulate(BODY, start, TS[:2], TOP, solver=solver, throw=False, max_steps=200)
            good = out.result == dfx.RESULTS.successful
            return jnp.where(good, jnp.sum(jnp.where(good, out.ys.q[-1], 0.0) ** 3), 0.0)

        return jnp.sum(jax.vmap(one)(rates))

    found, wanted = slope(jnp.asarray(rates).at[1].set(jnp.nan)), slope(jnp.asarray(rates))
    np.testing.assert_array_equal(found[::2], wanted[::2])


def test_the_closed_form_has_a_status_too():
    rates = jnp.asarray(OMEGA * np.ones((3, 1))).at[1, 0].set(jnp.nan)

    def one(omega):
        out = rj.simulate(BODY, rj.Attitude(Q, omega), TS, throw=False)
        return out.ys.omega, out.result

    omega, result = eqx.filter_jit(eqx.filter_vmap(one))(rates)
    assert list(result == NONFINITE) == [False, True, False]
    assert np.isnan(omega[1]).all() and np.isfinite(omega[::2]).all()
