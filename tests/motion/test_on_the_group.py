"""The scaling of a quaternion to length 1: near it, far from it, and its derivative."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.motion.equations import project_to_group

Q = np.array([0.5, -0.7, 0.1, 0.5])


def scaled(q):
    return project_to_group(rj.Attitude(q, jnp.zeros(3, q.dtype))).q


all_of = jax.jit(lambda q: (scaled(q), jax.jacfwd(scaled)(q), jax.jacrev(scaled)(q)))


@pytest.mark.parametrize("length", [1.0, 1 + 1e-12, 1 - 1e-6, 0.951, 1.048, 1.05, 0.3, 40.0])
@pytest.mark.parametrize(("dtype", "unit"), [(np.float64, 2.0**-53), (np.float32, 2.0**-24)])
def test_value_and_derivative(length, dtype, unit):
    q = jnp.asarray(Q / np.linalg.norm(Q) * length, dtype)
    with mp.workdps(40):
        p = [mp.mpf(float(c)) for c in q]
        size = mp.sqrt(sum(c * c for c in p))
        value = np.array([float(c / size) for c in p])
        slope = np.array(
            [[float(((i == j) - p[i] * p[j] / size**2) / size) for j in range(4)] for i in range(4)]
        )
    found, *slopes = all_of(q)
    np.testing.assert_allclose(found, value, atol=3 * unit)
    for found in slopes:
        np.testing.assert_allclose(found, slope, atol=8 * unit / length)
