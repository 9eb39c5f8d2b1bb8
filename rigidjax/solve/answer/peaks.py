"""Find the times at which a law of time may have a narrow peak, which steps could pass over.

A narrow peak comes from a steep function, such as `exp`, of an operand that itself changes slowly:
the operand of exp(−(t − c)²/2w²) is a parabola, for any width w. The operands are therefore sampled
at a few times of each step, and not the law. Sums, products, sines and roots make no narrow peak.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from rigidjax.solve.answer.run import DiffraxRun
from rigidjax.solve.engine.momentum import equations_of
from rigidjax.solve.programs.traced import trace_program
from rigidjax.solve.times.sides import evaluate_on_correct_sides
from rigidjax.solve.times.switching import (
    BENT,
    DECLARED,
    FIXED,
    PIECES,
    PLAIN,
    STRAIGHT,
    Interpreter,
)
from rigidjax.solve.times.switching_times import lowest_between

# The operands are sampled `_A_STEP` times in a mean step of the run (a result of a loop or a table
# itself: `_OWN` times), in blocks of `_WINDOWS` times `_SAMPLES` times, of which at most `_BLOCKS`
# are taken. A block gives one peak of each window.
_A_STEP, _OWN, _WINDOWS, _SAMPLES, _BLOCKS = 16, 64, 32, 16, 32
_SHORTER, _LARGE = 60, 1e30
_STEEP = {"tanh", "logistic", "erf", "erfc", "atan", "asinh", "sinh", "cosh", "expm1"}


def _peak_height(
    eqn: Any, inputs: list[Any], kinds: list[int], out: Any
) -> tuple[Array, bool] | None:
    """Return the height of a peak in time of an equation, a number that is largest there, and
    whether it is the equation's own result.

    Else it is the logarithm of the result, as far as it matters. `None`: there is no peak.
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


def times_of_peaks(setup: DiffraxRun, ts: Array, ys: PyTree, num_steps: Array) -> Array:
    """Return the times (32,), s, of narrow peaks of the field of a run, `ts[0]` for none.

    There are no times (0,) if no part of the field is a steep function of the time.
    """
    begin, span = ts[0], ts[-1] - ts[0]
    way, dtype = jnp.sign(span), ts.dtype
    state0 = jax.tree.map(lambda leaf: leaf[0], ys)
    tree, numbers = ravel_pytree(state0)[1], jax.vmap(lambda y: ravel_pytree(y)[0])(ys)
    field = equations_of(setup.body, state0, setup.torque)
    sided = evaluate_on_correct_sides(field, setup.sign, None, ts[-1])
    flat = lambda t, y: ravel_pytree(sided(t, tree(y), None))[0]  # noqa: E731
    program = trace_program(flat, begin, numbers[0]).closed
    itself: list[bool] = []  # of each operand

    def operands(t: Array) -> Array:
        rows: list[tuple[Array, bool]] = []

        def see(path: Any, inputs: Any, kinds: Any, out: Any) -> None:
            if any(DECLARED in str(eqn.source_info.name_stack) for eqn in path):
                return  # steps end at the jumps of the law, and between them it has no peak
            found = (_peak_height(path[-1], inputs, kinds, one) for one in out)
            rows.extend((jnp.ravel(h).astype(dtype), own) for h, own in filter(None, found))

        saved = jnp.searchsorted(way * ts[1:], way * t, side="right")
        given = [(t, STRAIGHT), (numbers[jnp.minimum(saved, len(numbers) - 1)], FIXED)]
        reader = Interpreter(lambda path, inputs, result, kind: result, False, see=see)
        reader.run(program.jaxpr, program.consts, given)
        itself[:] = [own for row, own in rows for _ in range(row.size)]
        return jnp.concatenate([jnp.zeros(0, dtype), *(row for row, _ in rows)])

    if not (m := jax.eval_shape(operands, begin).size):
        return ts[:0]
    first, own = operands(begin), np.array(itself)

    def height(t: Array) -> Array:
        x = operands(t)
        x = jnp.where(own, jnp.log(jnp.abs(x - first)), x) if own.any() else x
        return jnp.nan_to_num(x, nan=-_LARGE, posinf=_LARGE, neginf=-_LARGE)

    size = float(_WINDOWS * _SAMPLES)
    steps = num_steps.astype(dtype)
    blocks = jnp.clip(jnp.ceil((_OWN if own.any() else _A_STEP) / size * steps), 1.0, _BLOCKS)

    def block(i: Array, best: tuple[Array, ...]) -> tuple[Array, ...]:
        share = (i.astype(dtype) * size + np.arange(-1.0, size + 1.0)) / (blocks * size)
        # On an even grid, peaks that come once a second could all fall between the samples.
        t = begin + span * jnp.clip(share * (1.25 - 0.25 * share), 0.0, 1.0)
        h = jax.vmap(height)(t)
        left, right = h[1:-1] - h[:-2], h[1:-1] - h[2:]
        curve = jnp.where((left > 0) & (right >= 0), left + right, 0).reshape(_WINDOWS, -1)
        most = jnp.argmax(curve, 1).astype(jnp.int32)
        row = most // m + _SAMPLES * np.arange(_WINDOWS, dtype=np.int32)
        new = jnp.max(curve, 1), t[row], t[row + 2], most % m
        return jax.tree.map(lambda a, b: jnp.where(new[0] > best[0], a, b), new, best)

    # A peak is narrow if its height falls by more than 1/2 within half of a mean step.
    least = jnp.full(_WINDOWS, 4 * (steps / (blocks * size)) ** 2)
    none = jnp.full(_WINDOWS, begin)
    found = least, none, none, jnp.zeros(_WINDOWS, jnp.int32)
    _, low, high, element = lax.fori_loop(0, blocks.astype(jnp.int32), block, found)
    at = jax.vmap(lambda t, i: height(t)[i])

    many = jnp.where(jnp.any(high != low), _SHORTER, 0)
    return lax.stop_gradient(lowest_between(lambda t: -at(t, element), low, high, many))
