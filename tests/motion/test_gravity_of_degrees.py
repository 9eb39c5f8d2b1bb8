"""Gravity of higher degrees, Chebyshev tables, tides: against point masses, NumPy and quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from jax.flatten_util import ravel_pytree
from jax.test_util import check_grads

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion.conserved import conserved
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques import base

RNG = np.random.default_rng(1)
POINTS, MASSES = RNG.normal(size=(6, 3)), RNG.uniform(0.5, 2.0, 6)
POINTS -= MASSES @ POINTS / MASSES.sum()
BODY = rj.Inertia(
    sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(MASSES, POINTS, strict=True))
)
Q = RNG.normal(size=4)
Q /= np.linalg.norm(Q)
STATE = rj.Attitude(Q, [0.3, -0.2, 0.9])
UP = np.array([0.6, -0.64, 0.48])
TABLE = RNG.normal(size=(5, 3, 7)) * 0.3 ** np.arange(7)


def stokes(n):
    """The coefficients of degree n times mass and Rⁿ: sums of solid harmonics over the masses."""
    r = np.linalg.norm(POINTS, axis=1)
    turn = np.arctan2(POINTS[:, 1], POINTS[:, 0])
    out = []
    for m in range(n + 1):
        legendre = (-1) ** m * scipy.special.lpmv(m, n, POINTS[:, 2] / r)
        factor = (2 - (m == 0)) * scipy.special.factorial(n - m) / scipy.special.factorial(n + m)
        sum_ = factor * np.sum(MASSES * r**n * legendre * np.exp(1j * m * turn))
        out += [sum_.real] if m == 0 else [sum_.real, sum_.imag]
    return np.array(out)


HARMONICS = tuple(stokes(n) for n in (3, 4, 5, 6))


@pytest.mark.parametrize("highest", [2, 3, 4, 5])
def test_of_point_masses_the_rest_is_the_next_degree(highest):
    wrong = []
    for r in (40.0, 80.0):
        law = torques.GravityGradient(2.0, r * UP, HARMONICS[: highest - 2])
        here = np.asarray(rj.quaternion.rotate_inverse(jnp.asarray(Q), r * UP))
        away = np.linalg.norm(here - POINTS, axis=1)
        torque = 2.0 * np.sum(MASSES[:, None] * np.cross(POINTS, here) / away[:, None] ** 3, axis=0)
        potential = 2.0 * np.sum(MASSES * (1 / r - 1 / away))
        found = base.evaluate_torque(law, 0.0, STATE, BODY)
        energy = law.energy(0.0, STATE, BODY)
        wrong.append((np.linalg.norm(found - torque), abs(energy - potential)))
    # Twice as far: 2^(n + 1) times less of degree n, the first that is left out; two degrees mix.
    ratio = np.divide(*wrong)
    assert (ratio > 2.0 ** (highest + 1.5)).all() and (ratio < 2.0 ** (highest + 4)).all()


def test_the_second_degree_is_a_special_case():
    """Degree two by the recurrences' neighbour: the same body with no higher degrees."""
    plain, none = torques.GravityGradient(2.0, UP), torques.GravityGradient(2.0, UP, [np.zeros(7)])
    np.testing.assert_array_equal(plain(0.0, STATE, BODY), none(0.0, STATE, BODY))
    assert plain.energy(0.0, STATE, BODY) == none.energy(0.0, STATE, BODY)


LAW = torques.GravityGradient(2.0, 6.0 * UP, HARMONICS[:2])
MOVING = torques.GravityGradient(2.0, torques.Chebyshev(-1.0, 0.5, TABLE + 3.0), HARMONICS[:1])


def test_torque_potential_and_what_is_conserved():
    def moved(turn):
        q = rj.quaternion.multiply(STATE.q, rj.quaternion.exp(turn))
        return LAW.energy(0.0, rj.Attitude(q, STATE.omega), BODY)

    slope = jax.grad(moved)(jnp.zeros(3))
    np.testing.assert_allclose(base.evaluate_torque(LAW, 0.0, STATE, BODY), -slope, rtol=1e-12)
    _, rates = jax.jvp(
        lambda y: conserved(BODY, y, LAW), (STATE,), (AttitudeEquations(BODY, LAW)(0.0, STATE),)
    )
    assert sorted(rates) == ["energy", "momentum_along_axis"]
    for rate in rates.values():
        np.testing.assert_allclose(rate, 0.0, atol=1e-12)


@pytest.mark.parametrize("law", [LAW, MOVING, torques.ChangingInertia(torques.Tide(0.3, 0.2, 2.0, MOVING.position, 0.1), MOVING)])  # fmt: skip
def test_derivatives_by_every_number_and_no_matrix_product(law):
    numbers, restore = ravel_pytree((law, STATE, BODY))

    def value(numbers):
        law, state, body = restore(numbers)
        # No body has a tensor that is not symmetric: with one, the torque is NaN.
        body = rj.Inertia(0.5 * (body.tensor + body.tensor.T))
        return base.evaluate_torque(law, 0.3, state, body)

    check_grads(jax.jit(value), (numbers,), order=1, modes=["fwd"], eps=1e-6, rtol=1e-6, atol=1e-6)
    forward, reverse = (jax.jit(mode(value))(numbers) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(reverse, forward, rtol=1e-11, atol=1e-12)
    text = str(jax.make_jaxpr(lambda y: AttitudeEquations(BODY, law)(0.5, y))(STATE))
    assert "dot_general" not in text and "while" not in text


def test_a_chebyshev_table_is_numpys():
    table = torques.Chebyshev(-1.0, 0.5, TABLE)
    ts = np.concatenate([RNG.uniform(-1.0, 1.5, 40), [-1.0, 1.5]])
    i = np.minimum(np.floor((ts + 1.0) / 0.5).astype(int), 4)
    x = 2 * ((ts + 1.0) / 0.5 - i) - 1
    wanted = [np.polynomial.chebyshev.chebval(s, TABLE[n].T) for n, s in zip(i, x, strict=True)]
    np.testing.assert_allclose(jax.vmap(table)(ts), wanted, rtol=0, atol=4e-16)
    slopes = jax.vmap(jax.jacfwd(table))(ts[:40])
    wanted = [4 * np.polynomial.chebyshev.chebval(s, np.polynomial.chebyshev.chebder(TABLE[n].T)) for n, s in zip(i[:40], x[:40], strict=True)]  # fmt: skip
    np.testing.assert_allclose(slopes, wanted, rtol=0, atol=2e-14)
    assert np.isnan(table(-1.1)).all() and np.isnan(table(1.6)).all()


def test_a_tide_is_the_inertia_of_the_bulge():
    """The trace stays; a long way through the formula in world axes, with the delay."""
    tide = torques.Tide(0.3, 0.2, 2.0, MOVING.position, 0.7)
    before = rj.quaternion.multiply(STATE.q, rj.quaternion.exp(-0.2 * STATE.omega))
    r = np.asarray(rj.quaternion.rotate_inverse(before, MOVING.position(0.4)))
    w, up = np.asarray(STATE.omega), np.diag([0.0, 0.0, 1.0])
    pull = 2.0 * (np.outer(r, r) - np.eye(3) * (r @ r) / 3) / np.linalg.norm(r) ** 5
    spin = np.outer(w, w) - np.eye(3) * (w @ w) / 3 - 0.49 * (up - np.eye(3) / 3)
    wanted = np.asarray(BODY.tensor) + 0.3 * (spin / 3 - pull)
    found = tide(0.6, STATE, BODY)
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    np.testing.assert_allclose(np.trace(found), np.trace(BODY.tensor), rtol=1e-14)


def test_a_tide_without_a_torque_keeps_the_momentum_in_space():
    """d(IΩ)/dt = IΩ × Ω with the İ of the moving bulge; a spin bulge changes Ω's own factor."""
    law = torques.ChangingInertia(torques.Tide(0.3, 0.2, 2.0, MOVING.position, 0.7))
    rate = AttitudeEquations(BODY, law)(0.3, STATE)

    def momentum(t, state):
        now = law.tensor(t, state, BODY)
        return rj.quaternion.rotate(
            state.q, rj.so3.hat(jnp.zeros(3)) @ state.omega + now @ state.omega
        )

    _, change = jax.jvp(momentum, (jnp.asarray(0.3), STATE), (jnp.ones(()), rate))
    np.testing.assert_allclose(change, 0.0, atol=1e-14)


def test_a_delay_takes_spin_from_the_body():
    """A body that spins faster than the orbit is slowed down, without a delay it is not."""
    place, body = jnp.array([2.0, 0.0, 0.0]), rj.Inertia(4.0 * jnp.eye(3))
    quarters = jax.vmap(rj.quaternion.exp)(jnp.outer(jnp.arange(8.0) * jnp.pi / 4, jnp.eye(3)[2]))

    def torque(delay):
        tide = torques.Tide(0.3, delay, 2.0, place)
        law = torques.ChangingInertia(tide, torques.GravityGradient(2.0, place))
        field = AttitudeEquations(body, law)
        return jax.vmap(lambda q: field(0.0, rj.Attitude(q, [0.0, 0.0, 1.0])).omega[2])(
            quarters
        ).mean()

    assert abs(torque(0.0)) < 1e-15 and torque(0.1) < -1e-4 and torque(-0.1) > 1e-4


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: torques.GravityGradient(1.0, UP, [np.zeros(5)]), r"harmonics: degree 3: .*\(7,\)"),
        (lambda: torques.Chebyshev(0.0, 1.0, np.zeros((3, 4))), r"\(intervals, k, terms\), got"),
        (lambda: torques.Chebyshev(0.0, -1.0, TABLE), "step: wanted a positive length, s, got -1"),
        (lambda: torques.Chebyshev(0.0, 1.0, TABLE * np.nan), "coefficients: contains NaN"),
        (lambda: torques.Tide([1.0], 0.0, 1.0, UP), r"response: wanted shape \(\)"),
        (
            lambda: torques.ChangingInertia(torques.Tide),
            "wanted an object, got the class Tide; make",
        ),
    ],
)
def test_mistakes_are_told_in_words(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()
