"""Kinetic energy in the three forms of the notes, eqs 54–79, against a cloud of moving points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.body.energy import (
    angular_momentum,
    kinetic_energy,
    kinetic_energy_about,
    kinetic_energy_of_matrix_rate,
    spatial_angular_momentum,
)
from rigidjax.body.shapes import points


class Moving(eqx.Module):
    """A state as the protocols see it: no class of the floor above is needed."""

    x: jax.Array
    v: jax.Array
    q: jax.Array
    omega: jax.Array


class Turning(eqx.Module):
    omega: jax.Array


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


@pytest.fixture(scope="module")
def cloud():
    """1e4 points in motion: the definition `½ Σ m |ẋ|²`, summed by NumPy."""
    rng = np.random.default_rng(0)
    masses = rng.uniform(0, 1, 10_000)
    r = rng.normal(size=(10_000, 3)) @ rng.normal(size=(3, 3)) + 5.0
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    m = np.asarray(rj.quaternion.to_matrix(q))
    omega, velocity = rng.normal(size=3), rng.normal(size=3)
    x = rng.normal(size=3)
    # A point of the body moves as ẋ = V + M(Ω × r'), V the velocity of the body's origin.
    moved, rates = x + r @ m.T, velocity + np.cross(omega, r) @ m.T
    body = points(masses, r)
    com = np.asarray(body.com)
    state = Moving(
        jnp.asarray(x + m @ com),
        jnp.asarray(velocity + m @ np.cross(omega, com)),
        jnp.asarray(q),
        jnp.asarray(omega),
    )
    return {
        "body": body,
        "state": state,
        "m": m,
        "origin velocity": velocity,
        "energy": 0.5 * (masses * (rates**2).sum(axis=1)).sum(),
        "momentum": (masses[:, None] * np.cross(moved, rates)).sum(axis=0),
    }


def test_energy_with_translation_equals_the_sum_over_points(cloud):
    """Eq 79, and eq 57 with the cross term that remains when the origin is not the centre."""
    body, state = cloud["body"], cloud["state"]
    np.testing.assert_allclose(kinetic_energy(body, state), cloud["energy"], rtol=1e-13)
    about = kinetic_energy_about(body, state.q, cloud["origin velocity"], state.omega)
    np.testing.assert_allclose(about, cloud["energy"], rtol=1e-13)
    # Without the cross term (as eq 54 is often misused) it is another number.
    v, omega = cloud["origin velocity"], np.asarray(state.omega)
    dropped = 0.5 * float(body.mass) * v @ v + kinetic_energy(
        body.inertia_about(jnp.zeros(3)), omega
    )
    assert abs(float(dropped) / cloud["energy"] - 1) > 1e-2


def test_the_three_forms_agree_with_the_missing_half(cloud):
    """Eqs 63, 65 and 75; as printed, eqs 61–65 lack the ½ and give twice the energy."""
    body, state, m = cloud["body"], cloud["state"], cloud["m"]
    omega = np.asarray(state.omega)
    v = np.asarray(state.v)
    rotation = cloud["energy"] - 0.5 * float(body.mass) * v @ v
    s, j = np.asarray(body.second_moment), hat(omega)
    rate = m @ j
    np.testing.assert_allclose(kinetic_energy_of_matrix_rate(s, rate), rotation, rtol=1e-12)
    np.testing.assert_allclose(kinetic_energy_of_matrix_rate(s, j), rotation, rtol=1e-12)
    np.testing.assert_allclose(kinetic_energy(body.inertia, omega), rotation, rtol=1e-12)
    np.testing.assert_allclose(kinetic_energy(body, omega), rotation, rtol=1e-12)
    second, axes = np.linalg.eigh(s)
    along = kinetic_energy(rj.Inertia.from_second_moment(np.diag(second)), axes.T @ omega)
    np.testing.assert_allclose(along, rotation, rtol=1e-12)
    np.testing.assert_allclose(np.trace(rate @ s @ rate.T), 2 * rotation, rtol=1e-12)
    np.testing.assert_allclose(np.trace(j.T @ j @ s), 2 * rotation, rtol=1e-12)


def test_angular_momentum_in_the_body_and_in_the_world(cloud):
    body, state, m = cloud["body"], cloud["state"], cloud["m"]
    spatial = spatial_angular_momentum(body, state)
    np.testing.assert_allclose(spatial, cloud["momentum"], rtol=1e-11)
    own = np.asarray(spatial) - float(body.mass) * np.cross(state.x, state.v)
    np.testing.assert_allclose(angular_momentum(body, state), m.T @ own, rtol=1e-10, atol=1e-9)
    # Of an Inertia: about the point it turns about, translation unseen.
    np.testing.assert_allclose(spatial_angular_momentum(body.inertia, state), own, rtol=1e-10)


def test_derivatives_of_the_energy_are_the_momenta():
    inertia = rj.Inertia.from_tensor(np.array([[2, 0.1, 0.2], [0.1, 3, -0.3], [0.2, -0.3, 4]]))
    omega = jnp.array([0.3, -1.0, 2.0])
    gradient = jax.grad(lambda w: kinetic_energy(inertia, Turning(w)))(omega)
    np.testing.assert_allclose(gradient, angular_momentum(inertia, omega), rtol=1e-14)
    np.testing.assert_allclose(
        jax.hessian(lambda w: kinetic_energy(inertia, w))(jnp.zeros(3)), inertia.tensor, rtol=1e-14
    )


def test_a_state_without_attitude_has_no_momentum_in_the_world(unhooked):
    with pytest.raises(TypeError, match=r"attitude \(.q\), got Turning"):
        spatial_angular_momentum(rj.Inertia.from_principal(1.0, 1.0, 1.0), Turning(jnp.ones(3)))


def test_a_matrix_is_no_body(unhooked):
    with pytest.raises(TypeError, match=r"Inertia or MassProperties, got ndarray.*from_tensor"):
        kinetic_energy(np.eye(3), [1.0, 0, 0])


def test_a_state_is_no_rate(unhooked):
    """Its own attitude and velocity would not count beside those that are given."""
    body = rj.shapes.box(2.0, [0.1, 0.2, 0.3])
    with pytest.raises(TypeError, match="omega: wanted an array of numbers, got Spin"):
        kinetic_energy_about(body, [1.0, 0, 0, 0], [0.0, 0, 0], rj.Spin([1.0, 0, 0]))


def test_states_of_the_floor_above_are_understood():
    inertia = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    body = rj.MassProperties(2.0, [0.0, 0, 0], inertia.second_moment)
    spin = rj.Spin([1.0, 0, 0])
    rigid = rj.Rigid([0.0, 0, 0], [0.0, 3, 0], [1.0, 0, 0, 0], [1.0, 0, 0])
    assert float(kinetic_energy(inertia, spin)) == 0.5
    assert float(kinetic_energy(body, spin)) == 0.5
    assert float(kinetic_energy(body, rigid)) == 9.5
