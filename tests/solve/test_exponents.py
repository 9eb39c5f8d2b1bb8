"""Lyapunov exponents and transition matrices: published, exact and structural values, words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import torques

TOP_BODY = rj.Inertia.from_principal(1.0, 1.4, 0.8)
TOP = torques.HeavyTop(1.0, [0.1, 0.0, 0.3], [0.0, 0.0, -9.81])
START = rj.Attitude([0.8, 0.6, 0.0, 0.0], [0.5, 0.3, 3.0])


def lorenz(t, y, args):
    x, y, z = y[0], y[1], y[2]
    return jnp.stack([10.0 * (y - x), x * (28.0 - z) - y, x * y - 8 / 3 * z])


@pytest.mark.long
def test_lorenz():
    # Sprott 2003, Chaos and Time-Series Analysis: 0.9056, 0, −14.5723.
    found = rj.lyapunov_exponents(
        lorenz, jnp.array([1.0, 1.0, 20.0]), 1000.0, intervals=2000, transient=100, rtol=1e-8,
        atol=1e-8,
    )  # fmt: skip
    assert (found.errors < 0.02).all()
    assert (np.abs(found.values - np.array([0.9056, 0, -14.5723])) < 4 * found.errors).all()
    # The sum is the divergence, −(σ + 1 + β), everywhere.
    np.testing.assert_allclose(found.values.sum(), -(10 + 1 + 8 / 3), atol=1e-5)
    assert found.running.shape == (1900, 3) and found.times.shape == (1900,)
    # It converges: what it would have been half way is no nearer.
    assert abs(float(found.running[950, 0]) - 0.9056) < 0.06


@pytest.mark.long
def test_a_heavy_top_has_pairs_and_four_zeros():
    field = rj.equations_of_motion(TOP_BODY, START, TOP)
    found = rj.lyapunov_exponents(field, START, 1000.0, intervals=1000)
    values, errors = np.asarray(found.values), np.asarray(found.errors)
    assert values[0] > 5 * errors[0] > 0
    # Energy and the momentum about the vertical, and the shifts along time and about it.
    assert np.abs(values[1:5]).max() < 0.01
    np.testing.assert_allclose(values + values[::-1], 0, atol=2e-3)
    # With the weight on the axis it is Lagrange's top: no chaos, all come down as (log t)/t.
    body = rj.Inertia.from_principal(1.0, 1.0, 0.8)
    top = torques.HeavyTop(1.0, [0.0, 0.0, 0.3], [0.0, 0.0, -9.81])
    tame = rj.lyapunov_exponents(
        rj.equations_of_motion(body, START, top), START, 1000.0, intervals=1000
    )
    assert np.abs(tame.values).max() < 0.02 < 0.1 * values[0]


@pytest.mark.long
def test_a_damped_sphere_is_exact():
    # δΩ decays at c/I, and turns stay; q has three directions, not four.
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)
    start = rj.Attitude([0.8, 0.6, 0.0, 0.0], [0.5, 0.3, 3.0])
    field = rj.equations_of_motion(body, start, torques.Damping([0.6, 0.6, 0.6]))
    found = rj.lyapunov_exponents(field, start, 200.0, intervals=200, number=6)
    np.testing.assert_allclose(found.values, [0, 0, 0, -0.3, -0.3, -0.3], atol=1e-6)
    few = rj.lyapunov_exponents(field, start, 200.0, intervals=200, number=2)
    np.testing.assert_allclose(few.values, [0, 0], atol=1e-6)


@pytest.mark.long
def test_transition_matrices():
    out = rj.simulate(TOP_BODY, START, [0.0, 0.7, 1.5], TOP, rtol=1e-12, atol=1e-14)
    found = np.asarray(out.transition_matrix())
    np.testing.assert_allclose(found[0], np.eye(6), atol=1e-14)
    # In (θ, IΩ) the flow keeps volumes, and I is constant.
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-9)

    # Energy and the vertical momentum change nowhere: their gradients are left eigenvectors.
    def kept(change, state):
        there = rj.solve.tangent.moved(state, change)
        momentum = rj.spatial_angular_momentum(TOP_BODY, there)
        return jnp.stack([rj.energy(TOP_BODY, there, TOP), momentum[2]])

    rows = [
        jax.jacfwd(kept)(jnp.zeros(6), jax.tree.map(lambda leaf: leaf[i], out.ys)) for i in (0, 2)
    ]
    np.testing.assert_allclose(rows[1] @ found[2], rows[0], atol=1e-8)
    for i, e in enumerate(jnp.eye(6)):
        ends = [
            jax.tree.map(
                lambda leaf: leaf[-1],
                rj.simulate(
                    TOP_BODY, rj.solve.tangent.moved(START, s * e), [0.0, 0.7, 1.5], TOP,
                    rtol=1e-12, atol=1e-14,
                ).ys,
            )
            for s in (1e-4, -1e-4)
        ]  # fmt: skip
        wanted = rj.solve.tangent.between(ends[1], ends[0]) / 2e-4
        np.testing.assert_allclose(found[2, :, i], wanted, atol=1e-6)


@pytest.mark.long
def test_transition_matrices_of_others():
    body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    spin = rj.Spin([0.0, 0.0, 1.0])
    found = rj.simulate(body, spin, [0.0, 2.0]).transition_matrix()[1]
    # Small wobbles about axis 3 turn at Ω √((I3−I1)(I3−I2)/(I1 I2)): here 1.
    c, s = np.cos(2.0), np.sin(2.0)
    np.testing.assert_allclose(found, [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-12)
    mass = rj.MassProperties(2.0, jnp.zeros(3), body.second_moment)
    start = rj.Rigid([0.0, 1, 2], [3.0, 0, -1], START.q, START.omega)
    found = rj.simulate(mass, start, [0.0, 2.0]).transition_matrix()[1]
    assert found.shape == (12, 12)
    np.testing.assert_allclose(found[:3, 3:6], 2.0 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-9)
    moon = rj.scenes.cr3bp(0.0121505856)
    point = rj.Point([0.85, 0, 0.1], [0.0, 0.2, 0.0])
    out = rj.simulate(None, point, [0.0, 1.0], moon, rtol=1e-12, atol=1e-13)
    wanted = moon.transition(point, 1.0)
    np.testing.assert_allclose(out.transition_matrix()[1], wanted, atol=1e-8)


def test_words(unhooked):
    start = jnp.zeros(2)
    still = lambda t, y, args: -y
    for change, error, words in (
        (dict(number=3), ValueError, "number: wanted at most 2"),
        (dict(intervals=110), ValueError, "at least 20 after the transient"),
        (dict(time=-1.0), ValueError, "time: wanted a positive time"),
        (dict(field=1.0), TypeError, "field: wanted a function f"),
        (dict(state0=jnp.array([np.nan, 0.0])), ValueError, "state0: contains NaN"),
        (dict(state0=jnp.array([True, False])), TypeError, "state0"),
        (dict(field=lambda t, y, args: y[0]), TypeError, "field: wanted dy/dt of the shape of"),
        (dict(solver="RK4"), TypeError, "solver: wanted an explicit method"),
        (dict(rtol=0.0), ValueError, "wanted rtol > 0"),
    ):
        given = dict(field=still, state0=start, time=1.0) | change
        with pytest.raises(error, match=words):
            rj.lyapunov_exponents(**given)
