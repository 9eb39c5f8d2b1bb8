"""Quantities that a law is driven by: held from sample to sample, or named and given by a loop."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.motion.torques.base import given

Law = TypeVar("Law")


class Held(eqx.Module):
    """A function of time, t → (*k), that holds each sample until the next one (zero-order hold).

    **Arguments:** `times` (n,) s, increasing; `values` (n, *k), row i from time i on, the first
    also before it. Both may be traced.

    The value jumps at `times`: a law that reads it hands its `jump_times` on, and adaptive steps
    end there. For equal steps give the samples to `rigidjax.batch.rollout` as `inputs`.

    **Raises:** `ValueError` for numbers of rows that differ, times that do not increase, NaN.

    >>> Held([0.0, 1.0, 2.0], [[5.0], [6.0], [7.0]])(1.5)
    Array([6.], dtype=float64)
    """

    times: Float[Array, " n"]
    values: Float[Array, "n *k"]

    def __init__(
        self, times: Float[ArrayLike, " n"] | Sequence[Any], values: Float[ArrayLike, "n *k"] | Any
    ):
        t, rows = _checks.numbers(times, "times"), _checks.numbers(values, "values")
        if t.ndim != 1 or not t.shape[0] or rows.shape[:1] != t.shape:
            raise ValueError(
                f"Held: wanted a time for each row, got shapes {t.shape} and {rows.shape}"
            )
        kind = jnp.result_type(float)
        self.times = _checks.finite(t.astype(kind), "times")
        self.values = _checks.finite(rows.astype(kind), "values")
        falling = ~(_checks.namespace(t).diff(t) > 0)
        self.times = _checks.refuse(self.times, falling.any(), "Held: wanted increasing times")

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """The times of the samples, s: the value jumps at each."""
        return self.times

    def __call__(self, t: ScalarLike) -> Array:
        """The value at `t` (s), (*k)."""
        t = jnp.asarray(t, self.times.dtype)
        i = jnp.searchsorted(self.times, t, side="right").astype(jnp.int32) - 1
        return self.values[jnp.clip(i, 0, self.times.shape[0] - 1)]


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

    >>> bind(Input("u"), {"u": Held([0.0, 1.0], [2.0, 4.0])})(1.0)
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


def channel(value: Any, name: str, size: int) -> Any:
    """A law's input as it is if it can be called with a time; otherwise as a vector (size,)."""
    if callable(value):
        return _checks.function(value, name, f"of time to ({size},)")
    return given(value, (size,), name)


def at(source: Any, t: ScalarLike, name: str, size: int) -> Array:
    """The value of a `channel` at `t`."""
    if not callable(source):
        return source
    found: Callable[[Any], Any] = source
    return _checks.floating(found(t), (size,), f"{name}(t)")
