"""Row D12: the batched reverse pass with adaptive steps is the one of each body alone (1e-8)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj


@pytest.mark.slow
def test_together_and_alone():
    slope = jax.grad(
        lambda omega: rj.simulate(BODY, rj.Attitude(Q, omega), [0.0, 4.0], TOP).ys.omega[-1, 0]
    )
    rates = jnp.asarray(OMEGA * np.array([[0.5], [1.0], [3.0]]))
    together = jax.jit(jax.vmap(slope))(rates)
    one = jax.jit(slope)
    alone = jnp.stack([one(omega) for omega in rates])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-8 * np.abs(alone).max())
