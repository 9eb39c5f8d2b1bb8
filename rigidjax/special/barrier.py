"""Keep XLA from computing numbers again in each place that reads them (floor 0)."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

Tree = TypeVar("Tree")

# XLA on CPU drops barriers before it fuses, which is where it repeats what is shared: a solve of
# order 8 at 900 times took minutes, not milliseconds.
_DROPPED = jax.__version_info__ < (0, 11)


def barrier(tree: Tree) -> Tree:
    """The same numbers, computed once: `jax.lax.optimization_barrier`, also where XLA drops those.

    There each number is divided by a 1 that XLA cannot see to be 1; it does not repeat divisions.

    >>> float(barrier(jnp.array(0.5)))
    0.5
    """
    return jax.tree.map(_divided, tree) if _DROPPED else lax.optimization_barrier(tree)


def _divided(x):
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return x / lax.stop_gradient(jnp.where(x == x, jnp.ones_like(x), x))
