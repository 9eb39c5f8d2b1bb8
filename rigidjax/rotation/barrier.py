"""A barrier that keeps XLA from computing numbers again for each use."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

Tree = TypeVar("Tree")

# XLA on CPU drops barriers before fusion, which repeats shared values: a solve of order 8 at 900
# times took minutes, not milliseconds.
_DROPPED = jax.__version_info__ < (0, 11)


def barrier(tree: Tree) -> Tree:
    """The same numbers, computed once: `lax.optimization_barrier`, or `once` if XLA drops it."""
    if not _DROPPED:
        return lax.optimization_barrier(tree)
    real = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    return jax.tree.map(lambda x: once(x) if real(x) else x, tree)


def once(x: Array) -> Array:
    """The same number, computed once for all uses, here and in the gradient.

    It is divided by one (by 2 if NaN): XLA on CPU computes a quotient once, but repeats anything
    cheaper, with all its inputs, for every component.
    """
    return x / jnp.where(x == x, 1, 2)
