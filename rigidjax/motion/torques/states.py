"""Handle torques and functions of time with states of their own, which are integrated with the
state of the body.

A torque with states of its own has `state0`, the initial states, and `rate`, the derivative of the
states; it is called with the states as its last argument. `freeze_own_states` inserts the values of
the states: the result is a plain torque for the rest of the library.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import PyTree

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Body

Tree = TypeVar("Tree")
# The methods of a torque that take the values of its own states as their last argument.
_MEMBERS_THAT_TAKE_STATES = ("energy", "internal_momentum")


class FrozenLaw(eqx.Module):
    """Hold a torque or function of time with its own states, to be called without them."""

    law: Any
    own: tuple[Any]

    def __call__(self, *args: Any) -> Any:
        return self.law(*args, self.own[0])

    def __getattr__(self, name: str) -> Any:
        # All members of the torque (`feels`, `jump_times`, …) are members of this object as well,
        # except `state0` and `rate`: this object holds fixed values of the states, so that an
        # integrator must not take it for a torque with states to integrate.
        if name.startswith("_") or name in ("law", "own", "state0", "rate"):
            raise AttributeError(name)
        attribute = getattr(self.law, name)
        return FrozenLaw(attribute, self.own) if name in _MEMBERS_THAT_TAKE_STATES else attribute


def has_own_states(node: object) -> bool:
    """Return whether a torque or function of time has states: members `state0` and `rate`."""
    return not isinstance(node, type) and hasattr(node, "state0") and hasattr(node, "rate")


def contains_own_states(torque: PyTree) -> bool:
    """Return whether `torque`, or a torque or function of time inside it, has own states."""
    return any(map(has_own_states, jax.tree.leaves(torque, is_leaf=_is_node)))


def require_no_own_states(torque: PyTree, caller: str) -> None:
    """Raise `ValueError` if `torque` has own states, which the `caller` does not integrate."""
    if contains_own_states(torque):
        raise ValueError(
            f"{caller}: wanted a torque without states of its own, got one that has some (such as "
            "ReactionWheels or Lagged); integrate rigidjax.equations_of_motion with "
            "diffrax.diffeqsolve and diffrax.Event"
        )


def freeze_own_states(torque: Tree, own: tuple[PyTree, ...]) -> Tree:
    """Return a torque, or a pytree that contains one (such as a vector field), with the values of
    its own states inserted; inner parts come first in `own`.
    """
    queue = list(own)
    if not queue and not contains_own_states(torque):
        return torque

    def next_states(node: PyTree) -> PyTree:
        if not queue:
            words = "wanted the states of each part of the torque that has states of its own"
            raise ValueError(f"own: {words}, got no states for {type(node).__name__}")
        return queue.pop(0)

    frozen = _with_frozen_laws(torque, next_states)
    if queue:
        count = len(own) - len(queue)
        words = f"wanted one tree of states for each of the {count} parts of the torque with states"
        raise ValueError(f"own: {words}, got {len(own)}; are they of another torque?")
    return frozen


def initial_states(torque: PyTree, t: ScalarLike, state: PyTree, body: Body) -> tuple[PyTree, ...]:
    """Return the initial states of each part of the torque with states of its own, inner parts
    first, in the precision of the body's state.
    """
    states: list[Any] = []

    def initial_state_of(node: PyTree) -> PyTree:
        here = node.state0(t, state, body) if callable(node.state0) else node.state0
        own = _cast(here, f"state0 of {type(node).__name__}", state.omega.dtype)
        if not jax.tree.leaves(own):
            raise ValueError(f"state0 of {type(node).__name__}: wanted a tree of arrays, got none")
        states.append(own)
        return own

    _with_frozen_laws(torque, initial_state_of)
    return tuple(states)


def state_rates(
    torque: PyTree, t: ScalarLike, own: tuple[PyTree, ...], state: PyTree, body: Body
) -> tuple[PyTree, ...]:
    """Return the derivatives by time of the states of a torque, as pytrees like `own`; raise
    `ValueError` for a shape that is not that of the state.
    """
    queue, rates = list(own), []

    def rate_of_node(node: PyTree) -> PyTree:
        here = queue.pop(0)
        name = f"rate of {type(node).__name__}"
        rate = _cast(node.rate(t, here, state, body), name, state.omega.dtype)
        wanted, shapes = (jax.tree.map(jnp.shape, tree) for tree in (here, rate))
        if wanted != shapes:
            raise ValueError(f"{name}: wanted arrays as in state0, {wanted}, got {shapes}")
        rates.append(rate)
        return here

    _with_frozen_laws(torque, rate_of_node)
    return tuple(rates)


def _with_frozen_laws(torque: PyTree, states_of: Callable[[PyTree], PyTree]) -> PyTree:
    """Return a torque with each part that has states of its own replaced by a `FrozenLaw` with the
    states from `states_of`, which is called for inner parts first.
    """

    def is_leaf(node: PyTree) -> bool:
        return node is not torque and _is_node(node)

    def insert_in_node(node: PyTree) -> PyTree:
        inner = node is not torque and has_own_states(node)
        return _with_frozen_laws(node, states_of) if inner else node

    inserted = jax.tree.map(insert_in_node, torque, is_leaf=is_leaf)
    return FrozenLaw(inserted, (states_of(inserted),)) if has_own_states(torque) else inserted


def _is_node(node: PyTree) -> bool:
    """Return whether `node` has states of its own, or is a `FrozenLaw`, which holds them."""
    return isinstance(node, FrozenLaw) or has_own_states(node)


def _cast(tree: PyTree, name: str, dtype: DTypeLike) -> PyTree:
    """Return a pytree, such as states of a user's torque, with arrays checked and cast."""
    return jax.tree.map(lambda leaf: _checks.numeric_array(leaf, name).astype(dtype), tree)
