import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.solve.programs.linear_map import with_derivatives


@pytest.mark.oldest
def test_a_known_value_has_the_derivatives_of_the_other():
    def f(x):
        return with_derivatives(jnp.asarray(7.0), jnp.sin(x))

    x = jnp.asarray(0.3)
    np.testing.assert_allclose(f(x), 7.0, rtol=0)
    np.testing.assert_allclose(jax.jacfwd(f)(x), np.cos(0.3), rtol=1e-14)
    np.testing.assert_allclose(jax.grad(f)(x), np.cos(0.3), rtol=1e-14)
