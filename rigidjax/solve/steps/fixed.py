"""Solve with equal steps, in a loop that carries little more than the state.

`diffrax.diffeqsolve` can do more, but costs more time in each step. Every saved time is the end of
a step, so that no interpolation adds to the error of the method.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from rigidjax.motion.torques.inputs import InputRow, delays_of
from rigidjax.rotation.barrier import platform
from rigidjax.solve.steps.equal_steps import StepWithLoopedStages
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.magnus import Magnus4
from rigidjax.solve.steps.pieces import march_on_gpu, steps_per_piece
from rigidjax.solve.steps.splitting import AbstractSplitting
from rigidjax.solve.steps.steppers import AnyStepper, stepper_of


def fixed(
    solver: AbstractExplicit | StepWithLoopedStages | Magnus4 | AbstractSplitting,
    field: Callable[..., Any],
    ts: Float[Array, " times"],
    y0: Any,
    substeps: Any,
    last: Any = None,
) -> Any:
    """Solve a vector field with `substeps` equal steps between each two times of `ts`.

    **Arguments:**

    - `solver`: a method of `rigidjax.solvers`.
    - `field`: a vector field `f(t, y, args)`, such as `equations_of_motion` returns.
    - `ts`: (T,) the times of the states, s.
    - `y0`: the state at `ts[0]`.
    - `substeps`: the number of steps between two times of `ts`, a whole number. If the number is
      traced, JAX does not compile again for another number, but reverse mode does not work.
    - `last`: the index in `ts` of the time at which the run ends; the states at later times are set
      to `y0`. The index may be traced. Reverse mode works only with `None`, which means that the
      run ends at the last time.

    **Returns** the states at `ts`, with a leading time axis. They are differentiable in forward
    mode, and in reverse mode if `substeps` is a Python integer and `last` is `None`.

    **Raises:** `TypeError` for another solver, and the errors of the solver itself.

    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> ys = fixed(rj.solvers.DormandPrince8(), field, jnp.array([0.0, 1.0]), start, 8)
    >>> ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    stepper = stepper_of(solver, field, y0, substeps * (ts.size - 1))

    def span(y: Any, ends: tuple[Array, Array]) -> tuple[Any, Any]:
        left, right = ends
        h = (right - left) / jnp.asarray(substeps, left.dtype)
        if isinstance(substeps, int):
            y = march_steps(stepper, h, left, jnp.zeros((), jnp.int32), substeps, y)
        else:
            y = lax.fori_loop(0, substeps, lambda i, y: equal_step(stepper, h, left, i, y), y)
        return y, y

    if last is None:
        _, rest = lax.scan(span, stepper.start, (ts[:-1], ts[1:]))
    else:
        start = stepper.start
        still = jax.tree.map(lambda a: jnp.broadcast_to(a, (ts.size - 1, *a.shape)), start)
        rest = fill_rows(last, lambda y, i: span(y, (ts[i], ts[i + 1])), start, still)
    later = jax.vmap(stepper.state)(rest)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), y0, later)


def fill_rows(
    count: Any, row_of: Callable[[PyTree, Array], tuple[PyTree, PyTree]], y: PyTree, rows: PyTree
) -> PyTree:
    """Compute the first `count` rows of a table in a loop by `row_of(y, i) → (y, row)`.

    The rows are the first axis of each array of the tree; later rows stay as they are.
    """

    def put(i: Array, now: tuple[Any, Any]) -> tuple[Any, Any]:
        y, row = row_of(now[0], i)
        return y, jax.tree.map(lambda all_, mine: all_.at[i].set(mine), now[1], row)

    zero = jnp.zeros((), jnp.int32)
    return lax.fori_loop(zero, jnp.asarray(count, jnp.int32), put, (y, rows))[1]


def equal_step(
    stepper: AnyStepper,
    h: Array,
    t0: Array,
    i: Array,
    y: PyTree,
    inputs: PyTree = None,
    first_row: int = 0,
) -> PyTree:
    """Take equal step number `i`; return the numbers that stand for the state after it.

    Step 0 begins at `t0`, s. `inputs` is `None`, or an array for each input of the torque, whose
    row `first_row + i` belongs to step i.
    """

    def at(i: Array) -> Array:
        # Each time is computed from t0: a repeated sum of h would add up round-off (in a million
        # steps to 1e-3 in float32).
        return t0 + i.astype(h.dtype) * h

    now = jax.tree.map(lambda a: _row(a, first_row + i), inputs)
    if not stepper.delays:
        return stepper.step(at(i), at(i + 1), h, y, now)
    # A delayed input changes within the step. The step is therefore divided at these changes, and
    # its parts are taken one after another, so that all inputs are constant within each part.
    parts, early, late = delayed_changes(stepper.delays, h, i, inputs, first_row)
    edges = jnp.concatenate([jnp.zeros(1, h.dtype), jnp.sort(parts), jnp.ones(1, h.dtype)])

    def part(y: Any, ends: tuple[Array, Array]) -> tuple[Any, None]:
        left, right = ends
        # An input has its new value in a part that ends after the change of this input, and its old
        # value in any other part. If a delay is a whole number of steps, the part before the change
        # has the length 0, but it still gets the old value, because the derivative with respect to
        # the delay contains this value.
        values = [jnp.where(right <= p, a, b) for p, a, b in zip(parts, early, late, strict=True)]
        t, end = at(i) + left * h, jnp.where(right == 1, at(i + 1), at(i) + right * h)
        return stepper.step(t, end, (right - left) * h, y, InputRow(now, tuple(values))), None

    return lax.scan(part, y, (edges[:-1], edges[1:]))[0]


class Changes(NamedTuple):
    """Hold how m delayed inputs change within a step."""

    places: Array  # (m,) from 0 at the start of the step to 1 at its end
    before: list[Array]  # the values before the changes
    after: list[Array]


def delayed_changes(
    delays: Sequence[tuple[str, Array]], h: Array, i: Array, inputs: PyTree, first_row: int
) -> Changes:
    """Return where in step `i` each of m delayed inputs changes, and its values before and after.

    An input is constant during each step; if it is delayed, it changes within a step.
    """
    parts, early, late = [], [], []
    for name, delay in delays:
        steps = delay.astype(h.dtype) / h
        whole = lax.stop_gradient(jnp.floor(steps))
        parts.append(steps - whole)
        last = first_row + i - whole.astype(jnp.int32)
        early.append(_row(inputs[name], last - 1))
        late.append(_row(inputs[name], last))
    return Changes(jnp.stack(parts), early, late)


def inputs_at_start(torque: Any, h: Array, inputs: PyTree) -> PyTree:
    """Return the values of a torque's inputs at the start of a run, as `bind` takes them.

    A delayed input has the value of one delay earlier, or of its first row.
    """
    delays = delays_of(torque)
    now = jax.tree.map(lambda a: a[0], inputs)
    if not delays:
        return now
    parts, early, late = delayed_changes(delays, h, jnp.zeros((), jnp.int32), inputs, 0)
    values = [jnp.where(p > 0, a, b) for p, a, b in zip(parts, early, late, strict=True)]
    return InputRow(now, tuple(values))


def _row(a: Array, i: Any) -> Array:
    """Return row `i` of an array, or the nearest row."""
    return lax.dynamic_index_in_dim(a, jnp.clip(i, 0, a.shape[0] - 1), 0, keepdims=False)


def march_steps(
    stepper: AnyStepper, h: Array, t0: Array, first_step: Array, count: int, y: PyTree,
    inputs: PyTree = None,
) -> PyTree:  # fmt: skip
    """Take `count` equal steps from number `first_step`; return the numbers of the state after.

    In reverse mode the run is divided into about √count pieces. The states at the starts of all
    pieces are stored; those within a piece are stored for one piece at a time.
    """
    if platform() != "cpu":
        return march_on_gpu(
            lambda y, i: equal_step(stepper, h, t0, i, y, inputs), first_step, count, y
        )

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def one(y: Any, i: Array) -> tuple[Any, None]:
        return equal_step(stepper, h, t0, i, y, inputs), None

    @functools.partial(jax.checkpoint, prevent_cse=False, static_argnums=2)
    def some(y: Any, begin: Array, many: int) -> Any:
        return lax.scan(one, y, begin + jnp.arange(many, dtype=jnp.int32))[0]

    length = steps_per_piece(count)
    pieces, left = divmod(count, length)
    if pieces > 1:
        starts = first_step + length * jnp.arange(pieces, dtype=jnp.int32)
        y, _ = lax.scan(lambda y, begin: (some(y, begin, length), None), y, starts)
    else:
        y = some(y, first_step, length)
    return some(y, first_step + pieces * length, left) if left else y
