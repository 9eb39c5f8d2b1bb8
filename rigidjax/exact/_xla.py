"""A hint to XLA on CPU, so that scalar formulas compile and run fast.

A kernel of one body takes long to compile, whatever its size. A loop with a small state becomes one
kernel; single computations are therefore put into a loop.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Function = TypeVar("Function", bound=Callable[..., Any])


def one_kernel(function: Function) -> Function:
    """The same function of trees of arrays, compiled as one kernel if it is not batched.

    It is a loop of one turn: XLA knows neither the number of turns nor that the arguments stay, so
    it moves nothing out of the loop. Batches and derivatives use `function` itself.
    """
    # Traced once for all the uses below.
    once = jax.jit(function, inline=True)

    @jax.custom_jvp
    @functools.wraps(function)
    def call(*args: Any) -> Any:
        return alone(*args)

    @jax.custom_batching.custom_vmap
    def alone(*args: Any) -> Any:
        first = jax.tree.leaves(args)[0].ravel()[0]
        step = jnp.where(first == first, 1, 2)
        blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(once, *args))

        def turn(carry: Any) -> Any:
            i, args, _ = carry
            return i + step, jax.tree.map(jnp.zeros_like, args), once(*args)

        return jax.lax.while_loop(lambda c: c[0] < 1, turn, (jnp.zeros_like(step), args, blank))[2]

    @alone.def_vmap
    def _batched(size: int, batched: Any, *args: Any) -> Any:
        del size
        axes = jax.tree.map(lambda b: 0 if b else None, tuple(batched))
        out = jax.vmap(once, axes)(*args)
        return out, jax.tree.map(lambda _: True, out)

    @call.defjvp
    def _jvp(primals: Any, tangents: Any) -> Any:
        return jax.jvp(once, primals, tangents)

    return call  # pyright: ignore[reportReturnType]
