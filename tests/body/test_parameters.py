"""Any vector is a body, the boundary can be approached, derivatives are right (failures.md I9)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from once import once

from rigidjax.body import parameters
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.validation import real_mass, real_second_moment

CHARTS = {
    "R6": (6, parameters.unpack_second_moment, parameters.pack_second_moment),
    "R5": (5, parameters.unpack_shape, parameters.pack_shape),
    "R3": (3, parameters.unpack_moments, parameters.pack_moments),
    "R10": (10, parameters.unpack, parameters.pack),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("chart", CHARTS)
def test_packing_undoes_unpacking(chart, dtype):
    n, unpack, pack = CHARTS[chart]
    v = jnp.asarray(np.random.default_rng(n).normal(size=(30, n)), dtype)
    bodies, back = jax.jit(jax.vmap(lambda x: ((b := unpack(x)), pack(b))))(v)
    # A chart of positive definite matrices loses digits with their condition number.
    np.testing.assert_allclose(back, v, rtol=0, atol=3e3 * jnp.finfo(dtype).eps)
    assert {x.dtype for x in jax.tree.leaves((bodies, back))} == {np.dtype(dtype)}


def published_pseudo_inertia(v):
    """J = U Uᵀ of Rucker and Wensing 2022, in 50 digits."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = v
    e = mpmath.exp
    u = e(alpha) * mpmath.matrix(
        [[e(d1), s12, s13, t1], [0, e(d2), s23, t2], [0, 0, e(d3), t3], [0, 0, 0, 1]]
    )
    return u * u.T


def ours_as_pseudo_inertia(v):
    body = parameters.unpack(v)
    about_origin = body.second_moment_about(jnp.zeros_like(body.com))
    h = (body.mass * body.com)[:, None]
    return jnp.block([[about_origin, h], [h.T, body.mass[None, None]]])


def test_the_chart_is_the_published_one_with_its_derivative():
    v = np.random.default_rng(1).normal(size=10)
    with mpmath.workdps(50):
        exact = [mpmath.mpf(x) for x in v]
        value = np.array(published_pseudo_inertia(exact).tolist(), dtype=float)
        h = mpmath.mpf("1e-20")
        slopes = []
        for k in range(10):
            plus = [x + h * (i == k) for i, x in enumerate(exact)]
            minus = [x - h * (i == k) for i, x in enumerate(exact)]
            slope = (published_pseudo_inertia(plus) - published_pseudo_inertia(minus)) / (2 * h)
            slopes.append(np.array(slope.tolist(), dtype=float))
    np.testing.assert_allclose(ours_as_pseudo_inertia(v), value, rtol=1e-13, atol=1e-13)
    truth = np.stack(slopes, axis=-1)
    for jacobian in (jax.jacfwd, jax.jacrev):
        got = jax.jit(jacobian(ours_as_pseudo_inertia))(jnp.asarray(v))
        np.testing.assert_allclose(got, truth, rtol=1e-13, atol=1e-13 * np.abs(truth).max())


def test_principal_moments_through_the_chart_agree_with_fifty_digits():
    v = np.random.default_rng(2).normal(size=6)

    def truth(x):
        d1, d2, d3, s12, s23, s13 = x
        e = mpmath.exp
        u = mpmath.matrix([[e(d1), s12, s13], [0, e(d2), s23], [0, 0, e(d3)]])
        s = u * u.T
        i = (s[0, 0] + s[1, 1] + s[2, 2]) * mpmath.eye(3) - s
        return sorted(mpmath.eigsy(i, eigvals_only=True))

    def ours(x):
        return Inertia.from_second_moment(parameters.unpack_second_moment(x)).moments

    with mpmath.workdps(50):
        exact, h = [mpmath.mpf(x) for x in v], mpmath.mpf("1e-20")
        columns = []
        for k in range(6):
            plus = truth([x + h * (i == k) for i, x in enumerate(exact)])
            minus = truth([x - h * (i == k) for i, x in enumerate(exact)])
            columns.append([float((p - m) / (2 * h)) for p, m in zip(plus, minus, strict=True)])
    got = once(jax.jacrev(ours))(jnp.asarray(v))
    np.testing.assert_allclose(got, np.array(columns).T, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_thousand_wild_steps_meet_no_invalid_body(dtype):
    """Steps of length 10 in the chart, as an optimiser gone astray takes them."""
    rng = np.random.default_rng(3)
    steps = rng.normal(size=(1000, 10))
    steps *= 10 / np.linalg.norm(steps, axis=1, keepdims=True)
    walk = jnp.asarray(np.concatenate([np.cumsum(steps, axis=0), steps]), dtype)
    bodies = jax.jit(jax.vmap(parameters.unpack))(walk)
    inertia = jax.jit(jax.vmap(lambda b: b.inertia.tensor))(bodies)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((bodies, inertia)))
    # The same checks that refuse a wrong body: each raises on the first of the 2000.
    real_mass(bodies.mass)
    real_second_moment(bodies.second_moment)
    shapes = jax.jit(jax.vmap(parameters.unpack_shape))(walk[:, :5])
    real_second_moment(shapes)
    np.testing.assert_allclose(jnp.trace(shapes, axis1=1, axis2=2), 1, rtol=1e-5)
    moments = jax.jit(jax.vmap(parameters.unpack_moments))(walk[:, :3])
    assert bool((moments > 0).all() and jnp.isfinite(moments).all())
    largest = jnp.sort(moments, axis=1)
    slack = 4 * jnp.finfo(dtype).eps * largest[:, 2]
    assert bool((largest[:, 0] + largest[:, 1] - largest[:, 2] >= -slack).all())


@pytest.mark.parametrize("flat", [(1.0, 2.0, 0.0), (0.0, 0.0, 3.0)])
def test_plates_and_rods_are_approached_to_a_millionth(flat):
    target = jnp.diag(jnp.asarray(flat))
    thick = target + jnp.diag(jnp.where(jnp.asarray(flat) == 0, 1e-12, 0.0))
    body = MassProperties(1.0, jnp.zeros(3), thick)
    back = parameters.unpack(parameters.pack(body))
    assert float(jnp.abs(back.second_moment - target).max()) < 1e-6
    np.testing.assert_allclose(back.second_moment, thick, rtol=1e-14, atol=0)
    moments = back.inertia.moments
    assert 0 <= float(moments[0] + moments[1] - moments[2]) < 1e-6


def test_a_fit_reaches_a_plate_from_noisy_moments():
    """I9: unconstrained, 22 of 40 such fits end outside; in the chart none can."""
    measured = jnp.array([1.0, 1.05, 2.075])

    @jax.jit
    def fit(v):
        def step(_, x):
            residual = parameters.unpack_moments(x) - measured
            j = jax.jacfwd(parameters.unpack_moments)(x)
            return x - jnp.linalg.solve(j.T @ j + 1e-7 * jnp.eye(3), j.T @ residual)

        return parameters.unpack_moments(jax.lax.fori_loop(0, 200, step, v))

    moments = fit(jnp.zeros(3))
    # The nearest plate to the measurement: the excess 0.025 is shared out equally.
    np.testing.assert_allclose(moments, measured + 0.025 / 3 * np.array([1, 1, -1]), atol=1e-4)
    Inertia.from_principal(*moments)


def test_what_cannot_be_packed_is_refused_in_words(unhooked):
    plate = MassProperties(1.0, [0.0, 0, 0], np.diag([1.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match=r"zero eigenvalue \(a plate, rod or point\)"):
        parameters.pack(plate)
    with pytest.raises(ValueError, match="zero eigenvalue"):
        parameters.pack_moments([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="triangle"):
        parameters.pack_moments([1.0, 2.0, 3.5])
    with pytest.raises(ValueError, match=r"wanted shape \(10,\)"):
        parameters.unpack(np.ones(9))
    with pytest.raises(TypeError, match=r"MassProperties, got Inertia.*pack_shape"):
        parameters.pack(plate.inertia)
    with pytest.raises(RuntimeError, match="zero eigenvalue"):
        eqx.filter_jit(parameters.pack)(plate)


def test_scale_and_units_are_free_in_the_shape_chart():
    v = jnp.asarray(np.random.default_rng(4).normal(size=5))
    s = parameters.unpack_shape(v)
    for scale in (1e-20, 1e37):
        np.testing.assert_allclose(parameters.pack_shape(s * scale), v, atol=1e-13)
