"""Scenes with a solution in closed form: values and gradients of the equations, without a solver.

Each scene is marched by the plainest Runge–Kutta in `marching.py`; its formula is written apart from
the library, in NumPy or in many digits, and its gradients are differences of that formula.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from systems import tops_mp
from systems.marching import rk4

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def turn(axis, angle):
    """Quaternion of a turn by an angle, in NumPy."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


def product(p, q):
    a, u, b, v = p[0], p[1:], q[0], q[1:]
    return np.concatenate([[a * b - u @ v], a * v + b * u + np.cross(u, v)])


def check(run, formula, at, rtol):
    """Value and all first derivatives of `run` against a NumPy formula, differenced."""
    at = np.asarray(at, float)
    value, gradient = once(lambda x: (run(x), jax.jacfwd(run)(x)))(jnp.asarray(at))
    wanted = np.asarray(formula(at))
    np.testing.assert_allclose(value, wanted, rtol=rtol, atol=rtol * np.abs(wanted).max())
    # Six points: the difference is good to 1e-11.
    h, columns = 2e-3, []
    for i in range(at.size):
        e = h * np.eye(at.size)[i]
        f = [np.asarray(formula(at + k * e)) for k in (-3, -2, -1, 1, 2, 3)]
        columns.append((45 * (f[3] - f[2]) - 9 * (f[4] - f[1]) + (f[5] - f[0])) / (60 * h))
    wanted = np.stack(columns, axis=-1)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_a_damped_sphere_slows_exponentially():
    axis = np.array([1.0, -2.0, 2.0]) / 3

    def run(p):
        moment, c, speed = p
        body = rj.Inertia(moment * jnp.eye(3))
        field = AttitudeEquations(body, torques.Damping(c * jnp.ones(3)))
        end = rk4(field, rj.Attitude(IDENTITY, speed * axis), 2.0, 800)
        return jnp.concatenate([end.q, end.omega])

    def formula(p):
        moment, c, speed = p
        angle = speed * moment / c * -np.expm1(-c * 2.0 / moment)
        return np.concatenate([turn(axis, angle), speed * axis * np.exp(-c * 2.0 / moment)])

    check(run, formula, [0.7, 0.3, 1.5], 1e-12)


def test_quadratic_damping_slows_as_one_over_time():
    def run(p):
        moment, c, speed = p
        body = rj.Inertia(jnp.diag(jnp.stack([2.0 + 0 * moment, moment, 1.5 + 0 * moment])))
        law = torques.QuadraticDamping(jnp.stack([0.2 + 0 * c, c, 0.1 + 0 * c]))
        start = rj.Attitude(IDENTITY, speed * np.array([0.0, 1.0, 0.0]))
        end = rk4(AttitudeEquations(body, law), start, 2.0, 800)
        return jnp.concatenate([end.q, end.omega])

    def formula(p):
        moment, c, speed = p
        rate = speed / (1 + c * speed * 2.0 / moment)
        angle = moment / c * np.log1p(c * speed * 2.0 / moment)
        return np.concatenate([turn([0, 1.0, 0], angle), [0, rate, 0]])

    check(run, formula, [1.2, 0.4, 1.5], 1e-12)


def test_a_symmetric_body_spun_up_about_its_axis():
    # Ω3 = Ω30 + N t/I3; Ω1 + iΩ2 turns by λ ∫Ω3 dt, λ = (I3 − I1)/I1.
    def run(p):
        i1, i3, push, a, b, c = p
        body = rj.Inertia(jnp.diag(jnp.stack([i1, i1, i3])))
        law = torques.ConstantTorque(push * np.array([0.0, 0, 1]))
        return rk4(EulerEquations(body, law), rj.Spin(jnp.stack([a, b, c])), 2.0, 1500).omega

    def formula(p):
        i1, i3, push, a, b, c = p
        angle = (i3 - i1) / i1 * (c * 2.0 + push * 2.0 / i3)
        across = (a + 1j * b) * np.exp(1j * angle)
        return np.array([across.real, across.imag, c + push * 2.0 / i3])

    check(run, formula, [1.0, 1.6, 0.7, 0.3, -0.5, 0.9], 1e-12)


@pytest.mark.parametrize("kind", [torques.Pulses, torques.Tabulated])
def test_a_schedule_is_data(kind):
    """Marched from jump to jump, the impulse and its slope by rows and by times are right."""
    body = rj.Inertia.from_principal(1.0, 1.3, 1.6)
    axis = np.array([0.0, 1.0, 0.0])

    def run(p):
        times, values = p[:4], p[4:]
        rows = (values[:3] if kind is torques.Pulses else values)[:, None] * axis[None, :]
        law = kind(times, rows)
        field = EulerEquations(body, law)
        y = rj.Spin(0.2 * axis)
        for left, right in zip(law.jump_times[:-1], law.jump_times[1:], strict=True):
            # A hair before its end, so that the last stage does not see the next piece.
            inside = 1 - 1e-13
            y = rk4(lambda t, y, _, left=left: field(left + inside * t, y), y, right - left, 8)
        return y.omega

    def formula(p):
        times, values = p[:4], p[4:]
        mean = values[:3] if kind is torques.Pulses else (values[1:] + values[:-1]) / 2
        return axis * (0.2 + np.diff(times) @ mean / 1.3)

    check(run, formula, [0.3, 0.8, 1.1, 2.0, 0.4, -0.3, 0.8, 0.5], 1e-12)


def test_a_sphere_with_a_wheel():
    # L = R (IΩ + h) is fixed in space, h in the body: R(t) = exp(t L/I) exp(−t h/I).
    def run(p):
        moment, h, omega = p[0], p[1:4], p[4:7]
        field = AttitudeEquations(rj.Inertia(moment * jnp.eye(3)), torques.Flywheel(h))
        end = rk4(field, rj.Attitude(IDENTITY, omega), 2.0, 2000)
        return jnp.concatenate([end.q, end.omega])

    def formula(p):
        moment, h, omega = p[0], p[1:4], p[4:7]
        whole = moment * omega + h
        back = turn(h, -2.0 * np.linalg.norm(h) / moment)
        q = product(turn(whole, 2.0 * np.linalg.norm(whole) / moment), back)
        inverse = q * np.array([1, -1, -1, -1])
        seen = product(product(inverse, np.concatenate([[0], whole])), q)[1:]
        return np.concatenate([q, (seen - h) / moment])

    check(run, formula, [0.8, 0.3, -0.6, 0.5, 0.4, 0.9, -0.2], 1e-12)


class Ramp(eqx.Module):
    """Momentum about one axis, growing as a t + b t²."""

    a: jax.Array
    b: jax.Array

    def __call__(self, t):
        return jnp.array([0.0, 0.0, 1.0]) * (self.a * t + self.b * t**2)


def test_a_wheel_spun_up_turns_the_body_back():
    def run(p):
        moment, a, b = p
        body = rj.Inertia(jnp.diag(jnp.stack([1.0 + 0 * moment, 1.0 + 0 * moment, moment])))
        field = AttitudeEquations(body, torques.Flywheel(Ramp(a, b)))
        end = rk4(field, rj.Attitude(IDENTITY, np.zeros(3)), 1.5, 1000)
        return jnp.concatenate([end.q, end.omega])

    def formula(p):
        moment, a, b = p
        rate = -(a * 1.5 + b * 2.25) / moment
        angle = -(a * 1.125 + b * 1.125) / moment
        return np.concatenate([turn([0, 0, 1.0], angle), [0, 0, rate]])

    check(run, formula, [1.3, 0.4, -0.9], 1e-12)


SWINGS = {
    # A top hanging from its pivot, a compass needle, a dumbbell in the gradient of a far mass: each
    # swings as x'' = −rate2 sin x about the first axis (x twice the angle for the dumbbell).
    "pendulum": (lambda k: torques.HeavyTop(0.5, [0.0, 0.0, -2.0 * k], [0.0, 0.0, -9.81]), 9.81, 1),
    "compass": (lambda k: torques.MagneticDipole(k * np.array([0.0, 0.0, 3.0]), [0.0, 0.0, 2.0]), 6.0, 1),
    "gradient": (lambda k: torques.GravityGradient(8.0 * k, [0.0, 0.0, 2.0]), 3 * (2.0 - 1.1), 2),
    "spring": (lambda k: torques.FromPotential(_Compass(k)), 6.0, 1),
}  # fmt: skip


class _Compass(eqx.Module):
    k: jax.Array

    def __call__(self, q):
        return -6.0 * self.k * (q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2)


@pytest.mark.parametrize("name", list(SWINGS))
def test_swings_against_elliptic_functions(name):
    make, strength, fold = SWINGS[name]
    moment = 1.7
    body = rj.Inertia.from_principal(moment, 2.0, 1.1)

    def run(p):
        start, k = p
        law, half = make(k), 0.5 * start / fold
        q = jnp.stack([jnp.cos(half), jnp.sin(half), 0 * half, 0 * half])
        end = rk4(AttitudeEquations(body, law), rj.Attitude(q, np.zeros(3)), 1.3, 1500)
        return 2 * fold * jnp.arctan2(end.q[1], end.q[0])

    value, slope = once(lambda p: (run(p), jax.jacfwd(run)(p)))(jnp.array([2.0, 1.0]))

    def exact(start, k):
        return tops_mp.pendulum(strength * k / moment, start, 1.3)

    wanted = float(exact(2.0, 1.0))
    np.testing.assert_allclose(value, wanted, atol=1e-11)
    slopes = [
        tops_mp.derivative(lambda x: exact(x, 1), 2.0),
        tops_mp.derivative(lambda k: exact(2.0, k), 1.0),
    ]
    np.testing.assert_allclose(slope, np.array([float(s) for s in slopes]), rtol=1e-9)


def test_a_body_thrown_and_dropped():
    body = rj.MassProperties(2.0, np.zeros(3), np.diag([1.0, 0.9, 0.8]))
    start = rj.Rigid([0.0, 1, 2], [3.0, 0, 4], IDENTITY, [0.2, 0.4, 0.1])
    fall = torques.UniformGravity([0.0, 0.0, -9.81])
    thrown = jax.jit(lambda y: rk4(NewtonEuler(body, fall), y, 1.5, 500))(start)
    np.testing.assert_allclose(thrown.x, [4.5, 1.0, 2 + 6 - 9.81 * 1.125], rtol=1e-12)
    turned = rk4(AttitudeEquations(body.inertia), rj.Attitude(IDENTITY, start.omega), 1.5, 500)
    np.testing.assert_allclose(thrown.q, turned.q, rtol=1e-13)

    # Dropped in air: v = −v∞ tanh(g t/v∞), v∞² = m g/k.
    def run(p):
        law = torques.Sum(fall, torques.Drag(p[0]))
        at_rest = rj.Rigid(np.zeros(3), np.zeros(3), IDENTITY, np.zeros(3))
        end = rk4(NewtonEuler(body, law), at_rest, 1.5, 3000)
        return jnp.stack([end.x[2], end.v[2]])

    def formula(p):
        top = np.sqrt(2.0 * 9.81 / p[0])
        return np.array([-(top**2) / 9.81 * np.log(np.cosh(9.81 * 1.5 / top)), -top * np.tanh(9.81 * 1.5 / top)])  # fmt: skip

    check(run, formula, [0.4], 1e-12)


def test_a_sphere_on_a_circular_orbit():
    body = rj.MassProperties(2.0, np.zeros(3), 0.3 * np.eye(3))
    rate = np.sqrt(5.0 / 1.5**3)
    start = rj.Rigid([1.5, 0, 0], [0.0, 1.5 * rate, 0], IDENTITY, [0.0, 0, 0.7])
    field = NewtonEuler(body, torques.CentralGravity(5.0))
    end = jax.jit(lambda y: rk4(field, y, 2.0, 2000))(start)
    wanted = 1.5 * np.array([np.cos(2 * rate), np.sin(2 * rate), 0.0])
    np.testing.assert_allclose(end.x, wanted, atol=1e-11)
    np.testing.assert_allclose(end.q, turn([0, 0, 1.0], 1.4), atol=1e-12)


class Circle(eqx.Module):
    """A circular orbit in the x–y plane."""

    radius: float
    rate: float

    def __call__(self, t):
        angle = self.rate * t
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])


def test_a_satellite_librates_about_the_vertical():
    # In the plane, with the local vertical turning at n: x'' = −3n² (I2 − I1)/I3 · ½ sin 2x.
    rate = np.sqrt(5.0 / 1.5**3)
    body = rj.Inertia.from_principal(1.0, 1.8, 2.2)
    law = torques.GravityGradient(5.0, Circle(1.5, float(rate)))
    start = rj.Attitude(turn([0, 0, 1.0], 0.6), [0.0, 0, rate])
    end = jax.jit(lambda y: rk4(AttitudeEquations(body, law), y, 1.5, 2000))(start)
    angle = 2 * np.arctan2(float(end.q[3]), float(end.q[0])) - 1.5 * rate
    wanted = 0.5 * float(tops_mp.pendulum(3 * rate**2 * 0.8 / 2.2, 1.2, 1.5))
    np.testing.assert_allclose(angle, wanted, atol=1e-11)


def test_kovalevskaya_and_goryachev_chaplygin_integrals():
    """Two tops that have a fourth integral: its derivative along the equations is zero."""
    rng = np.random.default_rng(3)
    weight = 2.0 * 0.4 * 9.81
    law = torques.HeavyTop(2.0, [0.4, 0.0, 0.0], [0.0, 0.0, -9.81])

    def kovalevskaya(y):
        w, up = y.omega, rj.quaternion.rotate_inverse(y.q, jnp.array([0.0, 0.0, 1.0]))
        # I = C (2, 2, 1): |(Ω1 + iΩ2)² − (weight/C)(γ1 + iγ2)|².
        real = w[0] ** 2 - w[1] ** 2 - weight / 0.9 * up[0]
        return real**2 + (2 * w[0] * w[1] - weight / 0.9 * up[1]) ** 2

    def goryachev_chaplygin(y):
        w, up = y.omega, rj.quaternion.rotate_inverse(y.q, jnp.array([0.0, 0.0, 1.0]))
        # I = C (4, 4, 1), on the level where the momentum along the vertical is zero.
        return w[2] * (w[0] ** 2 + w[1] ** 2) - weight / 0.9 * w[0] * up[2]

    for moments, integral, level in (
        ((1.8, 1.8, 0.9), kovalevskaya, False),
        ((3.6, 3.6, 0.9), goryachev_chaplygin, True),
    ):
        inertia = rj.Inertia(jnp.diag(jnp.array(moments)))
        field = AttitudeEquations(inertia, law)
        q, w = rng.normal(size=4), rng.normal(size=3)
        q = q / np.linalg.norm(q)
        if level:
            up = np.asarray(rj.quaternion.rotate_inverse(jnp.asarray(q), jnp.array([0.0, 0, 1])))
            momentum = np.array(moments) * w
            w = (momentum - (momentum @ up) * up) / moments
        y = rj.Attitude(q, w)
        value, rate = jax.jvp(integral, (y,), (field(0.0, y),))
        assert abs(float(rate)) < 1e-12 * abs(float(value)) + 1e-12


@pytest.mark.parametrize(
    ("theta", "rates"),
    [
        (0.7, (0.4, 0.3, 5.0)),
        pytest.param(2.0, (-0.8, -0.5, 1.0), marks=pytest.mark.slow),
    ],
)
def test_lagrange_top_against_quadrature(theta, rates):
    i1, i3, weight, t = 1.3, 0.9, 2.0 * 0.5 * 9.81, 1.5
    law = torques.HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])

    def run(p):
        body = rj.Inertia(jnp.diag(jnp.stack([i1 + 0 * p[0], i1 + 0 * p[0], i3 + 0 * p[0]])))
        start = rj.lagrangian.Coordinates(
            jnp.stack([0 * p[0], p[0], 0 * p[0]]), jnp.stack([p[1], p[2], p[3]])
        )
        attitude = rj.lagrangian.to_attitude(start)
        end = rk4(AttitudeEquations(body, law), attitude, t, 3000)
        return 1 - 2 * (end.q[1] ** 2 + end.q[2] ** 2), end

    at = jnp.array([theta, *rates])
    (value, end), slope = once(lambda p: (run(p), jax.jacfwd(lambda x: run(x)[0])(p)))(at)

    phi, tilt, psi = (float(a) for a in tops_mp.lagrange_top(i1, i3, weight, theta, rates, t))
    np.testing.assert_allclose(value, np.cos(tilt), atol=1e-11)
    q = product(product(turn([0, 0, 1.0], phi), turn([1.0, 0, 0], tilt)), turn([0, 0, 1.0], psi))
    np.testing.assert_allclose(abs(np.asarray(end.q) @ q), 1.0, atol=1e-13)
    np.testing.assert_allclose(np.abs(end.q), np.abs(q), atol=1e-11)

    def along(i):
        def cosine(x):
            theta, *rates = [*at[:i].tolist(), x, *at[i + 1 :].tolist()]
            return tops_mp.lagrange_cosine(i1, i3, weight, theta, rates, t)

        return cosine

    wanted = [float(tops_mp.derivative(along(i), float(at[i]))) for i in range(4)]
    np.testing.assert_allclose(slope, wanted, rtol=1e-8, atol=1e-9)
