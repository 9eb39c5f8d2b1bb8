"""A body on an axle beside 50 digits: any amplitude, over the top, on the separatrix."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.integrate

import rigidjax as rj

G = 9.8125
NAMES = ("inertia", "arm", "angle", "rate", "t")


def axle_and_body(x):
    zero = jnp.zeros_like(x[0])
    body = rj.MassProperties(
        jnp.asarray(1.5, x.dtype),
        jnp.stack([zero, zero, -x[1]]),
        jnp.diag(0.5 * x[0] + zero * x)[:3, :3],
    )
    down = jnp.asarray([0.0, 0.0, -G], x.dtype)
    return rj.suspensions.Axle(jnp.eye(3, dtype=x.dtype)[1], jnp.zeros(3, x.dtype), down), body


def ours(x):
    axle, body = axle_and_body(x)
    turn = axle.swing(body, rj.Turn(x[2], x[3]))(x[4])
    return jnp.stack([turn.angle, turn.rate])


FIRST = jax.jit(jax.vmap(jax.jacfwd(ours)))
SECOND = jax.jit(jax.vmap(jax.jacfwd(jax.jacrev(ours))))


def exact(x):
    """Angle and rate at the time t by Legendre's integrals and Jacobi's functions."""
    inertia, arm, angle, rate, t = map(mp.mpf, x)
    b = mp.mpf(1.5) * mp.mpf(G) * arm / (inertia + mp.mpf(1.5) * arm**2)
    w, s = rate / 2, mp.sin(angle / 2)
    p = w * w + b * s * s
    if p == 0:
        return angle, rate
    m = b / p
    if m > 1:
        k = mp.sqrt(1 / m)
        v = mp.ellipf(mp.atan2(s / k, w / mp.sqrt(p)), 1 / m) + mp.sqrt(b) * t
        v -= 4 * mp.ellipk(1 / m) * mp.nint(v / (4 * mp.ellipk(1 / m)))
        sn, cn, dn = (mp.ellipfun(name, v, m=1 / m) for name in ("sn", "cn", "dn"))
        return 2 * mp.atan2(k * sn, dn), 2 * mp.sqrt(p) * cn
    u = mp.ellipf(angle / 2, m) + mp.sign(w) * mp.sqrt(p) * t
    turns = mp.nint(u / (2 * mp.ellipk(m))) if m < 1 else 0
    u -= 2 * turns * mp.ellipk(m) if turns else 0
    if m == 1:
        phi, dn = mp.atan(mp.sinh(u)), 1 / mp.cosh(u)
    else:
        sn, cn, dn = (mp.ellipfun(name, u, m=m) for name in ("sn", "cn", "dn"))
        phi = mp.atan2(sn, cn)
    return 2 * (phi + turns * mp.pi), 2 * mp.sign(w) * mp.sqrt(p) * dn


def slope(f, x, i):
    """The derivative of f(x), a number, by x[i]."""
    h = mp.mpf(10) ** -20
    at = lambda d: f([v + (d if j == i else 0) for j, v in enumerate(x)])
    return (at(h) - at(-h)) / (2 * h)


def at_the_top(angle):
    """The rate that carries it from an angle just to the top."""
    return 2 * np.sqrt(1.5 * G * 0.375 / (0.25 + 1.5 * 0.375**2)) * np.cos(angle / 2)


STARTS = [(a, 0.0) for a in (1e-8, 1e-3, 1.0, 2.5, np.pi - 1e-3, np.pi - 1e-8)]
STARTS += [(0.3, -1.25), (-1.0, 30.0), (2.0, -9.0)]
STARTS += [
    (a, s * at_the_top(a) * f) for a, s, f in ((0.5, 1, 1.0), (-2.0, -1, 1.0), (1.0, 1, 1 + 1e-9))
]
CASES = np.array([(0.25, 0.375, *start, t) for start in STARTS for t in (0.3, 1.9)])


def rounded(cases, dtype):
    """The nearest numbers, but none beyond π."""
    cases = cases.astype(dtype)
    beyond = cases[:, 2].astype(float) > np.pi
    cases[beyond, 2] = np.nextafter(cases[beyond, 2], np.asarray(0, dtype))
    return cases


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_values_to_four_units_of_round_off(dtype):
    cases, eps = rounded(CASES, dtype), float(np.finfo(dtype).eps)
    found = np.asarray(jax.jit(jax.vmap(ours))(jnp.asarray(cases)))
    with mp.workdps(50):
        for x, numbers in zip(cases, found, strict=True):
            x = [mp.mpf(float(v)) for v in x]
            for i, number in enumerate(numbers):
                # What the result changes by if each input changes by a unit of round-off.
                moved = sum(
                    abs(slope(lambda y, i=i: exact(y)[i], x, j) * v) for j, v in enumerate(x)
                )
                off = abs(mp.mpf(float(number)) - exact(x)[i])
                assert off <= 4 * eps * (abs(exact(x)[i]) + moved), (x, i)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_first_derivatives_to_four_units_of_round_off(dtype):
    cases, eps = rounded(CASES[[0, 4, 10, 12, 15, 17, 18, 20]], dtype), float(np.finfo(dtype).eps)
    found = np.asarray(FIRST(jnp.asarray(cases)))
    with mp.workdps(80):
        for x, rows in zip(cases, found, strict=True):
            x = [mp.mpf(float(v)) for v in x]
            for i, j in np.ndindex(2, 5):
                by = lambda y, i=i, j=j: slope(lambda z: exact(z)[i], y, j)
                moved = sum(abs(slope(by, x, k) * x[k]) for k in range(5))
                off = abs(mp.mpf(float(rows[i, j])) - by(x))
                assert off <= 4 * eps * (abs(by(x)) + moved), (x, i, j)


def test_second_derivatives():
    cases = CASES[[1, 5, 8, 10, 12, 15, 18, 22]]
    found = np.asarray(SECOND(jnp.asarray(cases)))
    with mp.workdps(80):
        for x, all_of_them in zip(cases, found, strict=True):
            x = [mp.mpf(v) for v in x]
            for i, j, k in ((0, 1, 2), (0, 2, 3), (1, 0, 2), (1, 3, 3), (0, 1, 4)):
                by = lambda y, i=i, j=j: slope(lambda z: exact(z)[i], y, j)
                largest = np.abs(all_of_them[i]).max()
                assert abs(all_of_them[i, j, k] - slope(by, x, k)) <= 1e-11 * largest, (x, i, j, k)


def test_any_axis_point_and_gravity_beside_scipy():
    body = rj.shapes.box(2.0, [0.4, 0.9, 0.05]).shift([0.2, 0.4, 0.1])
    axis, point, g = (
        np.array([0.2, 0.3, -1.0]),
        np.array([0.1, -0.3, 0.2]),
        np.array([3.0, 5.0, -8.0]),
    )
    door = rj.suspensions.Axle(axis, point, g)
    unit, arm = axis / np.linalg.norm(axis), np.asarray(body.com) - point

    def turned(angle):
        side = np.cross(unit, arm)
        return (
            arm * np.cos(angle) + side * np.sin(angle) + unit * (unit @ arm) * (1 - np.cos(angle))
        )

    moment = unit @ np.asarray(body.inertia_about(point).tensor) @ unit
    field = lambda t, y: [y[1], 2.0 * unit @ np.cross(turned(y[0]), g) / moment]
    ts = np.linspace(0.0, 4.0, 9)
    want = scipy.integrate.solve_ivp(
        field, (0, 4), [0.7, 1.9], "DOP853", ts, rtol=1e-12, atol=1e-13
    )
    start = rj.Turn(0.7, 1.9)
    closed = rj.simulate(body, start, ts, door)
    steps = rj.simulate(body, start, ts, door, solver=rj.solvers.DormandPrince8(), rtol=1e-12)
    for sol in (closed, steps):
        np.testing.assert_allclose(sol.ys.angle, want.y[0], atol=3e-10)
        np.testing.assert_allclose(sol.ys.rate, want.y[1], atol=3e-10)
        assert sol.drift["energy"] < 1e-11
    assert int(closed.stats["num_steps"]) == 0 < int(steps.stats["num_steps"])
    pose = door.state(body, jax.tree.map(lambda leaf: leaf[3], closed.ys))
    np.testing.assert_allclose(pose.x, point + turned(want.y[0, 3]), atol=1e-9)
    np.testing.assert_allclose(pose.v, np.cross(unit * want.y[1, 3], pose.x - point), atol=1e-9)
    np.testing.assert_allclose(rj.kinetic_energy(body, pose), 0.5 * moment * want.y[1, 3] ** 2)


def test_it_is_the_top_that_turns_about_the_same_axis():
    """`HeavyTop` on an `Attitude` moves in the same plane."""
    body = rj.shapes.box(0.3, [0.02, 0.02, 0.6]).shift([0.0, 0.0, -0.3])
    ts = np.linspace(0.0, 2.0, 5)
    top = rj.torques.HeavyTop(0.3, body.com, [0.0, 0.0, -9.80665])
    start = rj.Attitude(rj.quaternion.exp(jnp.array([0.0, 2.0, 0.0])), [0.0, 0.5, 0.0])
    want = rj.simulate(body.inertia_about(jnp.zeros(3)), start, ts, top, rtol=1e-11).ys
    axle = rj.suspensions.Axle([0.0, 3.0, 0.0], [0.0, 7.0, 0.0])
    got = rj.simulate(body, rj.Turn(2.0, 0.5), ts, axle).ys
    np.testing.assert_allclose(got.rate, want.omega[:, 1], atol=1e-8)


T = 1.3
REST = np.array([(0.375, 0.0, 0.0), (0.375, np.pi, 0.0), (0.0, 0.4, 2.0), (0.0, 0.4, 0.0)])
AT_REST = np.array([(0.25, *row, T) for row in (*REST, *REST)])


def test_rest_the_top_and_an_axle_that_gravity_does_not_turn():
    values, first = jax.jit(jax.vmap(ours))(AT_REST), FIRST(AT_REST)[:, :, 1:4]
    for (arm, angle, rate), end, rows in zip(REST, values, first, strict=False):
        if arm == 0:
            # To first order in the arm: γ'' = −k sin(γ₀ + rate t).
            k = 1.5 * G / 0.25
            way = scipy.integrate.quad(
                lambda s, a=angle, r=rate: -(T - s) * k * np.sin(a + r * s), 0, T
            )[0]
            np.testing.assert_allclose(end, [angle + rate * T, rate], rtol=1e-15)
            np.testing.assert_allclose(rows[0], [way, 1.0, T], rtol=1e-12)
            continue
        nu = np.sqrt(1.5 * G * 0.375 / (0.25 + 1.5 * 0.375**2)) * (1 if angle == 0 else 1j)
        c, s = np.cos(nu * T).real, (np.sin(nu * T) / nu).real
        np.testing.assert_allclose(end, [angle, 0.0], atol=1e-13)
        np.testing.assert_allclose(rows[:, 1:], [[c, s], [-((nu * nu).real) * s, c]], rtol=1e-11)


@pytest.mark.long
def test_second_derivatives_at_rest_and_at_the_top_are_finite():
    assert np.all(np.isfinite(SECOND(AT_REST)))


def test_long_after_the_separatrix_it_stands_at_the_top():
    axle, body = axle_and_body(jnp.array([0.25, 0.375, 0.0, 0.0, 0.0]))
    start = rj.Turn(0.0, at_the_top(0.0))
    late = jax.jit(lambda t: axle.swing(body, start)(t))(jnp.asarray(6.0))
    assert abs(float(late.angle) - np.pi) < 1e-3 and np.isfinite(float(late.rate))
    still = axle.swing(body, rj.Turn(np.pi, 0.0))(jnp.array([1.0, 1e3, 1e9]))
    np.testing.assert_allclose(still.rate[0], 0.0, atol=1e-13)
    assert np.all(np.isfinite(still.angle))


def test_events_and_crossings():
    axle, body = axle_and_body(jnp.array([0.25, 0.375, 0.0, 0.0, 0.0]))
    level = lambda t, state, body: state.angle
    quarter = rj.suspensions.period(body, axle, 3.0) / 4
    sol = rj.simulate(body, rj.Turn(3.0, 0.0), [0.0, 9.0], axle, event=level)
    np.testing.assert_allclose(sol.event_time, quarter, rtol=1e-14)
    found = rj.crossings(body, rj.Turn(3.0, 0.0), 0.0, 9.0, level, axle, max_crossings=4)
    np.testing.assert_allclose(found.times[:3], quarter * np.array([1.0, 3.0, 5.0]), rtol=1e-14)


def test_period_beside_quadrature():
    def of(x):
        axle, body = axle_and_body(x)
        return rj.suspensions.period(body, axle, x[2])

    x, hessian = np.array([0.25, 0.375, 2.9]), jax.jit(jax.hessian(of))

    def want(x):
        inertia, arm, a = x
        b = mp.mpf(1.5) * mp.mpf(G) * arm / (inertia + mp.mpf(1.5) * arm**2)
        k = mp.sin(a / 2)
        return (
            4
            / mp.sqrt(b)
            * mp.quad(lambda f: 1 / mp.sqrt(1 - (k * mp.sin(f)) ** 2), [0, mp.pi / 2])
        )

    with mp.workdps(90):
        x_mp = [mp.mpf(v) for v in x]
        np.testing.assert_allclose(float(of(jnp.array(x))), float(want(x_mp)), rtol=1e-13)
        first = [float(slope(want, x_mp, i)) for i in range(3)]
        np.testing.assert_allclose(jax.jit(jax.grad(of))(jnp.array(x)), first, rtol=1e-12)
        second = [float(slope(lambda y: slope(want, y, 2), x_mp, i)) for i in range(3)]
        np.testing.assert_allclose(hessian(jnp.array(x))[2], second, rtol=1e-11)
    small = jnp.array([0.25, 0.375, 0.0])
    bend = float(of(small)) / 8  # T = T₀ (1 + α²/16 + …)
    np.testing.assert_allclose(jax.grad(of)(small)[2], 0.0)
    np.testing.assert_allclose(hessian(small)[2, 2], bend, rtol=1e-13)
    with pytest.raises(ValueError, match="amplitude: wanted an angle below π"):
        rj.suspensions.period(axle_and_body(small)[1], axle_and_body(small)[0], 3.2)


def test_friction_and_torques_of_ones_own_beside_scipy():
    body = rj.shapes.box(0.3, [0.02, 0.02, 0.6]).shift([0.0, 0.0, -0.3])
    drag, ts = rj.suspensions.Friction(0.01, 0.02, 0.03, 0.5), np.linspace(0.0, 3.0, 7)
    push = lambda t, state, body: jnp.stack([0.0 * t, 0.1 * jnp.sin(3 * t), 7.0 + 0.0 * t])
    wind = rj.torques.UniformGravity([0.5, 0.0, 0.0])
    axle = rj.suspensions.Axle(
        [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], friction=drag, torque=rj.torques.Sum(push, wind)
    )
    moment = float(body.inertia_about(jnp.zeros(3)).tensor[1, 1])

    def field(t, y):
        loss = -(0.01 + 0.02 * abs(y[1])) * y[1] - 0.03 * np.tanh(y[1] / 0.5)
        sway = -0.3 * 0.5 * 0.3 * np.cos(y[0]) + 0.1 * np.sin(3 * t)
        return [y[1], (loss + sway - 0.3 * 9.80665 * 0.3 * np.sin(y[0])) / moment]

    want = scipy.integrate.solve_ivp(
        field, (0, 3), [1.0, 0.0], "DOP853", ts, rtol=1e-12, atol=1e-13
    )
    sol = rj.simulate(body, rj.Turn(1.0, 0.0), ts, axle, rtol=1e-11)
    np.testing.assert_allclose(sol.ys.angle, want.y[0], atol=1e-8)
    assert sol.drift == {} and rj.conserved(body, rj.Turn(1.0, 0.0), axle) == {}


def test_what_does_not_fit_is_said():
    body = rj.shapes.box(0.3, [0.02, 0.02, 0.6])
    axle = rj.suspensions.Axle([0.0, 1.0, 0.0], [0.0, 0.0, 0.3])
    start = rj.Turn(1.0, 0.0)
    with pytest.raises(TypeError, match="a Turn and a suspension go together"):
        rj.simulate(body, start, [0.0, 1.0])
    with pytest.raises(TypeError, match="got Spin and Axle"):
        rj.simulate(body.inertia, rj.Spin([0.0, 0, 1]), [0.0, 1.0], axle)
    with pytest.raises(TypeError, match="wanted MassProperties, got Inertia"):
        rj.simulate(body.inertia, start, [0.0, 1.0], axle)
    wheels = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0])
    with pytest.raises(ValueError, match="states of its own"):
        rj.suspensions.Axle([0.0, 1.0, 0.0], [0.0, 0.0, 0.3], torque=wheels)
    with pytest.raises(ValueError, match="state0"):
        rj.simulate(body, rj.Turn([1.0, 2.0], [0.0, 0.0]), [0.0, 1.0], axle)
