"""Carlson's and Legendre's integrals against mpmath at 50 digits: values, derivatives, edges."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax import test_util
from once import once

from rigidjax import elliptic

DTYPES = (np.float64, np.float32)


def worst(got, wanted, sensitivity=1.0):
    """Largest relative error in units of round-off."""
    got = np.asarray(got)
    assert np.isfinite(got).all()
    errors = [
        abs(mp.mpf(float(a)) - b) / abs(b) for a, b in zip(got.ravel(), wanted, strict=True) if b
    ]
    return float(max(errors)) / np.finfo(got.dtype).eps / sensitivity


def exact(function, *columns):
    with mp.workdps(50):
        rows = zip(*(np.asarray(c, np.float64) for c in columns), strict=True)
        return [mp.re(function(*(mp.mpf(float(x)) for x in row))) for row in rows]


def carlson_arguments(dtype, count=4):
    """Ratios from 1 to 1e24, equal arguments, one zero."""
    rng = np.random.default_rng(5)
    rows = 10.0 ** rng.uniform(-1, 1, (20, count))
    wide = 10.0 ** rng.uniform(-12, 12, (20, count))
    zero = 10.0 ** rng.uniform(-6, 6, (10, count))
    zero[:, 0] = 0
    equal = np.tile(10.0 ** rng.uniform(-3, 3, (5, 1)), (1, count))
    near = equal * (1 + 1e-5 * rng.uniform(-1, 1, equal.shape))
    return np.concatenate([rows, wide, zero, equal, near]).astype(dtype).T


@pytest.mark.parametrize("dtype", DTYPES)
def test_carlson_values(dtype):
    x, y, z, p = carlson_arguments(dtype)
    cases = [
        (elliptic.rf, mp.elliprf, (x, y, z)),
        (elliptic.rd, mp.elliprd, (x, y, z)),
        (elliptic.rj_, mp.elliprj, (x, y, z, p)),
        (elliptic.rc, mp.elliprc, (x, y)),
        (elliptic.rc, mp.elliprc, (x, -y)),
    ]
    for ours, reference, arguments in cases:
        got = jax.jit(ours)(*arguments)
        assert got.dtype == dtype
        assert worst(got, exact(reference, *arguments)) < 20


@pytest.mark.parametrize(
    ("dtype", "small", "big"), [(np.float64, 1e-150, 1e150), (np.float32, 1e-18, 1e18)]
)
def test_carlson_over_the_range_of_the_dtype(dtype, small, big):
    x = np.asarray([small, small, 0.0], dtype)
    y = np.asarray([small, big, small], dtype)
    z = np.full(3, big, dtype)
    assert worst(elliptic.rf(x, y, z), exact(mp.elliprf, x, y, z)) < 20


def moment(powers, arguments):
    """∫₀^∞ ∏ (t + a)^(−b) dt by tanh–sinh quadrature in ln t, 30 digits."""
    with mp.workdps(30):

        def f(s):
            return mp.exp(s) * mp.fprod(
                (mp.exp(s) + mp.mpf(float(a))) ** -mp.mpf(b)
                for a, b in zip(arguments, powers, strict=True)
            )

        return mp.quad(f, [-160, -20, -8, -3, 0, 3, 8, 20, 60])


@pytest.mark.oldest
@pytest.mark.parametrize(
    ("function", "factor", "powers"),
    [
        (elliptic.rf, 0.5, (0.5, 0.5, 0.5)),
        (elliptic.rd, 1.5, (0.5, 0.5, 1.5)),
        (elliptic.rj_, 1.5, (0.5, 0.5, 0.5, 1)),
        (elliptic.rc, 0.5, (0.5, 1)),
    ],
)
def test_carlson_first_and_second_derivatives_are_moments(function, factor, powers):
    n = len(powers)
    arguments = jnp.asarray([0.3, 2.0, 0.04, 5.0][:n])

    def whole(a):
        return function(*a)

    gradient, hessian = once(lambda a: (jax.grad(whole)(a), jax.jacfwd(jax.jacrev(whole))(a)))(
        arguments
    )
    for i in range(n):
        first_powers = tuple(b + (k == i) for k, b in enumerate(powers))
        first = -powers[i] * factor * moment(first_powers, arguments)
        assert gradient[i] == pytest.approx(float(first), rel=5e-14)
        for j in range(i, n):
            twice = tuple(b + (k == j) for k, b in enumerate(first_powers))
            second = powers[i] * first_powers[j] * factor * moment(twice, arguments)
            assert hessian[i, j] == pytest.approx(float(second), rel=1e-13)
            assert hessian[j, i] == pytest.approx(float(second), rel=1e-13)


def test_carlson_edges():
    assert elliptic.rf(0.0, 0.0, 1.0) == jnp.inf
    assert elliptic.rd(1.0, 2.0, 0.0) == jnp.inf
    assert elliptic.rj_(1.0, 2.0, 3.0, 0.0) == jnp.inf
    assert elliptic.rc(1.0, 0.0) == jnp.inf
    for value in (elliptic.rf(-1.0, 1.0, 1.0), elliptic.rj_(1.0, 1.0, 1.0, -1.0)):
        assert jnp.isnan(value)
    # An argument that is 0 and not differentiated leaves the other derivatives finite.
    slope = jax.grad(lambda y: elliptic.rf(0.0, y, 1.0))(0.5)
    assert slope == pytest.approx(-float(mp.elliprd(0, 1, 0.5)) / 6, rel=1e-14)
    assert jax.grad(elliptic.rf)(0.0, 1.0, 2.0) == -jnp.inf


M1 = (2.5, 1.0, 1 - 1e-9, 0.5, 1e-3, 1e-10, 1e-16, 1e-20, 1e-30)
PHI = (1e-9, 0.3, 1.5, np.pi / 2, 1.7, 3.0, -2.0, 12.0, 40.0)
N1 = (1.0, 0.5, 1e-8, 1e-20, 3.0, 1e6)


def conditioned(function, arguments):
    """Values and how far they move, relatively, when every argument moves by one part in 1e12."""
    with mp.workdps(60):
        step = mp.mpf(10) ** -12
        values = exact(function, *arguments)
        conditions = [mp.mpf(1)] * len(values)
        for k in range(len(arguments)):

            def moved(*a, k=k):
                return function(*(x * (1 + step) if i == k else x for i, x in enumerate(a)))

            for i, (other, value) in enumerate(zip(exact(moved, *arguments), values, strict=True)):
                conditions[i] += abs((other - value) / value) / step
        return values, conditions


@pytest.mark.parametrize("dtype", DTYPES)
def test_legendre_values(dtype):
    m1 = np.asarray(M1, dtype)
    m = (1 - m1.astype(np.float64)).astype(dtype)
    phi, b = (a.ravel() for a in np.meshgrid(np.asarray(PHI, dtype), m1))
    n1, c = (a.ravel() for a in np.meshgrid(np.asarray(N1, dtype), m1))
    # Π complete at n1 = 1 is K; the incomplete one pairs the lists.
    cases = [
        (lambda m1: elliptic.ellipk(1 - m1, m1), lambda m1: mp.ellipk(1 - m1), (m1,)),
        (lambda m1: elliptic.ellipe(1 - m1, m1), lambda m1: mp.ellipe(1 - m1), (m1,)),
        (
            lambda p, m1: elliptic.ellipf(p, 1 - m1, m1),
            lambda p, m1: mp.ellipf(p, 1 - m1),
            (phi, b),
        ),
        (
            lambda p, m1: elliptic.ellipeinc(p, 1 - m1, m1),
            lambda p, m1: mp.ellipe(p, 1 - m1),
            (phi, b),
        ),
        (
            lambda n1, m1: elliptic.ellippi(1 - n1, 1 - m1, m1, n1),
            lambda n1, m1: mp.elliprf(0, m1, 1) + (1 - n1) * mp.elliprj(0, m1, 1, n1) / 3,
            (n1, c),
        ),
    ]
    assert elliptic.ellipk(m).dtype == dtype
    for ours, reference, arguments in cases:
        got = np.asarray(jax.jit(ours)(*arguments))
        values, conditions = conditioned(reference, arguments)
        assert got.dtype == dtype and np.isfinite(got).all()
        errors = [
            float(abs(mp.mpf(float(g)) - v) / abs(v) / k)
            for g, v, k in zip(got, values, conditions, strict=True)
        ]
        worst_at = int(np.argmax(errors))
        where = [np.asarray(a)[worst_at] for a in arguments]
        assert max(errors) < 20 * np.finfo(dtype).eps, (where, got[worst_at], values[worst_at])


def third_kind(n, phi, m):
    """DLMF 19.25.14 and 19.2.10, in Carlson's integrals of mpmath."""
    turns = mp.nint(phi / mp.pi)
    s, c = mp.sin(phi - turns * mp.pi), mp.cos(phi - turns * mp.pi)
    x, y = c * c, 1 - m * s * s
    part = s * mp.elliprf(x, y, 1) + n * s**3 / 3 * mp.elliprj(x, y, 1, 1 - n * s * s)
    return part + 2 * turns * (mp.elliprf(0, 1 - m, 1) + n / 3 * mp.elliprj(0, 1 - m, 1, 1 - n))


FUNCTIONS = {
    "ellipk": (elliptic.ellipk, mp.ellipk, (0.3,)),
    "ellipk at 0": (elliptic.ellipk, mp.ellipk, (0.0,)),
    "ellipe": (elliptic.ellipe, mp.ellipe, (-1.7,)),
    "ellipe at 0": (elliptic.ellipe, mp.ellipe, (0.0,)),
    "ellippi": (elliptic.ellippi, mp.ellippi, (-0.6, 0.4)),
    "ellippi at 0": (elliptic.ellippi, mp.ellippi, (0.0, 0.0)),
    "ellipf": (elliptic.ellipf, mp.ellipf, (0.9, 0.6)),
    "ellipf second turn": (elliptic.ellipf, mp.ellipf, (4.0, 0.6)),
    "ellipf at 0": (elliptic.ellipf, mp.ellipf, (1.1, 0.0)),
    "ellipeinc": (elliptic.ellipeinc, mp.ellipe, (0.9, 0.6)),
    "ellipeinc second turn": (elliptic.ellipeinc, mp.ellipe, (4.0, -0.6)),
    "ellippiinc": (elliptic.ellippiinc, third_kind, (0.3, 2.2, 0.5)),
}


@functools.cache
def derivatives(ours):
    """The compiled gradient and Hessian of a function of the numbers in one array."""

    def whole(a):
        return ours(*a)

    return once(lambda a: (jax.grad(whole)(a), jax.jacfwd(jax.jacrev(whole))(a)))


@pytest.mark.oldest
@pytest.mark.parametrize("name", FUNCTIONS)
def test_legendre_first_and_second_derivatives(name):
    ours, reference, point = FUNCTIONS[name]
    size, at = len(point), jnp.asarray(point)
    gradient, hessian = derivatives(ours)(at)
    backwards = once(jax.hessian(lambda a: ours(*a)))(at) if size == 1 else hessian
    with mp.workdps(50):
        for i in range(size):
            for j in range(size):
                orders = [0] * size
                orders[i] += 1
                if j == i:
                    first = mp.re(mp.diff(reference, point, tuple(orders)))
                    assert gradient[i] == pytest.approx(float(first), rel=1e-13, abs=1e-15)
                orders[j] += 1
                second = mp.re(mp.diff(reference, point, tuple(orders)))
                assert hessian[i, j] == pytest.approx(float(second), rel=2e-13, abs=2e-15)
                assert hessian[i, j] == pytest.approx(float(hessian[j, i]), rel=1e-13, abs=2e-15)
    np.testing.assert_allclose(backwards, hessian, rtol=1e-14)


def test_derivatives_of_k_and_e_keep_their_digits_as_m_goes_to_1():
    """dK/dm = (E − m1 K)/(2 m m1), dE/dm = (E − K)/(2m) (DLMF 19.4.1–2), in 80 digits."""
    m1 = np.asarray([1e-3, 1e-10, 1e-30])
    k = jax.jit(jax.vmap(jax.grad(lambda b: elliptic.ellipk(1 - b, b))))(m1)
    e = jax.jit(jax.vmap(jax.grad(lambda b: elliptic.ellipe(1 - b, b))))(m1)
    with mp.workdps(80):
        for i, b in enumerate(mp.mpf(float(x)) for x in m1):
            K, E = mp.ellipk(1 - b), mp.ellipe(1 - b)
            assert -k[i] == pytest.approx(float((E - b * K) / (2 * (1 - b) * b)), rel=1e-14)
            assert -e[i] == pytest.approx(float((E - K) / (2 * (1 - b))), rel=1e-14)


def test_legendre_edges():
    assert elliptic.ellipk(1.0) == jnp.inf
    assert elliptic.ellipe(1.0) == 1
    assert jax.grad(elliptic.ellipe)(1.0) == -jnp.inf
    assert elliptic.ellippi(1.0, 0.5) == jnp.inf
    assert jnp.isnan(elliptic.ellipk(1.5))
    assert jnp.isnan(elliptic.ellipe(1.5))
    assert jnp.isnan(elliptic.ellippi(1.5, 0.5))
    # m = 1: the inverse Gudermannian and the sine, with their slopes.
    value, slope = jax.value_and_grad(elliptic.ellipf)(1.2, 1.0)
    assert value == pytest.approx(float(mp.asinh(mp.tan(1.2))), rel=1e-14)
    assert slope == pytest.approx(1 / np.cos(1.2), rel=1e-14)
    assert elliptic.ellipeinc(1.2, 1.0) == pytest.approx(np.sin(1.2), rel=1e-15)
    assert jax.grad(elliptic.ellipeinc, 1)(0.0, 0.5) == 0


def test_legendre_relation():
    """E K' + E' K − K K' = π/2 (DLMF 19.7.1)."""
    m = jnp.linspace(0.01, 0.99, 50)
    k, e, k1, e1 = (
        elliptic.ellipk(m),
        elliptic.ellipe(m),
        elliptic.ellipk(1 - m),
        elliptic.ellipe(1 - m),
    )
    np.testing.assert_allclose(e * k1 + e1 * k - k * k1, np.pi / 2, rtol=3e-15)


def test_shapes_broadcast_and_dtypes_follow():
    # Traced, not run: that is where shapes and dtypes are settled.
    of = jax.eval_shape
    assert of(elliptic.ellipf, jnp.ones((3, 1)), jnp.full((4,), 0.5)).shape == (3, 4)
    assert of(lambda x, z: elliptic.rd(x, 1.0, z), jnp.ones((2,)), jnp.ones((5, 1))).shape == (5, 2)
    for dtype in DTYPES:
        x = jnp.asarray([0.3], dtype)
        assert of(elliptic.ellippiinc, x, x, x).dtype == dtype
        assert of(lambda x: elliptic.ellipf(x, 0.5), x).dtype == dtype
        assert of(jax.grad(lambda x: elliptic.ellipf(1.0, x)[0]), x).dtype == dtype


def test_all_modes_agree():
    f = jax.jit(elliptic.ellippiinc)
    test_util.check_grads(f, (0.3, 1.1, 0.4), 1, modes=["fwd", "rev"], eps=1e-5)


def test_mistakes_are_named(unhooked):
    with pytest.raises(ValueError, match="modulus k given for the parameter"):
        elliptic.ellipk(0.5, 0.75)
    with pytest.raises(ValueError, match="broadcast together: phi"):
        elliptic.ellipf(jnp.ones(3), jnp.ones(2) * 0.5)
    with pytest.raises(TypeError, match="float32 or float64, got float16"):
        elliptic.rf(jnp.ones((), jnp.float16), 1.0, 1.0)
    with pytest.raises(TypeError, match="m: wanted an array of numbers"):
        elliptic.ellipk(None)
