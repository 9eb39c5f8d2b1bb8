"""Runs back in time: the vector field in s = −t, which increases while t decreases."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from rigidjax import _checks


def direction(times: Array) -> Int[Array, ""] | None:
    """`None` for times known to increase; else the sign of t's change, known or traced.

    >>> direction(jnp.array([0.0, 1.0])), int(direction(jnp.array([1.0, 0.0])))
    (None, -1)
    """
    ends = _checks.namespace(times).asarray(times)
    change = ends[-1] - ends[0]
    if _checks.known(times) and change > 0:
        return None
    # A whole number: derivatives do not carry it along.
    return jnp.asarray(jnp.sign(change), jnp.int32)


class Directed(eqx.Module):
    """A vector field in s = σt: σ f(σs, y), with the sign σ of the direction of time.

    **Arguments:** `field` f(t, y, args); `sign` σ, 1 or −1.

    >>> backwards = Directed(lambda t, y, args: t * y, jnp.asarray(-1))
    >>> float(backwards(jnp.asarray(-3.0), jnp.asarray(2.0), None))
    -6.0
    """

    field: Callable[..., Any]
    sign: Int[Array, ""]

    def __call__(self, s: Any, y: Any, args: Any = None) -> Any:
        slope = self.field(self.sign.astype(s.dtype) * s, y, args)
        return jax.tree.map(lambda leaf: self.sign.astype(leaf.dtype) * leaf, slope)


class DirectedJumps(eqx.Module):
    """As `Directed`, for fields that jump: a time t means what is before it, on the way back.

    A law has its new value from the jump on. A step back that begins there wants the old one, and
    one that ends there, at the last moment before it in s, the new one.
    """

    field: Callable[..., Any]
    sign: Int[Array, ""]

    def __call__(self, s: Any, y: Any, args: Any = None) -> Any:
        t = self.sign.astype(s.dtype) * s
        # The oldest JAX has no derivative of `nextafter`, not even one to be stopped.
        still = lax.stop_gradient(t)
        before = jnp.nextafter(still, jnp.full_like(still, -jnp.inf))
        shift = jnp.where(self.sign < 0, before - still, jnp.zeros_like(still))
        slope = self.field(t + shift, y, args)
        return jax.tree.map(lambda leaf: self.sign.astype(leaf.dtype) * leaf, slope)


class DirectedCondition(eqx.Module):
    """A condition `(t, y)` on states, asked at s = σt."""

    condition: Callable[..., Any]
    sign: Int[Array, ""]

    def __call__(self, s: Any, y: Any) -> Any:
        return self.condition(self.sign.astype(s.dtype) * s, y)
