"""Compute small changes of a state: ⊕, ⊖, the size of a change, and the names of its parts.

A state is any pytree of arrays: a `Spin`, an `Attitude`, a `Rigid`, a `Coupled`, a `frames.Point`,
an array. A change of a state is one vector, with the changes of all leaves in the order of the
leaves. The change of a quaternion q has three numbers, the rotation vector δθ (rad, body frame) in
`q exp(δθ)`: a change of a `Rigid` consists of the changes of x and v, δθ, and the change of Ω.
Source: Solà, Deray and Atchuthan 2018, arXiv:1812.01537, right-⊕ and right-⊖.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax._types import HasAttitude
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import quaternion_to_vector, vector_to_quaternion
from rigidjax.rotation.linalg3 import components


def dimension(state: PyTree) -> int:
    """Return the length of a change of `state`: its numbers, less one for each quaternion."""
    return max((place.stop for place in _slices(state)), default=0)


def leaf_names(state: PyTree) -> tuple[str, ...]:
    """Return the names of the leaves of `state`, such as "q", in the order of their changes."""
    paths = jax.tree.leaves_with_path(state)
    return tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths)


def parts_by_name(
    state: PyTree, change: Float[Array, "*batch n"]
) -> dict[str, Float[Array, "*batch _"]]:
    """Split changes of a state into the changes of its leaves, by the names of the leaves."""
    cut = (change[..., place] for place in _slices(state))
    return dict(zip(leaf_names(state), cut, strict=True))


def rotation_slices(state: PyTree) -> tuple[slice, ...]:
    """Return the places of the rotation vectors, one for each quaternion, in a change."""
    pairs = zip(_slices(state), _are_rotations(state), strict=True)
    return tuple(place for place, turned in pairs if turned)


def plus(state: PyTree, change: Float[Array, " n"]) -> PyTree:
    """Return `state ⊕ change`: q exp(δθ) for a quaternion q, the sum for any other leaf; exactly
    `state` if the change is zero.
    """

    def multiply_by_exp(q: Array, rotation_vector: Array) -> Array:
        return quaternion.multiply(q, vector_to_quaternion(rotation_vector))

    return _moved_state(state, change, multiply_by_exp, jnp.add)


def minus(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return `state ⊖ reference`, the change for which `plus(reference, change)` is `state`;
    quaternions may differ by a turn of up to π.
    """
    return _vector(
        state,
        reference,
        lambda q, q0: quaternion_to_vector(quaternion.multiply(quaternion.conjugate(q0), q)),
        jnp.subtract,
    )


def minus_small(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return `state ⊖ reference` for two states that are near, without an arctangent: the change of
    a quaternion has the length 2 sin(θ/2) for a turn by θ, where that of `minus` has θ.
    """

    def small_rotation_vector(q: Array, q0: Array) -> Array:
        w, *u = components(quaternion.multiply(quaternion.conjugate(q0), q))
        twice = jnp.where(w < 0, -2.0, 2.0).astype(w.dtype)
        return jnp.stack([twice * part for part in u])

    return _vector(state, reference, small_rotation_vector, jnp.subtract)


def vector_to_tangent(state: PyTree, change: Float[Array, " n"]) -> PyTree:
    """Return the tangent of `state`: the derivative of `plus(state, α * change)` at α = 0."""
    return _moved_state(state, change, quaternion.rate, lambda _, part: part)


def tangent_to_vector(state: PyTree, tangent_vector: PyTree) -> Float[Array, " n"]:
    """Return the change of `state` whose `vector_to_tangent` is `tangent_vector`."""
    return _vector(
        tangent_vector,
        state,
        lambda dq, q: 2.0 * quaternion.multiply(quaternion.conjugate(q), dq)[1:],
        lambda part, _: part,
    )


def _are_rotations(state: PyTree) -> list[bool]:
    """Return for each leaf whether it is the quaternion of a state with an attitude."""
    out = []
    for node in jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, HasAttitude)):
        q = node.q if isinstance(node, HasAttitude) else None
        out += [leaf is q for leaf in jax.tree.leaves(node)]
    return out


def _slices(state: PyTree) -> list[slice]:
    """Return the place of the change of each leaf in the vector of a change."""
    end, out = 0, []
    for leaf, turned in zip(jax.tree.leaves(state), _are_rotations(state), strict=True):
        begin, end = end, end + math.prod(jnp.shape(leaf)) - turned
        out.append(slice(begin, end))
    return out


def _moved_state(
    state: PyTree,
    change: Array,
    of_quaternion: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> PyTree:
    """Return the pytree `state` with each quaternion replaced by `of_quaternion(leaf, part)`, each
    other leaf by `of_others(leaf, part)`; `part` is the leaf's part of the vector `change`.
    """
    (leaves, tree), out = jax.tree.flatten(state), []
    for leaf, place, turned in zip(leaves, _slices(state), _are_rotations(state), strict=True):
        part = change[place] if turned else change[place].reshape(jnp.shape(leaf))
        out.append(of_quaternion(leaf, part) if turned else of_others(leaf, part))
    return jax.tree.unflatten(tree, out)


def _vector(
    first: PyTree,
    second: PyTree,
    of_quaternions: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> Array:
    """Return one vector of `of_quaternions(a, b)`, three numbers, for each pair of leaves with a
    quaternion b in `second`, and of `of_others(a, b)` for each other pair.
    """
    pairs = zip(
        jax.tree.leaves(first), jax.tree.leaves(second), _are_rotations(second), strict=True
    )
    out = [
        of_quaternions(a, b) if turned else of_others(a, b).reshape(-1) for a, b, turned in pairs
    ]
    return jnp.concatenate(out)
