"""Quantities that drive a law, by name: given by a loop at each step, or as functions of time."""

from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import ScalarLike

Law = TypeVar("Law")


class Input(eqx.Module):
    """A quantity that the loop gives, by name: the place in a law for `rollout(…, inputs=…)`.

    **Arguments:** `name` the key among the inputs. A law calls it with the time; it has a value
    once the law is `bind`-ed.

    >>> law = bind(Input("speed"), {"speed": jnp.array([3.0])})
    >>> law(0.0)
    Array([3.], dtype=float64)
    """

    name: str = eqx.field(static=True)

    def __call__(self, t: ScalarLike) -> Any:
        """**Raises:** `ValueError`: it has no value before `bind`."""
        raise ValueError(
            f"Input({self.name!r}) has no value: give inputs={{{self.name!r}: …}} to "
            "rigidjax.batch.rollout, or put a function of time in its place with "
            "rigidjax.torques.bind"
        )


class _Now(eqx.Module):
    """A value that does not depend on time."""

    value: Array

    def __call__(self, t: ScalarLike) -> Array:
        return self.value


def bind(law: Law, inputs: Mapping[str, Any] | None) -> Law:
    """The law with values in the place of its `Input`s.

    **Arguments:** `law` a torque, a force, or anything that holds them; `inputs` by name an array,
    which stays as it is, or a function of time such as `Held(times, values)`; `None` leaves the law
    as it is.

    **Raises:** `ValueError` for an input that is not among them.

    >>> bind(Input("u"), {"u": rj.torques.Held([0.0, 1.0], [2.0, 4.0])})(1.0)
    Array(4., dtype=float64)
    """
    if inputs is None:
        return law

    def value(node: Any) -> Any:
        if not isinstance(node, Input):
            return node
        if node.name not in inputs:
            raise ValueError(
                f"inputs: the law reads {node.name!r}, got {', '.join(map(repr, inputs)) or 'none'}"
            )
        found = inputs[node.name]
        return found if callable(found) else _Now(jnp.asarray(found))

    return jax.tree.map(value, law, is_leaf=lambda node: isinstance(node, Input))


def inputs_of(law: Any) -> list[str]:
    """The names of the inputs that a law reads.

    >>> inputs_of((Input("a"), Input("b"), Input("a")))
    ['a', 'b']
    """
    nodes = jax.tree.leaves(law, is_leaf=lambda node: isinstance(node, Input))
    return list(dict.fromkeys(node.name for node in nodes if isinstance(node, Input)))


def require_inputs(law: Any, inputs: Any) -> Mapping[str, Any]:
    """`inputs` (none: empty), if they are those that the law reads.

    **Raises:** `ValueError` for one that is missing, or that the law does not read; `TypeError` for
    what is no mapping.

    >>> sorted(require_inputs(Input("u"), {"u": 1.0}))
    ['u']
    """
    read, found = inputs_of(law), {} if inputs is None else inputs
    if not isinstance(found, Mapping):
        raise TypeError(f"inputs: wanted arrays by name, got {type(found).__name__}")
    if set(read) != set(found):
        raise ValueError(
            f"inputs: the law reads {', '.join(map(repr, read)) or 'none'}, got "
            f"{', '.join(map(repr, found)) or 'none'}"
        )
    return found
