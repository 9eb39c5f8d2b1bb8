"""Hints to XLA on CPU, so that scalar formulas compile and run fast.

XLA copies cheap arithmetic into each kernel that needs it: a chain of stages that all feed one
another grows exponentially. It does not copy divisions: a division by a 1 that is unknown to XLA
keeps a stage whole, and changes no bit (`fence`).

A kernel of one body takes long to compile, whatever its size. A loop with a small state becomes one
kernel; single computations are therefore put into a loop (`one_kernel`).
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rigidjax._types import Scalar

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable[..., Any])


def opaque_one(t: Scalar) -> Scalar:
    """1, unless t is NaN; XLA does not know."""
    return jax.lax.stop_gradient(jnp.where(t == t, jnp.ones_like(t), t))


def fence(tree: Tree, one: Scalar) -> Tree:
    """The same numbers, computed once."""
    return jax.tree.map(
        lambda x: x / (one if x.ndim == 0 else jnp.broadcast_to(one, x.shape)), tree
    )


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


_PARTS64 = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_PARTS32 = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
_SIN64 = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS64 = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
_SIN32 = (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4)
_COS32 = (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5)


def sincos(x: Scalar) -> tuple[Scalar, Scalar]:
    """Sin x and cos x of an angle in radians, by short polynomials. Not for differentiation.

    In batches of float64 XLA calls the scalar sine of the C library. Cody and Waite 1980 (reduction
    by π/2 in parts), fdlibm's and Cephes' minimax kernels. The error is one or two units in the
    last place up to 1e6 rad; beyond that it is within the round-off of the argument.
    """
    wide = x.dtype == jnp.float64
    parts, sines, cosines = (_PARTS64, _SIN64, _COS64) if wide else (_PARTS32, _SIN32, _COS32)
    n = jnp.round(x * (2.0 / jnp.pi))
    r = x
    for part in parts:
        r = r - n * part
    z = r * r
    s = r + r * z * _poly(sines, z)
    c = 1.0 - (0.5 * z - z * z * _poly(cosines, z))
    quarter = n - 4.0 * jnp.floor(0.25 * n)
    odd = (quarter == 1.0) | (quarter == 3.0)
    sine, cosine = jnp.where(odd, c, s), jnp.where(odd, s, c)
    sine = jnp.where(quarter >= 2.0, -sine, sine)
    cosine = jnp.where((quarter == 1.0) | (quarter == 2.0), -cosine, cosine)
    return sine, cosine


def _poly(coefficients, z):
    total = jnp.full_like(z, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * z + coefficient
    return total
