"""Euler angles: 24 sequences against SciPy, rates against the derivative of the matrix, both
singular cases of each."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.spatial.transform import Rotation

from rigidjax.rotation import euler, quaternion, so3

INTRINSIC = [
    "".join(s) for s in itertools.product("XYZ", repeat=3) if s[0] != s[1] and s[1] != s[2]
]
SEQUENCES = INTRINSIC + [s.lower() for s in INTRINSIC]
RNG = np.random.default_rng(0)
ANGLES = RNG.uniform(-3, 3, (12, 3))
RATES = RNG.normal(size=(12, 3))


def middles(sequence, dtype):
    """Middle angles on and near both singular cases."""
    near = [0, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6]
    if sequence[0] == sequence[2]:
        return [*near, np.pi, *(np.pi - e for e in near[1:])]
    return [*(np.pi / 2 - np.array(near)), *(-np.pi / 2 + np.array(near))]


def some(*quick):
    """These in every run, all in a long one."""
    return pytest.mark.parametrize(
        "sequence",
        [s if s in quick else pytest.param(s, marks=pytest.mark.slow) for s in SEQUENCES],
    )


# Fixed and moving axes, two and three of them, in either order round.
@some("ZYX", "YZX", "ZXZ", "xyz", "zxy", "yzy")
def test_a_sequence(sequence):
    """Matrix, angles and rates in one compilation; at and near the singular cases too (R8)."""

    def everything(angles, rates):
        m = euler.to_matrix(angles, sequence)
        found = euler.from_matrix(m, sequence)
        omega = euler.rates_to_omega(found, rates, sequence)
        _, dm = jax.jvp(lambda a: euler.to_matrix(a, sequence), (found,), (rates,))
        back = euler.omega_to_rates(found, omega, sequence)
        again = euler.rates_to_omega(found, back, sequence)
        flag = euler.is_singular(found, sequence)
        return m, found, so3.body_rate(m, dm), omega, back, again, flag

    run = jax.jit(jax.vmap(everything))
    outer = np.array([[1.0, -2.0], [0.3, 2.9], [-3.0, 3.0]])
    special = np.array([[a, b, c] for b in middles(sequence, float) for a, c in outer])
    angles = np.concatenate([ANGLES, special])
    rates = np.concatenate([RATES, np.tile([0.3, -1.0, 0.7], (len(special), 1))])
    m, found, true_omega, omega, back, again, flag = (np.asarray(x) for x in run(angles, rates))

    np.testing.assert_allclose(m, Rotation.from_euler(sequence, angles).as_matrix(), atol=3e-15)
    rebuilt = np.asarray(run(found, rates)[0])
    assert abs(rebuilt - m).max() < 1e-14
    assert np.isfinite(found).all() and (abs(found) <= np.pi).all()
    np.testing.assert_allclose(omega, true_omega, atol=1e-14)
    np.testing.assert_allclose(back[: len(ANGLES)], RATES, atol=1e-13)
    # Ω comes back wherever any rates make it; at a singular case these rates do make it.
    np.testing.assert_allclose(again, omega, atol=2e-14)
    middle = angles[len(ANGLES) :, 1]
    exact = np.isin(middle, [0, np.pi, np.pi / 2, -np.pi / 2])
    assert flag[len(ANGLES) :][exact].all() and not flag[: len(ANGLES)].any()
    assert (found[flag][:, 2] == 0).all() and (back[flag][:, 2] == 0).all()


@pytest.mark.parametrize("sequence", ["ZXZ", "xyz"])
def test_derivatives_at_and_near_the_singular_case(sequence):
    """Finite there; right 1e-3 from it."""
    symmetric = sequence[0] == sequence[2]
    singular = jnp.array([0.4, 0.0 if symmetric else np.pi / 2, 0.0])

    def f(m):
        return euler.from_matrix(m, sequence)

    for mode in (jax.jacfwd, jax.jacrev):
        assert np.isfinite(once(mode(f))(euler.to_matrix(singular, sequence))).all()
    near = singular + jnp.array([0.0, 1e-3 if symmetric else -1e-3, 0.5])

    def trip(a):
        return f(euler.to_matrix(a, sequence))

    np.testing.assert_allclose(once(jax.jacrev(trip))(near), np.eye(3), atol=1e-9)


@some("ZYX", "ZXZ", "xyz", "yzy")
def test_float32_keeps_the_matrix_in_every_sequence(sequence):
    """Row R8 in single precision: both singular cases, at and near them, and in between."""
    symmetric = sequence[0].lower() == sequence[2].lower()
    ends = (0.0, np.pi) if symmetric else (-np.pi / 2, np.pi / 2)
    away = [0.0, 1e-7, 1e-5, 1e-3, 0.7]
    middle = np.array([ends[0] + d for d in away] + [ends[1] - d for d in away])
    middle = np.concatenate([middle, middles(sequence, np.float32)])
    angles = np.stack([np.full_like(middle, 1.0), middle, np.full_like(middle, -2.0)], axis=1)
    trip = jax.jit(jax.vmap(lambda m: euler.to_matrix(euler.from_matrix(m, sequence), sequence)))
    placed = jax.jit(jax.vmap(lambda a: euler.to_matrix(a, sequence)))
    m = placed(jnp.asarray(angles, jnp.float32))
    assert trip(m).dtype == jnp.float32
    assert np.abs(np.asarray(trip(m)) - np.asarray(m)).max() < 1e-6


def test_world_frame_and_float32():
    a, r = jnp.array([0.3, 1.0, -0.4], jnp.float32), jnp.array([1.0, 2.0, 3.0], jnp.float32)
    m = euler.to_matrix(a)
    world = euler.rates_to_omega(a, r, frame="world")
    assert world.dtype == m.dtype == jnp.float32
    np.testing.assert_allclose(world, m @ euler.rates_to_omega(a, r), rtol=1e-6)
    np.testing.assert_allclose(euler.omega_to_rates(a, world, frame="world"), r, rtol=1e-5)


def test_the_component_no_rates_can_make_is_dropped():
    """At θ = 0 of 3-1-3, Ω across the line of nodes is out of reach."""
    a = jnp.zeros(3)
    rates = euler.omega_to_rates(a, jnp.array([1.0, 5.0, 2.0]))
    np.testing.assert_allclose(rates, [2, 1, 0])
    np.testing.assert_allclose(euler.rates_to_omega(a, rates), [1, 0, 2])


@pytest.mark.parametrize("bad", ["ZxZ", "ZZX", "ABC", "ZX", "", 313])
def test_unknown_sequences(bad, unhooked):
    with pytest.raises(ValueError, match="sequence: unknown"):
        euler.to_matrix(jnp.zeros(3), bad)
    with pytest.raises(ValueError, match="capitals are intrinsic"):
        jax.jit(lambda m: euler.from_matrix(m, bad))(jnp.eye(3))


def test_bad_frame_and_degrees(unhooked):
    with pytest.raises(ValueError, match="frame: wanted one of body, world, got 'space'"):
        euler.rates_to_omega(jnp.zeros(3), jnp.zeros(3), frame="space")
    with pytest.warns(UserWarning, match="are they degrees"):
        euler.to_matrix(jnp.array([90.0, 45.0, 0.0]))


def test_quaternion_of_angles_is_that_of_the_matrix():
    a = jnp.array([0.3, 1.0, -0.4])
    q = quaternion.canonical(euler.to_quaternion(a, "zyx"))
    np.testing.assert_allclose(q, quaternion.from_matrix(euler.to_matrix(a, "zyx")), atol=1e-15)
