"""Lagrange, Hamilton and Newton–Euler say the same, away from the chart's singularity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from systems.marching import rk4

import rigidjax as rj
from rigidjax import lagrangian, torques
from rigidjax.lagrangian.hamiltonian import MomentumAndDirection
from rigidjax.motion.equations import AttitudeEquations

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
INERTIA = rj.Inertia(TENSOR)
TOP = torques.HeavyTop(2.0, [0.1, -0.2, 0.5], [0.3, -0.4, -9.7])
LAWS = pytest.mark.parametrize("law", [None, TOP], ids=["free", "heavy"])


def _starts(count):
    """Angles away from sin θ = 0, and rates."""
    rng = np.random.default_rng(7)
    angles = rng.uniform([-3.0, 0.4, -3.0], [3.0, 2.7, 3.0], (count, 3))
    return lagrangian.Coordinates(angles, rng.normal(size=(count, 3)))


@LAWS
def test_euler_angles_agree_with_newton_euler_in_the_field(law):
    field = lagrangian.equations_of_motion(lagrangian.EulerAngleTop(INERTIA, law))
    direct = AttitudeEquations(INERTIA, law)

    @jax.jit
    @jax.vmap
    def both(y):
        # The rates of (q, Ω) that the rates of the angles give, and those of Newton and Euler.
        state, through = jax.jvp(lagrangian.to_attitude, (y,), (field(0.0, y),))
        return through, direct(0.0, state)

    through, wanted = both(_starts(50))
    np.testing.assert_allclose(through.q, wanted.q, rtol=1e-12, atol=1e-13)
    scale = np.abs(wanted.omega).max()
    np.testing.assert_allclose(through.omega, wanted.omega, rtol=1e-12, atol=1e-12 * scale)


@LAWS
def test_lie_poisson_agrees_with_newton_euler_in_the_field(law):
    direct = AttitudeEquations(INERTIA, law)
    if law is None:
        field = lagrangian.lie_poisson(lagrangian.RotationalHamiltonian(INERTIA))
    else:
        heavy = lagrangian.HeavyTopHamiltonian(INERTIA, law)
        field = lagrangian.lie_poisson_with_direction(heavy)

    @jax.jit
    @jax.vmap
    def both(y):
        state = lagrangian.to_attitude(y)
        rate = direct(0.0, state)
        if law is None:
            start = lagrangian.Momentum(jnp.asarray(TENSOR) @ state.omega)
            return field(0.0, start).pi, jnp.asarray(TENSOR) @ rate.omega
        start, through = jax.jvp(heavy.start, (state,), (rate,))
        found = field(0.0, start)
        return (
            jnp.concatenate([found.pi, found.gamma]),
            jnp.concatenate([through.pi, through.gamma]),
        )

    found, wanted = both(_starts(50))
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "law", [pytest.param(None, marks=pytest.mark.slow), TOP], ids=["free", "heavy"]
)
def test_all_three_agree_along_a_trajectory(law):
    start = lagrangian.Coordinates([0.3, 1.2, -0.4], [0.5, -0.2, 1.1])
    state = lagrangian.to_attitude(start)

    @once
    def run(start, state):
        top = lagrangian.EulerAngleTop(INERTIA, law)
        angles = rk4(lagrangian.equations_of_motion(top), start, 0.5, 1000)
        direct = rk4(AttitudeEquations(INERTIA, law), state, 0.5, 1000)
        if law is None:
            field = lagrangian.lie_poisson(lagrangian.RotationalHamiltonian(INERTIA))
            first = lagrangian.Momentum(INERTIA.tensor @ state.omega)
        else:
            heavy = lagrangian.HeavyTopHamiltonian(INERTIA, law)
            field, first = lagrangian.lie_poisson_with_direction(heavy), heavy.start(state)
        return lagrangian.to_attitude(angles), direct, rk4(field, first, 0.5, 1000)

    angles, direct, momentum = run(start, state)
    sign = jnp.sign(jnp.sum(angles.q * direct.q))
    np.testing.assert_allclose(sign * angles.q, direct.q, atol=1e-12)
    np.testing.assert_allclose(angles.omega, direct.omega, atol=2e-12)
    np.testing.assert_allclose(momentum.pi, TENSOR @ direct.omega, atol=2e-12)
    assert float(jnp.abs(direct.omega - state.omega).max()) > 0.05


class Pendulums:
    """Planar chain of equal point masses on equal rods, angles from the vertical."""

    def __init__(self, n):
        self.n = n

    def __call__(self, q, v):
        x, y = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
        return 0.5 * jnp.sum(x**2 + y**2) + 9.81 * jnp.sum(jnp.cumsum(jnp.cos(q)))


@pytest.mark.parametrize(
    "n", [1, pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(5, marks=pytest.mark.slow)]
)
def test_a_chain_of_pendulums_by_hand(n):
    # Σ_j c_ij (cos(q_i−q_j) q̈_j + sin(q_i−q_j) q̇_j²) = −g (n−i) sin q_i, c_ij = n − max(i, j).
    rng = np.random.default_rng(n)
    q, v = rng.normal(size=(2, n))
    i, j = np.indices((n, n))
    count, apart = n - np.maximum(i, j), q[:, None] - q[None, :]
    force = -9.81 * (n - np.arange(n)) * np.sin(q) - (count * np.sin(apart)) @ v**2
    wanted = np.linalg.solve(count * np.cos(apart), force)
    field = lagrangian.equations_of_motion(Pendulums(n))
    y = lagrangian.Coordinates(q, v)
    pushed = lagrangian.equations_of_motion(Pendulums(n), lambda t, q, v: -0.1 * v)

    @jax.jit
    def all_of(y):
        now = field(0.0, y)
        kept = jax.jvp(field.energy, (y,), (now,))
        lost = jax.jvp(field.energy, (y,), (pushed(0.0, y),))[1]
        return now.rate, *kept, lost, Pendulums(n)(y.q, y.rate)

    found, value, rate, lost, difference = all_of(y)
    np.testing.assert_allclose(found, wanted, rtol=1e-11)
    # Jacobi's integral is the energy, and it is kept.
    height = -9.81 * np.sum(np.cumsum(np.cos(q)))
    kinetic = difference + height
    np.testing.assert_allclose(value, kinetic + height, rtol=1e-12)
    assert abs(float(rate)) < 1e-11 * abs(float(value))
    np.testing.assert_allclose(lost, -0.1 * np.sum(v**2), rtol=1e-10)


def test_casimirs_are_kept_by_any_hamiltonian():
    field = lagrangian.lie_poisson_with_direction(
        lambda p, g: jnp.sum(p**4) + jnp.sin(g[0]) * p[1] + jnp.exp(g[2])
    )
    y = MomentumAndDirection([0.4, -1.0, 0.7], [0.1, 0.9, -0.3])

    def casimirs(y):
        return jnp.stack([jnp.sum(y.gamma**2), jnp.sum(y.pi * y.gamma)])

    _, rates = jax.jvp(casimirs, (y,), (field(0.0, y),))
    np.testing.assert_allclose(rates, np.zeros(2), atol=1e-14)


@pytest.mark.oldest
def test_gradients_with_respect_to_the_numbers_of_a_lagrangian():
    start = lagrangian.Coordinates([0.3, 1.2, -0.4], [0.5, -0.2, 1.1])
    weights = jnp.array([0.3, -1.0, 0.7])

    def by_angles(inertia, top, start):
        field = lagrangian.equations_of_motion(lagrangian.EulerAngleTop(inertia, top))
        rate = jax.jvp(lagrangian.to_attitude, (start,), (field(0.0, start),))[1]
        return jnp.sum(weights * rate.omega)

    def direct(inertia, top, start):
        state = lagrangian.to_attitude(start)
        return jnp.sum(weights * AttitudeEquations(inertia, top)(0.0, state).omega)

    both = jax.jit(lambda *x: (jax.grad(by_angles, (0, 1))(*x), jax.grad(direct, (0, 1))(*x)))
    found, wanted = both(INERTIA, TOP, start)
    # A tensor is symmetric: only the symmetric part of a gradient means anything.
    found, wanted = ((x[0].tensor + x[0].tensor.T, x[1]) for x in (found, wanted))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: lagrangian.equations_of_motion(3.0), "lagrangian: wanted a function \\(q, q̇\\) → L, J, got float"),
        (lambda: lagrangian.equations_of_motion(Pendulums(1), 2.0), "force: wanted a function"),
        (lambda: lagrangian.lie_poisson(None), "hamiltonian: wanted a function .*got NoneType"),
        (lambda: lagrangian.lie_poisson(lambda p: p)(0.0, lagrangian.Momentum([1.0, 0, 0])), r"hamiltonian: wanted shape \(\), got \(3,\); one number"),
        (lambda: lagrangian.equations_of_motion(lambda q, v: v)(0.0, lagrangian.Coordinates([1.0], [2.0])), r"lagrangian: wanted shape \(\), got \(1,\); one number"),
        (lambda: lagrangian.Coordinates([1.0, 2], [1.0]), r"rate: wanted shape \(2,\), got \(1,\); one rate"),
        (lambda: lagrangian.Coordinates(1.0, 2.0), r"q: wanted generalised coordinates .*give \[q\]"),
        (lambda: lagrangian.EulerAngleTop(INERTIA, torques.Damping([1.0, 1, 1])), "Damping has no potential.*generalised force"),
        (lambda: lagrangian.HeavyTopHamiltonian(INERTIA, torques.Damping([1.0, 1, 1])), "top: wanted HeavyTop, got Damping; .*gravity alone"),
        (lambda: lagrangian.HeavyTopHamiltonian(INERTIA, lambda t, state, body: state.omega), "top: wanted HeavyTop, got function"),
        (lambda: lagrangian.HeavyTopHamiltonian(TENSOR, TOP), "inertia: wanted Inertia, got ndarray"),
        (lambda: lagrangian.RotationalHamiltonian(TENSOR), "inertia: wanted Inertia, got ndarray"),
        (lambda: lagrangian.from_attitude(rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])), "sin θ = 0.*solve for an Attitude"),
    ],
)  # fmt: skip
def test_mistakes_are_told_in_words(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()
