"""What an adaptive run is made of, and what is kept of it for derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.runge_kutta import Field, Step
from rigidjax.solve.tableaus import Tableau


class Method(NamedTuple):
    """What a run is made of, beside its numbers.

    **Fields:** `tableau`; `field` and `project`, on (n, *bodies); `halt(t, y)` whether the run ends
    here, or `None`; `sizes` how many numbers each array of the state has; `max_steps`.
    """

    tableau: Tableau
    field: Field
    project: Callable[[Array], Array]
    halt: Callable[[Array, Array], Array] | None
    sizes: list[int]
    max_steps: int


class Run(NamedTuple):
    """The numbers of a run, a last axis of bodies in each.

    **Fields:** `t0`; `stops` (J,) where the torque jumps, and the last time; `between` (K,) times
    asked for; `y0` (n,); `rtol`, `atol`; `h0` the first step, NaN to choose one.
    """

    t0: Array
    stops: Array
    between: Array
    y0: Array
    rtol: Array
    atol: Array
    h0: Array

    @property
    def before(self) -> Array:
        """The last moment before each stop (J,): a stage there sees the torque before the jump."""
        jumps = lax.stop_gradient(self.stops[:-1])
        gap = jnp.nextafter(jumps, jnp.full_like(jumps, -jnp.inf)) - jumps
        return jnp.concatenate([self.stops[:-1] + gap, self.stops[-1:]])


class LoopState(NamedTuple):
    """Where the loop is.

    **Fields:** time, next step, state, index of the next stop, counters; how many of the times
    between are `known`.
    """

    t: Array
    h: Array
    y: Array
    stop: Array
    steps: Array
    rejected: Array
    known: Array


# A recorded step is one row (6 + n, *bodies): start; length; kind; index of the stop ahead, and how
# many times between were known, at the start; how many are in it; state at the start. Kinds: none
# was taken; one that gave states at times in it only, and is taken again for more of them; a step;
# each of these two also with its end on the stop.
Rows = Array
HEAD = 6
NONE, AGAIN, AGAIN_LAST, STEP, LAST = range(5)
# The next step of a run that has met the condition that ends it.
HALTED = -1.0


# The start of a segment is one row, too (6 + n, *bodies): what is one number, then the state. Whole
# numbers are exact in it up to 2²⁴ in float32.
_NUMBERS = ("t", "h", "stop", "steps", "rejected", "known")
_WHOLE = 2


def packed(loop: LoopState) -> Array:
    """A `LoopState` as one row."""
    numbers = [getattr(loop, name).astype(loop.y.dtype) for name in _NUMBERS]
    return jnp.concatenate([jnp.stack(numbers), loop.y])


def unpacked(row: Array) -> LoopState:
    """What was `packed`."""
    head, y = row[: len(_NUMBERS)], row[len(_NUMBERS) :]
    whole = head[_WHOLE:].astype(jnp.int32)
    return LoopState(y=y, **dict(zip(_NUMBERS, [*head[:_WHOLE], *whole], strict=True)))


class Record(NamedTuple):
    """A recorded run: the start of each segment (S, 6 + n, *bodies), how many there are, and the
    last one's rows.
    """

    starts: Array
    number: Array
    rows: Rows
    filled: Array


class Answer(NamedTuple):
    """States `between` (K, n, *bodies) and at the `end` (n, *bodies), NaN where not reached; time,
    state and next step of the loop when it ended (0, NaN where none is left to try, `HALTED`), and
    its counters.
    """

    between: Array
    end: Array
    t: Array
    last: Array
    h: Array
    steps: Array
    rejected: Array


def at_stop(kind: Array) -> Array:
    """Whether a step ends on the stop."""
    return (kind == LAST) | (kind == AGAIN_LAST)


class Taken(NamedTuple):
    """A recorded step: its `kind`, the index of the stop ahead, how many times between were known
    before it, how many are in it.
    """

    step: Step
    kind: Array
    stop: Array
    known: Array
    inside: Array


def row_of(run: Run, row: Array) -> Taken:
    """A recorded step."""
    t, h, y = row[0], row[1], row[HEAD:]
    kind, stop, known, inside = (row[i].astype(jnp.int32) for i in range(2, HEAD))
    end = jnp.where(at_stop(kind), at(run.before, stop), t + h)
    return Taken(Step(t, h, end, y), kind, stop, known, inside)


def at(a: Array, index: Array) -> Array:
    """a[index] of each body, along the first axis; a (J, …, *bodies), index (…, *bodies)."""
    if a.shape[0] == 1:
        return jnp.broadcast_to(a[0], index.shape)
    index = jnp.clip(index, 0, a.shape[0] - 1)
    if not index.ndim:
        return a[index]
    return jnp.take_along_axis(a, index[None], 0)[0]


def per_body(function: Callable[..., Any], bodies: int) -> Callable[..., Any]:
    """A function of one body's arrays as one of arrays with a last axis of bodies, if there is."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if bodies else function


def inserted(a: Array, rows: Array, index: Array) -> Array:
    return lax.dynamic_update_slice_in_dim(a, rows, index, 0)


def window(a: Array, index: Array, size: int) -> Array:
    return lax.dynamic_slice_in_dim(a, index, size, 0)
