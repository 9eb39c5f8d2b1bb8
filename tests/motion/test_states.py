"""Laws with states of their own: wheels, lags, a user's own; inertia that changes in time."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion.drive import Drive
from once import filter_once, once
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques import base
from rigidjax.motion.torques.states import freeze_own_states

LOCKED = rj.Inertia(np.array([[3.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 2.0]]))
AXES = np.array([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, 1.0]])
J = np.array([0.1, 0.2, 0.15])
SPEEDS = np.array([31.0, -20.0, 10.0])
START = rj.Attitude([0.5, -0.5, 0.5, 0.5], [0.2, -0.4, 0.3])
EDGES, LEVELS = (
    np.array([0.0, 0.8, 1.7]),
    np.array([[0.5, -0.2, 0.1], [-1.5, 0.3, 0.0], [0, 2.0, -0.4]]),
)
TS = np.array([0.0, 0.8, 2.6])


def wheels(gain=1.0, **more):
    return torques.ReactionWheels(
        AXES, J, SPEEDS, torques.Held(EDGES, gain * jnp.asarray(LEVELS)),
        max_torque=1.0, max_speed=33.0, viscous=2e-3, coulomb=[0.01, 0.02, 0.03], turn_over=2.0, **more,
    )  # fmt: skip


WHEELS = wheels()
BODY = WHEELS.without_wheels(LOCKED)


def of_scipy(outside=(0.0, 0.0, 0.0)):
    """Hughes' equations of a gyrostat with relative speeds, wheels locked in the inertia, solved
    for (dΩ/dt, ds/dt) as one linear system; piece by piece between jumps of the motors.
    """
    inertia = np.asarray(LOCKED.tensor)

    def friction(s):
        return 2e-3 * s + np.array([0.01, 0.02, 0.03]) * np.tanh(s / 2.0)

    def motor(asked, s):
        given = np.clip(asked, -1.0, 1.0)
        room = np.where(given > 0, 33.0 - s, 33.0 + s) / (0.05 * 33.0)
        x = np.clip(room, 0.0, 1.0)
        return given * (6 * x**5 - 15 * x**4 + 10 * x**3)

    def slope(t, y, asked):
        q, w, s = y[:4], y[4:7], y[7:]
        u = motor(asked, s) - friction(s)
        momentum = inertia @ w + AXES.T @ (J * s)
        matrix = np.block([[inertia, AXES.T * J], [J[:, None] * AXES, np.diag(J)]])
        found = np.linalg.solve(matrix, np.concatenate([np.cross(momentum, w) + outside, u]))
        a, b = q[0], q[1:]
        turn = 0.5 * np.concatenate([[-b @ w], a * w + np.cross(b, w)])
        return np.concatenate([turn, found])

    y, rows = np.concatenate([START.q, START.omega, SPEEDS]), {}
    marks = np.unique(np.concatenate([EDGES, TS]))
    for left, right in itertools.pairwise(marks):
        asked = LEVELS[np.searchsorted(EDGES, left, side="right") - 1]
        y = solve_ivp(slope, (left, right), y, "DOP853", args=(asked,), rtol=1e-12, atol=1e-12).y[
            :, -1
        ]
        rows[right] = y
    return np.stack([rows[t] for t in TS[1:]])


def test_wheels_as_scipy_has_them_from_the_equations():
    """With limits, friction, held motors, and a torque from outside in a sum; drift of momentum."""
    free = rj.simulate(BODY, START, TS, WHEELS, rtol=1e-12, atol=1e-13)
    wanted = of_scipy()
    np.testing.assert_allclose(free.ys.q[1:], wanted[:, :4], rtol=0, atol=2e-9)
    np.testing.assert_allclose(free.ys.omega[1:], wanted[:, 4:7], rtol=0, atol=2e-9)
    speeds = jax.vmap(WHEELS.speeds_of)(free.own[0], free.ys)
    np.testing.assert_allclose(speeds[1:], wanted[:, 7:], rtol=0, atol=2e-8)
    # Limits were met, both of them.
    assert np.abs(speeds).max() > 0.95 * 33.0
    assert np.abs(LEVELS).max() > 1.0
    assert set(free.drift) == {"momentum", "momentum_squared"}
    assert max(free.drift.values()) < 2e-12
    push = torques.ConstantTorque([0.2, 0.1, -0.3])
    pushed = rj.simulate(BODY, START, TS, torques.Sum(push, WHEELS), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(
        pushed.ys.omega[1:], of_scipy([0.2, 0.1, -0.3])[:, 4:7], rtol=0, atol=2e-9
    )
    assert pushed.own[0].shape == (3, 3)


def test_basilisk_balanced_wheels():
    """Attitude after 1 s of Basilisk's integrated test of reaction wheels, "BalancedWheels": three
    wheels whose torque is limited to 0.2 N m (0.5 are asked for), switched off after 0.5 s. Its
    wheels are part of the hub's inertia but about their axes: 100 N m s at 6000 rpm.
    """
    turns = 2 * np.pi / 60
    inertia = [100.0 / (6000 * turns)] * 3
    asked = torques.Held([0.0, 0.5], [[0.20, 0.10, -0.50], [0.0, 0.0, 0.0]])
    speeds = np.array([500.0, 200.0, -150.0]) * turns
    law = torques.ReactionWheels(np.eye(3), inertia, speeds, asked, max_torque=0.2)
    body = law.without_wheels(rj.Inertia.from_principal(900.0, 800.0, 600.0))
    start = rj.Attitude([1.0, 0, 0, 0], [0.08, 0.01, 0.0])
    q = rj.simulate(body, start, [0.0, 1.0], law, rtol=1e-12, atol=1e-14).ys.q[-1]
    # Modified Rodrigues parameters, written there to nine digits.
    wanted = [1.99853994e-02, 2.45647716e-03, 8.45356279e-06]
    np.testing.assert_allclose(q[1:] / (1 + q[0]), wanted, rtol=1e-8)


def test_momentum_is_kept_by_the_equations_themselves():
    """d/dt R(IΩ + Σ h a) is nothing at states drawn at random, to round-off, and energy changes by
    Σ u s: whatever motors, limits and friction do.
    """
    field = rj.equations_of_motion(BODY, Coupled.start(BODY, START, WHEELS), WHEELS)

    def kept(y):
        return rj.conserved(BODY, y, WHEELS)["momentum"], rj.energy(BODY, y, WHEELS)

    def change(q, omega, h, t):
        y = Coupled(rj.Attitude(rj.quaternion.normalise(q), omega), (h,))
        (value, _), (slope, power) = jax.jvp(kept, (y,), (field(t, y),))
        return (
            value,
            slope,
            power,
            jnp.sum(WHEELS.torques_of(t, h, y.motion) * WHEELS.speeds_of(h, y.motion)),
        )

    rng = np.random.default_rng(0)
    found = once(jax.vmap(change))(
        *(rng.normal(size=(50, n)) for n in (4, 3, 3)), rng.uniform(0, 3, 50)
    )
    value, slope, power, given = map(np.asarray, found)
    assert np.abs(slope).max() < 2e-14 * np.abs(value).max() * 10
    np.testing.assert_allclose(power, given, rtol=0, atol=1e-13)


def test_a_wheel_spun_up_on_a_symmetric_body():
    """Constant motor torque about the axis: Ω = −u t/(I − J), s = u t/J + u t/(I − J)."""
    law = torques.ReactionWheels([[0.0, 0, 1]], [0.1], [0.0], motor=[0.2])
    body = law.without_wheels(rj.Inertia.from_principal(1.0, 2.0, 2.1))
    np.testing.assert_allclose(body.tensor[2, 2], 2.0, rtol=1e-15)
    spin = rj.Spin([0.0, 0.0, 0.0])
    found = rj.simulate(body, spin, [0.0, 5.0], law)
    np.testing.assert_allclose(found.ys.omega[-1], [0.0, 0.0, -0.5], rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        law.speeds_of(found.own[0][-1], rj.Spin(found.ys.omega[-1])), [10.5], rtol=1e-14
    )
    np.testing.assert_allclose(found.evaluate(2.5).omega[2], -0.25, rtol=1e-14)
    many = rj.Spin(np.zeros((3, 3)))
    rolled = rj.batch.rollout(body, many, 0.05, 100, law, save_every=50)
    np.testing.assert_allclose(rolled.motion.omega[:, 1, 2], -0.5, rtol=1e-13)
    np.testing.assert_allclose(rolled.own[0][:, 0, 0], 0.5, rtol=1e-13)


def test_wheels_in_a_batch_and_in_single_precision():
    law = torques.ReactionWheels([[0.0, 0, 1]], [0.1], [0.0], motor=[0.2])
    body, many = rj.Inertia.from_principal(1.0, 2.0, 2.0), rj.Spin(np.zeros((3, 3)))
    some = rj.batch.simulate(body, many, [0.0, 5.0], law)
    np.testing.assert_allclose(some.ys.omega[:, 1, 2], -0.5, rtol=1e-13)
    np.testing.assert_allclose(some.own[0][:, 1, 0], 1.0, rtol=1e-13)
    single = rj.simulate(body, rj.Spin(np.zeros(3, np.float32)), np.array([0, 5], np.float32), law)
    assert single.own[0].dtype == single.ys.omega.dtype == np.float32


def test_derivatives_are_those_of_differences():
    """By the wheels' inertia, the motors' gain, friction, the start: both modes beside central
    differences of SciPy's independent run, the last by the gain only.
    """

    def end(x):
        law = eqx.tree_at(
            lambda w: (w.inertia, w.viscous), wheels(x[0]), (x[1] * WHEELS.inertia, x[2])
        )
        start = rj.Attitude(START.q, START.omega * x[3])
        sol = rj.simulate(BODY, start, TS[[0, -1]], law, rtol=1e-11, atol=1e-12)
        return jnp.concatenate([sol.ys.omega[-1], sol.own[0][-1]])

    x = jnp.array([0.9, 1.0, 2e-3, 1.0])
    forward, backward = filter_once(lambda x: (jax.jacfwd(end)(x), jax.jacrev(end)(x)))(x)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9)
    run = filter_once(end)
    for i in range(4):
        e = np.zeros(4)
        e[i] = 1e-4 * float(x[i])
        slope = (run(x + e) - run(x - e)) / (2 * e[i])
        np.testing.assert_allclose(
            forward[:, i], slope, rtol=0, atol=3e-6 * max(1.0, np.abs(slope).max())
        )


def lagged(t, lag):
    """∫ of 1 − exp(−t/T), and its derivative by T."""
    fade = np.exp(-t / lag)
    return t - lag * (1 - fade), -(1 - fade) + fade * t / lag


def test_a_lag_in_closed_form():
    """A step of 1 through a lag turns a body of inertia 2: Ω = (t − T (1 − e^(−t/T)))/2; and two
    lags one inside the other, of which e^(−t/T) (1 + t/T) is left.
    """
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)

    def end(lag):
        law = Drive(torques.Lagged(torques.Held([0.0, 9.0], [1.0, 1.0]), lag, 0.0))
        sol = rj.simulate(body, rj.Spin([0.0, 0, 0]), [0.0, 0.7], law)
        return sol.ys.omega[-1, 2], sol.own[0][-1]

    (found, value), (slope, _) = filter_once(lambda x: (end(x), jax.jacfwd(end)(x)))(
        jnp.asarray(0.3)
    )
    wanted, by_lag = lagged(0.7, 0.3)
    np.testing.assert_allclose(found, wanted / 2, rtol=1e-10)
    np.testing.assert_allclose(value, 1 - np.exp(-0.7 / 0.3), rtol=1e-10)
    np.testing.assert_allclose(slope, by_lag / 2, rtol=1e-8)
    twice = torques.Lagged(torques.Lagged(lambda t: jnp.ones(()), 0.3, 0.0), 0.3, 0.0)
    sol = rj.simulate(body, rj.Spin([0.0, 0, 0]), [0.0, 0.7], Drive(twice))
    x = 0.7 / 0.3
    np.testing.assert_allclose(
        [sol.own[0][-1], sol.own[1][-1]], [1 - np.exp(-x), 1 - np.exp(-x) * (1 + x)], rtol=1e-9
    )


def test_a_lag_of_inputs_in_a_batch():
    """Samples of each body through a lag, held: the exact lag of a staircase, to the steps' order."""
    h, lag = 0.01, 0.2
    rows = np.random.default_rng(1).normal(size=(2, 40))
    law = Drive(torques.Lagged(torques.Input("u"), lag))
    found = rj.batch.rollout(
        rj.Inertia.from_principal(1.0, 1.0, 1.0), rj.Spin(np.zeros((2, 3))), h, 40, law,
        inputs={"u": rows}, save_every=1,
    )  # fmt: skip
    value, wanted = rows[:, 0], []
    for i in range(40):
        value = rows[:, i] + (value - rows[:, i]) * np.exp(-h / lag)
        wanted.append(value)
    # (h/T)⁵/120 a step, some of 20 steps' worth of jumps of 3.
    np.testing.assert_allclose(found.own[0].T, wanted, rtol=0, atol=1e-7)


def test_inertia_that_changes_in_time():
    """About a principal axis IΩ is constant; about all three R I Ω is, with a torque inside dI/dt
    stands beside it; both beside closed forms.
    """

    def tensor(t):
        return jnp.diag(jnp.stack([1.0 + 0.2 * t, 2.0 + jnp.sin(t), 2.5 + 0.1 * t * t]))

    law = torques.ChangingInertia(tensor)
    fixed = rj.Inertia(tensor(0.0))
    ts = jnp.linspace(0.0, 3.0, 4)
    # Between steps dense output is off by up to ten times the tolerance.
    about_y = rj.simulate(fixed, rj.Spin([0.0, 0.7, 0.0]), ts, law, rtol=1e-10).ys.omega
    np.testing.assert_allclose(about_y[:, 1], 0.7 * 2.0 / (2.0 + np.sin(ts)), rtol=1e-9)
    free = rj.simulate(fixed, START, ts, law, rtol=1e-11, atol=1e-13).ys
    momentum = jax.vmap(lambda t, y: rj.quaternion.rotate(y.q, tensor(t) @ y.omega))(ts, free)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=1e-10
    )
    push = torques.ChangingInertia(tensor, torques.ConstantTorque([0.0, 0.3, 0.0]))
    driven = rj.simulate(fixed, rj.Spin([0.0, 0.7, 0.0]), ts, push, rtol=1e-10).ys.omega
    np.testing.assert_allclose(driven[:, 1], (1.4 + 0.3 * ts) / (2.0 + np.sin(ts)), rtol=1e-9)
    with pytest.raises(TypeError, match="put the others inside it"):
        torques.Sum(law, torques.ConstantTorque([0.0, 0.3, 0.0]))


class Slug(eqx.Module):
    """A user's own: a force and a tree of states, without a base class."""

    state0: dict

    def rate(self, t, own, state, body):
        return {"x": own["v"], "v": -4.0 * own["x"]}

    def __call__(self, t, state, body, own):
        return torques.Wrench(jnp.stack([own["x"], 0.0, 0.0]))


def test_a_users_own_law_on_a_moving_body():
    """An oscillator of frequency 2 pushes a mass of 0.5: v = sin(2 t); nested in a sum, twice."""
    body = rj.MassProperties(0.5, np.zeros(3), np.diag([1.0, 1.1, 1.2]))
    start = rj.Rigid([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.1, 0, 0])
    slug = Slug({"x": jnp.asarray(1.0), "v": jnp.asarray(0.0)})
    law = torques.Sum(torques.Sum(slug, torques.Damping([0.0, 0, 0])), slug)
    sol = rj.simulate(body, start, [0.0, 0.9], law, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(sol.ys.v[-1, 0], 2 * np.sin(1.8), rtol=1e-10)
    np.testing.assert_allclose([own["x"][-1] for own in sol.own], np.cos(1.8), rtol=1e-9)


def test_a_scene_without_states_is_the_same_program():
    """Not an operation more: the program is what the equations alone are, letter by letter."""
    law = torques.Sum(
        torques.Damping([0.1, 0.1, 0.1]), torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.8])
    )
    plain = AttitudeEquations(BODY, law)
    made = rj.equations_of_motion(BODY, START, law)
    texts = [str(jax.make_jaxpr(lambda y, f=f: f(0.5, y, None))(START)) for f in (plain, made)]
    assert texts[0] == texts[1]
    assert rj.motion.coupled.with_own_states(BODY, START, law, 0.0) is START
    assert rj.simulate(BODY, START, [0.0, 0.1], law).own is None


class Wrong(eqx.Module):
    state0: jax.Array

    def rate(self, t, own, state, body):
        return jnp.zeros(2)

    def __call__(self, t, state, body, own):
        return jnp.zeros(3)


def made(**change):
    good = dict(axes=AXES, inertia=J, speeds=SPEEDS)
    return torques.ReactionWheels(**(good | change))


@pytest.mark.parametrize(
    ("call", "kind", "words"),
    [
        (lambda: rj.simulate(BODY, START, TS, Wrong(jnp.zeros(3))), ValueError, r"rate of Wrong: wanted arrays as in state0, \(3,\), got \(2,\)"),
        (lambda: rj.simulate(BODY, START, TS, Wrong("no")), TypeError, "state0 of Wrong: wanted an array"),
        (lambda: rj.simulate(BODY, START, TS, Wrong(())), ValueError, "state0 of Wrong: wanted a tree of arrays, got none"),
        (lambda: WHEELS(0.0, START, BODY), TypeError, "own"),
        (lambda: base.evaluate_torque(WHEELS, 0.0, START, BODY), TypeError, r"ReactionWheels has states of its own.*its states last"),
        (lambda: rj.conserved(BODY, START, WHEELS), TypeError, "has states of its own"),
        (lambda: freeze_own_states(WHEELS, ()), ValueError, "own: wanted the states .* got no states for ReactionWheels"),
        (lambda: freeze_own_states(WHEELS, (1.0, 2.0)), ValueError, "own: wanted one tree .* of the 1 parts .* got 2"),
        (lambda: torques.Flywheel(torques.Lagged(lambda t: jnp.ones(3), 1.0)), TypeError, "see ReactionWheels"),
        (lambda: torques.Lagged(1.0, 1.0), TypeError, "source: wanted a function of time"),
        (lambda: torques.Lagged(lambda t: t, 0.0), ValueError, "time: wanted a positive time"),
        (lambda: rj.simulate(BODY, START, TS, Drive(torques.Lagged(lambda t: t, 0.1, [1.0, 2.0]))), ValueError, r"start has the shape \(2,\)"),
        (lambda: torques.Delayed(torques.Lagged(lambda t: t, 1.0), 0.1), TypeError, "delay its input"),
        (lambda: rj.batch.rollout(BODY, rj.Attitude(START.q[None], START.omega[None]), 0.1, 2, WHEELS, solver=rj.solvers.Magnus4()), TypeError, "no fixed steps of Magnus4 on Coupled"),
        (lambda: rj.simulate(BODY, START, TS, WHEELS, solver=rj.solvers.Splitting4()), TypeError, "Splitting: wanted AttitudeEquations"),
        (lambda: made(axes=2 * AXES), ValueError, "axes: wanted unit vectors"),
        (lambda: made(axes=AXES[0]), ValueError, r"axes: wanted \(R, 3\)"),
        (lambda: made(inertia=-J), ValueError, "inertia: wanted > 0"),
        (lambda: made(speeds=[1.0]), ValueError, r"speeds: wanted shape \(3,\)"),
        (lambda: made(max_speed=0.0), ValueError, "max_speed: wanted > 0"),
        (lambda: made(viscous=-1.0), ValueError, "viscous: wanted ≥ 0"),
        (lambda: made(feedback=1.0), TypeError, "feedback: wanted a function"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, kind, words):
    with pytest.raises(kind, match=words):
        call()
