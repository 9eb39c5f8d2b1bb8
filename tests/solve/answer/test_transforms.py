"""What `simulate` returns is a pytree of arrays: it goes through every transformation of JAX."""

import copy
import pickle

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj

BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
TS = jnp.linspace(0.0, 1.0, 5)
OMEGA = jnp.array([1.0, 0.1, 1.0])
QUATERNION = jnp.array([1.0, 0.0, 0.0, 0.0])
DRAG = rj.torques.Damping(0.1 * jnp.ones(3))
WHEELS = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [0.0], motor=[0.2])


def slower(t, state, body):
    return state.omega[0] - 0.95


def run(name, scale):
    spin = rj.Spin(scale * OMEGA)
    if name == "free":
        return rj.simulate(BODY, spin, TS)
    if name == "forced":
        return rj.simulate(BODY, spin, TS, DRAG)
    if name == "back":
        return rj.simulate(BODY, rj.Attitude(QUATERNION, scale * OMEGA), TS[::-1], DRAG)
    if name == "function":
        return rj.simulate(BODY, spin, TS, lambda t, state, body: -0.1 * state.omega)
    if name == "wheels":
        return rj.simulate(BODY, spin, TS, WHEELS)
    if name == "event":
        return rj.simulate(BODY, spin, TS, DRAG, event=slower)
    if name == "solver":
        return rj.simulate(BODY, spin, TS, DRAG, solver=dfx.Tsit5())
    assert name == "flies"
    body = rj.shapes.box(1.0, [0.1, 0.2, 0.3])
    state = rj.Rigid(jnp.zeros(3), OMEGA, QUATERNION, scale * OMEGA)
    return rj.simulate(body, state, TS, rj.torques.Drag(0.1))


NAMES = ("free", "forced", "back", "function", "wheels", "event", "solver", "flies")


@pytest.mark.parametrize("name", NAMES)
def test_solutions_go_through_transformations(name):
    one = run(name, jnp.asarray(1.0))
    scales = jnp.array([1.0, 0.5])
    plain = jax.jit(lambda scale: run(name, scale))(scales[0])
    assert isinstance(plain, rj.solve.Solution)
    found = {
        "jit": jax.tree.map(lambda leaf: leaf[None], plain),
        "vmap": jax.vmap(lambda scale: run(name, scale))(scales),
        "map": jax.lax.map(lambda scale: run(name, scale), scales),
    }
    for many in found.values():
        for leaf, wanted in zip(jax.tree.leaves(many.ys), jax.tree.leaves(one.ys), strict=True):
            np.testing.assert_allclose(leaf[0], wanted, rtol=1e-9, atol=1e-12)
        # What is asked of one of many is what is asked of one.
        first = jax.tree.map(lambda leaf: leaf[0], many)
        now = first.evaluate(TS[1] + 0.1)
        for leaf, wanted in zip(
            jax.tree.leaves(now), jax.tree.leaves(one.evaluate(TS[1] + 0.1)), strict=True
        ):
            np.testing.assert_allclose(leaf, wanted, rtol=1e-8, atol=1e-10)


def test_simulate_itself_may_be_transformed():
    found = jax.jit(rj.simulate)(BODY, rj.Spin(OMEGA), TS, DRAG)
    again = eqx.filter_jit(rj.simulate)(BODY, rj.Spin(OMEGA), TS, DRAG)
    np.testing.assert_allclose(found.ys.omega, again.ys.omega, rtol=1e-12)
    bodies = jax.vmap(rj.Inertia.from_principal)(*(jnp.ones(2) * x for x in (1.0, 2.0, 2.5)))
    many = jax.vmap(rj.simulate, in_axes=(0, None, None, None))(bodies, rj.Spin(OMEGA), TS, DRAG)
    np.testing.assert_allclose(many.ys.omega[1], found.ys.omega, rtol=1e-9)
    assert repr(found) == "Solution(Spin at 5 times 0 … 1 s, 4 steps, 0 rejected; successful)"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda sol: pickle.loads(pickle.dumps(sol))])
@pytest.mark.parametrize("name", ["free", "forced", "solver", "event"])
def test_a_copied_solution_evaluates_as_the_original(name, duplicate):
    sol = run(name, 1.0)
    copied = duplicate(sol)
    pairs = [(copied, sol), (copied.evaluate(0.2), sol.evaluate(0.2)), (copied.drift, sol.drift)]
    if name == "forced":
        pairs.append((copied.error, sol.error))
    for one, other in pairs:
        jax.tree.map(np.testing.assert_array_equal, one, other)
