"""Compute small changes of a state: ⊕, ⊖, the size of a change, and the names of its parts.

A state is any tree of arrays: a `Spin`, an `Attitude`, a `Rigid`, a `Coupled`, a `frames.Point`, an
array. A change of a state is one vector, with the changes of all leaves in the order of the leaves.
The change of a quaternion q has three numbers, the rotation vector δθ (rad, body frame) in `q
exp(δθ)`: a change of a `Rigid` consists of the changes of x and v, δθ, and the change of Ω. Source:
Solà, Deray and Atchuthan 2018, arXiv:1812.01537, right-⊕ and right-⊖.
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
    """Return the length n of the vector that describes a small change of `state`, a tree of arrays.

    This is the count of the numbers in `state`, less one for each quaternion: a quaternion has four
    numbers, but its change is a rotation vector of three numbers.
    """
    return max((place.stop for place in _slices_of_leaves(state)), default=0)


def leaf_names(state: PyTree) -> tuple[str, ...]:
    """Return the names of the leaves (arrays) of `state`, such as "q" and "omega". Their order is
    the order in which the changes of the leaves stand in the vector of a change of the state.
    """
    paths = jax.tree.leaves_with_path(state)
    return tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths)


def parts_by_name(
    state: PyTree, change: Float[Array, "*batch n"]
) -> dict[str, Float[Array, "*batch _"]]:
    """Split a change of a state into a dict: from the name of each leaf (array) of the state to the
    numbers of the change that belong to this leaf, which are three numbers for a quaternion.

    - `state`: a tree of arrays
    - `change`: (..., n), the changes of all leaves one after another, n = `dimension(state)`
    """
    cut = (change[..., place] for place in _slices_of_leaves(state))
    return dict(zip(leaf_names(state), cut, strict=True))


def rotation_slices(state: PyTree) -> tuple[slice, ...]:
    """Return one slice for each quaternion of `state`, a tree of arrays: the place of its rotation
    vector (three numbers) in the vector that describes a change of the state.
    """
    pairs = zip(_slices_of_leaves(state), _quaternion_flags(state), strict=True)
    return tuple(place for place, turned in pairs if turned)


def plus(state: PyTree, change: Float[Array, " n"]) -> PyTree:
    """Return the state after a small change, `state ⊕ change`: q exp(δθ) for a quaternion q, the
    sum for any other leaf (array); exactly `state` if the change is zero.

    - `state`: a tree of arrays
    - `change`: (n,), the changes of all leaves one after another; for a quaternion, the rotation
      vector δθ (3,), rad, body frame
    """

    def multiply_by_exp(q: Array, rotation_vector: Array) -> Array:
        return quaternion.multiply(q, vector_to_quaternion(rotation_vector))

    return _apply_change_to_leaves(state, change, multiply_by_exp, jnp.add)


def minus(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return the change (n,) from one state to another, `state ⊖ reference`: the vector `change`
    for which `plus(reference, change)` is `state`.

    - `state`, `reference`: two trees of arrays with one structure; the quaternions of the two may
      differ by a turn of up to π
    """
    return _concatenate_over_leaves(
        state,
        reference,
        lambda q, q0: quaternion_to_vector(quaternion.multiply(quaternion.conjugate(q0), q)),
        jnp.subtract,
    )


def minus_small(state: PyTree, reference: PyTree) -> Float[Array, " n"]:
    """Return the change (n,) from `reference` to a state near it, `state ⊖ reference`, computed
    without an arctangent.

    For two quaternions that differ by a turn of the angle θ, the three numbers of the change form a
    vector of the length 2 sin(θ/2), which is near θ for a small turn; the vector of `minus` has the
    length θ.

    - `state`, `reference`: two trees of arrays with one structure
    """

    def small_rotation_vector(q: Array, q0: Array) -> Array:
        w, *u = components(quaternion.multiply(quaternion.conjugate(q0), q))
        twice = jnp.where(w < 0, -2.0, 2.0).astype(w.dtype)
        return jnp.stack([twice * part for part in u])

    return _concatenate_over_leaves(state, reference, small_rotation_vector, jnp.subtract)


def vector_to_tangent(state: PyTree, change: Float[Array, " n"]) -> PyTree:
    """Return the derivative of `plus(state, α * change)` with respect to the number α at α = 0: a
    tree like `state`, which JAX takes as a tangent.

    - `state`: a tree of arrays
    - `change`: (n,), the changes of all leaves one after another; for a quaternion, a rotation
      vector (3,), body frame
    """
    return _apply_change_to_leaves(state, change, quaternion.rate, lambda _, part: part)


def tangent_to_vector(state: PyTree, tangent_vector: PyTree) -> Float[Array, " n"]:
    """Return the vector (n,) of the change of `state` whose tangent is `tangent_vector`: the
    inverse of `vector_to_tangent`.

    - `state`: a tree of arrays
    - `tangent_vector`: a tree like `state`, with the derivative of each leaf, such as dq (4,) for a
      quaternion q
    """
    return _concatenate_over_leaves(
        tangent_vector,
        state,
        lambda dq, q: 2.0 * quaternion.multiply(quaternion.conjugate(q), dq)[1:],
        lambda part, _: part,
    )


def _quaternion_flags(state: PyTree) -> list[bool]:
    """Return one flag for each leaf (array) of `state`, a tree of arrays, in the order of
    `jax.tree.leaves`: true if the leaf is the quaternion `q` of an `Attitude`, a `Rigid` or another
    state with an attitude.
    """
    out = []
    for node in jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, HasAttitude)):
        q = node.q if isinstance(node, HasAttitude) else None
        out += [leaf is q for leaf in jax.tree.leaves(node)]
    return out


def _slices_of_leaves(state: PyTree) -> list[slice]:
    """Return one slice for each leaf (array) of `state`, a tree of arrays: the place of the change
    of this leaf in the vector that describes a change of the state.

    The vector holds the changes of all leaves one after another: three numbers (a rotation vector)
    for a quaternion, and as many numbers as the leaf has for any other leaf.
    """
    end, out = 0, []
    for leaf, turned in zip(jax.tree.leaves(state), _quaternion_flags(state), strict=True):
        begin, end = end, end + math.prod(jnp.shape(leaf)) - turned
        out.append(slice(begin, end))
    return out


def _apply_change_to_leaves(
    state: PyTree,
    change: Array,
    of_quaternion: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> PyTree:
    """Return a tree like `state`, computed leaf by leaf from the state and a change of it: one
    function is applied to quaternions, and another function to all other arrays.

    - `state`: a tree of arrays
    - `change`: (n,), the changes of all leaves one after another: a rotation vector of three
      numbers for a quaternion, and as many numbers as the leaf has for any other leaf
    - `of_quaternion`: a function (q, vector) of a quaternion q (4,) and its rotation vector (3,),
      which returns the array (4,) that takes the place of q in the result
    - `of_others`: a function (leaf, change) of any other array and its change, of equal shape,
      which returns the array that takes the place of the leaf in the result
    """
    (leaves, tree), out = jax.tree.flatten(state), []
    for leaf, place, turned in zip(
        leaves, _slices_of_leaves(state), _quaternion_flags(state), strict=True
    ):
        part = change[place] if turned else change[place].reshape(jnp.shape(leaf))
        out.append(of_quaternion(leaf, part) if turned else of_others(leaf, part))
    return jax.tree.unflatten(tree, out)


def _concatenate_over_leaves(
    first: PyTree,
    second: PyTree,
    of_quaternions: Callable[[Array, Array], Array],
    of_others: Callable[[Array, Array], Array],
) -> Array:
    """Return one vector (n,), computed from pairs of arrays at the same place of two trees: one
    function is applied to the pairs with a quaternion, and another function to all other pairs. The
    results stand in the vector one after another.

    - `first`: a tree of arrays with the structure of `second`
    - `second`: a state, which determines the leaves that are quaternions
    - `of_quaternions`: a function (a, b) of the array a (4,) in `first` and the quaternion b (4,)
      in `second`, which returns three numbers
    - `of_others`: a function (a, b) of the array a in `first` and the array b in `second`, of equal
      shape, which returns an array of this shape
    """
    pairs = zip(
        jax.tree.leaves(first), jax.tree.leaves(second), _quaternion_flags(second), strict=True
    )
    out = [
        of_quaternions(a, b) if turned else of_others(a, b).reshape(-1) for a, b, turned in pairs
    ]
    return jnp.concatenate(out)
