"""Ellipsoids of energy and momentum, and the solid one that moves as the body does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.body import shapes
from rigidjax.body.energy import ellipsoid

INERTIA = rj.Inertia.from_principal(1.0, 2.0, 2.5).rotate(np.array([0.8, 0.0, 0.6, 0.0]))


def surface(semi_axes, q):
    """Points of the ellipsoid, in body axes."""
    n = np.random.default_rng(0).normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return (n * np.asarray(semi_axes)) @ np.asarray(rj.quaternion.to_matrix(q)).T


def test_every_rate_on_it_has_that_energy_or_momentum():
    rates = jnp.asarray(surface(*ellipsoid(INERTIA, "energy", 3.0)))
    energies = once(jax.vmap(lambda w: rj.kinetic_energy(INERTIA, w)))(rates)
    np.testing.assert_allclose(energies, 3.0, rtol=1e-13)
    rates = jnp.asarray(surface(*ellipsoid(INERTIA, "momentum", 3.0)))
    momenta = once(jax.vmap(lambda w: rj.angular_momentum(INERTIA, w)))(rates)
    np.testing.assert_allclose(np.linalg.norm(momenta, axis=1), 3.0, rtol=1e-13)


def test_the_equal_ellipsoid_has_the_same_mass_properties():
    body = shapes.box(2.0, [1.0, 2.0, 3.0]).rotate(np.array([0.8, 0.0, 0.6, 0.0]))
    semi_axes, q = ellipsoid(body, "mass")
    again = shapes.ellipsoid(2.0, semi_axes).rotate(q)
    np.testing.assert_allclose(again.second_moment, body.second_moment, rtol=1e-13, atol=1e-14)


def test_a_sphere_carries_derivatives():
    def axes(a):
        return ellipsoid(rj.Inertia(a), "energy", 2.0)[0]

    gradient = jax.grad(lambda a: axes(a).sum())(jnp.eye(3))
    np.testing.assert_allclose(gradient, -np.eye(3), atol=1e-14)


def test_a_rod_has_none(unhooked):
    with pytest.raises(ValueError, match="thin rod"):
        ellipsoid(shapes.rod(1.0, 1.0).inertia, "energy", 1.0)


def test_a_size_that_is_missing_or_too_much_is_refused():
    with pytest.raises(
        TypeError, match="wanted the momentum, kg m²/s for the ellipsoid of momentum, got None"
    ):
        ellipsoid(INERTIA, "momentum")
    with pytest.raises(TypeError, match=r"wanted no size for the ellipsoid of mass, got 1\.0"):
        ellipsoid(shapes.box(2.0, [1.0, 2.0, 3.0]), "mass", 1.0)
