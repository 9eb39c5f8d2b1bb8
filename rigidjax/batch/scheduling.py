"""Which bodies are computed together: those that need about as many steps."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.motion.coupled import motion_of, started
from rigidjax.solve import equations_of_motion


def quickness(body: Any, state0: Any, torque: Any, t0: Array) -> Array:
    """How fast a body turns and is turned at the start, rad/s: steps are as many as that is large.

    **Returns** a scalar, `|Ω| + √|dΩ/dt|`; NaN where there is no slope.
    """
    y0 = started(body, state0, torque, t0)
    slope = motion_of(equations_of_motion(body, y0, torque)(t0, y0, None))
    rate, change = jnp.sum(state0.omega**2), jnp.sum(slope.omega**2)
    return lax.stop_gradient(jnp.sqrt(rate) + jnp.sqrt(jnp.sqrt(change)))


def dealt(key: Array, chunk: int, parts: int) -> tuple[Array, Array]:
    """An order by `key` (N,), NaN last, and the way back from it.

    With several devices chunks are dealt like cards, so that each gets quick ones and slow ones.

    >>> order, back = dealt(jnp.array([3.0, 1.0, 2.0]), 128, 1)
    >>> order.tolist(), back.tolist()
    ([1, 2, 0], [2, 0, 1])
    """
    order, count = jnp.argsort(key), key.shape[0]
    chunk = min(chunk, -(-count // parts))
    size = -(-count // (chunk * parts)) * chunk
    # Where each device's share of `size` lies in the order; the last may be a short one.
    seats = np.arange(size * parts).reshape(-1, parts, chunk).transpose(1, 0, 2).reshape(-1)
    seats = seats[seats < count]
    order = order[seats]
    return order, jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=order.dtype))
