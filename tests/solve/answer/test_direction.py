"""Decreasing times: the closed form at negative times, there and back, jumps, derivatives, words."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax import torques

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
BODY = rj.Inertia(TENSOR)
START = rj.Attitude([0.8, -0.2, 0.4, 0.4], [0.9, -1.1, 0.4])
TIGHT = dict(rtol=1e-12, atol=1e-14)
TOP_BODY = rj.Inertia.from_principal(1.3, 1.3, 0.9)
TOP = torques.HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
FORTH, BACK = np.linspace(0.0, 3.0, 8), np.linspace(3.0, 0.0, 8)


WAYS = pytest.mark.parametrize(
    "solver",
    [None, pytest.param(dfx.Dopri8(), marks=pytest.mark.long)],
    ids=["loop", "diffrax"],
)


class Nothing(rj.torques.AbstractTorque):
    """A torque of zero: the free motion, but through a solver."""

    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)


def last(tree):
    return jax.tree.map(lambda leaf: leaf[-1], tree)


def close(found, wanted, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=atol), found, wanted)


@pytest.mark.parametrize(
    ("torque", "solver"),
    [
        (None, None),
        (Nothing(), None),
        pytest.param(Nothing(), dfx.Dopri8(), marks=pytest.mark.long),
    ],
    ids=["free", "loop", "diffrax"],
)
def test_a_free_body_at_negative_times(torque, solver):
    # The closed form, whose own oracle at negative times has fifty digits (tests/exact).
    ts = np.array([1.0, 0.0, -2.5, -9.0])
    out = rj.simulate(BODY, START, ts, torque, solver=solver, **TIGHT)
    wanted = jax.vmap(lambda t: rj.exact.free_body(BODY, START, t))(jnp.asarray(ts - 1.0))
    close(out.ys, wanted, 1e-10)
    close(out.evaluate(-4.0), rj.exact.free_body(BODY, START, -5.0), 1e-10)
    np.testing.assert_array_equal(out.ts, ts)


@WAYS
def test_there_and_back(solver):
    forth = rj.simulate(TOP_BODY, START, FORTH, TOP, solver=solver, **TIGHT)
    back = rj.simulate(TOP_BODY, last(forth.ys), BACK, TOP, solver=solver, dt0=-0.01, **TIGHT)
    close(jax.tree.map(lambda leaf: leaf[::-1], back.ys), forth.ys, 1e-9)
    assert max(float(v) for v in back.drift.values()) < 1e-10
    assert int(back.stats["num_steps"]) > 1


@pytest.mark.long
def test_a_body_that_moves_and_a_point():
    mass = rj.MassProperties(2.0, jnp.zeros(3), BODY.second_moment)
    start = rj.Rigid([0.0, 1, 2], [3.0, 0, -1], START.q, START.omega)
    fall = torques.UniformGravity([0.0, 0.0, -9.81])
    ys = rj.simulate(mass, start, [0.0, -2.0], fall).ys
    # x(t) = x + v t + g t²/2
    np.testing.assert_allclose(ys.x[-1], [-6.0, 1.0, 2.0 + 2.0 - 0.5 * 9.81 * 4], atol=1e-9)
    moon = rj.orbits.cr3bp(0.0121505856)
    first = rj.Point([0.85, 0, 0.1], [0.0, 0.2, 0.0])
    there = last(rj.simulate(None, first, [0.0, 1.0], moon, **TIGHT).ys)
    close(last(rj.simulate(None, there, [1.0, 0.0], moon, **TIGHT).ys), first, 1e-11)
    # The mirror y → −y turns time round (Roy and Ovenden 1955).
    mirrored = last(rj.simulate(None, first, [0.0, -1.0], moon, **TIGHT).ys)
    close((mirrored.x, mirrored.v), (there.x * M, -there.v * M), 1e-11)


M = np.array([1.0, -1.0, 1.0])


def test_collision_on_the_way_back():
    moon = rj.orbits.cr3bp(0.0121505856, radii=(0.02, 0.005))
    first = rj.Point([0.95, 0, 0], [0.0, 0.0, 0.0])
    out = [
        rj.simulate(None, first, [0.0, end], moon, throw=False).stats["end_time"]
        for end in (2.0, -2.0)
    ]
    np.testing.assert_allclose(out[0], -out[1], atol=1e-9)
    assert 0 < out[0] < 2


@WAYS
def test_jumps_on_the_way_back(solver):
    # Ω about a principal axis under pulses is a sum of their parts: exact.
    body = rj.Inertia.from_principal(2.0, 3.0, 4.0)
    law = torques.Pulses([1.0, 1.5, 2.0], [[0.0, 0.0, 2.0], [0.0, 0.0, -6.0]])
    ts = [3.0, 1.75, 1.25, 0.0]
    out = rj.simulate(body, rj.Spin([0.0, 0.0, 1.0]), ts, law, solver=solver, rtol=1e-9)
    np.testing.assert_allclose(out.ys.omega[:, 2], [1.0, 1.375, 1.625, 1.5], atol=1e-13)
    # An edge met on the right side costs no step but its own.
    assert int(out.stats["num_rejected_steps"]) == 0


class Swing(rj.torques.AbstractTorque):
    """cos t about z: a ball of inertia 1 has the rate sin t and the angle −cos t."""

    feels = rj.motion.HasSpin
    rate_free = True

    def __call__(self, t, state, body):
        return jnp.stack([0 * t, 0 * t, jnp.cos(t)])


LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("RungeKutta4", "DormandPrince8")]


@pytest.mark.parametrize("solver", ["Tsitouras5", "Magnus4", "Splitting4", *LONG])
def test_our_steps_in_diffrax_on_the_way_back(solver):
    # Stages were on the wrong side of the start of a step: order 1 under a torque of time. And the
    # dense output of a splitting, within a step, was of order 2.
    ball, ts = rj.Inertia(jnp.eye(3)), np.array([2.0, 0.925, 0.0])
    at = jax.vmap(lambda t: jnp.stack([0 * t, 0 * t, t]))
    wanted = rj.Attitude(once(jax.vmap(rj.quaternion.exp))(at(-np.cos(ts))), at(np.sin(ts)))
    start, method = jax.tree.map(lambda leaf: leaf[0], wanted), getattr(rj.solvers, solver)()
    how = dict(dt0=0.05, stepsize_controller=dfx.ConstantStepSize())
    close(rj.simulate(ball, start, ts, Swing(), solver=method, **how).ys, wanted, 5e-8)


@pytest.mark.long
def test_derivatives_on_the_way_back():
    def end(omega, edge, late):
        law = torques.Pulses(jnp.stack([edge, edge + 0.5]), [[0.3, -0.2, 0.5]])
        start = rj.Attitude(START.q, omega)
        out = last(rj.simulate(BODY, start, jnp.stack([late + 2.0, late]), law, **TIGHT).ys)
        return jnp.concatenate([out.q, out.omega])

    at = (START.omega, jnp.asarray(0.9), jnp.asarray(0.2))
    forward, reverse = once(
        lambda *at: (jax.jacfwd(end, (0, 1, 2))(*at), jax.jacrev(end, (0, 1, 2))(*at))
    )(*at)
    close(forward, reverse, 1e-10)
    run = once(end)
    h = 1e-5
    for i, e in enumerate(np.eye(3)):
        wanted = (run(at[0] + h * e, *at[1:]) - run(at[0] - h * e, *at[1:])) / (2 * h)
        np.testing.assert_allclose(forward[0][:, i], wanted, atol=1e-8)
    for i in (1, 2):
        step = [h * (j == i) for j in range(3)]
        ahead = run(*(a + s for a, s in zip(at, step, strict=True)))
        behind = run(*(a - s for a, s in zip(at, step, strict=True)))
        np.testing.assert_allclose(forward[i], (ahead - behind) / (2 * h), atol=1e-8)


@pytest.mark.long
def test_traced_and_batched_times_go_either_way():
    @once
    def ends(ts):
        return jax.vmap(lambda ts: rj.simulate(TOP_BODY, START, ts, TOP, **TIGHT).ys.omega)(ts)

    both = ends(jnp.stack([jnp.asarray(FORTH), jnp.asarray(-FORTH)]))
    for found, ts in zip(both, (FORTH, -FORTH), strict=True):
        np.testing.assert_allclose(
            found, rj.simulate(TOP_BODY, START, ts, TOP, **TIGHT).ys.omega, atol=1e-11
        )


@pytest.mark.parametrize("torque", [None, TOP], ids=["free", "forced"])
def test_batches_go_back(torque):
    body = TOP_BODY if torque is not None else BODY
    starts = rj.Attitude(jnp.tile(START.q, (3, 1)), START.omega[None] + jnp.arange(3.0)[:, None])
    bodies = jax.tree.map(lambda leaf: jnp.tile(leaf, (3, 1, 1)), body)
    found = rj.batch.simulate(bodies, starts, BACK, torque)
    one = rj.simulate(body, jax.tree.map(lambda leaf: leaf[1], starts), BACK, torque)
    close(jax.tree.map(lambda leaf: leaf[1], found.ys), one.ys, 1e-10)


def test_words():
    with pytest.raises(ValueError, match=r"wanted decreasing times; ts\[2\] is not below the one"):
        rj.simulate(BODY, START, [1.0, 0.0, 0.5])
    with pytest.raises(ValueError, match="to go back in time give decreasing ts"):
        rj.simulate(BODY, START, [0.0, 1.0], Nothing(), dt0=-0.1)
    with pytest.raises(ValueError, match="outside the times"):
        rj.simulate(BODY, START, [1.0, 0.0]).evaluate(1.5)
    bad = jax.jit(lambda ts: rj.simulate(BODY, START, ts).ys.omega)
    with pytest.raises(Exception, match="increasing times, or decreasing ones throughout"):
        bad(jnp.array([0.0, 1.0, 0.5])).block_until_ready()
