"""Lyapunov exponents and transition matrices: published, exact and structural values, words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.manifold import minus, plus

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


def roessler(t, y, args):
    x, y, z = y[0], y[1], y[2]
    return jnp.stack([-y - z, x + 0.2 * y, 0.2 + z * (x - 5.7)])


def test_long_intervals():
    # Sprott 2003: 0.0714, 0, −5.3943. In an interval directions grow apart by e²² and more.
    found = rj.lyapunov_exponents(roessler, jnp.ones(3), 5000.0, intervals=1000, rtol=1e-8)
    assert (found.errors < 0.015).all()
    assert (np.abs(found.values - np.array([0.0714, 0, -5.3943])) < 4 * found.errors + 1e-4).all()
    found = rj.lyapunov_exponents(
        lorenz, jnp.array([1.0, 1.0, 20.0]), 1000.0, intervals=100, transient=20, rtol=1e-8
    )
    assert (np.abs(found.values - np.array([0.9056, 0, -14.5723])) < 4 * found.errors + 1e-4).all()


def test_the_sum_is_the_mean_divergence():
    # Short enough for SciPy to follow the same motion: e^(0.07 · 150) times its errors.
    slope = lambda t, y: np.asarray(
        [-y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - 5.7), 0.2 + y[0] - 5.7]
    )
    run = solve_ivp(slope, (0, 150), [1, 1, 1, 0], "DOP853", rtol=1e-11, atol=1e-12)
    found = rj.lyapunov_exponents(roessler, jnp.ones(3), 150.0, intervals=75, transient=0)
    np.testing.assert_allclose(found.values.sum(), run.y[3, -1] / 150, atol=1e-6)


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-9])
def test_a_linear_field_is_exact_within_its_errors(rtol):
    # At rest no step has an error of its own: only that of the tangents keeps steps short.
    axes = np.array([[1.0, 0.3, 0.2], [0.0, 1.0, 0.5], [0.1, 0.0, 1.0]])
    matrix = axes @ np.diag([0.5, -1.0, -30.0]) @ np.linalg.inv(axes)
    found = rj.lyapunov_exponents(
        lambda t, y, args: matrix @ y, jnp.zeros(3), 60.0, intervals=60, transient=20, rtol=rtol
    )
    off = np.abs(found.values - np.array([0.5, -1.0, -30.0]))
    assert (off <= found.errors).all() and (found.errors < 300 * rtol).all()


def test_errors_hold_what_is_left_of_the_transient():
    # 30 intervals are twenty parts of one each, and ten at the start that are in no part.
    found = rj.lyapunov_exponents(
        lambda t, y, args: jnp.array([0.3, -0.2, -0.7]) * y, jnp.ones(3), 20.0, intervals=40,
        transient=10, rtol=1e-11,
    )  # fmt: skip
    off = np.abs(found.values - np.array([0.3, -0.2, -0.7]))
    assert (off < 4 * found.errors).all()


def test_other_states_over_long_intervals():
    # x″ = −40 x − 41 v: −1 and −40 along each axis.
    point = rj.Point([0.1, 0.2, 0.0], [0.0, 0.0, 0.3])
    found = rj.lyapunov_exponents(
        lambda t, y, args: rj.Point(y.v, -40 * y.x - 41 * y.v), point, 60.0, intervals=30,
        transient=5,
    )  # fmt: skip
    np.testing.assert_allclose(found.values, [-1.0] * 3 + [-40.0] * 3, atol=1e-6)
    # A damped sphere with a wheel in its bearing: turns stay, q has three directions.
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)
    wheel = torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0], viscous=0.2)
    torque = torques.Sum(torques.Damping([0.6, 0.6, 3.0]), wheel)
    start = Coupled.start(body, START, torque)
    field = rj.equations_of_motion(body, start, torque)
    found = rj.lyapunov_exponents(field, start, 900.0, intervals=30, transient=10)
    # Ωz and h: 2 Ωz′ = −3 Ωz − u, h′ = u = −0.2 (h/0.1 − Ωz).
    of_wheel = np.linalg.eigvals([[-1.6, 1.0], [0.2, -2.0]])
    wanted = np.sort([0, 0, 0, -0.3, -0.3, *of_wheel])[::-1]
    np.testing.assert_allclose(found.values, wanted, atol=1e-6)
    # The largest first, also where the parts of a state do not meet.
    apart = lambda t, y, args: jnp.array([-3.0, 0.5, -1.0]) * y
    found = rj.lyapunov_exponents(apart, jnp.zeros(3), 60.0, intervals=60, number=2, transient=30)
    np.testing.assert_allclose(found.values, [0.5, -1.0], atol=1e-6)
    # A heavy top conserves volumes, and its exponents come in pairs.
    field = rj.equations_of_motion(TOP_BODY, START, TOP)
    found = rj.lyapunov_exponents(field, START, 600.0, intervals=60, transient=10)
    values = np.asarray(found.values)
    assert values[0] > 5 * found.errors[0]
    np.testing.assert_allclose(values + values[::-1], 0, atol=5e-3)


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
    assert np.abs(tame.values).max() < 0.1 * values[0]


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
        there = plus(state, change)
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
                    TOP_BODY, plus(START, s * e), [0.0, 0.7, 1.5], TOP,
                    rtol=1e-12, atol=1e-14,
                ).ys,
            )
            for s in (1e-4, -1e-4)
        ]  # fmt: skip
        wanted = minus(ends[0], ends[1]) / 2e-4
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
    moon = rj.orbits.cr3bp(0.0121505856)
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
