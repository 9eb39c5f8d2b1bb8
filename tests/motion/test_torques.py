"""Torques and forces: values, potentials, conservation at the level of the equations, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.test_util import check_grads
from once import once

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion import HasPose
from rigidjax.motion.conserved import conserved, drift, energy
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.motion.torques import base
from rigidjax.motion.torques.base import jump_times_of

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
INERTIA = rj.Inertia(TENSOR)
BODY = rj.MassProperties(2.0, np.zeros(3), INERTIA.second_moment)
OMEGA = np.array([0.9, -1.1, 0.4])
Q = np.array([0.8, -0.2, 0.4, 0.4])
Q = Q / np.linalg.norm(Q)
R = np.asarray(rj.quaternion.to_matrix(jnp.asarray(Q)))
SPIN, ATTITUDE = rj.Spin(OMEGA), rj.Attitude(Q, OMEGA)
RIGID = rj.Rigid([1.5, -2.0, 0.7], [0.3, 1.0, -0.4], Q, OMEGA)
TABLE = torques.Linear([0.0, 1.0, 3.0], [[0.0, 0.2, 0.1], [1.0, 0.0, -0.3], [0.5, 0.4, 0.0]])
TOP = torques.HeavyTop(2.0, [0.1, -0.2, 0.5], [0.3, -0.4, -9.7])
GRADIENT = torques.GravityGradient(5.0, [1.2, -0.8, 0.5])
DIPOLE = torques.MagneticDipole([0.2, 0.7, -0.3], [0.5, 0.1, 0.9])
WHEEL = torques.Flywheel([0.3, -0.6, 0.8])


class Orbit(eqx.Module):
    """A circle in the x–y plane."""

    radius: jax.Array
    rate: jax.Array

    def __call__(self, t):
        angle = self.rate * t
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])


ORBIT = Orbit(jnp.array(1.5), jnp.array(0.4))


class Spring(eqx.Module):
    """Pulls the attitude back to the identity."""

    k: jax.Array

    def __call__(self, q):
        return self.k * (1 - q[0] ** 2) + 0.3 * q[1] * q[2]


SPRING = torques.FromPotential(Spring(jnp.array(0.8)))


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def _gradient_by_hand():
    r = R.T @ np.array([1.2, -0.8, 0.5])
    distance = np.linalg.norm(r)
    return 15.0 / distance**5 * np.cross(r, TENSOR @ r)


def _drag_by_hand():
    u = np.array([0.3, 1.0, -0.4]) - [0.1, 0.0, 0.2]
    return -0.7 * np.linalg.norm(u) * u


@pytest.mark.parametrize(
    ("law", "state", "wanted"),
    [
        (torques.ConstantTorque([0.1, 0.2, 0.3]), SPIN, [0.1, 0.2, 0.3]),
        (torques.InSpace([0.1, 0.2, 0.3]), ATTITUDE, R.T @ [0.1, 0.2, 0.3]),
        (torques.InSpace(TABLE), ATTITUDE, R.T @ [0.5, 0.1, -0.1]),
        (torques.Damping([0.1, 0.2, 0.3]), SPIN, -OMEGA * [0.1, 0.2, 0.3]),
        (torques.QuadraticDamping([0.1, 0.2, 0.3]), SPIN, -np.linalg.norm(OMEGA) * OMEGA * [0.1, 0.2, 0.3]),
        (TOP, ATTITUDE, np.cross([0.1, -0.2, 0.5], 2.0 * R.T @ [0.3, -0.4, -9.7])),
        (GRADIENT, ATTITUDE, _gradient_by_hand()),
        (DIPOLE, ATTITUDE, np.cross([0.2, 0.7, -0.3], R.T @ [0.5, 0.1, 0.9])),
        (WHEEL, SPIN, np.cross([0.3, -0.6, 0.8], OMEGA)),
        (torques.Flywheel(TABLE), SPIN, np.cross([0.5, 0.1, -0.1], OMEGA) - [1.0, -0.2, -0.4]),
        (torques.Tabulated(TABLE.times, TABLE.values), SPIN, [0.5, 0.1, -0.1]),
        (torques.Pulses([0.0, 0.4, 3.0], [[1.0, 0, 0], [0.0, 2, 0]]), SPIN, [0.0, 2.0, 0.0]),
        (torques.Sum(WHEEL, DIPOLE), ATTITUDE, np.cross([0.3, -0.6, 0.8], OMEGA) + np.cross([0.2, 0.7, -0.3], R.T @ [0.5, 0.1, 0.9])),
        (lambda t, state, body: 2.0 * state.omega, SPIN, 2.0 * OMEGA),
    ],
)  # fmt: skip
def test_values_by_hand(law, state, wanted):
    base.require_state_type(law, state)
    found = base.evaluate_torque(law, 0.5, state, INERTIA)
    np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15)


def test_a_gravity_gradient_follows_its_orbit():
    moving, still = torques.GravityGradient(5.0, ORBIT), torques.GravityGradient(5.0, ORBIT(0.5))
    found = base.evaluate_torque(moving, 0.5, ATTITUDE, INERTIA)
    np.testing.assert_allclose(
        found, base.evaluate_torque(still, 0.5, ATTITUDE, INERTIA), rtol=1e-14
    )
    assert moving.axis is None and not moving.steady and still.steady


@pytest.mark.parametrize(
    ("law", "state"),
    [
        (TOP, ATTITUDE),
        (GRADIENT, ATTITUDE),
        (DIPOLE, ATTITUDE),
        (SPRING, ATTITUDE),
        (torques.CentralGravity(5.0), RIGID),
        (torques.UniformGravity([0.3, -0.4, -9.7]), RIGID),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_torque_and_force_are_minus_the_slope_of_the_energy(law, state):
    # Turn by a small ψ in the body, move by a small d in the world: δU = −τ·ψ − F·d.
    body = BODY if isinstance(state, rj.Rigid) else INERTIA

    def moved(turn, shift):
        q = rj.quaternion.multiply(state.q, rj.quaternion.exp(turn))
        at = eqx.tree_at(lambda s: s.q, state, q)
        if isinstance(state, rj.Rigid):
            at = eqx.tree_at(lambda s: s.x, at, state.x + shift)
        return law.energy(0.0, at, body)

    turn, shift = jax.grad(moved, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3))
    force, torque = base.force_and_torque(law, 0.0, state, body)
    np.testing.assert_allclose(torque, -turn, rtol=1e-12, atol=1e-14)
    if force is not None:
        np.testing.assert_allclose(force, -shift, rtol=1e-12, atol=1e-14)


FALL, CENTRE = torques.UniformGravity([0.3, -0.4, -9.7]), torques.CentralGravity(5.0)
ALL = ["momentum", "momentum_squared"]


class Push(torques.AbstractTorque):
    feels = HasPose

    def __call__(self, t, state, body):
        return torques.Wrench([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("law", "state", "names"),
    [
        (None, SPIN, ["energy", "momentum_squared"]),
        (None, ATTITUDE, ["energy", *ALL]),
        (None, RIGID, ["energy", "linear_momentum", *ALL, "momentum_about_origin"]),
        (WHEEL, ATTITUDE, ["energy", *ALL]),
        (torques.Flywheel(TABLE), ATTITUDE, ALL),
        (TOP, ATTITUDE, ["energy", "momentum_along_axis"]),
        (torques.Sum(TOP, WHEEL), ATTITUDE, ["energy", "momentum_along_axis"]),
        (torques.Sum(TOP, DIPOLE), ATTITUDE, ["energy"]),
        (GRADIENT, ATTITUDE, ["energy", "momentum_along_axis"]),
        (torques.GravityGradient(5.0, ORBIT), ATTITUDE, []),
        (DIPOLE, ATTITUDE, ["energy", "momentum_along_axis"]),
        (SPRING, ATTITUDE, ["energy"]),
        (torques.Damping([0.1, 0.1, 0.1]), ATTITUDE, []),
        (torques.ConstantTorque([0.1, 0.1, 0.1]), ATTITUDE, []),
        (lambda t, state, body: state.omega, ATTITUDE, []),
        (FALL, RIGID, ["energy", *ALL]),
        (CENTRE, RIGID, ["energy", "momentum_about_origin"]),
        (torques.Sum(CENTRE, WHEEL), RIGID, ["energy", "momentum_about_origin"]),
        (torques.Sum(FALL, torques.Drag(0.3)), RIGID, []),
        (torques.Sum(FALL, DIPOLE), RIGID, ["energy", "momentum_along_axis"]),
        (Push(), RIGID, []),
    ],
)
def test_what_is_said_to_be_conserved_is(law, state, names):
    """Its derivative along the equations of motion is zero: no solver comes in."""
    rigid = isinstance(state, rj.Rigid)
    body = BODY if rigid else INERTIA
    field = {
        rj.Spin: lambda: EulerEquations(body, law),
        rj.Attitude: lambda: AttitudeEquations(body, law),
        rj.Rigid: lambda: NewtonEuler(body, law),
    }[type(state)]()
    t = jnp.array(0.5)
    values, rates = jax.jvp(
        lambda s, y: conserved(body, y, law, s), (t, state), (jnp.ones(()), field(t, state))
    )
    assert sorted(values) == sorted(names)
    for name, rate in rates.items():
        np.testing.assert_allclose(rate, np.zeros_like(rate), atol=2e-13, err_msg=name)


HELD = torques.Held([0.0, 1.0], np.zeros((2, 3)))


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    "make",
    [
        lambda: torques.Flywheel(HELD),
        lambda: torques.bind(
            torques.Flywheel(torques.Delayed(torques.Input("h"), 0.1)), {"h": HELD}
        )(0.5, rj.Spin(OMEGA), INERTIA),
        lambda: torques.ChangingInertia(torques.Held([0.0, 1.0], np.zeros((2, 3, 3)))),
    ],
)
def test_a_momentum_that_jumps_is_refused(make):
    # Its derivative was zero everywhere: the body did not feel that the wheel was spun up.
    with pytest.raises(TypeError, match="wanted a function of time without jumps"):
        make()


def test_damping_takes_the_energy_that_it_should():
    law = torques.Sum(torques.Damping([0.1, 0.2, 0.3]), torques.QuadraticDamping([0.3, 0.1, 0.2]))
    rate = EulerEquations(INERTIA, law)(0.0, SPIN)
    _, power = jax.jvp(lambda y: energy(INERTIA, y), (SPIN,), (rate,))
    wanted = -np.sum(
        (np.array([0.1, 0.2, 0.3]) + np.array([0.3, 0.1, 0.2]) * np.linalg.norm(OMEGA)) * OMEGA**2
    )
    np.testing.assert_allclose(power, wanted, rtol=1e-13)


def test_newton_euler_adds_forces_and_torques():
    drag = torques.Drag(0.7, centre=[0.1, 0.2, -0.3], wind=[0.1, 0.0, 0.2])
    law = torques.Sum(FALL, drag, torques.ConstantTorque([0.1, 0.2, 0.3]))
    found = NewtonEuler(BODY, law)(0.0, RIGID)
    push = _drag_by_hand()
    np.testing.assert_allclose(found.v, [0.3, -0.4, -9.7] + push / 2.0, rtol=1e-14)
    torque = np.array([0.1, 0.2, 0.3]) + np.cross([0.1, 0.2, -0.3], R.T @ push)
    wanted = np.linalg.solve(TENSOR, torque - np.cross(OMEGA, TENSOR @ OMEGA))
    np.testing.assert_allclose(found.omega, wanted, rtol=1e-13)


@pytest.mark.parametrize(
    ("law", "state"),
    [
        (torques.Sum(TOP, GRADIENT, DIPOLE, WHEEL, SPRING, torques.InSpace([0.1, 0.2, 0.3])), ATTITUDE),
        (torques.Sum(torques.QuadraticDamping([0.3, 0.1, 0.2]), torques.Flywheel(TABLE)), ATTITUDE),
        (torques.Sum(CENTRE, FALL, torques.Drag(0.7, [0.1, 0.2, -0.3])), RIGID),
    ],
    ids=["attitude", "spin", "rigid"],
)  # fmt: skip
def test_derivatives_of_first_and_second_order(law, state):
    """With respect to the state, and to every number of the laws and of the body."""
    body = BODY if isinstance(state, rj.Rigid) else INERTIA

    # One vector: check_grads works number by number of it, not program by program of each leaf.
    numbers, restore = ravel_pytree((law, state, body))

    def value(numbers):
        law, state, body = restore(numbers)
        force, torque = base.force_and_torque(law, 0.5, state, body)
        return torque if force is None else jnp.concatenate([force, torque])

    check_grads(once(value), (numbers,), order=2, modes=["fwd"], rtol=1e-5, atol=1e-6)
    # JAX 0.10.1 refuses `once` under reverse mode: so it is outermost.
    forward, reverse = (once(mode(value))(numbers) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_at_rest_the_first_derivative_of_quadratic_laws_is_zero_not_nan(mode):
    law = torques.QuadraticDamping([0.3, 0.1, 0.2])
    at_rest = mode(lambda w: base.evaluate_torque(law, 0.0, rj.Spin(w), INERTIA))(jnp.zeros(3))
    np.testing.assert_array_equal(at_rest, np.zeros((3, 3)))
    drag = torques.Drag(0.5, [0.1, 0.2, 0.3])

    def push(v):
        return base.force_and_torque(drag, 0.0, rj.Rigid(np.zeros(3), v, Q, OMEGA), BODY)[0]

    np.testing.assert_array_equal(mode(push)(jnp.zeros(3)), np.zeros((3, 3)))


@pytest.mark.parametrize("law", [TOP, GRADIENT, DIPOLE, WHEEL, SPRING, torques.Flywheel(TABLE)])
def test_float32_states_stay_float32(law):
    state = rj.Attitude(Q.astype(np.float32), OMEGA.astype(np.float32))
    found = eqx.filter_jit(AttitudeEquations(INERTIA, law))(jnp.float32(0.5), state)
    assert found.omega.dtype == found.q.dtype == jnp.float32
    exact = AttitudeEquations(INERTIA, law)(0.5, ATTITUDE)
    np.testing.assert_allclose(found.omega, exact.omega, rtol=3e-6, atol=3e-6)


@pytest.mark.parametrize(
    ("law", "state"),
    [
        (torques.Sum(TOP, GRADIENT, DIPOLE, WHEEL, SPRING, torques.Flywheel(TABLE)), ATTITUDE),
        (torques.Sum(CENTRE, FALL, torques.Drag(0.7, [0.1, 0.2, -0.3])), RIGID),
    ],
)
def test_the_equations_are_elementwise(law, state):
    """No matrix product: its gradient is slow on CPU, and GPUs round it to ten bits."""
    rigid = isinstance(state, rj.Rigid)
    field = NewtonEuler(BODY, law) if rigid else AttitudeEquations(INERTIA, law)
    text = str(jax.make_jaxpr(lambda y: field(0.5, y))(state))
    assert "dot_general" not in text and "while" not in text and "cross" not in text


@pytest.mark.parametrize("rows", [5, 300])
def test_tables_against_numpy(rows):
    rng = np.random.default_rng(rows)
    times = np.cumsum(rng.uniform(0.1, 1.0, rows))
    values = rng.normal(size=(rows, 3))
    at = np.concatenate([rng.uniform(times[0] - 1, times[-1] + 1, 50), times])
    line = np.stack([np.interp(at, times, values[:, i]) for i in range(3)], axis=1)
    linear = torques.Linear(times, values)
    np.testing.assert_allclose(jax.jit(jax.vmap(linear))(at), line, rtol=1e-12, atol=1e-13)
    inside = (at >= times[0]) & (at <= times[-1])
    table = torques.Tabulated(times, values)
    found = jax.jit(jax.vmap(lambda t: table(t, SPIN, INERTIA)))(at)
    np.testing.assert_allclose(found, line * inside[:, None], rtol=1e-12, atol=1e-13)
    pulses = torques.Pulses(times, values[:-1])
    found = jax.jit(jax.vmap(lambda t: pulses(t, SPIN, INERTIA)))(at)
    index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, rows - 2)
    np.testing.assert_array_equal(found, values[index] * inside[:, None])
    np.testing.assert_allclose(pulses.impulse, np.diff(times) @ values[:-1], rtol=1e-12, atol=1e-12)


def test_jump_times_reach_the_front_door():
    law = torques.Sum(
        torques.Pulses([1.0, 2.5], [[0.0, 0, 1]]),
        torques.InSpace(torques.Linear([0.0, 2.0], np.zeros((2, 3)))),
        torques.Flywheel(TABLE),
        torques.Damping([1.0, 1, 1]),
    )
    np.testing.assert_array_equal(law.jump_times, [0.0, 0.0, 1.0, 1.0, 2.0, 2.5, 3.0])
    assert jump_times_of(TOP).shape == (0,) and jump_times_of(None).shape == (0,)
    assert torques.Sum(TOP, WHEEL).jump_times.shape == (0,)


def test_drift_is_relative_and_sees_a_wrong_motion():
    ts = jnp.linspace(0.0, 2.0, 5)
    turned = jnp.outer(1.0 + 1e-3 * ts, jnp.asarray(OMEGA))
    ys = rj.Attitude(jnp.broadcast_to(jnp.asarray(Q), (5, 4)), turned)
    found = drift(ts, ys, INERTIA)
    np.testing.assert_allclose(found["energy"], 1 - 1 / 1.002**2, rtol=1e-9)
    np.testing.assert_allclose(found["momentum"], 1 - 1 / 1.002, rtol=1e-9)
    still = rj.Spin(jnp.zeros((5, 3)))
    assert all(float(value) == 0.0 for value in drift(ts, still, INERTIA).values())
    assert drift(ts, ys, INERTIA, torques.Damping([1.0, 1, 1])) == {}


def test_energy_adds_up():
    law = torques.Sum(TOP, torques.Sum(DIPOLE, WHEEL))
    found = energy(INERTIA, ATTITUDE, law)
    potential = -2.0 * np.dot(R @ [0.1, -0.2, 0.5], [0.3, -0.4, -9.7])
    potential += -np.dot(R @ [0.2, 0.7, -0.3], [0.5, 0.1, 0.9])
    np.testing.assert_allclose(found, 0.5 * OMEGA @ TENSOR @ OMEGA + potential, rtol=1e-14)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: torques.ConstantTorque(1.0), r"torque: wanted shape \(3,\), got \(\)"),
        (lambda: torques.QuadraticDamping(0.1), "coefficient.*one number for each body axis"),
        (lambda: torques.HeavyTop(1.0, [0, 0, 1.0], 9.81), r"gravity: .*\[0, 0, -9.81\]"),
        (lambda: torques.UniformGravity(9.81), r"gravity: .*\[0, 0, -9.81\]"),
        (lambda: torques.GravityGradient([1.0, 2, 3], 5.0), r"mu: wanted shape \(\), got \(3,\)"),
        (lambda: torques.CentralGravity([1.0, 2, 3]), r"mu: wanted shape \(\), got \(3,\)"),
        (lambda: torques.MagneticDipole([1.0, 2], [0.0, 0, 1]), r"moment: wanted shape \(3,\)"),
        (lambda: torques.Flywheel(2.0), r"momentum: wanted shape \(3,\), got \(\)"),
        (lambda: torques.InSpace("up"), "torque: wanted"),
        (lambda: torques.Drag([1.0]), r"coefficient: wanted shape \(\), got \(1,\)"),
        (lambda: torques.Wrench([1.0]), r"force: wanted shape \(3,\), got \(1,\); world-frame N"),
        (lambda: torques.Tabulated([0.0, 1.0], [[0.0, 0, 1]]), r"wanted 2 rows of 3.*constant pieces: Pulses"),
        (lambda: torques.Pulses([0.0, 1.0], np.ones((2, 3))), r"wanted 1 rows of 3.*n \+ 1 edges"),
        (lambda: torques.Tabulated([0.0, 2.0, 1.0], np.ones((3, 3))), r"times\[2\] is not above"),
        (lambda: torques.Tabulated([0.0, np.nan], np.ones((2, 3))), "times: contains NaN.*index"),
        (lambda: torques.Linear([0.0], np.ones((1, 3))), "wanted at least 2 times"),
        (lambda: torques.Sum(), "at least one torque"),
        (lambda: torques.Sum([TOP, WHEEL]), r"got list; several go in a Sum: Sum\(a, b\)"),
        (lambda: torques.Sum(TOP, torques.Damping), r"wanted an object, got the class Damping; make Damping\(\.\.\.\)"),
        (lambda: base.require_state_type([TOP], ATTITUDE), r"torque: wanted a torque.*got list"),
        (lambda: base.require_torque([0.0, 0.0, 1.0]), r"got list; a constant one is ConstantTorque\(\["),
        (lambda: base.require_state_type(torques.Damping, SPIN), "torque: wanted an object, got the class Damping"),
        (lambda: torques.Damping([1.0, np.nan, 1.0]), "coefficient: contains NaN"),
        (lambda: torques.GravityGradient(1.0, np.zeros(3)), "position: .*got zero"),
        (lambda: torques.FromPotential(3.0), "wanted a function q → U, J, got float"),
        (lambda: base.require_state_type(TOP, SPIN), "HeavyTop needs a state with HasAttitude, got Spin; take Attitude"),
        (lambda: base.require_state_type(torques.Sum(WHEEL, TOP), SPIN), "Sum needs.*HasAttitude"),
        (lambda: base.require_state_type(FALL, ATTITUDE), "UniformGravity needs a state with HasPose"),
        (lambda: NewtonEuler(BODY, TOP)(0.0, RIGID), "fixed point.*use UniformGravity"),
        (lambda: base.evaluate_torque(lambda t, s, b: torques.Wrench([0.0, 0, 1]), 0.0, SPIN, INERTIA), "wanted a Rigid state"),
        (lambda: base.evaluate_torque(lambda t, s, b: s.omega[:2], 0.0, SPIN, INERTIA), "body-frame N m"),
        (lambda: energy(INERTIA, SPIN, torques.Damping([1.0, 1, 1])), "wanted torques with a potential, got Damping"),
        (lambda: EulerEquations(rj.Inertia.from_principal(1.0, 1.0, 0.0)), "a principal moment is zero.*rod"),
        (lambda: NewtonEuler(rj.MassProperties(1.0, np.zeros(3), np.diag([0.0, 0, 1.0]))), "moment is zero"),
    ],
)  # fmt: skip
def test_mistakes_are_told_in_words(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


def test_a_law_that_looks_at_what_the_state_has_not_is_named():
    def brake(t, state, body):
        return -rj.quaternion.rotate_inverse(state.q, state.omega)

    def spring(t, state, body):
        return -state.x

    def wrong(t, state, body):
        return state.banana

    words = r"torque function looks at state.q, the attitude, and Spin has none: start from Att"
    for law in (brake, rj.torques.Sum(brake, rj.torques.Damping([0.1, 0.1, 0.1]))):
        with pytest.raises(TypeError, match=words):
            base.force_and_torque(law, 0.0, SPIN, BODY)
    with pytest.raises(TypeError, match=r"state\.x, the position, and Attitude has none"):
        base.force_and_torque(spring, 0.0, ATTITUDE, BODY)
    with pytest.raises(AttributeError, match="banana"):
        base.force_and_torque(wrong, 0.0, SPIN, BODY)
