"""sn, cn, dn, am against mpmath: values, first and second derivatives, up to the separatrix."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import once

from rigidjax import elliptic

M1 = (0.5, 0.1, 0.9, 1.0, 3.0, 1e-3, 1e-6, 1e-10, 1e-16, 1e-20, 1e-30)
FRACTIONS = (1e-9, 0.01, 0.37, 0.5, 0.999, 1.0, 2.0, 3.1, 4.7, 7.9, -1.3)


def twin(u, m1):
    """sn, cn, dn as mpmath has them, reduced by the half period."""
    m = 1 - m1
    if m1 == 0:
        return mp.tanh(u), mp.sech(u), mp.sech(u)
    if m1 < 0:
        root = mp.sqrt(m)
        s, c, d = twin(u * root, -m1 / m)
        return s / root, d, c
    if m < 0:
        root = mp.sqrt(m1)
        s, c, d = twin(u * root, 1 / m1)
        return s / d / root, c / d, 1 / d
    half = 2 * mp.ellipk(m)
    turns = int(mp.nint(u / half))
    u = u - half * turns
    if m == 0:
        s, c, d = mp.sin(u), mp.cos(u), mp.mpf(1)
    else:
        s, c, d = (mp.ellipfun(kind, u=u, m=m) for kind in ("sn", "cn", "dn"))
    return (-1) ** turns * s, (-1) ** turns * c, d


def derivatives(u, m1):
    """f, f_u, f_m, f_uu, f_um, f_mm of (sn, cn, dn) by differences in 90 digits."""
    h = mp.mpf(10) ** -18 * (abs(u) + mp.mpf(10) ** -5)
    g = mp.mpf(10) ** -18 * (min(m1, 1) if m1 > 0 else mp.exp(-2 * abs(u)))

    def f(a, b):
        return mp.matrix(twin(u + a * h, m1 - b * g))

    at = f(0, 0)
    east, west, north, south = f(1, 0), f(-1, 0), f(0, 1), f(0, -1)
    corners = f(1, 1) - f(1, -1) - f(-1, 1) + f(-1, -1)
    return [
        at,
        (east - west) / (2 * h),
        (north - south) / (2 * g),
        (east - 2 * at + west) / h**2,
        corners / (4 * h * g),
        (north - 2 * at + south) / g**2,
    ]


def points(dtype, m1s, fractions):
    rows = []
    for m1 in np.asarray(m1s, dtype):
        with mp.workdps(60):
            quarter = float(mp.ellipk(1 - mp.mpf(float(m1)))) if m1 > 0 else 5.0
        rows += [(f * quarter, m1) for f in fractions]
    u, m1 = np.asarray(rows, dtype).T
    return u, m1, (1 - m1.astype(np.float64)).astype(dtype)


def stacked(u, m, m1):
    return jnp.stack(elliptic.sncndn(u, m, m1))


def check(dtype, u, m1, got, orders, bound):
    """Errors, in units of round-off × (size + change when u or m1 moves relatively by one)."""
    eps, step = float(np.finfo(dtype).eps), mp.mpf(10) ** -8
    with mp.workdps(130):
        for i in range(len(u)):
            x, b = mp.mpf(float(u[i])), mp.mpf(float(m1[i]))
            tables = [derivatives(x, b), derivatives(x * (1 + step), b)]
            tables.append(derivatives(x, b * (1 + step)))
            for k in orders:
                for j in range(3):
                    want = tables[0][k][j]
                    # Mixed and second derivatives in m: relative to the largest of the three.
                    size = abs(want) if k < 4 else mp.norm(tables[0][k])
                    size += sum(abs(table[k][j] - want) for table in tables[1:]) / step
                    error = abs(mp.mpf(float(got[k][i][j])) - want)
                    limit = bound[k] * eps * size + mp.mpf(10) ** -35
                    assert error < limit, (k, j, u[i], m1[i], got[k][i][j], mp.nstr(want, 20))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_values_over_eight_quarter_periods_up_to_the_separatrix(dtype):
    u, m1, m = points(dtype, M1, FRACTIONS)
    got = np.asarray(jax.jit(jax.vmap(stacked))(u, m, m1))
    assert got.dtype == dtype
    eps, step = float(np.finfo(dtype).eps), mp.mpf(10) ** -12
    with mp.workdps(60):
        for i in range(len(u)):
            x, b = mp.mpf(float(u[i])), mp.mpf(float(m1[i]))
            want, east, north = twin(x, b), twin(x * (1 + step), b), twin(x, b * (1 + step))
            for j in range(3):
                moved = abs(east[j] - want[j]) + abs(north[j] - want[j])
                error = abs(mp.mpf(float(got[i][j])) - want[j])
                assert error < 6 * eps * (abs(want[j]) + moved / step), (u[i], m1[i], j)


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_first_and_second_derivatives(dtype):
    # In float32 the second derivatives leave the range below 1e-16.
    m1s = (0.3, 1.0, 0.0, 1e-10) + ((1e-30,) if dtype == np.float64 else (1e-16,))
    u, m1, m = points(dtype, m1s, (1e-3, 0.41, 1.2, -5.1))

    def everything(u, m1, m):
        value = stacked(u, m, m1)
        first = jax.jacfwd(stacked, (0, 2))
        du, db = first(u, m, m1)
        (uu, ub), (_, bb) = jax.jacfwd(first, (0, 2))(u, m, m1)
        return value, du, -db, uu, -ub, bb

    got = jax.jit(jax.vmap(everything))(u, m1, m)
    assert all(part.dtype == dtype for part in got)
    check(dtype, u, m1, [np.asarray(part) for part in got], range(6), (6, 8, 10, 10, 10, 40))


@pytest.mark.oldest
def test_reverse_mode_and_the_parameter_alone():
    """Without m1 the derivative is that in m; reverse over forward agrees with forward twice."""
    u, m = jnp.asarray(2.3), jnp.asarray(0.35)

    def alone(u, m):
        return jnp.stack(elliptic.sncndn(u, m))

    def pair(u, m):
        return stacked(u, m, 1 - m)

    one = once(jax.jacfwd(jax.jacrev(alone, (0, 1)), (0, 1)))(u, m)
    two = once(jax.jacfwd(jax.jacfwd(pair, (0, 1)), (0, 1)))(u, m)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


def test_zero_parameter_and_one():
    """∂sn/∂m = −¼(u − sin u cos u) cos u at m = 0 (DLMF 22.10.4); 22.10.7 at m = 1."""
    u = jnp.asarray([1e-8, 0.4, 3.0, 20.0])
    sine = jax.jacfwd(lambda m, u: elliptic.sncndn(u, m)[0])
    batch = jax.jit(jax.vmap(sine, (None, 0)))

    def slope(m):
        return batch(m, u)

    x = np.asarray(u)
    with mp.workdps(40):
        zero = [float(-(a - mp.sin(a) * mp.cos(a)) * mp.cos(a) / 4) for a in map(mp.mpf, x)]
        one = [float((a * mp.sech(a) ** 2 - mp.tanh(a)) / 4) for a in map(mp.mpf, x)]
    np.testing.assert_allclose(slope(0.0), zero, rtol=1e-14)
    np.testing.assert_allclose(slope(1.0), one, rtol=1e-14)
    np.testing.assert_allclose(slope(1.0)[-1], -0.25, rtol=1e-14)
    far = batch(1.0, u + 2000.0)
    np.testing.assert_allclose(far, -0.25, rtol=1e-14)


@once
@jax.vmap
def value_and_slope_by_m(u, m):
    def f(m):
        return jnp.stack(elliptic.sncndn(u, m))

    return f(m), jax.jacfwd(f)(m)


@pytest.mark.parametrize("m", [-7.0, -0.2, 1.3, 40.0])
def test_parameters_outside_the_unit_interval(m):
    u = np.asarray([0.3, 1.7, -9.0])
    value, slope = value_and_slope_by_m(u, np.full(3, m))
    with mp.workdps(90):
        for i, x in enumerate(map(mp.mpf, u)):
            f0, _, fm, *_ = derivatives(x, 1 - mp.mpf(m)) if m < 1 else outside(x, m)
            np.testing.assert_allclose(value[i], [float(a) for a in f0], rtol=1e-13, atol=2e-15)
            np.testing.assert_allclose(slope[i], [float(a) for a in fm], rtol=1e-12, atol=2e-14)


def outside(u, m):
    g = mp.mpf(10) ** -20

    def f(b):
        return mp.matrix(twin(u, 1 - mp.mpf(m) - b))

    return f(0), None, (f(g) - f(-g)) / (2 * g)


@pytest.mark.slow
def test_amplitude():
    """am inverts F for m ≤ 1 and grows without jumps; its slope is dn."""
    u = jnp.linspace(-30, 30, 601)
    for m in (-2.0, 0.0, 0.7, 1.0):
        phi = elliptic.am(u, m)
        near = jnp.abs(phi) < 1.5
        back = elliptic.ellipf(jnp.where(near, phi, 0), m) if m == 1 else elliptic.ellipf(phi, m)
        wanted = jnp.where(near, u, 0) if m == 1 else u
        np.testing.assert_allclose(back, wanted, rtol=1e-14, atol=2e-14)
        assert (jnp.diff(phi) >= 0).all()
    slope = jax.vmap(jax.grad(elliptic.am), (0, None))(u, 0.7)
    np.testing.assert_allclose(slope, elliptic.sncndn(u, 0.7)[2], rtol=1e-14)
    # m > 1: it swings.
    swing = elliptic.am(u, 4.0)
    assert jnp.max(jnp.abs(swing)) <= np.arcsin(0.5)
    np.testing.assert_allclose(jnp.sin(swing), elliptic.sncndn(u, 4.0)[0], atol=1e-15)


def test_algebra():
    """sn² + cn² = 1, dn² + m sn² = 1; periods 4K and 2K; parity (DLMF 22.4, 22.6.1)."""
    u, m = jnp.linspace(-9.0, 9.0, 64), jnp.asarray(0.83)
    s, c, d = elliptic.sncndn(u, m)
    np.testing.assert_allclose(s * s + c * c, 1, rtol=1e-15)
    np.testing.assert_allclose(d * d + m * s * s, 1, rtol=1e-15)
    half = 2 * elliptic.ellipk(m)
    np.testing.assert_allclose(elliptic.sncndn(u + half, m), (-s, -c, d), atol=3e-15)
    np.testing.assert_array_equal(elliptic.sncndn(-u, m), (-s, c, d))


def test_nothing_and_not_a_number():
    for dtype in (np.float32, np.float64):
        s, c, d = elliptic.sncndn(np.zeros((), dtype), np.asarray(0.5, dtype))
        assert (s, c, d) == (0, 1, 1) and s.dtype == dtype
        tiny = elliptic.sncndn(np.asarray(1e-30, dtype), np.asarray(0.5, dtype))[0]
        assert tiny == np.asarray(1e-30, dtype)
        whole = elliptic.sncndn(elliptic.ellipk(np.asarray(0.5, dtype)) * 2, np.asarray(0.5, dtype))
        assert np.isfinite(whole).all()
    assert all(jnp.isnan(x) for x in elliptic.sncndn(jnp.nan, 0.5))
    assert all(jnp.isnan(x) for x in elliptic.sncndn(1.0, jnp.nan))


def test_mistakes_are_named(unhooked):
    with pytest.raises(ValueError, match=r"m1: wanted 1 − m, but m \+ m1 differs"):
        elliptic.sncndn(1.0, 0.9, 0.9)
    with pytest.raises(ValueError, match="broadcast together: u"):
        elliptic.sncndn(jnp.ones(3), jnp.ones(2) * 0.5)
    with pytest.raises(TypeError, match="u: wanted float32 or float64"):
        elliptic.sncndn(jnp.ones((), jnp.bfloat16), 0.5)
