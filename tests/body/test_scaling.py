"""Powers of two against `math.ldexp`; derivatives are powers of two as well."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.body.scaling import binary_exponent, times_power_of_two

# (x, n) with a normal product; 2ⁿ itself is out of range in some.
DOUBLE = [
    *((x, n) for x in (0.0, -0.0, 1.0, -1.5, 0.1) for n in (0, 5, -5, 1022, 1023, -1000)),
    *((1.7e308, n) for n in (0, -1, -1022, -1024, -1074, -2040)),
    *((3e-308, n) for n in (1, 1023, 1024, 1030, 2040)),
    (0.0, 1030),
    (0.0, -1074),
    (math.inf, -3),
    (-math.inf, 3),
]
SINGLE = [
    *((x, n) for x in (0.0, 1.0, -1.5) for n in (0, 5, -5, 126, 127, -120)),
    *((3.4e38, n) for n in (-1, -126, -128, -149, -250)),
    *((2e-38, n) for n in (1, 127, 128, 149, 250)),
]


def arrays(dtype):
    cases = DOUBLE if dtype == np.float64 else SINGLE
    xs = np.array([x for x, _ in cases], dtype)
    ns = np.array([n for _, n in cases], np.int32)
    products = [math.ldexp(float(x), int(n)) for x, n in zip(xs, ns, strict=True)]
    return xs, ns, np.array(products, dtype)


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_products_are_exact(dtype):
    xs, ns, want = arrays(dtype)
    got = jax.jit(jax.vmap(times_power_of_two))(xs, ns)
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, want)
    # XLA knows n: it must not multiply the two factors together.
    known = jax.jit(lambda x: [times_power_of_two(x[k], jnp.array(n)) for k, n in enumerate(ns)])
    np.testing.assert_array_equal(np.array(known(xs)), want)


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_derivatives_are_exact(dtype):
    """Forward, reverse and second, of every x: 0 too, where those of `jnp.ldexp` were wrong."""
    xs, ns, _ = arrays(dtype)
    info = np.finfo(dtype)
    keep = np.isfinite(xs) & (ns < info.maxexp) & (ns >= info.minexp)
    xs, ns = xs[keep], ns[keep]
    want = np.array([math.ldexp(1.0, n) for n in ns.tolist()], dtype)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(times_power_of_two)))(xs, ns), want)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.jacfwd(times_power_of_two)))(xs, ns), want)

    def square(x, n):
        return times_power_of_two(x, n) ** 2

    few = abs(ns) < 60
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(jax.hessian(square)))(xs[few], ns[few]), 2 * want[few] ** 2
    )


@pytest.mark.oldest
def test_tangents_pass_where_the_power_is_out_of_range():
    """2ⁿ is no double, but its product with the tangent is."""
    for n, tangent in ((1030, 1e-5), (-1060, 1e300)):
        _, moved = jax.jvp(lambda x, n=n: times_power_of_two(x, jnp.array(n)), (0.0,), (tangent,))
        assert moved == math.ldexp(tangent, n)


@pytest.mark.oldest
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_exponents(dtype):
    info = np.finfo(dtype)
    for x in (0.0, 1.0, -0.75, 2.0, 1e30, -1e-30, float(info.max), float(info.tiny)):
        x = dtype(x)
        assert int(binary_exponent(jnp.array([x / 2, x, -x]))) == math.frexp(x)[1]
    value, moved = jax.jvp(
        lambda x: times_power_of_two(x, -binary_exponent(x)), (dtype(3.0),), (dtype(1.0),)
    )
    assert (value, moved) == (0.75, 0.25)
