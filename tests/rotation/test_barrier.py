"""A function compiled as one kernel is the same function, in batches and in derivatives, too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.rotation.barrier import compiled_as_one_kernel, match_batch_axes


def partly_shared(a, b):
    return 2.0 * a, jnp.zeros_like(a) + 3.0, a * jnp.sin(b)


@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0)])
def test_a_derivative_of_its_batch_under_jit(axes):
    """Results that a batch shares: JAX gave the derivatives of all bodies to each."""
    a, b = (jnp.arange(1.0, 4.0) if axis == 0 else jnp.array(0.7) for axis in axes)
    one, plain = jax.jit(compiled_as_one_kernel(partly_shared)), partly_shared
    found, wanted = (
        jax.jit(lambda a, b, f=f: jax.jvp(jax.vmap(f, axes), (a, b), (2 * a, -b)))(a, b)
        for f in (one, plain)
    )
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.oldest
@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0)])
def test_a_second_derivative_of_its_batch_under_jit(axes):
    """The derivative of a kernel repeats its values, which are differentiated in their turn."""
    a, b = (jnp.arange(1.0, 4.0) if axis == 0 else jnp.array(0.7) for axis in axes)
    kernel = jax.vmap(compiled_as_one_kernel(partly_shared), axes)

    def along(a, b):
        return jax.jvp(kernel, (a, b), (jnp.ones_like(a), jnp.ones_like(b)))

    steps = 2.0 * jnp.ones_like(a), jnp.ones_like(b)
    (value, change), (slope, second) = jax.jit(lambda: jax.jvp(along, (a, b), steps))()
    # Of a sin b: by (1, 1), by (2, 1), and by both.
    np.testing.assert_allclose(value[2], a * jnp.sin(b), rtol=1e-15)
    np.testing.assert_allclose(change[2], jnp.sin(b) + a * jnp.cos(b), rtol=1e-15)
    np.testing.assert_allclose(slope[2], 2 * jnp.sin(b) + a * jnp.cos(b), rtol=1e-15)
    np.testing.assert_allclose(second[2], 3 * jnp.cos(b) - a * jnp.sin(b), rtol=1e-14)


def test_a_constant_with_a_derivative():
    """As entries that are zero by choice of the axes; all is linear: the slope is 4 exactly."""

    @jax.custom_jvp
    def zero(x):
        return match_batch_axes(jnp.zeros_like(x), x)

    zero.defjvp(lambda primals, tangents: (zero(*primals), tangents[0]))
    batch = jax.vmap(jax.jit(lambda x: 2.0 * zero(x) + 1.0))
    slope = jax.grad(lambda x: jnp.sum(batch(x) ** 2))(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [4.0, 4.0, 4.0])
