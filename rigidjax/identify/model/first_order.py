"""Compute a function of the parameters to first order: its value and its Jacobian."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float, PyTree


class FirstOrder(NamedTuple):
    """Hold the value of a function and its Jacobian, both arrays or pytrees of arrays."""

    value: Any
    # The parameters are the last axis of each array.
    jacobian: Any


def value_and_jacfwd(function: Callable[[Array], Any], x: Float[Array, " n"]) -> FirstOrder:
    """Return the value of a `function` at x and its Jacobian, by forward mode."""

    def value_and_aux(x: Array) -> tuple[PyTree, PyTree]:
        value = function(x)
        return value, value

    jacobian, value = jax.jacfwd(value_and_aux, has_aux=True)(x)
    return FirstOrder(value, jacobian)
