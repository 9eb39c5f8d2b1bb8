"""Convert a state to a tuple of scalars, and back.

XLA on CPU compiles a loop that carries a tuple of scalars to one kernel. In a batch of N states
such a loop carries a tuple of (N,) arrays and uses vector instructions. A loop that carries (7,) or
(N, 7) arrays becomes many small kernels.
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

Atoms = tuple[Array, ...]
# An array of more numbers than this is not split: to treat each number by itself would cost more
# time to compile than it saves.
FEW = 32


def split_scalars(tree: PyTree) -> Atoms:
    """Return the numbers of a tree of arrays as scalars; an array above `FEW` stays as it is."""
    parts: list[Array] = []
    for leaf in jax.tree.leaves(tree):
        leaf = jnp.asarray(leaf)
        if leaf.ndim == 0 or leaf.size > FEW:
            parts.append(leaf)
        elif leaf.size:
            parts.extend(part.reshape(()) for part in lax.split(leaf.reshape(-1), (1,) * leaf.size))
    return tuple(parts)


def join_scalars(scalars: Atoms, like: PyTree) -> PyTree:
    """Return the tree, with the structure and shapes of `like`, from its scalars."""
    leaves, structure = jax.tree.flatten(like)
    queue = iter(scalars)
    out = []
    for leaf in leaves:
        shape = jnp.shape(leaf)
        size = math.prod(shape)
        if not shape or size > FEW:
            out.append(next(queue))
        elif size:
            out.append(jnp.stack([next(queue) for _ in range(size)]).reshape(shape))
        else:
            out.append(leaf)
    return jax.tree.unflatten(structure, out)
