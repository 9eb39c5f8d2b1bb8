import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.solve.linear_map import known_with_derivatives_of


@pytest.mark.oldest
def test_a_known_value_has_the_derivatives_of_the_other():
    def f(x):
        return known_with_derivatives_of(jnp.asarray(7.0), jnp.sin(x))

    x = jnp.asarray(0.3)
    np.testing.assert_allclose(f(x), 7.0, rtol=0)
    np.testing.assert_allclose(jax.jacfwd(f)(x), np.cos(0.3), rtol=1e-14)
    np.testing.assert_allclose(jax.grad(f)(x), np.cos(0.3), rtol=1e-14)
