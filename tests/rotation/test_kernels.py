"""exp and log on the whole ladder of angles: values, first and second derivatives, both modes."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.rotation import quaternion, so3

SMALL = [0, 1e-300, 1e-20, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1, 2, 3]
NEAR = [np.pi - 10.0**-k for k in range(1, 16)]
DTYPES = [np.float64, np.float32]
EPS = {np.float64: 2.3e-16, np.float32: 1.2e-7}


def axes(n):
    """Random axes, and the awkward ones: coordinate axes, nearly so, planes, diagonals."""
    e = np.eye(3)
    awkward = [*e, *-e, *(e + 1e-9), *(e + 1e-5 * e[[1, 2, 0]]), *(1 - e), np.ones(3), -np.ones(3)]
    rows = np.concatenate([awkward, np.random.default_rng(0).normal(size=(n - len(awkward), 3))])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@functools.cache
def vectors(dtype, n=1000):
    """Rotation vectors (rows), as stored, and their angles; only those that stay below π."""
    angles = np.array(SMALL + NEAR)
    v = (angles[:, None, None] * axes(n)).reshape(-1, 3).astype(dtype)
    length = np.linalg.norm(v.astype(np.float64), axis=1)
    return v[length < np.pi], length[length < np.pi]


ROUTES = {
    "matrix": lambda v: so3.log(so3.exp(v)),
    "quaternion": lambda v: quaternion.log(quaternion.exp(v)),
}


# Both routes in float64, one in float32; the other in a long run.
BOTH = pytest.mark.parametrize(
    ("route", "dtype"),
    [
        ("matrix", np.float64),
        ("quaternion", np.float64),
        ("matrix", np.float32),
        pytest.param("quaternion", np.float32, marks=pytest.mark.slow),
    ],
)


@pytest.mark.oldest
@BOTH
def test_log_of_exp_is_one_with_its_jacobian_in_both_modes(route, dtype):
    """R1, R3, R4. Bars 4e-15 on the value, 1e-13 on J, 1e-12 near π; float32 1e-6, 2e-6, 1e-5."""
    f = ROUTES[route]
    v, length = vectors(dtype)
    value = np.asarray(jax.jit(jax.vmap(f))(v))
    assert value.dtype == dtype
    near = length > np.pi - 1e-1 if dtype == np.float64 else length > np.pi - 1e-3
    sure = np.pi - length > (1e-12 if dtype == np.float64 else 1e-6)
    error = abs(value - v).max(axis=1)
    # Where π − θ is round-off either sign is right.
    error[~sure] = np.minimum(error, abs(value + v).max(axis=1))[~sure]
    assert error.max() < (4e-15 if dtype == np.float64 else 1e-6)
    assert (error <= 16 * EPS[dtype] * length + 1e-307).all()
    for mode in (jax.jacfwd, jax.jacrev):
        jacobian = np.asarray(jax.jit(jax.vmap(mode(f)))(v))
        assert jacobian.dtype == dtype and np.isfinite(jacobian).all()
        error = abs(jacobian - np.eye(3)).max(axis=(1, 2))
        assert error[~near].max() < (1e-13 if dtype == np.float64 else 2e-6)
        assert error[sure].max() < (1e-12 if dtype == np.float64 else 1e-5)


@pytest.mark.oldest
@BOTH
def test_second_derivative_of_log_of_exp_is_zero(route, dtype):
    """Forward over reverse and reverse over forward; the size of log's own curvature is 1."""
    v, length = vectors(dtype, 30)
    v = v[np.pi - length > (1e-12 if dtype == np.float64 else 1e-5)]
    f = ROUTES[route]
    orders = {"matrix": (jax.jacfwd, jax.jacrev), "quaternion": (jax.jacrev, jax.jacfwd)}
    outer, inner = orders[route]
    hessian = np.asarray(once(jax.vmap(outer(inner(f))))(v))
    assert abs(hessian).max() < (1e-13 if dtype == np.float64 else 1e-5)


def exact_quaternion(v):
    """(cos θ/2, v sin(θ/2)/θ) in 50 digits."""
    v = [mp.mpf(x) for x in v]
    theta = mp.sqrt(sum(x * x for x in v))
    half = mp.sin(theta / 2) / theta if theta else mp.mpf(1) / 2
    return [mp.cos(theta / 2), *[half * x for x in v]]


def exact_matrix(v):
    w, x, y, z = exact_quaternion(v)
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["quaternion", "matrix"])
def test_exp_against_fifty_digits(name, dtype):
    """Relative to what an error of one rounding in θ does; far turns included."""
    f, exact = {
        "quaternion": (quaternion.exp, exact_quaternion),
        "matrix": (so3.exp, exact_matrix),
    }[name]
    v = np.concatenate([vectors(dtype, 25)[0], (axes(25) * 6.5).astype(dtype)])
    v = np.concatenate([v, (axes(25) * 100).astype(dtype), (axes(20) * 1e-3).astype(dtype)])
    with mp.workdps(50):
        want = np.array([[float(x) for x in exact([float(x) for x in row])] for row in v])
    got = np.asarray(jax.jit(jax.vmap(f))(v)).reshape(len(v), -1)
    scale = np.maximum(1, np.linalg.norm(v, axis=1))[:, None]
    assert (abs(got - want) <= 4 * EPS[dtype] * scale).all()
    # The parts that vanish with v keep their relative accuracy, down to the smallest normal number.
    if name == "quaternion":
        small = np.linalg.norm(v, axis=1) < 0.5
        assert (abs(got - want)[small, 1:] <= 4 * EPS[dtype] * abs(want[small, 1:]) + 1e-307).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_second_derivatives_of_exp_against_fifty_digits(dtype):
    """Central differences of step 1e-15 in 60 digits are right to 1e-29; v = 0 and θ > π included."""
    base = np.array([[0, 0, 0], [1e-9, 0, 2e-9], [3e-4, -1e-4, 0], [0.3, -0.2, 0.5], [2, 1, -2]])
    v = np.concatenate([base, base[3:] * 4]).astype(dtype)
    with mp.workdps(60):
        h = mp.mpf(10) ** -15
        basis = np.array([[h if i == j else mp.mpf(0) for j in range(3)] for i in range(3)])

        def second(row, i, j):
            row = np.array([mp.mpf(float(x)) for x in row])
            parts = [
                np.array(exact_matrix(row + a * basis[i] + b * basis[j])) * a * b
                for a in (1, -1)
                for b in (1, -1)
            ]
            return [float(x) for x in sum(parts) / (4 * h * h)]

        want = np.array([[[second(row, i, j) for j in range(3)] for i in range(3)] for row in v])
    want = want.transpose(0, 3, 1, 2).reshape(-1, 3, 3, 3, 3)
    for outer, inner in ((jax.jacfwd, jax.jacrev), (jax.jacfwd, jax.jacfwd)):
        got = np.asarray(jax.jit(jax.vmap(outer(inner(so3.exp))))(v))
        assert abs(got - want).max() < (1e-12 if dtype == np.float64 else 1e-5)


def test_log_at_exactly_half_a_turn():
    """Finite, one-sided right, and ∇|log|² = 2π along the axis, not 0 (R4)."""
    for axis in axes(20):
        q = jnp.concatenate([jnp.zeros(1), jnp.asarray(axis)])
        v = quaternion.log(q)
        # |axis| is 1 to one rounding, which atan2 does not see.
        np.testing.assert_allclose(jnp.linalg.norm(v), np.pi, rtol=4e-16)
        np.testing.assert_array_equal(v, quaternion.log(-q))
        side = np.sign(np.dot(v, axis))

        def turned(x, v=v):
            return quaternion.log(quaternion.exp(v - x * v / jnp.pi))

        np.testing.assert_allclose(jax.jacfwd(turned)(1e-13), -v / np.pi, atol=1e-12)
        # The one-sided slope of 2 atan2(1, w), w being the scalar of q or of −q.
        slope = jax.jvp(quaternion.log, (q,), (jnp.array([1.0, 0, 0, 0]),))[1]
        np.testing.assert_allclose(slope, -2 * axis, atol=1e-14)

        def loss(q):
            return (quaternion.log(q) ** 2).sum()

        np.testing.assert_allclose(jax.grad(loss)(q)[0], -4 * np.pi * side, rtol=1e-14)


@pytest.mark.parametrize("dtype", DTYPES)
def test_jacobians(dtype):
    """J_l is the derivative of exp; the inverses are inverse; exact for tiny turns (SE(3))."""
    v, _length = vectors(dtype, 40)
    tol = 1e-14 if dtype == np.float64 else 3e-6

    def parts(v):
        left, right = so3.left_jacobian(v), so3.right_jacobian(v)
        m = so3.exp(v)
        dm = jax.jacfwd(so3.exp)(v)
        world = jax.jit(jax.vmap(so3.world_rate, in_axes=(None, 2), out_axes=1))(m, dm)
        body = jax.jit(jax.vmap(so3.body_rate, in_axes=(None, 2), out_axes=1))(m, dm)
        eye = jnp.eye(3, dtype=v.dtype)
        return (
            left - world,
            right - body,
            so3.product(left, so3.left_jacobian_inverse(v)) - eye,
            so3.product(right, so3.right_jacobian_inverse(v)) - eye,
            left - so3.product(so3.adjoint(m), right),
        )

    for error in jax.jit(jax.vmap(parts))(v):
        assert abs(np.asarray(error)).max() < tol
    # J_l(v) u − u ≈ ½ v × u: its leading digits must not drown, whatever the size of v.
    u = np.array([0.3, -2.0, 1.0], dtype)
    got = jax.jit(jax.vmap(lambda v: so3.apply(so3.left_jacobian(v), u)))(v)
    with mp.workdps(50):

        def exact(row):
            x, y, z = (mp.mpf(float(a)) for a in row)
            t = x * x + y * y + z * z
            theta = mp.sqrt(t)
            b = (1 - mp.cos(theta)) / t if t > 1e-30 else mp.mpf(1) / 2
            c = (theta - mp.sin(theta)) / theta**3 if t > 1e-30 else mp.mpf(1) / 6
            h = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            return list((mp.eye(3) + b * h + c * h * h) * mp.matrix([float(a) for a in u]))

        want = np.array([[float(x) for x in exact(row)] for row in v])
    assert abs(np.asarray(got) - want).max() < 20 * EPS[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivative_at_rest(dtype):
    """R2: d(attitude)/dω at ω = 0 is T 1, and the attitude is linear in a tiny ω."""
    duration = np.array(0.7, dtype)
    q0 = quaternion.exp(jnp.array([0.3, -1.0, 0.4], dtype))

    def moved(w):
        return quaternion.log(
            quaternion.multiply(quaternion.conjugate(q0), quaternion.advance(q0, w, duration))
        )

    tol = 1e-13 if dtype == np.float64 else 1e-6
    for mode in (jax.jacfwd, jax.jacrev):
        got = once(mode(moved))(jnp.zeros(3, dtype))
        np.testing.assert_allclose(got, duration * np.eye(3), atol=tol)
    direction, one = np.array([0.6, 0.0, -0.8], dtype), np.array([1, 0, 0, 0], dtype)
    turned = jax.jit(lambda w: quaternion.log(quaternion.advance(one, w, duration)))
    for size in (1e-15, 1e-12, 1e-9, 1e-6):
        v = turned(size * direction)
        np.testing.assert_allclose(
            v, size * duration * direction, rtol=1e-10 if tol < 1e-9 else 1e-6
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_distance(dtype):
    """R5: relative 1e-6 from 1e-12 to π, by matrix and by quaternion; 0 with slope 0 at 0."""
    v, length = vectors(dtype, 40)
    v, length = v[length >= 0.9e-12], length[length >= 0.9e-12]
    one = np.eye(3, dtype=dtype)
    by_matrix = jax.jit(jax.vmap(lambda v: so3.distance(one, so3.exp(v))))(v)
    by_quaternion = jax.jit(jax.vmap(lambda v: quaternion.angle(-quaternion.exp(v))))(v)
    np.testing.assert_allclose(by_matrix, length, rtol=1e-6)
    np.testing.assert_allclose(by_quaternion, length, rtol=1e-6)
    assert float(so3.distance(one, one)) == 0
    assert np.isfinite(once(jax.grad(lambda m: so3.distance(one, m)))(one)).all()
    assert float(quaternion.angle(jnp.eye(4, dtype=dtype)[3])) == pytest.approx(np.pi)
    distance = once(jax.grad(lambda v: so3.distance(one, so3.exp(v))))
    slope = distance(np.array([0, 3e-4, 0], dtype))
    np.testing.assert_allclose(slope, [0, 1, 0], atol=1e-6)


def test_matrix_exponential_agrees():
    """exp(hat v) by the general algorithm (notes, eqs 14, 15)."""
    v = axes(20) * np.linspace(0, 6, 20)[:, None]
    ours = jax.jit(jax.vmap(so3.exp))(v)
    general = once(jax.vmap(lambda v: jax.scipy.linalg.expm(so3.hat(v))))(v)
    np.testing.assert_allclose(ours, general, atol=2e-14)


@pytest.mark.parametrize("dtype", DTYPES)
def test_drift_over_a_million_products(dtype):
    """R9: norm ≤ 1e-14 / 2e-7 and angle ≤ 1e-9 / 1e-3 against the exact power."""
    step = quaternion.exp(jnp.array([1e-3, 2e-3, -1.5e-3], dtype))

    def turn(q, _):
        return quaternion.normalise(quaternion.multiply(q, step)), None

    q, _ = jax.jit(lambda q: jax.lax.scan(turn, q, length=1_000_000))(jnp.eye(4, dtype=dtype)[0])
    assert abs(np.linalg.norm(np.asarray(q, np.float64)) - 1) < (
        1e-14 if dtype == np.float64 else 2e-7
    )
    with mp.workdps(50):
        w, *u = (mp.mpf(float(x)) for x in step)
        n = mp.sqrt(sum(x * x for x in u))
        half = mp.atan2(n, w) * 1_000_000
        power = np.array([float(mp.cos(half)), *[float(mp.sin(half) * x / n) for x in u]])
    apart = quaternion.multiply(quaternion.conjugate(power), np.asarray(q, np.float64))
    assert float(quaternion.angle(apart)) < (1e-9 if dtype == np.float64 else 1e-3)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_error_is_the_same_for_both_signs(dtype):
    """R10, bit for bit, at w = 0 and at zeros of either sign too."""
    rng = np.random.default_rng(1)
    q = rng.normal(size=(300, 4))
    q[:60, 0] = 0
    q[40:60, 1:3] = 0
    q[60:90] = np.eye(4)[rng.integers(0, 4, 30)]
    q = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(dtype)

    def errors(q):
        return (
            quaternion.log(q),
            quaternion.angle(q),
            quaternion.to_matrix(q),
            quaternion.rotate(q, jnp.array([1.0, 2.0, 3.0], dtype)),
            quaternion.canonical(q),
            rj.rotation.mrp.from_quaternion(q),
            rj.rotation.rodrigues.from_quaternion(q),
            *[rj.rotation.euler.from_quaternion(q, s) for s in ("ZXZ", "zyx")],
        )

    both = jax.jit(jax.vmap(errors))
    for one, other in zip(both(q), both(-q), strict=True):
        np.testing.assert_array_equal(one, other)
