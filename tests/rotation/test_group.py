"""Group axioms, equivariance and round trips between every pair of charts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from rigidjax.rotation import euler, mrp, quaternion, rodrigues, so3

fixed = settings(derandomize=True, deadline=None, max_examples=60)
finite = st.floats(-1, 1, allow_subnormal=False)
angles = st.one_of(
    st.floats(0, 3.1),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-5, np.pi - 1e-9, np.pi, 5.0, 30.0]),
)


@st.composite
def vectors(draw):
    """Rotation vectors: any axis, angles with the awkward ones among them."""
    axis = np.array([draw(finite), draw(finite), draw(finite)])
    axis[draw(st.integers(0, 2))] += 1.5
    return draw(angles) * axis / np.linalg.norm(axis)


@jax.jit
def _axioms(u, v, w, y):
    p, q, r = quaternion.exp(u), quaternion.exp(v), quaternion.exp(w)
    P, Q = so3.exp(u), so3.exp(v)
    pq = quaternion.multiply(p, q)
    one = jnp.eye(4)[0]
    rotate, M = quaternion.rotate, quaternion.to_matrix
    return {
        "unit": (pq @ pq, 1.0),
        "associative": (
            quaternion.multiply(pq, r),
            quaternion.multiply(p, quaternion.multiply(q, r)),
        ),
        "inverse": (quaternion.multiply(p, quaternion.conjugate(p)), one),
        "matrix of a product": (M(pq), so3.product(M(p), M(q))),
        "exp by both routes": (M(p), P),
        "orthogonal": (P.T @ P, jnp.eye(3)),
        "right-handed": (so3.determinant(P), 1.0),
        "rotate is M y": (rotate(p, y), so3.to_world(P, y)),
        "and back": (quaternion.rotate_inverse(p, rotate(p, y)), y),
        "body components": (quaternion.rotate_inverse(p, y), so3.to_body(P, y)),
        "one rotation after another": (rotate(p, rotate(q, y)), rotate(pq, y)),
        "opposite vector": (quaternion.exp(-u), quaternion.conjugate(p)),
        "keeps the cross product": (
            rotate(p, so3.cross(y, w)),
            so3.cross(rotate(p, y), rotate(p, w)),
        ),
        # Equivariance: M exp(v) Mᵀ = exp(M v), and distances seen from anywhere.
        "conjugation": (so3.conjugate(Q, P), so3.exp(so3.apply(so3.adjoint(P), v))),
        "distance, turned from the left": (
            so3.distance(so3.product(P, Q), P),
            so3.distance(Q, jnp.eye(3)),
        ),
        "distance, turned from the right": (
            so3.distance(so3.product(Q, P), P),
            so3.distance(Q, jnp.eye(3)),
        ),
        "distance both ways": (so3.distance(P, Q), so3.distance(Q, P)),
        "slerp starts": (quaternion.to_matrix(quaternion.interpolate(p, q, 0.0)), P),
        "slerp arrives": (quaternion.to_matrix(quaternion.interpolate(p, q, 1.0)), Q),
        "slerp on matrices": (so3.interpolate(P, Q, 1.0), Q),
        "hat and vee": (so3.vee(so3.hat(u)), u),
        "solve": (so3.apply(P, so3.solve(P, y)), y),
    }


@fixed
@given(vectors(), vectors(), vectors(), vectors())
def test_axioms(u, v, w, y):
    for name, (got, want) in _axioms(u, v, w, y).items():
        scale = max(1.0, *(np.linalg.norm(x) for x in (u, v, w, y))) ** 2
        # Near opposite attitudes the shorter way may be either: the angle is what both share.
        np.testing.assert_allclose(got, want, atol=3e-15 * scale, err_msg=name)


CHARTS = {
    "matrix": (quaternion.from_matrix, quaternion.to_matrix),
    "vector": (quaternion.exp, quaternion.log),
    "mrp": (mrp.to_quaternion, mrp.from_quaternion),
    "rodrigues": (rodrigues.to_quaternion, rodrigues.from_quaternion),
    "ZXZ": (euler.to_quaternion, euler.from_quaternion),
    "xyz": (lambda a: euler.to_quaternion(a, "xyz"), lambda q: euler.from_quaternion(q, "xyz")),
    "quaternion": (lambda q: q, quaternion.canonical),
}


JITTED = {name: (jax.jit(into), jax.jit(out)) for name, (into, out) in CHARTS.items()}


@settings(fixed, max_examples=30)
@given(vectors())
def test_round_trips_between_every_pair_of_charts(v):
    """The rotation is kept to 1e-14; Rodrigues' parameters lose digits as the half turn nears."""
    q = quaternion.canonical(quaternion.exp(v))
    matrix = quaternion.to_matrix(q)
    near = abs(np.linalg.norm(v) % (2 * np.pi) - np.pi) < 1e-6
    for a, (into_a, from_a) in JITTED.items():
        there = into_a(from_a(q))
        for b, (into_b, from_b) in JITTED.items():
            if near and "rodrigues" in (a, b):
                continue
            back = quaternion.to_matrix(into_a(from_a(into_b(from_b(there)))))
            np.testing.assert_allclose(back, matrix, atol=1e-14, err_msg=f"{a} → {b} → {a}")


def test_slerp_turns_at_a_constant_rate_and_is_regular_at_equal_ends():
    p = quaternion.exp(jnp.array([0.2, 0.3, -1.0]))
    q = -quaternion.multiply(p, quaternion.exp(jnp.array([1.0, -1.0, 2.0])))

    @jax.jit
    def steps(p, q, s):
        at = jax.vmap(lambda s: quaternion.interpolate(p, q, s))(s)
        step = lambda a, b: quaternion.log(quaternion.multiply(quaternion.conjugate(a), b))
        return jax.vmap(step)(at[:-1], at[1:])

    found = steps(p, q, np.linspace(0, 1, 5))
    np.testing.assert_allclose(found, np.tile([0.25, -0.25, 0.5], (4, 1)), atol=1e-15)
    slope = jax.jit(
        jax.jacfwd(
            lambda v: quaternion.log(quaternion.interpolate(jnp.eye(4)[0], quaternion.exp(v), 0.3))
        )
    )
    np.testing.assert_allclose(slope(jnp.zeros(3)), 0.3 * np.eye(3), atol=1e-16)


def test_uniform_rotations():
    """Haar measure: moments of M up to second order, and of the angle, within 5 standard errors."""
    keys = jax.random.split(jax.random.key(0), 20_000)
    m = np.asarray(jax.jit(jax.vmap(so3.uniform))(keys))
    n = len(m)
    assert abs(m.mean(0)).max() < 5 * np.sqrt(1 / 3 / n)
    second = np.einsum("nij,nkl->ijkl", m, m) / n
    assert abs(second - np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3)) / 3).max() < 5 / np.sqrt(
        5 * n
    )
    # The density of the angle is (1 − cos θ)/π: E θ = π/2 + 2/π.
    theta = Rotation.from_matrix(m.copy()).magnitude()  # SciPy 1.14 wants to write there
    assert abs(theta.mean() - (np.pi / 2 + 2 / np.pi)) < 5 * theta.std() / np.sqrt(n)
    assert quaternion.uniform(jax.random.key(1), jnp.float32).dtype == jnp.float32


def test_orders_of_components():
    ours = quaternion.exp(jnp.array([0.1, -0.2, 0.3]))
    scipy = Rotation.from_rotvec([0.1, -0.2, 0.3])
    np.testing.assert_allclose(quaternion.to_xyzw(ours), scipy.as_quat(), atol=1e-15)
    np.testing.assert_array_equal(quaternion.from_xyzw(quaternion.to_xyzw(ours)), ours)


def test_mrp_shadow_switch_and_rates():
    """σ and its shadow are one rotation; the switch keeps |σ| ≤ 1; rates are dσ/dt, both ways."""
    rng = np.random.default_rng(0)
    sigma, omega = rng.normal(size=(2, 50, 3))
    both = jax.jit(jax.vmap(mrp.to_matrix))
    np.testing.assert_allclose(both(jax.jit(jax.vmap(mrp.shadow))(sigma)), both(sigma), atol=2e-15)
    kept = jax.jit(jax.vmap(mrp.switch))(sigma)
    assert (np.linalg.norm(kept, axis=1) <= 1 + 1e-15).all()
    np.testing.assert_allclose(both(kept), both(sigma), atol=2e-15)
    np.testing.assert_array_equal(mrp.switch(jnp.zeros(3)), np.zeros(3))
    np.testing.assert_array_equal(jax.jit(jax.jacrev(mrp.switch))(jnp.zeros(3)), np.eye(3))
    _check_rates(mrp, sigma, omega)


def test_cayley_and_rates():
    rng = np.random.default_rng(1)
    g, omega = rng.normal(size=(2, 50, 3))
    for row in g[:5]:
        h = np.asarray(so3.hat(row))
        cayley = (np.eye(3) + h) @ np.linalg.inv(np.eye(3) - h)
        np.testing.assert_allclose(rodrigues.to_matrix(row), cayley, atol=1e-15)
    _check_rates(rodrigues, g, omega)
    assert bool(rodrigues.is_singular(jnp.eye(4)[2])) and not bool(
        rodrigues.is_singular(jnp.eye(4)[0])
    )


def _check_rates(chart, x, omega):
    """Ṁ = M hat(Ω) along dx/dt, by automatic differentiation of the chart's own matrix."""

    def parts(x, omega):
        rates = chart.omega_to_rates(x, omega)
        m, dm = jax.jvp(chart.to_matrix, (x,), (rates,))
        return so3.body_rate(m, dm), chart.rates_to_omega(x, rates)

    for got in jax.jit(jax.vmap(parts))(x, omega):
        np.testing.assert_allclose(got, omega, atol=5e-14)


@pytest.mark.parametrize("frame", ["body", "world"])
def test_rates_of_matrices(frame):
    """Ω and w from M and Ṁ along M(t) = exp(t hat a) exp(t hat b), against a difference quotient."""
    a, b = jnp.array([0.3, -0.2, 0.9]), jnp.array([-1.0, 0.4, 0.1])

    def path(t):
        return so3.product(so3.exp(t * a), so3.exp(t * b))

    m, dm = jax.jvp(path, (0.7,), (1.0,))
    w = a + so3.apply(so3.exp(0.7 * a), b)
    if frame == "world":
        np.testing.assert_allclose(so3.world_rate(m, dm), w, atol=1e-15)
    else:
        np.testing.assert_allclose(so3.body_rate(m, dm), so3.to_body(m, w), atol=1e-15)
        np.testing.assert_allclose(so3.rate(m, so3.body_rate(m, dm)), dm, atol=1e-15)

        def q(t):
            return quaternion.multiply(quaternion.exp(t * a), quaternion.exp(t * b))

        qt, dq = jax.jvp(q, (0.7,), (1.0,))
        np.testing.assert_allclose(quaternion.rate(qt, so3.body_rate(m, dm)), dq, atol=1e-15)
