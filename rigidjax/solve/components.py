"""A state as a tuple of scalars, or as one vector, and back.

XLA on CPU runs a loop over a tuple of scalars as one kernel and, batched, over a tuple of (N,)
arrays in vector instructions. A loop over (7,) or (N, 7) arrays becomes many small kernels.
"""

import math
from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

Atoms = tuple[Array, ...]
# Beyond this many numbers, writing each out costs more to compile than it gains.
FEW = 32


def split(tree: Any) -> Atoms:
    """The numbers of a tree of arrays as scalars, leaf by leaf; long leaves stay whole."""
    parts: list[Array] = []
    for leaf in jax.tree.leaves(tree):
        leaf = jnp.asarray(leaf)
        if leaf.ndim == 0 or leaf.size > FEW:
            parts.append(leaf)
        elif leaf.size:
            parts.extend(part.reshape(()) for part in lax.split(leaf.reshape(-1), (1,) * leaf.size))
    return tuple(parts)


def join(parts: Atoms, like: Any) -> Any:
    """The tree shaped as `like` whose numbers are `parts`, as `split` gave them."""
    leaves, structure = jax.tree.flatten(like)
    queue = iter(parts)
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


def leaf_sizes(like: Any) -> list[int]:
    """The number of numbers in each array."""
    return [math.prod(jnp.shape(leaf)) for leaf in jax.tree.leaves(like)]


def one_dtype(tree: Any, name: str, advice: str = "") -> Any:
    """The dtype of all arrays of a tree, or `TypeError`."""
    kinds = {jnp.result_type(leaf) for leaf in jax.tree.leaves(tree)}
    if len(kinds) != 1:
        found = ", ".join(sorted(map(str, kinds)))
        raise TypeError(f"{name}: wanted arrays of one dtype, got {found}{advice}")
    return kinds.pop()


def flat(tree: Any) -> Array:
    """The numbers of a tree of arrays of one dtype as a vector."""
    one_dtype(tree, "state", "; convert its arrays to one, or use a solver of diffrax")
    return jnp.concatenate([jnp.reshape(leaf, -1) for leaf in jax.tree.leaves(tree)])


def unflat(vector: Array, like: Any) -> Any:
    """The tree shaped as `like` whose numbers are those of `vector`."""
    leaves, tree = jax.tree.flatten(like)
    pieces = jnp.split(vector, list(accumulate(leaf_sizes(like)))[:-1])
    shaped = [piece.reshape(jnp.shape(a)) for piece, a in zip(pieces, leaves, strict=True)]
    return jax.tree.unflatten(tree, shaped)


def lift(a: Array, like: Array) -> Array:
    """`a` with leading axes of length 1, as many axes as `like`: last axes are those they share."""
    return a.reshape((1,) * (like.ndim - a.ndim) + a.shape)
