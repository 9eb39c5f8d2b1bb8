"""How much a small error at the start has grown by each saved time."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax.motion.manifold import dimension, minus_small, plus


@eqx.filter_jit
def growth(flow: Callable[[Any, Array], Any], ts: Array, ys: Any) -> Float[Array, " times"]:
    """The largest singular value of dy(t)/dy(t0) at each of `ts`, relative to the state's sizes.

    **Arguments:** `flow(y0, ts)` the motion, a Module differentiable in forward mode; `ts` (T,) s;
    `ys` its states there. Each part of the state (q, Ω; x, v) counts relative to its largest size
    in the run, so that the number has no unit.
    """
    sizes = jax.tree.map(_size, ys)
    start = jax.tree.map(lambda leaf, size: leaf[0] / size, ys, sizes)
    numbers, unravel = ravel_pytree(start)

    def end(numbers: Array) -> Array:
        y0 = jax.tree.map(lambda leaf, size: leaf * size, unravel(numbers), sizes)
        rows = jax.tree.map(lambda leaf, size: leaf / size, flow(y0, ts), sizes)
        return jax.vmap(lambda row: ravel_pytree(row)[0])(rows)

    return jnp.linalg.norm(jax.jacfwd(end)(numbers), ord=2, axis=(1, 2))


@eqx.filter_jit
def transition(flow: Callable[[Any, Array], Any], ts: Array, ys: Any) -> Float[Array, "times n n"]:
    """∂y(t)/∂y(t0) at each of `ts` between tangent spaces: see `Solution.transition_matrix`.

    **Arguments:** as for `growth`.
    """
    start = jax.tree.map(lambda leaf: leaf[0], ys)

    def changes(change: Array) -> Array:
        return jax.vmap(minus_small)(flow(plus(start, change), ts), ys)

    return jax.jacfwd(changes)(jnp.zeros(dimension(start), ts.dtype))


def _size(leaf: Array) -> Array:
    # A run that ended early has NaN in the rows that it did not reach.
    size = jnp.sqrt(jnp.nanmax(jnp.sum((leaf * leaf).reshape(leaf.shape[0], -1), axis=1)))
    return jnp.where(size > 0, size, jnp.ones_like(size))
