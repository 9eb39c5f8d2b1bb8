"""Stumpff functions against 50-digit series, with derivatives to third order."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from rigidjax.rotation import stumpff

mp.mp.dps = 50
TS = np.concatenate(
    [
        [0.0, 1e-300, 1e-40, 1e-16, 1e-8],
        np.linspace(0.01, 12, 40),
        # Both sides of each switch: θ = π/2, π, and of the end of the polynomials.
        *[x * (1 + np.array([-1e-9, 0, 1e-9])) for x in ((np.pi / 2) ** 2, np.pi**2)],
        [20.0, 39.0, 100.0, 1e4],
    ]
)


def exact(k, t, order=0):
    """The derivative of c_k of any order, term by term."""
    t = mp.mpf(float(t))
    mp.mp.dps = 50 if t < 1000 else 150
    n = order
    total = term = mp.mpf(-1) ** n * mp.factorial(n) / mp.factorial(k + 2 * n)
    while abs(term) > mp.mpf(10) ** -90:
        n += 1
        term *= -t * n / (n - order) / ((k + 2 * n) * (k + 2 * n - 1))
        total += term
    return total


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_values_and_derivatives_of_every_order(dtype):
    """Forward over forward over reverse; 1e-13 / 1e-5 of the size at zero, up to θ = 100."""
    ts = TS.astype(dtype)
    eps = np.finfo(dtype).eps

    def everything(t):
        table = []
        for k in range(4):
            one = lambda t, k=k: stumpff.stumpff(k, t)
            two = lambda t, one=one: jax.jvp(one, (t,), (jnp.ones_like(t),))[1]
            three = lambda t, two=two: jax.jvp(two, (t,), (jnp.ones_like(t),))[1]
            table.append(jnp.stack([one(t), jax.grad(one)(t), jax.grad(two)(t), three(t)]))
        return jnp.stack(table)

    got = np.asarray(jax.jit(jax.vmap(everything))(ts))
    assert got.dtype == dtype
    for k in range(4):
        for row, order in enumerate([0, 1, 2, 2]):
            want = np.array([float(exact(k, t, order)) for t in ts])
            size = float(abs(exact(k, 0, order)))
            # Where θ is known to eps, so is the function, to eps times its slope.
            error = abs(got[:, k, row] - want) / (size * (1 + np.sqrt(ts)))
            assert error.max() < (12 if order else 4) * eps, (k, order, error.max() / eps)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_inverse_kernel(dtype):
    ts = np.array([0, 1e-300, 1e-16, 1e-6, 0.1, 1, 4, 9, np.pi**2, 15, 30], dtype)

    def want(t):
        half = mp.sqrt(t) / 2
        return (1 - half * mp.cot(half)) / t if t > 1e-30 else mp.mpf(1) / 12 + t / 720

    got = jax.jit(jax.vmap(stumpff.inverse_coefficient))(ts)
    slope = jax.jit(jax.vmap(jax.grad(stumpff.inverse_coefficient)))(ts)
    values = np.array([float(want(mp.mpf(float(t)))) for t in ts])
    slopes = np.array([float(mp.diff(want, mp.mpf(float(t)))) if t > 1e-3 else 1 / 720 for t in ts])
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(got, values, rtol=16 * eps)
    np.testing.assert_allclose(slope, slopes, rtol=1e-6 if dtype == np.float64 else 1e-4)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_inverse_kernel_near_a_full_turn(dtype):
    """It is 1/θ(2π − θ) there, and as good as 2π − θ is."""
    eps = np.finfo(dtype).eps
    left = np.array([1, 1e-1, 1e-2, 1e-3] + [1e-5, 1e-7] * (dtype == np.float64))
    ts = np.square(2 * np.pi - left).astype(dtype)
    left = 2 * np.pi - np.sqrt(ts.astype(float))

    def want(t):
        half = mp.sqrt(t) / 2
        return (1 - half * mp.cot(half)) / t

    got = jax.jit(jax.vmap(stumpff.inverse_coefficient))(ts)
    slope = jax.jit(jax.vmap(jax.grad(stumpff.inverse_coefficient)))(ts)
    with mp.workdps(40):
        values = np.array([float(want(mp.mpf(float(t)))) for t in ts])
        slopes = np.array([float(mp.diff(want, mp.mpf(float(t)))) for t in ts])
    for found, right, lost in ((got, values, 1), (slope, slopes, 2)):
        np.testing.assert_array_less(
            abs(np.asarray(found, float) / right - 1), 8 * eps * (1 + lost * np.pi / left)
        )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_arctan_ratio(dtype):
    z = np.linspace(0, np.tan(np.pi / 8) ** 2, 50).astype(dtype)
    root = np.sqrt(z.astype(np.float64)[1:])
    got = np.asarray(stumpff.arctan_ratio(jnp.asarray(z)))
    assert got[0] == 1
    np.testing.assert_allclose(got[1:], np.arctan(root) / root, rtol=2 * np.finfo(dtype).eps)
