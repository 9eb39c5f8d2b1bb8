"""Compute small changes of a state: ⊕, ⊖, the size of a change, and the names of its parts.

A state is any tree of arrays: a `Spin`, an `Attitude`, a `Rigid`, a `Coupled`, a `frames.Point`, an
array. A change of a state is one vector, with the changes of all leaves in the order of the leaves.
The change of a quaternion q has three numbers, the rotation vector δθ (rad, body frame) in `q
exp(δθ)`: a change of a `Rigid` consists of the changes of x and v, δθ, and the change of Ω. Source:
Solà, Deray and Atchuthan 2018, arXiv:1812.01537, right-⊕ and right-⊖.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax._types import HasAttitude
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import quaternion_to_vector, vector_to_quaternion
from rigidjax.rotation.linalg3 import components


def dimension(state: PyTree) -> int:
    """Return the size of a change of `state`: the count of its numbers, less one for each
    quaternion.
    """
    return max((place.stop for place in _places(state)), default=0)


def names(state: PyTree) -> tuple[str, ...]:
    """Return the names of the leaves, in the order of their numbers in a change."""
    paths = jax.tree.leaves_with_path(state)
    return tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths)


def parts_by_name(
    state: PyTree, change: Float[Array, "*batch n"]
) -> dict[str, Float[Array, "*batch _"]]:
    """Return those numbers of a change that belong to each leaf, by the name of the leaf; a
    quaternion has three numbers in a change.
    """
    cut = (change[..., place] for place in _places(state))
    return dict(zip(names(state), cut, strict=True))


def rotation_slices(state: PyTree) -> tuple[slice, ...]:
    """Return the slices of the rotation vectors in a change, one for each quaternion."""
    pairs = zip(_places(state), _is_quaternion(state), strict=True)
    return tuple(place for place, turned in pairs if turned)


def plus(state: PyTree, change: Float[Array, " n"]) -> Any:
    """Return `state ⊕ change`: q exp(δθ) for quaternions, sums for other leaves; exactly `state` at
    0.
    """

    def rotate(q: Array, part: Array) -> Array:
        return quaternion.multiply(q, vector_to_quaternion(part))

    return _leaf_by_leaf(state, change, rotate, jnp.add)


def minus(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return `state ⊖ reference`: the change with `plus(reference, change) = state`, a turn of up
    to π.
    """
    return _vector(
        state,
        reference,
        lambda q, q0: quaternion_to_vector(quaternion.multiply(quaternion.conjugate(q0), q)),
        jnp.subtract,
    )


def minus_small(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return `state ⊖ reference` for a near state, without an arctangent.

    A turn by θ gives 2 sin(θ/2), not θ.
    """

    def turn(q: Array, q0: Array) -> Array:
        w, *u = components(quaternion.multiply(quaternion.conjugate(q0), q))
        twice = jnp.where(w < 0, -2.0, 2.0).astype(w.dtype)
        return jnp.stack([twice * part for part in u])

    return _vector(state, reference, turn, jnp.subtract)


def tangent(state: PyTree, change: Float[Array, " n"]) -> Any:
    """Return the derivative of `plus(state, ·)` at zero along `change`: a tangent vector of JAX."""
    return _leaf_by_leaf(state, change, quaternion.rate, lambda _, part: part)


def tangent_to_vector(state: PyTree, tangent_vector: PyTree) -> Float[Array, " n"]:
    """Return the change whose `tangent` at `state` is `tangent_vector`.

    This function is the inverse of `tangent`.
    """
    return _vector(
        tangent_vector,
        state,
        lambda dq, q: 2.0 * quaternion.multiply(quaternion.conjugate(q), dq)[1:],
        lambda part, _: part,
    )


def _is_quaternion(state: PyTree) -> list[bool]:
    """Return, for each leaf, whether it is the quaternion of a state with an attitude."""
    out = []
    for node in jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, HasAttitude)):
        q = node.q if isinstance(node, HasAttitude) else None
        out += [leaf is q for leaf in jax.tree.leaves(node)]
    return out


def _places(state: PyTree) -> list[slice]:
    """Return the slice of each leaf's numbers in a change."""
    end, out = 0, []
    for leaf, turned in zip(jax.tree.leaves(state), _is_quaternion(state), strict=True):
        begin, end = end, end + math.prod(jnp.shape(leaf)) - turned
        out.append(slice(begin, end))
    return out


def _leaf_by_leaf(
    state: PyTree,
    change: Array,
    of_quaternion: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> Any:
    """Return a tree like `state`, whose leaves are `of_quaternion(leaf, part)` for quaternions and
    `of_others(leaf, part)` for other leaves.

    Here `part` holds the numbers of `change` that belong to the leaf.
    """
    (leaves, tree), out = jax.tree.flatten(state), []
    for leaf, place, turned in zip(leaves, _places(state), _is_quaternion(state), strict=True):
        part = change[place] if turned else change[place].reshape(jnp.shape(leaf))
        out.append(of_quaternion(leaf, part) if turned else of_others(leaf, part))
    return jax.tree.unflatten(tree, out)


def _vector(
    first: PyTree,
    second: PyTree,
    of_quaternions: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> Array:
    """Return one vector, made of `of_quaternions(a, b)` for quaternions and `of_others(a, b)` for
    other leaves.

    Here a is a leaf of the tree `first`, and b the leaf at the same place of the tree `second`.
    """
    pairs = zip(
        jax.tree.leaves(first), jax.tree.leaves(second), _is_quaternion(second), strict=True
    )
    out = [
        of_quaternions(a, b) if turned else of_others(a, b).reshape(-1) for a, b, turned in pairs
    ]
    return jnp.concatenate(out)
