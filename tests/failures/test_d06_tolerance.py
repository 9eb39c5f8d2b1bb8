"""Row D6: a tolerance below round-off is said to be one, and is not ground out."""

import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import Nothing

import rigidjax as rj

# DETEST B5 as a free body (failures.md, section 2d).
C = np.array([1 / np.sqrt(0.51 * 3), 1 / np.sqrt(0.51), 1 / np.sqrt(3)])
WANTED = [-0.93965707987292039619, -0.34211777540007490653, 0.74141265961999530078]


@pytest.mark.parametrize(
    ("dtype", "rtol", "bar"), [(jnp.float32, 1e-12, 1e-4), (jnp.float64, 1e-17, 1e-11)]
)
def test_it_warns_and_does_what_can_be_done(dtype, rtol, bar):
    c = np.array([C[0], C[1], C[0] / C[1]])
    body = rj.Inertia(jnp.diag(jnp.array([2.0, 3.0, 1.0], dtype)))
    start = rj.Spin(jnp.asarray(np.array([0.0, 1.0, 1.0]) / c, dtype))
    ts = jnp.array([0.0, 20.0], dtype)
    with pytest.warns(UserWarning, match=f"{jnp.dtype(dtype)} cannot reach rtol={rtol:g}; using"):
        out = rj.simulate(body, start, ts, Nothing(), rtol=rtol, atol=rtol)
    assert int(out.stats["num_steps"]) < 2000
    np.testing.assert_allclose(c * np.asarray(out.ys.omega[-1]), WANTED, rtol=0, atol=bar)
