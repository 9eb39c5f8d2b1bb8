"""Principal axes and functions of inertia at equal moments and at any scale (failures.md R7)."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from once import once

from rigidjax.body.principal_axes import matrix_function, principal
from rigidjax.rotation import quaternion

SCALES = [1e-20, 1.0, 1e20, 1e37]


def rotation(seed: int) -> np.ndarray:
    m, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return m * np.sign(np.linalg.det(m))


def symmetric(seed: int) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(3, 3))
    return a + a.T


def bodies() -> dict[str, np.ndarray]:
    r = rotation(1)

    def turned(*m):
        return r @ np.diag(m) @ r.T

    return {
        "sphere": np.eye(3),
        "oblate": np.diag([1.0, 1.0, 1.8]),
        "prolate": np.diag([0.2, 1.0, 1.0]),
        "rotated oblate": turned(1.0, 1.0, 1.8),
        "gap 1e-9": turned(1.0, 1.0 + 1e-9, 1.8),
        "gap 1e-4": turned(1.0, 1.0 + 1e-4, 1.0 + 2e-4),
        "generic": turned(0.7, 1.2, 1.6),
    }


BODIES = bodies()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_moments_and_axes_rebuild_the_tensor_at_every_scale(dtype):
    tolerance = 30 * jnp.finfo(dtype).eps
    tensors = jnp.asarray([a * s for a in BODIES.values() for s in SCALES], dtype)
    moments, q = jax.jit(jax.vmap(principal))(tensors)
    axes = once(jax.vmap(quaternion.to_matrix))(q)
    back = jnp.einsum("nij,nj,nkj->nik", axes, moments, axes, precision="highest")
    size = jnp.max(jnp.abs(tensors), axis=(1, 2))[:, None, None]
    assert float(jnp.max(jnp.abs(back / size - tensors / size))) < tolerance
    assert float(jnp.max(jnp.abs(jnp.linalg.norm(q, axis=1) - 1))) < tolerance
    assert bool(jnp.all(q[:, 0] >= 0.5 - tolerance))
    assert bool(jnp.all(jnp.diff(moments, axis=1) >= 0))
    assert moments.dtype == q.dtype == dtype


def test_axes_in_order_are_not_turned_and_others_are_the_nearest():
    np.testing.assert_array_equal(principal(jnp.diag(jnp.array([1.0, 2, 3])))[1], [1, 0, 0, 0])
    np.testing.assert_array_equal(principal(jnp.eye(3))[1], [1, 0, 0, 0])
    moments, q = principal(jnp.diag(jnp.array([3.0, 1, 2])))
    np.testing.assert_array_equal(moments, [1, 2, 3])
    np.testing.assert_allclose(jnp.abs(q), 0.5, rtol=1e-15)


@once
def jacobians(a, scale):
    def f(x):
        return principal(x * scale)

    return jax.jacfwd(f)(a), jax.jacrev(f)(a)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", BODIES)
def test_derivatives_are_finite_forward_and_reverse_at_every_scale(name, dtype):
    for scale in SCALES:
        a = jnp.asarray(BODIES[name] * scale, dtype)
        # The axes do not depend on the scale: normalise so that float32 can hold the derivative.
        s = jnp.asarray(scale, dtype)
        for jacobian in jax.tree.leaves(jacobians(a / s, s)):
            assert bool(jnp.isfinite(jacobian).all())


@pytest.mark.oldest
def test_derivatives_of_distinct_moments_agree_with_fifty_digits():
    a, e = BODIES["generic"], symmetric(5)

    def truth(t):
        with mpmath.workdps(50):
            values, vectors = mpmath.eigsy(mpmath.matrix(a) + t * mpmath.matrix(e))
            # Projectors do not depend on the sign of an axis.
            return [values[k] for k in range(3)] + [
                vectors[i, k] * vectors[j, k] for k in range(3) for i in range(3) for j in range(3)
            ]

    def ours(t):
        moments, q = principal(jnp.asarray(a) + t * jnp.asarray(e))
        axes = quaternion.to_matrix(q)
        return jnp.concatenate([moments, jnp.einsum("ik,jk->kij", axes, axes).ravel()])

    with mpmath.workdps(50):
        h = mpmath.mpf("1e-15")
        plus, here, minus = truth(h), truth(mpmath.mpf(0)), truth(-h)
        first = np.array([float((p - m) / (2 * h)) for p, m in zip(plus, minus, strict=True)])
        second = np.array(
            [float((p - 2 * c + m) / h**2) for p, c, m in zip(plus, here, minus, strict=True)]
        )
    zero = jnp.zeros(())
    slopes = once(lambda t: (jax.jacfwd(ours)(t), jax.jacrev(ours)(t)))(zero)
    for slope in slopes:
        np.testing.assert_allclose(slope, first, rtol=1e-12, atol=1e-12)
    bend = once(jax.jacfwd(jax.jacfwd(ours)))(zero)
    np.testing.assert_allclose(bend, second, rtol=1e-10, atol=1e-10)


@pytest.mark.oldest
@pytest.mark.parametrize("name", ["sphere", "oblate", "prolate", "rotated oblate"])
def test_what_depends_on_equal_moments_symmetrically_has_the_right_derivative(name):
    # Σ λ³ = Tr A³ and the eigenspace of the odd moment are smooth where moments meet.
    a = jnp.asarray(BODIES[name])
    gradient = jax.grad(lambda x: jnp.sum(principal(x)[0] ** 3))(a)
    np.testing.assert_allclose(gradient, 3 * a @ a, rtol=1e-13, atol=1e-13)
    if name != "sphere":
        odd = 0 if name == "prolate" else 2
        e = jnp.asarray(symmetric(7))

        def projector(x):
            axis = quaternion.to_matrix(principal(x)[1])[:, odd]
            return axis[:, None] * axis[None, :]

        moved = jax.jvp(projector, (a,), (e,))[1]
        moments, q = principal(a)
        axis = quaternion.to_matrix(q)[:, odd]
        p = jnp.outer(axis, axis)
        rest = jnp.eye(3) - p
        exact = (p @ e @ rest + rest @ e @ p) / (moments[odd] - moments[1])
        np.testing.assert_allclose(moved, exact, rtol=1e-12, atol=1e-13)


def exponential_and_derivatives(a, e):
    """exp(A), and its first and second derivative along E, in 60 digits."""
    with mpmath.workdps(60):
        h = mpmath.mpf("1e-20")
        a, e = mpmath.matrix(a), mpmath.matrix(e)
        plus, here, minus = mpmath.expm(a + h * e), mpmath.expm(a), mpmath.expm(a - h * e)
        first, second = (plus - minus) / (2 * h), (plus - 2 * here + minus) / h**2
        return [np.array(x.tolist(), dtype=float) for x in (here, first, second)]


@once
def along(x, direction, scale):
    def f(y):
        return matrix_function(lambda m: jnp.exp(m / scale), y)

    def slope(y):
        return jax.jvp(f, (y,), (direction * scale,))[1]

    _, pull = jax.vjp(f, x * scale)
    _, pull_slope = jax.vjp(slope, x * scale)
    return (
        f(x * scale),
        (slope(x * scale), pull(direction)[0] * scale),
        (jax.jvp(slope, (x * scale,), (direction * scale,))[1], pull_slope(direction)[0] * scale),
    )


@pytest.mark.oldest
@pytest.mark.parametrize("name", BODIES)
def test_exponential_and_its_derivatives_at_equal_moments_and_any_scale(name):
    a, e = BODIES[name], symmetric(3)
    value, first, second = exponential_and_derivatives(a, e)
    for dtype, tolerances in (
        (jnp.float64, (1e-14, 1e-13, 1e-12)),
        (jnp.float32, (3e-6, 2e-5, 3e-4)),
    ):
        # At 1e37 the derivative itself, 1e-37, leaves the range of float32.
        for scale in SCALES if dtype == jnp.float64 else (*SCALES[:3], 1e33):
            x, direction = jnp.asarray(a, dtype), jnp.asarray(e, dtype)
            w, slopes, bends = along(x, direction, jnp.asarray(scale, dtype))
            # exp's derivatives are their own transposes: both modes give the same matrix.
            checks = [(w, value)] + [(s, first) for s in slopes] + [(s, second) for s in bends]
            for (got, want), tolerance in zip(
                checks, np.repeat(tolerances, (1, 2, 2)), strict=True
            ):
                error = np.abs(np.asarray(got, np.float64) - want).max() / np.abs(want).max()
                assert error < tolerance, (dtype, scale, error)


def test_a_function_may_depend_on_what_is_differentiated():
    a = jnp.asarray(BODIES["rotated oblate"])
    e = jnp.asarray(symmetric(4))

    def f(p, t):
        return matrix_function(lambda m: m**p, a + t * e)

    # d/dp A^p = A^p log A; and at p = 2, d/dt A² = A E + E A, d²/dt² = 2 E².
    power = jax.jit(lambda x: matrix_function(lambda m: m**2.0 * jnp.log(m), x))(a)

    @once
    def slopes(p, t):
        by_t = jax.jacfwd(f, 1)
        return jax.jacfwd(f)(p, t), by_t(p, t), jax.jacfwd(by_t, 1)(p, t)

    by_power, slope, bend = slopes(jnp.asarray(2.0), jnp.asarray(0.0))
    np.testing.assert_allclose(by_power, power, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(slope, a @ e + e @ a, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(bend, 2 * e @ e, rtol=1e-12, atol=1e-12)


def test_square_root_squares_back_for_rods_and_plates():
    tensors = jnp.asarray([np.diag([1e-9, 1.0, 1.0]), BODIES["rotated oblate"], np.eye(3)])
    root = jax.jit(jax.vmap(lambda a: matrix_function(jnp.sqrt, a)))(tensors)
    np.testing.assert_allclose(jnp.einsum("nij,njk->nik", root, root), tensors, atol=3e-15)
