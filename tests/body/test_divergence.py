"""The divergence of two bodies is a prior that no choice of frame changes."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from once import once

from rigidjax.body import parameters, shapes
from rigidjax.body.divergence import divergence
from rigidjax.rotation import quaternion


def body(seed):
    return parameters.unpack(jnp.asarray(np.random.default_rng(seed).normal(size=10)))


def pseudo_inertia(b):
    m, c, s = float(b.mass), np.asarray(b.com), np.asarray(b.second_moment)
    j = mpmath.zeros(4)
    for i in range(3):
        j[i, 3] = j[3, i] = mpmath.mpf(m) * mpmath.mpf(c[i])
        for k in range(3):
            j[i, k] = mpmath.mpf(s[i, k]) + mpmath.mpf(m) * mpmath.mpf(c[i]) * mpmath.mpf(c[k])
    j[3, 3] = m
    return j


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_log_determinant_divergence_of_the_four_by_four_matrix(seed):
    a, b = body(seed), body(seed + 10)
    with mpmath.workdps(50):
        ratio = mpmath.inverse(pseudo_inertia(b)) * pseudo_inertia(a)
        exact = sum(ratio[i, i] for i in range(4)) - mpmath.log(mpmath.det(ratio)) - 4
    np.testing.assert_allclose(divergence(a, b), float(exact), rtol=1e-11)


@pytest.mark.parametrize("radius", [1e-1, 1e-2, 1e-3, 1e-4])
def test_long_thin_bodies(radius):
    """𝔖 is known to ε of its largest entry, its smallest eigenvalue to ε 𝔖₁/𝔖₃."""
    q = quaternion.exp(jnp.array([0.3, 0.5, -0.7]))
    a = shapes.cylinder(1.1, 1.1 * radius, 1.05).rotate(q)
    b = shapes.cylinder(1.0, radius, 1.0).rotate(q)
    lost = 8 * 2.2e-16 * 4 / 12 / (radius / 2) ** 2
    # From a body like it, and from a ball.
    for reference in (b, shapes.sphere(1.0, 1.0)):
        with mpmath.workdps(50):
            ratio = mpmath.inverse(pseudo_inertia(reference)) * pseudo_inertia(a)
            right = sum(ratio[i, i] for i in range(4)) - mpmath.log(mpmath.det(ratio)) - 4
        assert abs(float(divergence(a, reference) - float(right))) < lost
    assert abs(float(divergence(b, b))) < lost


def test_zero_only_at_the_reference_and_flat_there():
    reference = body(5)
    v = parameters.pack(reference)
    nearby = np.asarray(v) + 0.3 * np.random.default_rng(0).normal(size=(20, 10))

    @once
    def all_of(v, nearby):
        loss = lambda x: divergence(parameters.unpack(x), reference)
        return loss(v), jax.grad(loss)(v), jax.hessian(loss)(v), jax.vmap(loss)(nearby)

    value, slope, bend, values = (np.asarray(x) for x in all_of(v, nearby))
    assert abs(value) < 1e-12
    np.testing.assert_allclose(slope, 0, atol=1e-11)
    assert np.linalg.eigvalsh(bend)[0] > 0.01
    assert (values > 0).all()


def test_no_frame_and_no_unit_changes_it():
    a, b = body(1), body(2)
    before = divergence(a, b)
    q = np.array([0.5, 0.5, -0.5, 0.5])
    r = np.array([3.0, -2.0, 7.0])
    moved = divergence(a.rotate(q).shift(r), b.rotate(q).shift(r))
    np.testing.assert_allclose(moved, before, rtol=1e-9)

    def in_grams_and_millimetres(x):
        return type(x)(1e3 * x.mass, 1e3 * x.com, 1e9 * x.second_moment)

    changed = divergence(in_grams_and_millimetres(a), in_grams_and_millimetres(b))
    np.testing.assert_allclose(changed, before, rtol=1e-9)
