"""Hold the state of a particle, without a body."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import Vectors


class Point(eqx.Module):
    """Hold the position and velocity of a particle, in the frame of its scene.

    **Arguments:** `x` (3,) position, m; `v` (3,) velocity dx/dt **in this frame**, m/s. Scenes with
    other units, such as the restricted three-body problem, state their units. Source: notes, eq 84.

    >>> Point([1.0, 0, 0], [0.0, 2, 0]).v.shape
    (3,)
    """

    x: Float[Array, "*batch 3"]
    v: Float[Array, "*batch 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, x: Vectors, v: Vectors):
        hint = "a plane problem has z = 0; functions take one particle, batch with jax.vmap"
        x = _checks.array_of_shape(x, (3,), "x", batched=True, hint=hint)
        v = _checks.array_of_shape(v, (3,), "v", batched=True, hint=hint)
        _checks.require_same_batch(x=(x, 1), v=(v, 1))
        dtype = jnp.promote_types(x.dtype, v.dtype)
        self.x, self.v = x.astype(dtype), v.astype(dtype)


def require_point(state: PyTree, name: str = "state") -> PyTree:
    """Return `state` if it has one position `x` (3,) and one velocity `v` (3,); raise an error for
    anything else. `name` is the name of the argument, for the message.
    """
    if isinstance(state, type) or not (hasattr(state, "x") and hasattr(state, "v")):
        raise TypeError(f"{name}: wanted a Point(x, v), got {_checks.type_name(state)}")
    for part in ("x", "v"):
        _checks.array_of_shape(getattr(state, part), (3,), f"{name}.{part}")
    return state
