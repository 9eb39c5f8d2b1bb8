"""Keep XLA from computing shared intermediates once for every output.

XLA on CPU copies cheap arithmetic into each kernel that needs it: a chain of stages that all feed
one another grows exponentially, in compile time and in run time. It does not copy divisions.
Dividing by a 1 that it cannot see to be 1 therefore keeps a stage whole, and changes no bit.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

from rigidjax._types import Scalar

Tree = TypeVar("Tree")


def opaque_one(t: Scalar) -> Scalar:
    """1, unless t is NaN; XLA does not know."""
    return jax.lax.stop_gradient(jnp.where(t == t, jnp.ones_like(t), t))


def fence(tree: Tree, one: Scalar) -> Tree:
    """The same numbers, computed once."""
    return jax.tree.map(
        lambda x: x / (one if x.ndim == 0 else jnp.broadcast_to(one, x.shape)), tree
    )
