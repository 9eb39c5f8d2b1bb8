"""Laws and functions of time that have states of their own, integrated with the body's.

Such a law has `state0`, its states at the start, and `rate`, their derivative; it is called with
its states last. Everything else of the library sees it as a plain law once they are put in:
`freeze`.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import ScalarLike

Tree = TypeVar("Tree")
# What a law says of itself that depends on its states.
_OF_STATES = ("energy", "internal_momentum")


class Frozen(eqx.Module):
    """A law with its states put in: a plain law, or a plain function of time. `freeze` makes it.

    **Arguments:** `law`; `own` its states, in a tuple of one.
    """

    law: Any
    own: tuple[Any]

    def __call__(self, *args: Any) -> Any:
        return self.law(*args, self.own[0])

    def __getattr__(self, name: str) -> Any:
        # What the law says of itself (`feels`, `jump_times`, …), but that it has states.
        if name.startswith("_") or name in ("law", "own", "state0", "rate"):
            raise AttributeError(name)
        found = getattr(self.law, name)
        return Frozen(found, self.own) if name in _OF_STATES else found


def has_own(node: object) -> bool:
    """Whether this law, or function of time, itself has states: `state0` and `rate`."""
    return not isinstance(node, type) and hasattr(node, "state0") and hasattr(node, "rate")


def has_states(law: Any) -> bool:
    """Whether a law, or anything inside it, has states of its own."""
    return any(map(has_own, jax.tree.leaves(law, is_leaf=_stop)))


def require_stateless(law: Any, what: str) -> None:
    """Raise `ValueError` for a law with states of its own where they are not followed."""
    if has_states(law):
        raise ValueError(
            f"{what}: wanted a torque without states of its own, got one that has some (such as "
            "ReactionWheels or Lagged); integrate rigidjax.equations_of_motion with "
            "diffrax.diffeqsolve and diffrax.Event"
        )


def freeze(law: Tree, own: tuple[Any, ...]) -> Tree:
    """The law with its states put in, so that it can be called as any other.

    **Arguments:** `law` a torque, a force, or anything that holds them; `own` a tuple of the states
    of each that has some, in the order in which they stand in the law, what is inside another
    first: a row of `Solution.own`.

    **Raises:** `ValueError` for another number of them.

    >>> from rigidjax import torques
    >>> law = torques.ConstantTorque([0.0, 0.0, 1.0])
    >>> freeze(law, ()) is law
    True
    """
    queue = list(own)
    if not queue and not has_states(law):
        return law
    frozen = _visit(law, lambda node: queue.pop(0) if queue else _missing(node))
    if queue:
        raise ValueError(f"own: the law has {len(own) - len(queue)} with states, got {len(own)}")
    return frozen


def first_states(law: Any, t: ScalarLike, state: Any, body: Any) -> tuple[Any, ...]:
    """The states of a law at the start, in the precision of the body's state: see `freeze`.

    **Arguments:** `t` s; `state` of the body at the start; `body`.

    **Raises:** `TypeError` for states that are no numbers.
    """
    found: list[Any] = []

    def begin(node: Any) -> Any:
        here = node.state0(t, state, body) if callable(node.state0) else node.state0
        own = _numbers(here, f"state0 of {type(node).__name__}", state.omega.dtype)
        if not jax.tree.leaves(own):
            raise ValueError(f"state0 of {type(node).__name__}: wanted a tree of arrays, got none")
        found.append(own)
        return own

    _visit(law, begin)
    return tuple(found)


def rates_of(
    law: Any, t: ScalarLike, own: tuple[Any, ...], state: Any, body: Any
) -> tuple[Any, ...]:
    """The derivative of each state, as `own` (see `freeze`).

    **Raises:** `ValueError` where a `rate` is not shaped as its `state0`.
    """
    queue, found = list(own), []

    def one(node: Any) -> Any:
        here = queue.pop(0)
        name = f"rate of {type(node).__name__}"
        rate = _numbers(node.rate(t, here, state, body), name, state.omega.dtype)
        wanted, shapes = (jax.tree.map(jnp.shape, tree) for tree in (here, rate))
        if wanted != shapes:
            raise ValueError(f"{name}: wanted arrays as in state0, {wanted}, got {shapes}")
        found.append(rate)
        return here

    _visit(law, one)
    return tuple(found)


def require_frozen(law: Any) -> None:
    """Raise `TypeError` for a law that was to be called without its states."""
    if has_own(law):
        raise TypeError(
            f"{type(law).__name__} has states of its own (state0, rate): simulate, batch.rollout, "
            "batch.simulate and identify.fit_windows integrate them; elsewhere call it with "
            "its states last: law(t, state, body, own)"
        )


def _visit(tree: Any, own_of: Callable[[Any], Any]) -> Any:
    """The tree with all that has states frozen; `own_of(node)` gives them, what is inside first."""

    def stop(node: Any) -> bool:
        return node is not tree and _stop(node)

    def inside(node: Any) -> Any:
        return _visit(node, own_of) if node is not tree and has_own(node) else node

    within = jax.tree.map(inside, tree, is_leaf=stop)
    return Frozen(within, (own_of(within),)) if has_own(tree) else within


def _stop(node: Any) -> bool:
    return isinstance(node, Frozen) or has_own(node)


def _numbers(tree: Any, name: str, dtype: Any) -> Any:
    return jax.tree.map(lambda leaf: _checks.numbers(leaf, name).astype(dtype), tree)


def _missing(node: Any) -> Any:
    raise ValueError(f"own: no states for {type(node).__name__}")
