"""Points, voxels, quadrature: sums against exact integrals, near and far from the origin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.body import shapes
from rigidjax.body.symmetric3 import to_inertia


@pytest.mark.parametrize(("dtype", "offset"), [(jnp.float64, 2.0**20), (jnp.float32, 2.0**10)])
def test_points_far_away_lose_nothing(dtype, offset):
    rng = np.random.default_rng(0)
    # Multiples of 2⁻⁸ stay exact when shifted, so that only our arithmetic is seen.
    r = np.round(rng.uniform(-1, 1, size=(5000, 3)) * 256) / 256
    m = rng.uniform(0, 1, 5000).astype(dtype)
    body = shapes.points(jnp.asarray(m), jnp.asarray(r + offset, dtype))
    m = m.astype(np.float64)
    centre = (m[:, None] * r).sum(axis=0) / m.sum()
    second = np.einsum("n,ni,nj->ij", m, r - centre, r - centre)
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(
        body.second_moment, second, rtol=50 * eps, atol=50 * eps * second.max()
    )
    np.testing.assert_allclose(body.com, centre + offset, rtol=2 * eps)
    assert body.mass.dtype == dtype


def test_voxels_of_a_uniform_box_are_the_box_whatever_the_grid():
    for cells in ((1, 1, 1), (3, 4, 5)):
        size = np.array([1.0, 2.0, 3.0])
        spacing, corner = size / cells, np.array([1e6, -2e6, 3e6])
        body = shapes.voxels(np.full(cells, 2.0), spacing, corner)
        box = shapes.box(12.0, size)
        np.testing.assert_allclose(body.mass, 12, rtol=1e-14)
        np.testing.assert_allclose(body.com, corner + size / 2, rtol=1e-15)
        np.testing.assert_allclose(body.second_moment, box.second_moment, rtol=1e-13, atol=1e-13)


def test_voxels_are_differentiable_in_the_density():
    # Each cell adds ρ V (r rᵀ + h²/12): the energy of the sum is linear about a fixed point.
    spacing = jnp.array([0.5, 0.5, 0.5])

    def about_origin(density):
        body = shapes.voxels(density, spacing, jnp.zeros(3))
        return body.second_moment_about(jnp.zeros(3))[0, 0]

    got = jax.grad(about_origin)(jnp.ones((2, 1, 1)))
    exact = 0.125 * (np.array([0.25, 0.75]) ** 2 + 0.25 / 12)
    np.testing.assert_allclose(got.ravel(), exact, rtol=1e-13)


def test_quadrature_is_differentiable_in_density_and_shape():
    """ρ = 1 + k z in a box of height c: ∫ρ = abc(1 + kc/2), ∫ρ z² = ab(c³/3 + k c⁴/4)."""

    def integrals(k, c):
        body = shapes.quadrature(
            lambda p: 1.0 + k * p[2], lambda u: u * jnp.stack([jnp.ones(()), jnp.ones(()), c]), 4
        )
        about = body.second_moment_about(jnp.zeros(3))
        return jnp.stack([body.mass, body.mass * body.com[2], about[2, 2]])

    k, c = 0.3, 1.7
    exact = [c + k * c**2 / 2, c**2 / 2 + k * c**3 / 3, c**3 / 3 + k * c**4 / 4]
    by_k = [c**2 / 2, c**3 / 3, c**4 / 4]
    by_c = [1 + k * c, c + k * c**2, c**2 + k * c**3]
    np.testing.assert_allclose(integrals(jnp.asarray(k), jnp.asarray(c)), exact, rtol=1e-13)
    slopes = jax.jit(jax.jacrev(integrals, argnums=(0, 1)))(jnp.asarray(k), jnp.asarray(c))
    np.testing.assert_allclose(slopes, [by_k, by_c], rtol=1e-13)


def test_a_mirrored_map_is_the_same_body():
    body = shapes.quadrature(lambda p: jnp.ones(()), lambda u: u * jnp.array([-1.0, 2.0, 3.0]), 2)
    np.testing.assert_allclose(body.second_moment, shapes.box(6.0, [1, 2, 3.0]).second_moment)


def test_a_cloud_weighs_the_same_in_any_order_and_frame():
    rng = np.random.default_rng(1)
    m, r = rng.uniform(size=30), rng.normal(size=(30, 3))
    turn = rng.permutation(30)
    a, b = shapes.points(m, r), shapes.points(m[turn], r[turn])
    np.testing.assert_allclose(a.second_moment, b.second_moment, rtol=1e-13, atol=1e-13)
    textbook = sum(
        w * (p @ p * np.eye(3) - np.outer(p, p))
        for w, p in zip(m, r - np.asarray(a.com), strict=True)
    )
    np.testing.assert_allclose(to_inertia(a.second_moment), textbook, rtol=1e-12, atol=1e-12)


WRONG = {
    "rows": (
        lambda: shapes.points([1.0, 2.0], np.zeros((3, 3))),
        r"positions: wanted shape .*one row for each of 2 masses",
    ),
    "negative": (lambda: shapes.points([1.0, -2.0], np.zeros((2, 3))), "masses ≥ 0, got -2.0"),
    "massless": (lambda: shapes.points([0.0, 0.0], np.zeros((2, 3))), "mass"),
    "NaN": (lambda: shapes.points([1.0], [[0.0, np.nan, 0.0]]), r"positions: .*index \(0, 1\)"),
    "grid": (
        lambda: shapes.voxels(np.ones((2, 2)), [1.0] * 3, [0.0] * 3),
        "density: wanted",
    ),
    "below zero": (lambda: shapes.voxels(-np.ones((2, 2, 2)), [1.0] * 3, [0.0] * 3), "≥ 0"),
    "order": (
        lambda: shapes.quadrature(lambda r: r[0], lambda u: u, 0),
        "order: wanted a whole number of at least 1",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_clouds_are_named(case, unhooked):
    call, words = WRONG[case]
    with pytest.raises(ValueError, match=words):
        call()
