"""Projection, alignment, Wahba's problem and the mean: against SVD, Sylvester and optimality."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import once
from scipy.linalg import solve_sylvester
from scipy.spatial.transform import Rotation

from rigidjax.rotation import fitting, quaternion, so3

DTYPES = [np.float64, np.float32]


def project_truth(a, e):
    """Polar factor by SVD, and its derivative in direction e from P X + X P = RᵀE − EᵀR."""
    u, s, vt = np.linalg.svd(a.astype(np.float64))
    r, p = u @ vt, vt.T @ np.diag(s) @ vt
    return r, r @ solve_sylvester(p, p, r.T @ e - e.T @ r)


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", DTYPES)
def test_projection_and_its_derivative(dtype):
    """R6: at 1, at rotations, 1e-9 and 1e-4 from them, and far: 1e-13 / 1e-6, jvp and vjp."""
    rng = np.random.default_rng(0)
    turns = [np.eye(3), *Rotation.random(4, random_state=rng).as_matrix()]
    noise = [0, 1e-9, 1e-4, 0.2]
    a = np.array([r + n * rng.normal(size=(3, 3)) for r in turns for n in noise]).astype(dtype)
    e, c = rng.normal(size=(2, *a.shape)).astype(dtype)

    def parts(a, e, c):
        r, forward = jax.jvp(so3.project, (a,), (e,))
        _, backward = jax.vjp(so3.project, a)
        return r, forward, backward(c)[0]

    r, forward, backward = (np.asarray(x, np.float64) for x in jax.jit(jax.vmap(parts))(a, e, c))
    want = [project_truth(*pair) for pair in zip(a, e.astype(np.float64), strict=True)]
    tol = 1e-13 if dtype == np.float64 else 1e-6
    assert abs(r - [w[0] for w in want]).max() < (5e-15 if dtype == np.float64 else tol)
    orth = r.swapaxes(1, 2) @ r - np.eye(3)
    assert abs(orth).max() < (8e-16 if dtype == np.float64 else tol)
    scale = abs(np.array([w[1] for w in want])).max()
    assert abs(forward - [w[1] for w in want]).max() < tol * scale
    paired = (backward * e).sum((1, 2)) - (c * forward).sum((1, 2))
    assert abs(paired).max() < 20 * tol


def test_second_derivative_of_projection():
    """Against central differences of the first derivative, on SO(3) itself."""
    rng = np.random.default_rng(1)
    r = Rotation.random(random_state=rng).as_matrix()
    e, g = rng.normal(size=(2, 3, 3))
    first = jax.jit(lambda a: jax.jvp(so3.project, (a,), (e,))[1])
    second = once(lambda r, g: jax.jvp(first, (r,), (g,))[1])(r, g)
    h = 1e-5
    np.testing.assert_allclose(second, (first(r + h * g) - first(r - h * g)) / (2 * h), atol=1e-8)


def test_wahba_against_scipy_and_two_vectors():
    """Noisy and exact, weighted; two directions are enough; also when the noise mirrors."""
    rng = np.random.default_rng(2)
    for n in (2, 3, 20):
        m = Rotation.random(random_state=rng).as_matrix()
        body, w = rng.normal(size=(n, 3)), rng.uniform(0.5, 2, n)
        world = body @ m.T
        np.testing.assert_allclose(so3.wahba(body, world), m, atol=1e-14)
        noisy = world + 0.2 * rng.normal(size=(n, 3))
        want = Rotation.align_vectors(noisy, body, weights=w)[0].as_matrix()
        np.testing.assert_allclose(so3.wahba(body, noisy, w), want, atol=1e-13)
    mirrored = np.diag([3.0, 2.0, -1.0])
    np.testing.assert_allclose(so3.wahba(np.eye(3), mirrored), np.eye(3), atol=1e-15)
    body = np.array([[1.0, 0, 0], [1.0, 1e-3, 0]])
    np.testing.assert_allclose(so3.wahba(body, body @ m.T), m, atol=1e-11)


@pytest.mark.oldest
def test_wahba_derivative():
    """Turning all world directions turns the answer; a general direction by differences."""
    rng = np.random.default_rng(3)
    body, d = rng.normal(size=(2, 5, 3))
    world = body @ Rotation.random(random_state=rng).as_matrix().T + 0.1 * d
    f = jax.jit(lambda w: so3.wahba(body, w))
    m = f(world)

    def turned(v):
        return so3.log(so3.product(f(world @ so3.exp(v).T), m.T))

    np.testing.assert_allclose(once(jax.jacrev(turned))(jnp.zeros(3)), np.eye(3), atol=1e-13)
    h = 1e-6
    slope = once(lambda w, d: jax.jvp(f, (w,), (d,))[1])(world, d)
    np.testing.assert_allclose(slope, (f(world + h * d) - f(world - h * d)) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("body", [[[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0], [-2.0, -4.0, -6.0]]])
def test_wahba_refuses_a_free_turn(body, unhooked):
    body = np.array(body)
    with pytest.raises(ValueError, match="do not fix the attitude"):
        so3.wahba([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="do not fix the attitude"):
        so3.wahba(body, body)
    with pytest.raises(RuntimeError, match="do not fix the attitude"):
        jax.block_until_ready(jax.jit(so3.wahba)(body, body))


def test_wrong_shapes(unhooked):
    with pytest.raises(ValueError, match=r"body: wanted shape \(n, 3\), got \(3,\)"):
        so3.wahba(np.ones(3), np.ones(3))
    with pytest.raises(ValueError, match=r"matrices: wanted shape \(n, 3, 3\), got \(3, 3\)"):
        so3.mean(np.eye(3))


@pytest.mark.parametrize("off", [2.0, 1e-3, 1e-8, 1e-12, 1e-15, 0.0])
def test_alignment(off):
    """Also of nearly and exactly opposite directions: R a = b, orthogonal, least angle.

    Compiled: XLA rounds the two lengths otherwise than one operation after another does, and
    opposite directions were then left where they are.
    """
    rng = np.random.default_rng(4)
    for a in (*np.eye(3), *rng.normal(size=(40, 3))):
        a = a / np.linalg.norm(a)
        b = -a + off * rng.normal(size=3)
        b = b / np.linalg.norm(b)
        m, turned = (np.asarray(part) for part in aligned(3 * a, 0.1 * b))
        np.testing.assert_allclose(m @ a, b, atol=1e-15)
        np.testing.assert_allclose(m.T @ m, np.eye(3), atol=2e-15)
        angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
        np.testing.assert_allclose(turned, angle, atol=2e-15)


@jax.jit
def aligned(a, b):
    m = so3.align(a, b)
    return m, so3.distance(np.eye(3), m)


def test_alignment_is_smooth_where_the_directions_are_one():
    """da across a turns by a × da."""
    z = jnp.array([0, 0, 1.0])
    slope = once(jax.jacfwd(lambda b: so3.log(so3.align(z, b))))(z)
    np.testing.assert_allclose(slope, so3.hat(z), atol=1e-15)


@pytest.mark.slow
def test_karcher_mean():
    """The residual vanishes; equivariant; first and second derivatives by differences."""
    rng = np.random.default_rng(5)
    v, w = 0.6 * rng.normal(size=(6, 3)), rng.uniform(0.5, 2, 6)
    f = jax.jit(lambda v, w: so3.mean(jax.vmap(so3.exp)(v), w))
    m = f(v, w)
    residual = sum(a * so3.log(so3.product(m.T, so3.exp(x))) for a, x in zip(w, v, strict=True))
    np.testing.assert_allclose(residual, np.zeros(3), atol=1e-14)
    g = so3.exp(jnp.array([1.0, 2.0, -1.0]))
    moved = so3.mean(jax.vmap(lambda x: so3.product(g, so3.exp(x)))(v), w)
    np.testing.assert_allclose(moved, so3.product(g, m), atol=1e-14)
    both_signs = jax.vmap(quaternion.exp)(v) * np.array([1.0, -1, 1, -1, -1, 1])[:, None]
    np.testing.assert_allclose(
        quaternion.to_matrix(so3.mean_quaternion(both_signs, w)), m, atol=1e-14
    )

    # Two rotations: the middle of the geodesic, whose derivative in an end is known at equality.
    def ends(x):
        return so3.log(so3.mean(jnp.stack([jnp.eye(3), so3.exp(x)])))

    np.testing.assert_allclose(jax.jacfwd(ends)(jnp.zeros(3)), 0.5 * np.eye(3), atol=1e-15)


@pytest.mark.slow
def test_derivatives_of_the_karcher_mean():
    """First and second, by central differences (minutes to compile)."""
    rng = np.random.default_rng(6)
    v, w, e = 0.6 * rng.normal(size=(4, 3)), rng.uniform(0.5, 2, 4), rng.normal(size=(4, 3))
    f = jax.jit(lambda v: so3.mean(jax.vmap(so3.exp)(v), w))
    h = 1e-5
    first = jax.jit(lambda v: jax.jvp(f, (v,), (e,))[1])
    np.testing.assert_allclose(first(v), (f(v + h * e) - f(v - h * e)) / (2 * h), atol=1e-9)
    _, second = jax.jvp(first, (v,), (e,))
    np.testing.assert_allclose(second, (first(v + h * e) - first(v - h * e)) / (2 * h), atol=1e-8)


def derivative_of_wahba(body, world, weights, change):
    """The derivative of the best rotation as `world` moves along `change`, by 60 digits of SVD."""

    def best(h):
        total = mp.zeros(3)
        for b, x, w, e in zip(body, world, weights, change, strict=True):
            moved = mp.matrix(x.tolist()) + h * mp.matrix(e.tolist())
            total += mp.mpf(w) * moved * mp.matrix(b.tolist()).T
        u, _, vt = mp.svd_r(total)
        return u * mp.diag([1, 1, mp.sign(mp.det(u) * mp.det(vt))]) * vt

    with mp.workdps(60):
        h = mp.mpf(10) ** -20
        return np.array(((best(h) - best(-h)) / (2 * h)).tolist(), float)


@pytest.mark.long
@pytest.mark.parametrize("ratio", [1e5, 1e8, 1e11])
def test_a_heavy_direction_beside_a_light_one(ratio):
    # SciPy's infinite weight is the limit: off by the residual over the ratio.
    rng = np.random.default_rng(9)
    body = rng.normal(size=(3, 3))
    right = Rotation.random(random_state=4).as_matrix()
    world = body @ right.T + 0.02 * rng.normal(size=(3, 3))
    weights = np.array([1.0, ratio, 0.7])
    change = rng.normal(size=(3, 3))
    found, slope = jvp_of_wahba(body, world, weights, change)
    limit = Rotation.align_vectors(world, body, weights=[1.0, np.inf, 0.7])[0].as_matrix()
    assert np.abs(found - limit).max() < 1e-13 + 1.0 / ratio
    true = derivative_of_wahba(body, world, weights, change)
    np.testing.assert_allclose(slope, true, rtol=0, atol=1e-14 + 1e-19 * ratio)
    backward = gradient_of_wahba(world, body, weights, true)
    np.testing.assert_allclose(
        np.sum(backward * change), np.sum(true**2), rtol=0, atol=1e-13 + 1e-18 * ratio
    )
    with pytest.raises(ValueError, match="do not fix the attitude"):
        so3.wahba(body[[0, 0, 0]], world, weights)


@pytest.mark.parametrize("top", [0, 4, 8])
def test_random_weights_and_directions_that_contradict_each_other(top):
    """Against SciPy's SVD, which loses digits with the ratio of the weights; and the derivative."""
    rng = np.random.default_rng(40 + top)
    for scatter in (0.05, 1.0, 30.0):
        for _ in range(20):
            body, noise = rng.normal(size=(2, 4, 3))
            world = Rotation.random(random_state=int(rng.integers(1 << 30))).apply(body)
            world, weights = world + scatter * noise, 10 ** rng.uniform(0, top, 4)
            change = rng.normal(size=(4, 3))
            found, slope = jvp_of_wahba(body, world, weights, change)
            right, _ = Rotation.align_vectors(world, body, weights=weights)
            off = np.linalg.norm((Rotation.from_matrix(found) * right.inv()).as_rotvec())
            assert off < 1e-13 * 30**2 * 10.0**top
            true = derivative_of_wahba(body, world, weights, change)
            assert np.abs(slope - true).max() < 1e-9 * np.abs(true).max() + 1e-12


@jax.jit
def jvp_of_wahba(body, world, weights, change):
    return jax.jvp(lambda world: so3.wahba(body, world, weights), (world,), (change,))


@jax.jit
@jax.grad
def gradient_of_wahba(world, body, weights, along):
    return jnp.sum(so3.wahba(body, world, weights) * along)


@pytest.mark.parametrize("ratio", [3e5, 2e9, 1e12])
@pytest.mark.parametrize("dtype", DTYPES)
def test_one_heavy_direction_that_the_others_contradict(ratio, dtype):
    """The limit is SciPy's infinite weight; the others are wild, so that no first guess is near."""
    rng = np.random.default_rng(7)
    ratio = min(ratio, 1e4) if dtype == np.float32 else ratio
    for _ in range(10):
        body, world = rng.normal(size=(2, 3, 3)).astype(dtype)
        found = np.asarray(so3.wahba(body, world, np.array([2.0, ratio, 1.0], dtype)))
        limit, _ = Rotation.align_vectors(world, body, weights=[2.0, np.inf, 1.0])
        assert np.abs(found - limit.as_matrix()).max() < 200 / ratio + 1e-13


@pytest.mark.parametrize("world", [-np.eye(3), np.diag([1.0, 1.0, -1.0])])
def test_two_attitudes_that_fit_equally_well_are_refused(world, unhooked):
    with pytest.raises(ValueError, match="wahba: these directions do not fix the attitude"):
        so3.wahba(np.eye(3), world)


def test_a_search_that_does_not_arrive_says_so(monkeypatch, unhooked):
    body, world = np.random.default_rng(3).normal(size=(2, 3, 3))
    monkeypatch.setattr(fitting, "_MOST_STEPS", 0)
    jax.clear_caches()
    with pytest.raises(ValueError, match="Newton's method did not arrive in 0 steps"):
        so3.wahba(body, world)
    jax.clear_caches()


def test_projection_of_matrices_that_are_nearly_singular(unhooked):
    u, v = Rotation.random(2, random_state=8).as_matrix()
    for small in (1e-4, 1e-7):
        found = so3.project(u @ np.diag([3.0, small, 0.7 * small]) @ v.T)
        np.testing.assert_allclose(found, u @ v.T, rtol=0, atol=1e-14 / small)
    with pytest.raises(ValueError, match="many rotations are equally near"):
        so3.project(u @ np.diag([3.0, 2e-9, 1e-9]) @ v.T)
