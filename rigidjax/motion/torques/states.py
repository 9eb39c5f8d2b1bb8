"""Handle torques and functions of time with states of their own, which are integrated with the
state of the body.

Such a torque has `state0`, the initial states, and `rate`, the derivative of the states; the states
are the last argument of the torque. `freeze` inserts the states: for the rest of the library the
result is a plain torque.
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
# The members of a torque that depend on its states.
_OF_STATES = ("energy", "internal_momentum")


class FrozenLaw(eqx.Module):
    """Wrap a torque or function of time `law` that has states of its own (such as the speed of a
    wheel), with the values `own` of these states inserted, so that it can be called without them;
    `freeze` makes it.
    """

    law: Any
    own: tuple[Any]

    def __call__(self, *args: Any) -> Any:
        return self.law(*args, self.own[0])

    def __getattr__(self, name: str) -> Any:
        # The members of the torque (`feels`, `jump_times`, …) are handed on, except the members
        # that belong to states.
        if name.startswith("_") or name in ("law", "own", "state0", "rate"):
            raise AttributeError(name)
        attribute = getattr(self.law, name)
        return FrozenLaw(attribute, self.own) if name in _OF_STATES else attribute


def has_own_states(node: object) -> bool:
    """Return whether `node`, a torque or a function of time, has states of its own, such as the
    speed of a wheel: it then has the members `state0` (the initial states) and `rate` (their
    derivative).
    """
    return not isinstance(node, type) and hasattr(node, "state0") and hasattr(node, "rate")


def has_states(law: PyTree) -> bool:
    """Return whether the torque `law`, or any torque or function of time inside it, has states of
    its own, such as the speed of a wheel.
    """
    return any(map(has_own_states, jax.tree.leaves(law, is_leaf=_has_states_or_is_frozen)))


def require_stateless(law: PyTree, user: str) -> None:
    """Raise `ValueError` if the torque `law` has states of its own, such as the speed of a wheel,
    which the caller does not integrate; the text `user` names the caller in the message.
    """
    if has_states(law):
        raise ValueError(
            f"{user}: wanted a torque without states of its own, got one that has some (such as "
            "ReactionWheels or Lagged); integrate rigidjax.equations_of_motion with "
            "diffrax.diffeqsolve and diffrax.Event"
        )


def freeze(law: Tree, own: tuple[Any, ...]) -> Tree:
    """Return the torque `law` with the states `own` inserted, so that it can be called as a torque
    without states.

    `own` holds the states of each part of `law` that has states, in the order of these parts in
    `law`, inner parts first.
    """
    queue = list(own)
    if not queue and not has_states(law):
        return law

    def own_of(node: PyTree) -> Any:
        if not queue:
            raise ValueError(f"own: no states for {type(node).__name__}")
        return queue.pop(0)

    frozen = _insert_states(law, own_of)
    if queue:
        raise ValueError(f"own: the torque has {len(own) - len(queue)} with states, got {len(own)}")
    return frozen


def initial_states(law: PyTree, t: ScalarLike, state: PyTree, body: Body) -> tuple[Any, ...]:
    """Return the initial states of a torque, as a tuple with a tree of arrays for each part of the
    torque that has states of its own (inner parts first), in the precision of the state of the
    body.

    - `law`: the torque
    - `t`: s, the time of the start
    - `state`: the state of motion at the start
    - `body`: an `Inertia` or `MassProperties`
    """
    states: list[Any] = []

    def initial_state_of(node: PyTree) -> Any:
        here = node.state0(t, state, body) if callable(node.state0) else node.state0
        own = _checked_numbers(here, f"state0 of {type(node).__name__}", state.omega.dtype)
        if not jax.tree.leaves(own):
            raise ValueError(f"state0 of {type(node).__name__}: wanted a tree of arrays, got none")
        states.append(own)
        return own

    _insert_states(law, initial_state_of)
    return tuple(states)


def rates_of_own_states(
    law: PyTree, t: ScalarLike, own: tuple[Any, ...], state: PyTree, body: Body
) -> tuple[Any, ...]:
    """Return the derivatives with respect to time of the states that a torque has of its own, as a
    tuple of trees like `own`. **Raises:** `ValueError` for a derivative whose shape is not that of
    the state.

    - `law`: the torque
    - `t`: s, the time
    - `own`: for each part of the torque that has states, inner parts first, a tree with their
      values
    - `state`: the state of motion
    - `body`: an `Inertia` or `MassProperties`
    """
    queue, rates = list(own), []

    def rate_of_node(node: PyTree) -> Any:
        here = queue.pop(0)
        name = f"rate of {type(node).__name__}"
        rate = _checked_numbers(node.rate(t, here, state, body), name, state.omega.dtype)
        wanted, shapes = (jax.tree.map(jnp.shape, tree) for tree in (here, rate))
        if wanted != shapes:
            raise ValueError(f"{name}: wanted arrays as in state0, {wanted}, got {shapes}")
        rates.append(rate)
        return here

    _insert_states(law, rate_of_node)
    return tuple(rates)


def require_frozen(law: PyTree) -> None:
    """Raise `TypeError` if the torque `law` has states of its own, such as the speed of a wheel,
    but is called without the values of these states.
    """
    if has_own_states(law):
        words = "has states of its own (state0, rate): simulate, batch.rollout, batch.simulate and "
        words += "identify.fit integrate them; elsewhere call it with its states last"
        raise TypeError(f"{type(law).__name__} {words}: law(t, state, body, own)")


def _insert_states(tree: PyTree, own_of: Callable[[Any], Any]) -> Any:
    """Return a torque in which each torque with states of its own (such as the speed of a wheel) is
    replaced by a `FrozenLaw`: this torque together with the values of its states.

    - `tree`: the torque, or a tree of torques
    - `own_of`: a function (torque) that returns the values of the states of one torque. If a torque
      contains another one, the function is called for the inner torque first.
    """

    def is_leaf(node: PyTree) -> bool:
        return node is not tree and _has_states_or_is_frozen(node)

    def insert_in_node(node: PyTree) -> Any:
        return _insert_states(node, own_of) if node is not tree and has_own_states(node) else node

    inserted = jax.tree.map(insert_in_node, tree, is_leaf=is_leaf)
    return FrozenLaw(inserted, (own_of(inserted),)) if has_own_states(tree) else inserted


def _has_states_or_is_frozen(node: PyTree) -> bool:
    """Return whether `node` is a torque or a function of time with states of its own (such as the
    speed of a wheel), or a `FrozenLaw`, in which the values of such states are already inserted.
    """
    return isinstance(node, FrozenLaw) or has_own_states(node)


def _checked_numbers(tree: PyTree, name: str, dtype: DTypeLike) -> Any:
    """Return a tree of arrays after a check that each array holds numbers, with each array
    converted to `dtype`.

    - `tree`: the states of a user's torque, or their derivatives, as the torque returned them
    - `name`: the name of the tree, for messages
    - `dtype`: the dtype of the result
    """
    return jax.tree.map(lambda leaf: _checks.numeric_array(leaf, name).astype(dtype), tree)
