"""Find the times at which a law of time may have a narrow peak, which steps could pass over.

A narrow peak comes from a steep function, such as `exp`, of an operand that itself changes slowly:
the operand of exp(−(t − c)²/2w²) is a parabola, for any width w. The operands are therefore sampled
at a few times of each step, and not the law. Sums, products, sines and roots make no narrow peak.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from rigidjax.solve import switching
from rigidjax.solve.sides import evaluate_on_correct_sides
from rigidjax.solve.stops import trace_program
from rigidjax.solve.switching import BENT, FIXED, PIECES, PLAIN, STRAIGHT

# The operands are sampled `_A_STEP` times in a mean step of the run, in blocks of `_WINDOWS` times
# `_SAMPLES` times, of which at most `_BLOCKS` are taken. A block gives one peak of each window.
_A_STEP, _WINDOWS, _SAMPLES, _BLOCKS = 64, 32, 16, 32
_HALVINGS, _LARGE = 60, 1e30
_STEEP = {"tanh", "logistic", "erf", "erfc", "atan", "asinh", "sinh", "cosh", "expm1"}


def _height(eqn: Any, inputs: list[Any], kinds: list[int], out: Any) -> tuple[Array, bool] | None:
    """Return what has its maximum at a peak of an equation, and whether it is the result itself.

    It is the logarithm of the result, as far as it matters. `None`: the equation makes no peak.
    """
    name, log = eqn.primitive.name, lambda a: jnp.log(jnp.abs(a))
    at = kinds[1] if len(kinds) > 1 else FIXED
    if name in ("gather", "dynamic_slice"):
        return None if at == FIXED else (out, True)
    if max(kinds, default=FIXED) <= PIECES or name in PLAIN:
        return None
    x = inputs[0]
    if name in ("exp", "exp2"):
        return (x if kinds[0] == BENT else -jnp.abs(x)), False
    if name in _STEEP:
        return -jnp.abs(x), False
    if name == "div":
        return None if at <= PIECES else (-log(inputs[1]), False)
    if name in ("rsqrt", "log", "log1p"):
        return -log(x + 1 if name == "log1p" else x), False
    if name in ("pow", "integer_pow"):
        power = inputs[1] if name == "pow" else eqn.params["y"]
        return None if name != "pow" and 0 <= power <= 4 else (power * log(x), False)
    return (out, True) if jnp.issubdtype(jnp.result_type(out), jnp.floating) else None


def times_of_peaks(
    field: Callable[..., PyTree], sign: Array | None, ts: Array, ys: PyTree, num_steps: Array
) -> Array:
    """Return the times (32,), s, of narrow peaks of a vector field, `ts[0]` for none.

    `ys` are the states at the first of the times `ts`: those after the last have this state. `sign`
    is the direction of time, as for `evaluate_on_correct_sides`. There are no times (0,) if no part
    of the field is a steep function of the time.
    """
    start, span = ts[0], ts[-1] - ts[0]
    tree = jax.tree.map(lambda leaf: leaf[0], ys)
    numbers = jax.vmap(lambda y: ravel_pytree(y)[0])(ys)
    sided = evaluate_on_correct_sides(field, sign, None)
    restored = ravel_pytree(tree)[1]
    flat = lambda t, y: ravel_pytree(sided(t, restored(y), None))[0]  # noqa: E731
    program, way = trace_program(flat, start, numbers[0]).closed, jnp.sign(span)
    itself: list[np.ndarray] = []

    def operands(t: Array) -> Array:
        rows = []

        def see(path: Any, inputs: Any, kinds: Any, out: Any) -> None:
            if any(switching.DECLARED in str(eqn.source_info.name_stack) for eqn in path):
                return  # steps end at the jumps of the law, and between them it has no peak
            found = (_height(path[-1], inputs, kinds, one) for one in out)
            rows.extend((jnp.ravel(h).astype(t.dtype), own) for h, own in filter(None, found))

        y = numbers[jnp.clip(jnp.searchsorted(way * ts, way * t, side="right"), 1, len(numbers)) - 1]
        keep = lambda path, inputs, result, kind: result  # noqa: E731
        reader = switching.Interpreter(keep, False, see=see)
        reader.run(program.jaxpr, program.consts, [(t, STRAIGHT), (y, FIXED)])
        itself[:] = [np.full(row.size, own) for row, own in rows]
        return jnp.concatenate([row for row, _ in rows]) if rows else jnp.zeros(0, t.dtype)

    if not jax.eval_shape(operands, start).size:
        return ts[:0]
    own, first = np.concatenate(itself), operands(start)

    def height(t: Array) -> Array:
        x = operands(t)
        x = jnp.where(own, jnp.log(jnp.abs(x - first)), x) if own.any() else x
        return jnp.nan_to_num(x, nan=-_LARGE, posinf=_LARGE, neginf=-_LARGE)

    count = jnp.asarray(_WINDOWS * _SAMPLES, ts.dtype)
    blocks = jnp.clip(jnp.ceil(_A_STEP * num_steps / count), 1, _BLOCKS).astype(ts.dtype)
    least = 4 * (num_steps / (blocks * count)) ** 2  # falls by 1/2 within half of a mean step

    def block(i: Array, best: Any) -> Any:
        share = (i * count + np.arange(-1, _WINDOWS * _SAMPLES + 1)) / (blocks * count)
        # On an even grid, peaks that come once a second could all fall between the samples.
        t = start + span * jnp.clip(share * (1.25 - 0.25 * share), 0, 1)
        h = jax.vmap(height)(t)
        curve = jnp.where(
            (h[1:-1] > h[:-2]) & (h[1:-1] >= h[2:]), 2 * h[1:-1] - h[:-2] - h[2:], 0
        ).reshape(_WINDOWS, -1)
        most = jnp.argmax(curve, 1)
        new = jnp.max(curve, 1), t[:-2][row := most // own.size + _SAMPLES * np.arange(_WINDOWS)], t[2:][row], most % own.size
        return jax.tree.map(lambda a, b: jnp.where(new[0] > best[0], a, b), new, best)

    none = jnp.full(_WINDOWS, start)
    begin = jnp.full(_WINDOWS, least, ts.dtype), none, none, jnp.zeros(_WINDOWS, int)
    _, low, high, element = lax.fori_loop(0, blocks.astype(int), block, begin)
    at = jax.vmap(lambda t, i: height(t)[i])

    def shorter(_: Any, ends: Any) -> Any:
        low, high = ends
        third = (high - low) / 3
        rises = at(low + third, element) < at(high - third, element)
        return jnp.where(rises, low + third, low), jnp.where(rises, high, high - third)

    halvings = jnp.where(jnp.any(high != low), _HALVINGS, 0)
    low, high = lax.fori_loop(0, halvings, shorter, (low, high))
    return lax.stop_gradient(0.5 * (low + high))
