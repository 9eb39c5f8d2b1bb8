"""Any vector is a body, plates are ordinary points, derivatives are right (failures.md I9)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import optimistix as optx
import pytest
from once import once

from rigidjax.body import parameters
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.validation import require_physical_mass, require_second_moment
from rigidjax.rotation import so3

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
    # So near to zero that 1 + V has no negative eigenvalue: beyond, two vectors are one body.
    v = jnp.asarray(np.random.default_rng(n).uniform(-0.25, 0.25, size=(30, n)), dtype)
    bodies, back = jax.jit(jax.vmap(lambda x: ((b := unpack(x)), pack(b))))(v)
    np.testing.assert_allclose(back, v, rtol=0, atol=3e2 * jnp.finfo(dtype).eps)
    assert {x.dtype for x in jax.tree.leaves((bodies, back))} == {np.dtype(dtype)}


def shape(d1, d2, s12, s23, s13):
    """(1 + V)² over its trace, in 50 digits."""
    root = mpmath.matrix([[1 + d1, s12, s13], [s12, 1 + d2, s23], [s13, s23, 1 - d1 - d2]])
    square = root * root
    return square / (square[0, 0] + square[1, 1] + square[2, 2])


def pseudo_inertia(v):
    """The 4 × 4 matrix of mass, first and second moments, in 50 digits."""
    mass, com = mpmath.exp(2 * v[0]), mpmath.matrix(v[7:])
    second = mass * (3 * mpmath.exp(2 * v[1]) * shape(*v[2:7]) + com * com.T)
    out = mpmath.matrix(4)
    for i in range(3):
        out[i, 3] = out[3, i] = mass * com[i]
        for j in range(3):
            out[i, j] = second[i, j]
    out[3, 3] = mass
    return out


def ours_as_pseudo_inertia(v):
    body = parameters.unpack(v)
    about_origin = body.second_moment_about(jnp.zeros_like(body.com))
    h = (body.mass * body.com)[:, None]
    return jnp.block([[about_origin, h], [h.T, body.mass[None, None]]])


def test_the_chart_and_its_derivative_agree_with_fifty_digits():
    v = np.random.default_rng(1).normal(size=10)
    with mpmath.workdps(50):
        exact = [mpmath.mpf(x) for x in v]
        value = np.array(pseudo_inertia(exact).tolist(), dtype=float)
        h = mpmath.mpf("1e-20")
        slopes = []
        for k in range(10):
            plus = [x + h * (i == k) for i, x in enumerate(exact)]
            minus = [x - h * (i == k) for i, x in enumerate(exact)]
            slope = (pseudo_inertia(plus) - pseudo_inertia(minus)) / (2 * h)
            slopes.append(np.array(slope.tolist(), dtype=float))
    np.testing.assert_allclose(ours_as_pseudo_inertia(v), value, rtol=1e-13, atol=1e-13)
    truth = np.stack(slopes, axis=-1)
    for jacobian in (jax.jacfwd, jax.jacrev):
        got = jax.jit(jacobian(ours_as_pseudo_inertia))(jnp.asarray(v))
        np.testing.assert_allclose(got, truth, rtol=1e-13, atol=1e-13 * np.abs(truth).max())


def test_principal_moments_through_the_chart_agree_with_fifty_digits():
    v = np.random.default_rng(2).normal(size=6)

    def truth(x):
        s = 3 * mpmath.exp(2 * x[0]) * shape(*x[1:])
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


@pytest.mark.oldest
@pytest.mark.parametrize("values", [(1.0, 2.0, 3.0), (2.0, 2.0, 3.0), (2.0, 2.0, 2.0)])
def test_packing_has_its_derivative_at_equal_moments_too(values):
    """dA of A² = 𝔖 is the integral of e^(−tA) d𝔖 e^(−tA)."""
    rng = np.random.default_rng(5)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    s, ds = turn @ np.diag(values) @ turn.T, rng.normal(size=(3, 3))
    s, ds = s / np.trace(s), ds + ds.T
    ds -= s * np.trace(ds)  # the trace at rest
    with mpmath.workdps(30):
        a = mpmath.sqrtm(mpmath.matrix(s.tolist()))
        h = mpmath.mpf("1e-10")
        moved = mpmath.sqrtm(mpmath.matrix(s.tolist()) + h * mpmath.matrix(ds.tolist()))
        back = mpmath.sqrtm(mpmath.matrix(s.tolist()) - h * mpmath.matrix(ds.tolist()))
        da = np.array(((moved - back) / (2 * h)).tolist(), dtype=float)
        a = np.array(a.tolist(), dtype=float)
    dv = 3 * (da / np.trace(a) - a * np.trace(da) / np.trace(a) ** 2)
    truth = [dv[0, 0], dv[1, 1], dv[0, 1], dv[1, 2], dv[0, 2]]
    _, got = jax.jvp(parameters.pack_shape, (jnp.asarray(s),), (jnp.asarray(ds),))
    np.testing.assert_allclose(got, truth, rtol=1e-9, atol=1e-9)


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
    require_physical_mass(bodies.mass)
    require_second_moment(bodies.second_moment)
    shapes = jax.jit(jax.vmap(parameters.unpack_shape))(walk[:, :5])
    require_second_moment(shapes)
    np.testing.assert_allclose(jnp.trace(shapes, axis1=1, axis2=2), 1, rtol=1e-5)
    moments = jax.jit(jax.vmap(parameters.unpack_moments))(walk[:, :3])
    assert bool((moments > 0).all() and jnp.isfinite(moments).all())
    largest = jnp.sort(moments, axis=1)
    slack = 4 * jnp.finfo(dtype).eps * largest[:, 2]
    assert bool((largest[:, 0] + largest[:, 1] - largest[:, 2] >= -slack).all())


@pytest.mark.parametrize("flat", [(1.0, 2.0, 0.0), (0.0, 0.5, 0.5), (0.0, 0.0, 3.0)])
def test_plates_and_rods_are_ordinary_points(flat):
    turn, _ = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))
    for axes in (np.eye(3), turn):
        target = jnp.asarray(axes @ np.diag(flat) @ axes.T)
        body = MassProperties(1.5, [0.1, 0.0, 0.2], target)
        vector = parameters.pack(body)
        assert bool((jnp.abs(vector) < 3).all())
        # The thickness of a plate is known as the root of round-off.
        back = parameters.unpack(vector)
        np.testing.assert_allclose(back.second_moment, target, rtol=0, atol=1e-14)
        slopes = jax.jacfwd(lambda v: parameters.unpack(v).inertia.tensor)(vector)
        assert bool(jnp.isfinite(slopes).all())


@pytest.mark.parametrize("thin", range(3))
def test_a_small_turn_of_a_plate_is_a_small_step(thin):
    """In Cholesky's factor it is a large one, where the plate is thin along a certain axis."""
    plate = np.diag(np.roll([0.0, 0.3, 0.7], thin))
    for angle in (1e-3, 1e-6):
        turned = [so3.exp(angle * jnp.eye(3)[k]) for k in range(3)]
        steps = [
            parameters.pack_shape(turn @ plate @ turn.T) - parameters.pack_shape(plate)
            for turn in turned
        ]
        assert all(float(jnp.abs(step).max()) < 3 * angle for step in steps)


def test_a_fit_reaches_a_plate_from_noisy_moments():
    """I9: unconstrained, 22 of 40 such fits end outside; in the chart none can."""
    measured = jnp.array([1.0, 1.05, 2.075])

    def residual(x, _):
        return parameters.unpack_moments(x) - measured

    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    found = optx.least_squares(residual, solver, jnp.zeros(3), max_steps=1000)
    moments = parameters.unpack_moments(found.value)
    # The nearest plate to the measurement: the excess 0.025 is shared out equally.
    np.testing.assert_allclose(moments, measured + 0.025 / 3 * np.array([1, 1, -1]), atol=1e-4)
    Inertia.from_principal(*moments)


def test_what_cannot_be_packed_is_refused_in_words(unhooked):
    point = MassProperties(1.0, [0.0, 0, 0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="a point has no shape"):
        parameters.pack(point)
    with pytest.raises(ValueError, match="a point has no shape"):
        parameters.pack_moments([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="triangle"):
        parameters.pack_moments([1.0, 2.0, 3.5])
    with pytest.raises(ValueError, match="positive semi-definite"):
        parameters.pack_second_moment(np.diag([1.0, 1.0, -0.1]))
    with pytest.raises(ValueError, match=r"wanted shape \(10,\)"):
        parameters.unpack(np.ones(9))
    with pytest.raises(TypeError, match=r"MassProperties, got Inertia.*pack_shape"):
        parameters.pack(Inertia.from_principal(1.0, 1.0, 1.0))
    with pytest.raises(RuntimeError, match="a point has no shape"):
        eqx.filter_jit(parameters.pack)(point)
    with pytest.raises(ValueError, match="beyond the dtype"):
        parameters.pack_second_moment(1e308 * np.eye(3))


def test_the_earth_in_single_precision():
    """A total whose reciprocal is no normal number was lost: all numbers were NaN."""
    moments = jnp.array([8.008e37, 8.01e37, 8.034e37], jnp.float32)
    second = jnp.diag(jnp.array([4.018e37, 4.016e37, 3.992e37], jnp.float32))
    back = parameters.unpack_second_moment(parameters.pack_second_moment(second))
    np.testing.assert_allclose(back / 1e37, second / 1e37, rtol=1e-5, atol=1e-5)
    back = parameters.unpack_moments(parameters.pack_moments(moments))
    np.testing.assert_allclose(back / 1e37, moments / 1e37, rtol=1e-5)


def test_second_derivatives_of_packing_are_symmetric():
    """By all nine entries, off the symmetric matrices, too."""
    second = jnp.diag(jnp.array([1.0, 1.3, 0.8])) + 0.1
    weights = jnp.cos(jnp.arange(6.0))
    of_flat = lambda x: weights @ parameters.pack_second_moment(x.reshape(3, 3))
    found = jax.jit(jax.hessian(of_flat))(second.ravel())
    np.testing.assert_allclose(found, found.T, rtol=0, atol=1e-13)


def test_nan_of_a_misfit_is_not_lost():
    plate = parameters.pack_shape(jnp.diag(jnp.array([4.0, 4.0, 1e-12])))
    assert jnp.isnan(parameters.curvature_rows_near_flat_body(plate, jnp.full(5, jnp.nan))).any()


...


def test_scale_and_units_are_free_in_the_shape_chart():
    v = jnp.asarray(np.random.default_rng(4).uniform(-0.25, 0.25, size=5))
    s = parameters.unpack_shape(v)
    for scale in (1e-20, 1e37):
        np.testing.assert_allclose(parameters.pack_shape(s * scale), v, atol=1e-13)
