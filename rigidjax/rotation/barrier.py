"""Give hints to XLA: which numbers to compute once for all their uses, and what to compile as one
kernel.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, PyTree

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable[..., Any])

# Whether XLA on CPU drops barriers before it fuses operations, as it does before JAX 0.11. Values
# that are used twice are then computed twice: a solve of order 8 at 900 times took minutes, not
# milliseconds.
_DROPPED = jax.__version_info__ < (0, 11)


def platform() -> str:
    """Return the kind of device that computes, such as "cpu".

    This is the kind of `jax.default_device`, if it is set: `jax.default_backend` ignores this
    setting.
    """
    device: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def barrier(tree: Tree) -> Tree:
    """Return the arrays of `tree` unchanged, such that XLA on CPU computes each once for all its
    uses, instead of repeating its operations at each use.

    This is `lax.optimization_barrier`, or `compute_once` where XLA drops barriers.

    On a GPU each barrier would end a kernel, which costs more than computing some numbers twice; no
    barrier is set there.
    """
    if platform() != "cpu" or not any(isinstance(a, Tracer) for a in jax.tree.leaves(tree)):
        return tree
    if not _DROPPED:
        return lax.optimization_barrier(tree)
    real = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    return jax.tree.map(lambda x: compute_once(x) if real(x) else x, tree)


def compute_once(x: Array) -> Array:
    """Return the number `x` unchanged, such that XLA on CPU computes it once, here and in the
    gradient.

    The number is divided by one (by 2 if it is NaN). XLA on CPU computes a quotient once; XLA
    repeats any cheaper operation, with all inputs of the operation, for every component.
    """
    return x / jnp.where(x == x, 1, 2)


def compiled_as_one_kernel(function: Function) -> Function:
    """Return a function of trees of arrays that computes `function`, compiled as one kernel where
    no argument is batched.

    Many small kernels for one body take long to compile; XLA on CPU makes one kernel of a loop with
    a small state. Therefore `function` runs in a loop with one iteration. XLA knows neither the
    number of iterations nor that the arguments stay the same, and so XLA moves nothing out of the
    loop. Batches and derivatives use `function` itself, without the loop.
    """
    # `function` is traced once for all the uses below.
    plain = jax.jit(function, inline=True)

    @jax.custom_jvp
    @functools.wraps(function)
    def call(*args: PyTree) -> Any:
        return call_unbatched(*args)

    @jax.custom_batching.custom_vmap
    def call_unbatched(*args: PyTree) -> Any:
        first = jax.tree.leaves(args)[0].ravel()[0]
        step = jnp.where(first == first, 1, 2)
        blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(plain, *args))

        def turn(carry: PyTree) -> Any:
            i, args, _ = carry
            return i + step, jax.tree.map(jnp.zeros_like, args), plain(*args)

        return lax.while_loop(lambda c: c[0] < 1, turn, (jnp.zeros_like(step), args, blank))[2]

    @call_unbatched.def_vmap
    def _call_under_vmap(size: int, batched: PyTree, *args: PyTree) -> Any:
        del size
        axes = jax.tree.map(lambda b: 0 if b else None, tuple(batched))
        # JAX before 0.12 calls this rule also where only tangents are batched; no argument is
        # batched then.
        is_batched = any(jax.tree.leaves(batched))
        out = jax.vmap(plain, axes)(*args) if is_batched else plain(*args)
        return out, jax.tree.map(lambda _: is_batched, out)

    @call.defjvp
    def _jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        out, change = jax.jvp(plain, primals, tangents)
        return batch_as(out, primals), change

    return call  # pyright: ignore[reportReturnType]


@jax.custom_jvp
def batch_as(tree: PyTree, args: PyTree) -> Any:
    """Return `tree` with every array batched by `jax.vmap` if any array of `args` is batched.

    This repeats what the batching rule of `compiled_as_one_kernel` returns. Under `jit`, JAX takes
    the axes of a batch from the function, and the values from the rule for the derivative. If the
    function and the rule batch differently, arrays have wrong shapes, and no error is raised.
    """
    return _batch_like(tree, args)


@batch_as.defjvp
def _batch_as_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    """Return two things: the first of two trees of arrays, in which every array has a batch axis of
    `jax.vmap` if any array of the second tree has one, as `batch_as` gives it; and the change of
    the first tree. By this rule JAX differentiates `batch_as`.

    - `primals`: the two trees
    - `tangents`: their changes; the change of the second tree is not used
    """
    return batch_as(*primals), tangents[0]


@jax.custom_batching.custom_vmap
def _batch_like(tree: PyTree, args: PyTree) -> Any:
    """Return `tree` unchanged. Under `jax.vmap` every array of the result has a batch axis if any
    array of `args` or of `tree` has one.

    - `tree`: a tree of arrays
    - `args`: another tree of arrays, whose values are not used
    """
    del args
    return tree


@_batch_like.def_vmap
def _batch_like_under_vmap(size: int, batched: PyTree, tree: PyTree, args: PyTree) -> Any:
    """Return the two things that `jax.vmap` wants of a function that returns `tree` unchanged: the
    tree, in which every array has a batch axis if any array of the two arguments has one; and a
    tree of truth values, whether each array of the result has a batch axis.

    - `size`: the number of members of the batch
    - `batched`: a pair of trees of truth values: which arrays of `tree`, and which of `args`, have
      a batch axis in front
    - `tree`, `args`: the two arguments of the function, trees of arrays; the values in `args` are
      not used
    """
    del args
    if not any(jax.tree.leaves(batched)):
        return tree, batched[0]
    grow = lambda a, b: a if b else jnp.broadcast_to(a, (size, *a.shape))  # noqa: E731
    return jax.tree.map(grow, tree, batched[0]), jax.tree.map(lambda _: True, tree)
