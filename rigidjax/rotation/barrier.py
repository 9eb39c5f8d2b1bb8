"""Keep XLA from computing numbers again in each place that reads them."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

Tree = TypeVar("Tree")

# XLA on CPU drops barriers before it fuses, which is where it repeats what is shared: a solve of
# order 8 at 900 times took minutes, not milliseconds.
_DROPPED = jax.__version_info__ < (0, 11)


def barrier(tree: Tree) -> Tree:
    """The same numbers, computed once: `jax.lax.optimization_barrier`, also where XLA drops those.

    There each number goes through `once`.
    """
    return jax.tree.map(_real_once, tree) if _DROPPED else lax.optimization_barrier(tree)


def once(x: Array) -> Array:
    """The same number, computed once however often it is used, here and in the gradient.

    A division by one (by 2 for NaN): XLA on CPU computes a quotient once, where it would repeat
    anything cheaper, with all that leads to it, for every component.
    """
    return x / jnp.where(x == x, 1, 2)


def _real_once(x: Array) -> Array:
    return once(x) if jnp.issubdtype(x.dtype, jnp.floating) else x
