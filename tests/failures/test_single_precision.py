"""Rows D3, D4, D9, D10, D11, D14, D23 in float32: the same behaviour, at the precision's own bar."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import tops_mp
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj
from rigidjax.solve.engine.loop import NONFINITE

SINGLE = jnp.float32
EQUAL = dfx.ConstantStepSize()


def single(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, SINGLE), tree)


SMALL, START = single(BODY), single(rj.Attitude(Q, OMEGA))


def times(*values):
    return jnp.array(values, SINGLE)


def test_d03_a_spin_too_fast_is_no_number():
    start = single(rj.Attitude(Q, 100.0 * OMEGA / np.linalg.norm(OMEGA)))
    run = rj.simulate(
        SMALL, start, times(0, 10, 20), TOP, dt0=0.1, stepsize_controller=EQUAL, throw=False
    )
    assert run.ys.omega.dtype == SINGLE
    assert run.result == NONFINITE and np.isnan(run.ys.omega[-1]).all()


def test_d04_flip_times_of_the_closed_form():
    """δ down to 1e-6: the time to 1e-5 of itself; smaller ones are below float32's own digits of 1."""
    deltas = np.array([1e-2, 1e-4, 1e-6])
    # As in test_d04_flip_time.py.
    wanted = np.array([9.4255178968436496622, 17.402483478546878418, 25.378872335690177766])
    body = single(rj.Inertia.from_principal(1.0, 2.0, 3.0))

    def late(delta, t):
        start = rj.Spin(jnp.stack([jnp.zeros_like(delta), jnp.ones_like(delta), delta]))
        omega = rj.exact.free_body(body, start, t).omega
        return omega[1] / (omega[0] * omega[2])

    found = jax.jit(jax.vmap(late))(jnp.asarray(deltas, SINGLE), jnp.asarray(wanted, SINGLE))
    print(f"D4 float32: {np.asarray(found) / wanted}")
    np.testing.assert_array_less(np.abs(found), 1e-5 * wanted)


def test_d09_a_short_pulse_is_not_stepped_over():
    """A pulse of 10 ms with an impulse of 10 on a sphere: Ω is the impulse, whatever the steps."""
    ball = single(rj.Inertia.from_principal(2.0, 2.0, 2.0))
    law = rj.torques.Pulses([1.0, 1.01], [[0.0, 0.0, 1000.0]])
    out = rj.simulate(ball, rj.Spin(jnp.zeros(3, SINGLE)), times(0, 3), law)
    assert out.ys.omega.dtype == SINGLE
    print(f"D9 float32: {float(out.ys.omega[-1, 2]) - 5.0:.1e}")
    np.testing.assert_allclose(out.ys.omega[-1], [0.0, 0.0, 5.0], atol=5e-4)


def test_d10_d11_a_bad_body_in_a_batch_is_alone():
    rates = (OMEGA * np.linspace(0.5, 1.5, 4)[:, None]).astype(np.float32)
    bad = rates.copy()
    bad[2, 1] = np.nan

    @eqx.filter_jit
    def run(rates):
        def one(omega):
            out = rj.simulate(
                SMALL, rj.Attitude(START.q, omega), times(0, 5), TOP, throw=False, max_steps=2000
            )
            return out.ys, out.result

        return eqx.filter_vmap(one)(rates)

    (good, _), (ys, result) = run(jnp.asarray(rates)), run(jnp.asarray(bad))
    others = np.array([0, 1, 3])
    assert list(np.flatnonzero(result == dfx.RESULTS.successful)) == list(others)
    np.testing.assert_array_equal(ys.q[others], good.q[others])
    assert np.isnan(ys.q[2]).any()


@pytest.mark.slow
def test_d14_growth_warns():
    body = single(rj.Inertia.from_principal(1.0, 1.6, 2.2))
    law = rj.torques.HeavyTop(1.0, [1.0, 0.4, 0.7], [0.0, 0.0, -1.0])
    q = np.array([0.29457358, 0.51677653, 0.16788989, 0.78611794])
    start = single(rj.Attitude(q / np.linalg.norm(q), [1.40904798, 2.72002574, -1.26857553]))
    out = rj.simulate(body, start, times(0, 40, 80, 120), law)
    with pytest.warns(UserWarning, match="gradients through them mean nothing"):
        grown = out.growth
    assert float(grown[-1]) > 1e5


def test_d23_accuracy_does_not_depend_on_the_spin():
    """As in float64, a thousand steps; the height of the axis to 1e-4 up to 1000 rad/s."""
    body = single(rj.Inertia.from_principal(1.0, 1.0, 0.6))
    law = rj.torques.HeavyTop(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    q = jnp.asarray(rj.quaternion.exp(jnp.array([0.6, 0.0, 0.0])), SINGLE)

    @jax.jit
    def height(speed):
        start = rj.Attitude(q, jnp.stack([0.0 * speed, 0.0 * speed, speed]))
        last = rj.simulate(
            body, start, times(0, 5, 10), law, solver=rj.solvers.Splitting4(), dt0=0.01,
            throw=False, stepsize_controller=EQUAL,
        ).ys.q[-1]  # fmt: skip
        return 1 - 2 * (last[1] ** 2 + last[2] ** 2)

    for speed in (30.0, 1000.0):
        wanted = tops_mp.lagrange_cosine(1, 0.6, 9.81 / 2, "0.6", (0, 0, speed), 10)
        off = float(height(jnp.asarray(speed, SINGLE))) - float(wanted)
        print(f"D23 float32 {speed:g}: {off:.1e}")
        assert abs(off) < 1e-4
