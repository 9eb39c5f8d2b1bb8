"""Closed form and adaptive steps for many bodies: the order kept, each with a status of its own."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.batch.simulate import sorted_for_chunks

TOP = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
TS = [0.0, 0.7, 2.0]


def batch(count, seed=0):
    rng = np.random.default_rng(seed)
    tensor = jnp.asarray(rng.uniform(1.0, 1.9, (count, 3)))[:, None, :] * jnp.eye(3)[None]
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    omega = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-1, 1, (count, 1))
    return rj.Inertia(tensor), rj.Attitude(q, omega)


def row(tree, i):
    return jax.tree.map(lambda a: a[i], tree)


def ends(result):
    return np.asarray(result == dfx.RESULTS.successful), np.asarray(result == dfx.RESULTS.nonfinite)


def test_free_bodies_are_the_closed_form():
    bodies, states = batch(5)
    found = rj.batch.simulate(bodies, states, TS, chunk=2)
    assert found.ys.q.shape == (5, 3, 4) and found.num_steps.max() == 0
    assert ends(found.result)[0].all()
    for i in range(5):
        alone = rj.simulate(row(bodies, i), row(states, i), TS).ys
        assert jnp.abs(found.ys.q[i] - alone.q).max() < 1e-14
        assert jnp.abs(found.ys.omega[i] - alone.omega).max() < 1e-13


def test_a_torque_order_and_bad_bodies():
    # Rows D10 and D11: the good bodies keep their bits, the bad ones end at once and say so.
    bodies, states = batch(12)
    run = lambda start: rj.batch.simulate(bodies, start, TS, TOP, chunk=4, max_steps=300)
    whole = run(states)
    assert ends(whole.result)[0].all()
    for i in (0, 5, 11):
        alone = rj.simulate(row(bodies, i), row(states, i), TS, TOP, rtol=1e-11, atol=1e-13).ys
        assert jnp.abs(whole.ys.q[i] - alone.q).max() < 3e-8
    # Not a number, too large to square, and so fast that it runs out of steps.
    found = run(
        rj.Attitude(states.q, states.omega.at[3].set(jnp.nan).at[7].set(1e200).at[9].set(1e4))
    )
    good = np.setdiff1d(np.arange(12), [3, 7, 9])
    assert np.array_equal(found.ys.q[good], whole.ys.q[good])
    assert np.array_equal(found.num_steps[good], whole.num_steps[good])
    fine, lost = ends(found.result)
    assert fine[good].all() and lost[[3, 7]].all()
    assert found.num_steps[3] <= 2 and found.num_steps[7] <= 2
    assert np.asarray(found.result == dfx.RESULTS.max_steps_reached)[9]
    assert np.isnan(found.ys.q[jnp.array([3, 7, 9]), 1:]).all()


def test_equal_steps():
    bodies, states = batch(3)
    found = rj.batch.simulate(bodies, states, rj.batch.Steps(0.01, 20, 10, t0=1.0))
    np.testing.assert_allclose(found.ts, [1.1, 1.2], rtol=1e-15)
    plain = rj.batch.rollout(bodies, states, 0.01, 20)
    assert jnp.abs(found.ys.q[:, -1] - plain.q).max() < 1e-15
    assert ends(found.result)[0].all() and found.num_steps.min() == 20


def test_ill_starts_are_marked_where_they_are_traced():
    bodies, states = batch(3)
    bad = rj.Attitude(states.q.at[1].mul(1.5), states.omega)
    found = jax.jit(lambda b, s: rj.batch.simulate(b, s, rj.batch.Steps(0.1, 2)))(bodies, bad)
    assert np.array_equal(ends(found.result)[0], [True, False, True])


def test_dealing_is_a_permutation():
    key = jnp.asarray(np.random.default_rng(1).permutation(50).astype(float)).at[9].set(jnp.nan)
    for chunk, parts in ((4, 1), (4, 3), (128, 2), (1, 7)):
        order, back = sorted_for_chunks(key, chunk, parts)
        assert np.array_equal(np.sort(order), np.arange(50))
        assert np.array_equal(key[order][back], key, equal_nan=True)
    # Two devices: the quick and the slow are shared out.
    order, _ = sorted_for_chunks(jnp.arange(16.0), 4, 2)
    assert order.tolist() == [0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7, 12, 13, 14, 15]


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_gradients_are_those_of_single_bodies(mode):
    # Row D12.
    bodies, states = batch(3)

    def value(omega, run):
        return jnp.sum(
            run(rj.Attitude(states.q, omega)).q[:, 1:] * jnp.arange(1.0, 5.0)[None, None]
        )

    adjoint = dfx.ForwardMode() if mode == "forward" else None
    derivative = jax.jacfwd if mode == "forward" else jax.grad

    def ours(start):
        return rj.batch.simulate(bodies, start, TS, TOP, rtol=1e-12, atol=1e-13, adjoint=adjoint).ys

    def theirs(start):
        one = lambda b, s: rj.simulate(b, s, TS, TOP, rtol=1e-12, atol=1e-13, adjoint=adjoint).ys
        return jax.vmap(one)(bodies, start)

    found = jax.jit(derivative(lambda o: value(o, ours)))(states.omega)
    truth = jax.jit(derivative(lambda o: value(o, theirs)))(states.omega)
    assert jnp.abs(found - truth).max() < 1e-8 * jnp.abs(truth).max()


@pytest.mark.slow
def test_other_solvers():
    bodies, states = batch(3)
    ours = rj.batch.simulate(bodies, states, TS, TOP)
    other = rj.batch.simulate(bodies, states, TS, TOP, solver=dfx.Tsit5())
    assert jnp.abs(ours.ys.q - other.ys.q).max() < 1e-6


def test_words(unhooked):
    bodies, states = batch(3)
    with pytest.raises(ValueError, match="increasing times"):
        rj.batch.simulate(bodies, states, [0.0, 2.0, 1.0])
    with pytest.raises(ValueError, match="Magnus4 takes fixed steps"):
        rj.batch.simulate(bodies, states, TS, solver=rj.solvers.Magnus4())
    with pytest.raises(TypeError, match="wanted Spin, Attitude or Rigid"):
        rj.batch.simulate(bodies, states.omega, TS)
    with pytest.raises(TypeError, match="wanted Inertia"):
        rj.batch.simulate(bodies.tensor, states, TS)


@pytest.mark.parametrize("count", [40, 200])
def test_no_bit_of_a_body_depends_on_the_others(count):
    # More than one chunk, or a part of one; under a law whose last digits show the order of bodies.
    rng = np.random.default_rng(3)
    q = rng.normal(size=(count, 4))
    q = jnp.asarray(q / np.linalg.norm(q, axis=1)[:, None])
    omega, law = (
        rng.normal(size=(count, 3)),
        rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0, 0, -9.0]),
    )
    bodies = rj.Inertia(jax.vmap(jnp.diag)(jnp.asarray(1 + rng.uniform(0, 0.5, (count, 3)))))

    def rates(omega):
        states = rj.Attitude(q, jnp.asarray(omega))
        return np.asarray(rj.batch.simulate(bodies, states, [0.0, 3.0], law).ys.omega)

    right = rates(omega)
    for index, wild in ((3, np.nan), (17, 30.0), (0, np.nan)):
        other = np.array(omega)
        other[index] *= wild
        one = rates(other)
        same = [np.array_equal(a, b) for a, b in zip(one, right, strict=True)]
        assert [i for i in range(count) if not same[i]] == [index]
