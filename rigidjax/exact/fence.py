"""Keep XLA from computing shared intermediates once for every output.

XLA on CPU copies cheap arithmetic into each kernel that needs it: a chain of stages that all feed
one another grows exponentially, in compile time and in run time. It does not copy divisions.
Dividing by a 1 that it cannot see to be 1 therefore keeps a stage whole, and changes no bit.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import Scalar

Tree = TypeVar("Tree")


def opaque_one(t: Scalar) -> Scalar:
    """1, unless t is NaN; XLA does not know."""
    return jax.lax.stop_gradient(jnp.where(t == t, jnp.ones_like(t), t))


# XLA on CPU writes a concatenation of so many parts as one kernel; each kernel costs ten
# milliseconds to compile.
_MOST = 8


def fence(tree: Tree, one: Scalar) -> Tree:
    """The same scalars, computed once."""
    leaves, structure = jax.tree.flatten(tree)
    if any(jnp.ndim(x) for x in leaves):
        return jax.tree.map(lambda x: x / jnp.broadcast_to(one, jnp.shape(x)), tree)
    parts = [part / jnp.broadcast_to(one, part.shape) for part in _packed(leaves)]
    return jax.tree.unflatten(structure, _unpacked(parts))


def repeat(count: int, step: Callable[[Tree], Tree], tree: Tree) -> Tree:
    """`step` on a tree of scalars, `count` times, in a loop of few kernels."""
    leaves, structure = jax.tree.flatten(tree)

    def packed_step(_: Scalar, parts: list[Array]) -> list[Array]:
        after = step(jax.tree.unflatten(structure, _unpacked(parts)))
        return _packed(jax.tree.leaves(after))

    parts = jax.lax.fori_loop(0, count, packed_step, _packed(leaves))
    return jax.tree.unflatten(structure, _unpacked(parts))


def _packed(leaves: list[Scalar]) -> list[Array]:
    return [jnp.stack(leaves[i : i + _MOST]) for i in range(0, len(leaves), _MOST)]


def _unpacked(parts: list[Array]) -> list[Scalar]:
    return [x for part in parts for x in jnp.unstack(part)]
