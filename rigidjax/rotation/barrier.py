"""Give hints to XLA: which numbers it computes once for all their uses, and which functions it
compiles as one kernel.
"""

import functools
import os
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, PyTree

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable[..., Any])

# Whether XLA on CPU drops the barriers of `lax.optimization_barrier` before it fuses operations, as
# it does before JAX 0.11. A value that is used twice is then computed twice, and so is each value
# that it depends on: a run with a solver of order 8 and 900 output times took minutes, not
# milliseconds.
_DROPPED = jax.__version_info__ < (0, 11)
# The options of XLA that are set before JAX 0.11, with their names as keys. By the first XLA on CPU
# makes one kernel of a loop of which an iteration reads and writes less than 10 MB, and not only of
# loops below a kilobyte; by the second it writes the code of kernels with its older emitters, which
# compile in half of the time. Later versions do the first by default, and end at the second.
_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_FLAGS = {
    _LOOPS: f"--xla_backend_extra_options={_LOOPS}=10000000",
    "xla_cpu_use_fusion_emitters": "--xla_cpu_use_fusion_emitters=false",
}


def set_xla_flags() -> None:
    """Set options of XLA by which programs run and compile faster before JAX 0.11 (Python 3.11).

    Call it after the imports, and before the first computation: XLA reads the environment variable
    `XLA_FLAGS`, to which the options are added, when it compiles its first program. An option that
    the variable names is left as it is, and from JAX 0.11 on nothing is changed. On CPU forced
    motions and fits then run about five times as fast, and compile in 0.6 of the time. The command
    line calls this function; `import rigidjax` changes nothing.

    >>> set_xla_flags()
    """
    given = os.environ.get("XLA_FLAGS", "")
    if jax.__version_info__ < (0, 11):
        added = [flag for name, flag in _FLAGS.items() if name not in given]
        os.environ["XLA_FLAGS"] = " ".join([*added, *given.split()])


@functools.cache
def warn_of_slow_loops() -> None:
    """Warn, once in a process, if XLA on CPU will split a loop into many small kernels, as it does
    by default before JAX 0.11.
    """
    flagged = _LOOPS in os.environ.get("XLA_FLAGS", "")
    if jax.__version_info__ < (0, 11) and not flagged and platform() == "cpu":
        warnings.warn(
            f"jax {jax.__version__} makes many small kernels of the loop over the steps of a run, "
            "which then takes about five times as long: call rj.set_xla_flags() before the first "
            "computation, or start Python with the environment variable "
            f"XLA_FLAGS={_FLAGS[_LOOPS]}; with Python 3.12 or later jax needs no option",
            stacklevel=3,
        )


def platform() -> str:
    """Return the kind of device on which JAX computes, such as "cpu": that of `jax.default_device`,
    if it is set, which `jax.default_backend` ignores.
    """
    device: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def barrier(tree: Tree) -> Tree:
    """Return `tree` unchanged, such that XLA on CPU computes each array once for all uses.

    This is done by `lax.optimization_barrier`, or, where XLA drops such barriers, by a division by
    one. On a GPU each barrier would end a kernel, which costs more than computing some numbers
    twice; no barrier is set there.
    """
    if platform() != "cpu" or not any(isinstance(a, Tracer) for a in jax.tree.leaves(tree)):
        return tree
    if not _DROPPED:
        return lax.optimization_barrier(tree)
    real = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    return jax.tree.map(lambda x: computed_once(x) if real(x) else x, tree)


def computed_once(x: Array) -> Array:
    """Return x unchanged, such that XLA on CPU computes it once, here and in the gradient.

    The array is divided by one, or by two where it is NaN, so that XLA cannot know the divisor and
    leave the division out. XLA on CPU computes a quotient once; XLA repeats any cheaper operation,
    with all that the operation depends on, at each use.
    """
    return x / jnp.where(x == x, 1, 2)


def one_kernel(function: Function) -> Function:
    """Return `function`, which XLA compiles as one kernel unless `jax.vmap` batches it.

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
        # JAX before 0.12 calls this rule for `vmap` also if only the tangents of the arguments are
        # batched; no argument itself is batched then.
        is_batched = any(jax.tree.leaves(batched))
        out = jax.vmap(plain, axes)(*args) if is_batched else plain(*args)
        return out, jax.tree.map(lambda _: is_batched, out)

    @call.defjvp
    def _jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        out, change = jax.jvp(plain, primals, tangents)
        return match_batch_axes(out, primals), change

    return call  # pyright: ignore[reportReturnType]


@jax.custom_jvp
def match_batch_axes(tree: PyTree, reference: PyTree) -> PyTree:
    """Return `tree`, whose arrays are all batched under `jax.vmap` if one of `reference` is.

    A function from `one_kernel` gives all of its results a batch axis if any argument
    has one; the rule for its derivative does the same by this function. Under `jit`, JAX takes the
    batch axes from the function, and the values from the rule. If the two batch differently, arrays
    have wrong shapes, and no error is raised.
    """
    return _with_batch_axes(tree, reference)


@match_batch_axes.defjvp
def _match_batch_axes_jvp(
    primals: tuple[PyTree, PyTree], tangents: tuple[PyTree, PyTree]
) -> tuple[PyTree, PyTree]:
    """Return the first tree and its tangent."""
    return match_batch_axes(*primals), tangents[0]


@jax.custom_batching.custom_vmap
def _with_batch_axes(tree: PyTree, reference: PyTree) -> PyTree:
    """Return `tree`, whose arrays are all batched under `jax.vmap` if one of both trees is."""
    del reference
    return tree


@_with_batch_axes.def_vmap
def _with_batch_axes_vmap(
    size: int, batched: PyTree, tree: PyTree, reference: PyTree
) -> tuple[PyTree, PyTree]:
    """Return `tree` with batch axes in front, and which arrays of the result have them."""
    del reference
    if not any(jax.tree.leaves(batched)):
        return tree, batched[0]
    grow = lambda a, b: a if b else jnp.broadcast_to(a, (size, *a.shape))  # noqa: E731
    return jax.tree.map(grow, tree, batched[0]), jax.tree.map(lambda _: True, tree)
