"""Transport between frames, the fictitious terms one by one, and motion solved inside."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from once import once

import rigidjax as rj
from rigidjax.frames import AboutAxis, BodyInFrame, Force, MovingFrame, Point, Uniform
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.frames.frame_kinematics import Instant
from rigidjax.motion.equations import EulerEquations

TIGHT = dict(rtol=1e-13, atol=1e-14)


class Wobble(eqx.Module):
    """Any smooth turn: two rotation vectors that swing, multiplied."""

    n: jax.Array

    def __call__(self, t):
        a, b, c, d = self.n[:3], self.n[3:6], self.n[6:9], self.n[9:12]
        one = rj.so3.exp(a + b * jnp.sin(t))
        return rj.so3.product(one, rj.so3.exp(c * t + d * jnp.cos(2 * t)))


class Path(eqx.Module):
    """Any smooth way of the origin."""

    n: jax.Array

    def __call__(self, t):
        return self.n[:3] + self.n[3:6] * t**2 + self.n[6:9] * jnp.sin(3 * t)


def wobbly(numbers):
    return MovingFrame(Wobble(numbers[:12]), Path(numbers[12:21]))


NUMBERS = np.random.default_rng(5).normal(size=(40,))
lists = st.lists(st.floats(-2, 2), min_size=31, max_size=31)


@once
def kinematics(numbers, t):
    """x(t) and its derivatives, of x'(t) = a + bt + ct² put through the frame, both ways."""
    frame, (a, b, c) = wobbly(numbers), numbers[21:30].reshape(3, 3)

    def inside(s):
        return a + b * s + c * s**2

    def outside(s):
        return Path(numbers[12:21])(s) + Wobble(numbers[:12])(s) @ inside(s)

    def derivatives(f):
        one = jnp.ones(())
        first = lambda s: jax.jvp(f, (s,), (one,))[1]
        return f(t), first(t), jax.jvp(first, (t,), (one,))[1]

    x, v, acc = derivatives(inside)
    found = frame.to_inertial(Point(x, v), t)
    back = frame.from_inertial(found, t)
    pushed = frame.acceleration_to_inertial(x, v, acc, t)
    # Newton's law in S' from the force in S: the same number as x'' itself.
    seen = frame.acceleration(x, v, t, frame.force_from_inertial(derivatives(outside)[2], t))
    return derivatives(outside), (found.x, found.v, pushed), (x, v, acc), (back.x, back.v, seen)


@given(lists)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_position_velocity_acceleration_both_ways(numbers):
    # Eqs 85–91: the formulas against the derivatives of the composed motion.
    outside, found, inside, back = kinematics(jnp.asarray(numbers[:30]), jnp.asarray(numbers[30]))
    for one, other in zip(outside + inside, found + back, strict=True):
        scale = 1 + max(float(jnp.abs(part).max()) for part in outside)
        np.testing.assert_allclose(one, other, rtol=0, atol=3e-14 * scale)


def test_eq_91_as_printed_is_wrong():
    # A free particle at rest at x = (1, 0, 0) seen from a frame turning about z at 2 rad/s goes
    # round a circle: x'' = −4 x'. The notes print one more x'' in the bracket of eq 91.
    rate, x = jnp.array([0.0, 0, 2]), jnp.array([1.0, 0, 0])
    v = -jnp.cross(rate, x)
    bracket = jnp.cross(rate, jnp.cross(rate, x)) + 2 * jnp.cross(rate, v)
    true = -4 * x
    np.testing.assert_allclose(-bracket, true)
    printed = -bracket / 2  # x'' = −(bracket + x'') solved for x''
    assert float(jnp.abs(printed - true).max()) == 2.0
    np.testing.assert_allclose(MovingFrame(Uniform(rate)).acceleration(x, v, 0.0), true)


def test_each_term_alone():
    zero, x, v = np.zeros(3), np.array([2.0, 0, 0]), np.array([0.0, 3, 0])
    uniform, t = MovingFrame(Uniform([0.0, 0, 5])), 0.7
    # Only centrifugal: at rest in a uniform frame. Outward, Ω²r.
    np.testing.assert_allclose(uniform.acceleration(x, zero, t), [50.0, 0, 0], atol=1e-13)
    np.testing.assert_allclose(uniform.centrifugal(x, t), [50.0, 0, 0], atol=1e-13)
    # Only Coriolis: at the axis of a uniform frame. To the right, 2Ωv.
    np.testing.assert_allclose(uniform.acceleration(zero, v, t), [30.0, 0, 0], atol=1e-13)
    np.testing.assert_allclose(uniform.coriolis(v, t), [30.0, 0, 0], atol=1e-13)
    # Only Euler: at the moment when a frame starts to turn. Backwards, dΩ/dt r.
    starting = MovingFrame(AboutAxis([0.0, 0, 1], lambda s: 2 * s**2))
    np.testing.assert_allclose(starting.acceleration(x, v, 0.0), [0.0, -8, 0], atol=1e-13)
    np.testing.assert_allclose(starting.euler_acceleration(x, 0.0), [0.0, -8, 0], atol=1e-13)
    # Only the origin: a lift that falls freely takes gravity away.
    lift = MovingFrame(lambda s: jnp.eye(3), lambda s: jnp.array([0.0, 0, -4.905]) * s**2)
    gravity = jnp.array([0.0, 0, -9.81])
    np.testing.assert_allclose(lift.acceleration(x, v, t, gravity), zero, atol=1e-13)
    for other in (uniform.euler_acceleration(x, t), starting.centrifugal(x, 0.0)):
        np.testing.assert_array_equal(other, zero)


def test_the_four_terms_add_up():
    frame, t = wobbly(NUMBERS), 0.6
    x, v = NUMBERS[21:24], NUMBERS[24:27]
    parts = frame.centrifugal(x, t) + frame.coriolis(v, t) + frame.euler_acceleration(x, t)
    np.testing.assert_allclose(
        frame.acceleration(x, v, t), parts + frame.translational_acceleration(t), rtol=1e-13
    )


class Pull(eqx.Module):
    """A force in S that depends on place, velocity and time."""

    k: jax.Array

    def __call__(self, t, state, body=None):
        return -self.k * state.x - 0.1 * state.v + jnp.sin(t) * jnp.ones(3)


@pytest.mark.parametrize("seed", [0, 1])
def test_inside_equals_outside(seed):
    numbers = jnp.asarray(np.random.default_rng(seed).normal(size=21))
    frame, pull = wobbly(numbers), Pull(jnp.array([1.0, 2, 3]))
    start, ts = Point([1.0, 0.5, -0.3], [0.2, 0, 1]), jnp.linspace(0.0, 3.0, 13)
    outside = rj.simulate(None, start, ts, pull, **TIGHT).ys
    first = frame.from_inertial(start, 0.0)
    inside = rj.simulate(None, first, ts, InFrame(frame, outside=pull), **TIGHT).ys
    moved = jax.jit(jax.vmap(frame.to_inertial))(inside, ts)
    for name in ("x", "v"):
        found, wanted = getattr(moved, name), getattr(outside, name)
        np.testing.assert_allclose(found[-1], wanted[-1], rtol=0, atol=1e-11)
        # Between steps it is the dense output of the solver, not its steps, that limits.
        np.testing.assert_allclose(found, wanted, rtol=0, atol=3e-10)


def test_gradient_with_the_rate_against_fifty_digits():
    x0, v0, late, rate = [1.0, 0.5, -0.3], [0.2, 0.0, 1.0], 3.0, 0.7

    def exact(w):
        # Free in S from x'(0), v'(0) at M(0) = 1: v = v' + w × x'. Then turned back by w late.
        v = [v0[0] - w * x0[1], v0[1] + w * x0[0]]
        x, y = x0[0] + v[0] * late, x0[1] + v[1] * late
        c, s = mp.cos(w * late), mp.sin(w * late)
        return c * x + s * y

    def end(w, adjoint):
        frame = MovingFrame(Uniform(jnp.stack([0 * w, 0 * w, w])))
        ys = rj.simulate(None, Point(x0, v0), [0.0, late], frame, adjoint=adjoint, **TIGHT).ys
        return ys.x[-1, 0]

    with mp.workdps(50):
        wanted = float(mp.diff(exact, mp.mpf(rate)))
        value = float(exact(mp.mpf(rate)))
    forward = dfx.ForwardMode()
    for both in (
        jax.value_and_grad(lambda w: end(w, None)),
        lambda w: jax.jvp(lambda w: end(w, forward), (w,), (1.0,)),
    ):
        found, slope = once(both)(rate)
        assert abs(float(found) - value) < 1e-12
        assert abs(float(slope) - wanted) < 1e-11 * abs(wanted)


def test_composition_and_inverse():
    outer, inner, t = wobbly(NUMBERS), wobbly(-0.7 * NUMBERS[::-1]), 0.4
    state = Point(NUMBERS[21:24], NUMBERS[24:27])
    step = outer.to_inertial(inner.to_inertial(state, t), t)
    both = outer.compose(inner)
    for name in ("x", "v"):
        whole = getattr(both.to_inertial(state, t), name)
        np.testing.assert_allclose(whole, getattr(step, name), rtol=0, atol=1e-12)
        back = getattr(outer.inverse().to_inertial(outer.to_inertial(state, t), t), name)
        np.testing.assert_allclose(back, getattr(state, name), rtol=0, atol=1e-12)
    nothing = outer.compose(outer.inverse()).at(t)
    np.testing.assert_allclose(nothing.rotation, np.eye(3), atol=1e-14)
    for part in jax.tree.leaves(nothing)[1:]:
        np.testing.assert_allclose(part, np.zeros(3), atol=1e-12)
    # The given rate of a composed frame is that of its matrix.
    plain = MovingFrame(both.matrix).at(t)
    np.testing.assert_allclose(plain.rate, both.at(t).rate, atol=1e-13)
    np.testing.assert_allclose(plain.rate_change, both.at(t).rate_change, atol=1e-12)


@once
def carried_rate(numbers, t):
    frame = wobbly(numbers)

    def q(s):
        return rj.quaternion.exp(numbers[21:24] + numbers[24:27] * s)

    def rate(turn):
        value, dot = jax.jvp(turn, (t,), (jnp.ones(()),))
        return 2 * rj.quaternion.multiply(rj.quaternion.conjugate(value), dot)[1:]

    seen = rj.Rigid(numbers[:3], numbers[3:6], q(t), rate(q))
    out = frame.to_inertial(seen, t)
    attitude = frame.to_inertial(rj.Attitude(q(t), rate(q)), t)
    whole = rate(lambda s: rj.quaternion.multiply(rj.quaternion.from_matrix(frame.matrix(s)), q(s)))
    return seen, out, frame.from_inertial(out, t), attitude, whole


def test_a_bodys_whole_state():
    seen, out, back, attitude, whole = carried_rate(jnp.asarray(NUMBERS), jnp.asarray(0.3))
    np.testing.assert_allclose(out.omega, whole, atol=1e-13)
    np.testing.assert_allclose(attitude.omega, whole, atol=1e-13)
    turned = rj.so3.product(wobbly(NUMBERS).matrix(0.3), rj.quaternion.to_matrix(seen.q))
    np.testing.assert_allclose(rj.quaternion.to_matrix(out.q), turned, atol=1e-14)
    for name in ("x", "v", "omega"):
        np.testing.assert_allclose(getattr(back, name), getattr(seen, name), atol=1e-13)
    assert abs(abs(float(jnp.sum(back.q * seen.q))) - 1) < 1e-14


@pytest.mark.slow
def test_a_body_solved_inside_a_moving_frame():
    frame, body = (
        MovingFrame(Wobble(jnp.asarray(NUMBERS[:12]))),
        rj.Inertia.from_principal(1.0, 2.0, 2.5),
    )
    start, ts = rj.Attitude([0.8, 0.0, 0.6, 0.0], [0.5, -0.4, 0.7]), jnp.linspace(0.0, 3.0, 5)
    outside = rj.simulate(body, start, ts).ys
    first = frame.from_inertial(start, 0.0)
    inside = rj.simulate(body, first, ts, BodyInFrame(frame), **TIGHT).ys
    moved = jax.jit(jax.vmap(frame.to_inertial))(inside, ts)
    np.testing.assert_allclose(moved.omega[-1], outside.omega[-1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(moved.omega, outside.omega, rtol=0, atol=3e-10)
    same = jnp.abs(jnp.sum(moved.q * outside.q, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)


@pytest.mark.slow
def test_a_frame_that_rides_on_a_body():
    body, start = (
        rj.Inertia.from_principal(1.0, 2.0, 2.5),
        rj.Attitude([1.0, 0, 0, 0], [0.5, -0.4, 0.7]),
    )
    solution = rj.simulate(body, start, [0.0, 4.0])
    now = eqx.filter_jit(MovingFrame(solution).at)(2.5)
    state = solution.evaluate(2.5)
    np.testing.assert_allclose(now.rate, state.omega, atol=1e-14)
    np.testing.assert_allclose(now.rotation, rj.quaternion.to_matrix(state.q), atol=1e-14)
    euler = EulerEquations(body)(0.0, rj.Spin(state.omega)).omega
    np.testing.assert_allclose(now.rate_change, euler, atol=1e-12)
    # Its Ω agrees with vee(Mᵀ dM/dt).
    plain = MovingFrame(MovingFrame(solution).matrix).angular_velocity(2.5)
    np.testing.assert_allclose(plain, state.omega, atol=1e-12)


def test_jacobi_integral_of_a_uniform_frame_is_kept():
    scene = InFrame(
        MovingFrame(Uniform([0.1, 0.2, 0.9])), potential=lambda x: 2 * jnp.sum(x**2) + x[0] ** 3
    )
    solution = rj.simulate(
        None, Point([0.2, 0.1, 0], [0.0, 0.3, 0]), [0.0, 10.0, 20.0], scene, **TIGHT
    )
    assert 0 < float(solution.stats["drift"]["jacobi"]) < 1e-12
    assert InFrame(wobbly(NUMBERS)).conserved(0.0, Point(np.zeros(3), np.zeros(3))) == {}


def test_quaternions_single_precision_and_free_particles():
    turned = MovingFrame(lambda t: rj.quaternion.exp(t * jnp.array([0.0, 0, 2.0])))
    np.testing.assert_allclose(turned.at(0.3).rate, [0.0, 0, 2], atol=1e-14)
    single = Point(np.float32([1, 2, 3]), np.float32([0, 1, 0]))
    frame = MovingFrame(Uniform([0.0, 0, 2]))
    out = frame.to_inertial(single, np.float32(0.3))
    assert out.x.dtype == out.v.dtype == jnp.float32
    scene = InFrame(frame, inside=lambda t, state: -state.x)
    ys = rj.simulate(None, single, np.float32([0.0, 1.0]), scene).ys
    assert ys.x.dtype == jnp.float32
    straight = rj.simulate(None, single, np.float32([0.0, 1.0])).ys
    np.testing.assert_allclose(straight.x[-1], [1, 3, 3], rtol=1e-5)
    free = Force(None).conserved(0.0, single)
    assert free == {}


def test_vmap_over_frames_and_times():
    rates = jnp.linspace(0.5, 2.0, 4)

    def end(w):
        frame = MovingFrame(Uniform(w * jnp.array([0.0, 0, 1])))
        return rj.simulate(None, Point([1.0, 0, 0], [0.0, 1, 0]), [0.0, 1.0], frame).ys.x[-1]

    c, s = np.cos(rates), np.sin(rates)
    y = 1 + rates
    np.testing.assert_allclose(
        jax.vmap(end)(rates), np.stack([c + s * y, c * y - s, 0 * c], 1), atol=1e-8
    )


REST = Point([1.0, 0, 0], [0.0, 0, 0])
FLIPPED = np.diag([1.0, 1, -1])
MISTAKES = [
    (lambda: MovingFrame(np.eye(3)), TypeError, r"function of time .* got ndarray; .*Uniform"),
    (lambda: MovingFrame(Uniform([0.0, 0, 1]), np.zeros(3)), TypeError, "origin: wanted a function"),
    (lambda: MovingFrame(lambda t: FLIPPED).matrix(0.0), ValueError, "rotation: left-handed frame, det = -1"),
    (lambda: MovingFrame(lambda t: 2 * np.eye(3)).matrix(0.0), ValueError, "rotation: not orthogonal"),
    (lambda: MovingFrame(lambda t: np.ones(3)).matrix(0.0), ValueError, r"wanted a matrix or a qu"),
    (lambda: MovingFrame(Uniform([0.0, 0, 1])).to_inertial(rj.Spin([0.0, 0, 1]), 0.0), TypeError, "rate alone"),
    (lambda: MovingFrame(Uniform([0.0, 0, 1])).to_inertial(Point(np.ones((4, 3)), np.ones((4, 3))), 0.0), ValueError, "batch with jax.vmap"),
    (lambda: Point([1.0, 2], [0.0, 0]), ValueError, r"wanted shape \(3,\), got \(2,\); a plane problem has z = 0"),
    (lambda: rj.simulate(rj.Inertia(np.eye(3)), REST, [0.0, 1.0]), TypeError, "because a Point is no body"),
    (lambda: rj.simulate(None, REST, [0.0, 1.0], "cr3bp"), TypeError, "wanted a scene .* got str"),
    (lambda: rj.simulate(None, REST, [0.0, 1.0], lambda t, s, b: jnp.zeros(2)), ValueError, r"wanted shape \(3,\), got \(2,\); force per mass"),
    (lambda: rj.simulate(None, REST, [0.0, 1.0], rj.torques.Damping(np.ones(3))), TypeError, "Damping needs a state with HasSpin"),
    (lambda: rj.simulate(rj.Inertia(np.eye(3)), rj.Spin(np.ones(3)), [0.0, 1.0], MovingFrame(Uniform([0.0, 0, 1]))), TypeError, "moves a Point"),
    (lambda: AboutAxis(np.zeros(3), lambda t: t), ValueError, "wanted a direction, got zero"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_instants_can_be_made_by_hand():
    zero = jnp.zeros(3)
    now = Instant(jnp.eye(3), jnp.array([0.0, 0, 2]), zero, zero, zero, zero)
    np.testing.assert_array_equal(now.fictitious([1.0, 0, 0], [0.0, 0, 0]), [4.0, 0, 0])
