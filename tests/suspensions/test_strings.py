"""Bifilar and trifilar pendulums beside quadrature at 30 digits, SciPy, and their geometry."""

import diffrax
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.integrate

import rigidjax as rj

PLATE = rj.shapes.box(1.2, [0.3, 0.2, 0.02])
MOMENT = float(PLATE.inertia.tensor[2, 2])
SIZES = (0.12, 0.09, 0.7)


def strings(above, below, length, **more):
    return rj.suspensions.Strings(3, above, below, length, gravity=9.81, **more)


def height(angle, above, below, length):
    return mp.sqrt(length**2 - above**2 - below**2 + 2 * above * below * mp.cos(angle))


def moment(angle, inertia, mass, *sizes):
    lift = -sizes[0] * sizes[1] * mp.sin(angle) / height(angle, *sizes)
    return inertia + mass * lift**2


def period(inertia, mass, above, below, length, swing):
    """4 ∫ √(M/2(V(α) − V(γ))) dγ, with γ = α cos ψ; differences of cosines as products of sines."""
    sizes = above, below, length

    def density(psi):
        angle, less = swing * mp.cos(psi), swing * mp.sin(psi / 2) ** 2
        fall = 4 * above * below * mp.sin(swing - less) * mp.sin(less)
        fall *= mass * mp.mpf(9.81) / (height(angle, *sizes) + height(swing, *sizes))
        return mp.sqrt(moment(angle, inertia, mass, *sizes) / (2 * fall)) * swing * mp.sin(psi)

    return 4 * mp.quad(density, [0, mp.pi / 4, mp.pi / 2])


def ours(x):
    inertia, mass, *sizes, swing = x
    zero = jnp.zeros(3)
    body = rj.MassProperties(mass, zero, jnp.diag(0.5 * jnp.stack([inertia, inertia, 0.0 * mass])))
    return rj.suspensions.period(body, strings(*sizes), swing)


@pytest.mark.parametrize("swing", [1e-3, 0.4, 1.5, 2.8])
def test_period_beside_quadrature(swing):
    x = jnp.array([MOMENT, 1.2, *SIZES, swing])
    with mp.workdps(30):
        numbers = [mp.mpf(float(v)) for v in x]
        want = period(*numbers)
    np.testing.assert_allclose(float(jax.jit(ours)(x)), float(want), rtol=1e-13)


@jax.jit
def period_and_derivatives(x):
    return ours(x), jax.grad(ours)(x), jax.hessian(ours)(x)


def test_derivatives_of_the_period():
    x = np.array([MOMENT, 1.2, *SIZES, 0.9])
    _, gradient, hessian = period_and_derivatives(x)

    def along(f, i, j=None):
        h = mp.mpf(10) ** -12
        at = lambda d: [mp.mpf(v) + d * (n == i) for n, v in enumerate(x)]
        return (f(*at(h)) - f(*at(-h))) / (2 * h)

    with mp.workdps(50):
        first = [float(along(period, i)) for i in range(6)]
        by_swing = lambda *y: (
            (period(*y[:5], y[5] + mp.mpf(10) ** -12) - period(*y[:5], y[5] - mp.mpf(10) ** -12))
            / (2 * mp.mpf(10) ** -12)
        )
        second = [float(along(by_swing, i)) for i in range(6)]
    np.testing.assert_allclose(gradient, first, rtol=1e-12)
    np.testing.assert_allclose(hessian[5], second, rtol=1e-11)


def test_small_swings_are_an_ordinary_point():
    x = np.array([MOMENT, 1.2, *SIZES, 0.0])
    h = np.sqrt(SIZES[2] ** 2 - (SIZES[0] - SIZES[1]) ** 2)
    want = 2 * np.pi * np.sqrt(MOMENT * h / (1.2 * 9.81 * SIZES[0] * SIZES[1]))
    value, gradient, hessian = period_and_derivatives(x)
    np.testing.assert_allclose(value, want, rtol=1e-14)
    bend = (period_and_derivatives(x + 1e-3 * np.eye(6)[5])[0] - value) / 0.5e-6
    assert gradient[5] == 0
    np.testing.assert_allclose(hessian[5, 5], bend, rtol=1e-5)


def test_motion_beside_scipy_and_its_strings_keep_their_length():
    two = rj.suspensions.Strings(2, *SIZES, axis=[0.0, 0.0, 2.0], gravity=9.81)
    ts = np.linspace(0.0, 5.0, 11)

    def field(t, y):
        a, b, length = SIZES
        h = np.sqrt(length**2 - a**2 - b**2 + 2 * a * b * np.cos(y[0]))
        lift = -a * b * np.sin(y[0]) / h
        bend = (-a * b * np.cos(y[0]) - lift**2) / h
        pull = 1.2 * 9.81 * lift - 1.2 * lift * bend * y[1] ** 2
        return [y[1], pull / (MOMENT + 1.2 * lift**2)]

    want = scipy.integrate.solve_ivp(
        field, (0, 5), [1.4, 0.5], "DOP853", ts, rtol=1e-12, atol=1e-13
    )
    sol = rj.simulate(PLATE, rj.Turn(1.4, 0.5), ts, two, rtol=1e-11)
    np.testing.assert_allclose(sol.ys.angle, want.y[0], atol=1e-9)
    assert sol.drift["energy"] < 1e-10
    at_rest = [0.0, float(rj.suspensions.period(PLATE, two, 1.4))]
    assert rj.simulate(PLATE, rj.Turn(1.4, 0.0), at_rest, two).drift["energy"] < 1e-8
    turn = jax.tree.map(lambda leaf: leaf[3], sol.ys)
    pose = two.state(PLATE, turn)
    for sign in (1.0, -1.0):
        top = np.array([sign * SIZES[0], 0.0, 0.0])
        end = pose.x + rj.quaternion.rotate(pose.q, jnp.array([sign * SIZES[1], 0.0, 0.0]))
        np.testing.assert_allclose(np.linalg.norm(end - top), SIZES[2], rtol=1e-14)
    # The energy of the body as a `Rigid`, with gravity, is the suspension's.
    lifted = rj.energy(PLATE, pose, rj.torques.UniformGravity([0.0, 0.0, -9.81]))
    np.testing.assert_allclose(two.energy(PLATE, turn), lifted, rtol=1e-13)
    # Newton: the strings carry the weight and what lifts the body.
    h, pull = two.height(turn.angle), two.tension(PLATE, turn)
    z = lambda t: -rj.simulate(PLATE, turn, [0.0, t], two, rtol=1e-12).ys.angle[1]
    step = 1e-3
    back, ahead = (float(two.height(-z(t))) for t in (-step, step))
    np.testing.assert_allclose(
        2 * pull * h / SIZES[2], 1.2 * (9.81 - (ahead + back - 2 * h) / step**2), rtol=1e-5
    )


def test_slack_strings_and_strings_that_touch_are_said():
    short = rj.suspensions.Strings(2, 0.2, 0.2, 0.45)
    ts = jnp.linspace(0.0, 1.0, 101)
    with pytest.raises(ValueError, match=r"the strings go slack or touch at t = .* take a slower"):
        rj.simulate(PLATE, rj.Turn(0.0, 30.0), ts, short)
    for suspension, rate, slack in ((short, 30.0, True), (strings(*SIZES), 9.0, False)):
        sol = rj.simulate(PLATE, rj.Turn(0.0, rate), ts, suspension, throw=False)
        end, turn = float(sol.stats["end_time"]), sol.stats["end_state"]
        assert 0 < end < 1 and np.array_equal(np.isnan(sol.ys.angle), np.asarray(ts) > end)
        assert (float(suspension.tension(PLATE, turn)) <= 0) == slack
        assert (float(turn.angle) > np.pi) != slack
    with pytest.raises(ValueError, match="strings longer than"):
        rj.suspensions.Strings(2, 0.1, 0.5, 0.4)
    with pytest.raises(ValueError, match="length: wanted a positive number"):
        rj.suspensions.Strings(2, 0.1, 0.5, -0.4)


def test_energy_over_a_hundred_thousand_swings():
    bifilar = strings(*SIZES)
    swing = float(rj.suspensions.period(PLATE, bifilar, 0.5))
    # Not at the turning points alone: 101 times in 100 000 swings and a quarter.
    ts = np.linspace(0.0, (1e5 + 0.25) * swing, 101)
    equal = diffrax.ConstantStepSize()
    sol = rj.simulate(
        PLATE, rj.Turn(0.5, 0.0), ts, bifilar,
        dt0=swing / 160, stepsize_controller=equal, max_steps=20_000_000,
    )  # fmt: skip
    energies = np.asarray(jax.vmap(lambda y: bifilar.energy(PLATE, y))(sol.ys))
    of_swing = bifilar.potential(PLATE, 0.5) - bifilar.potential(PLATE, 0.0)
    # Round-off alone: 2e-11 of the swing's energy, 5e-14 of that below the ceiling.
    assert np.ptp(energies) < min(3e-11 * float(of_swing), 1e-11 * abs(energies[0]))
    # 3e5 rad of phase at the angle 0.5: 2e-7 rad is 6e-13 of the period.
    np.testing.assert_allclose(sol.ys.angle[-1], 0.0, atol=2e-7)
