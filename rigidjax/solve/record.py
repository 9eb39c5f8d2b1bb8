"""What a run with adaptive steps is made of, and what is kept of it; bodies in the last axis."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.runge_kutta import Field
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
    """Where the loop is: time, next step, index of the next stop, counters, state."""

    t: Array
    h: Array
    stop: Array
    steps: Array
    rejected: Array
    y: Array


# A recorded attempt is one row (4 + n, *bodies): start, length, kind, index of the stop ahead, and
# the state at the start. Kinds: no step was taken; a step; a step that ends on the stop.
Rows = Array
HEAD = 4
NONE, STEP, LAST = range(3)
# The next step of a run that has met the condition that ends it.
HALTED = -1.0


def packed(loop: LoopState) -> Array:
    """A `LoopState` as one row. Whole numbers are exact in it up to 2²⁴ in float32."""
    return jnp.concatenate([jnp.stack([a.astype(loop.y.dtype) for a in loop[:-1]]), loop.y])


def unpacked(row: Array) -> LoopState:
    """What was `packed`."""
    head = len(LoopState._fields) - 1
    stop, steps, rejected = row[2:head].astype(jnp.int32)
    return LoopState(row[0], row[1], stop, steps, rejected, row[head:])


class Record(NamedTuple):
    """A recorded run: the start of each segment (S, 5 + n, *bodies) and the end of the last, how
    many segments there are, and the last one's rows and how many they are.
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


class Segment(NamedTuple):
    """A part of a run: its rows, the time at which each begins (inf where there is none), times of
    its start and end, and the number of rows.
    """

    rows: Rows
    times: Array
    begin: Array
    end: Array
    number: Array


def times_of(run: Run, rows: Rows) -> tuple[Array, Array, Array]:
    """Start, length and end of the steps of rows (4 + n, *bodies).

    The start moves with the stop before it, the length of a step that ends on a stop with both; all
    other lengths are held.
    """
    t, h, kind, stop = lax.stop_gradient(rows[:HEAD])
    stop, last = stop.astype(jnp.int32), kind == LAST
    begun = at(jnp.concatenate([run.t0[None], run.stops]), stop)
    t = t + (begun - lax.stop_gradient(begun))
    end = at(run.before, stop)
    h = jnp.where(last, end - t, h)
    return t, h, jnp.where(last, end, t + h)


# So few rows that it is quicker to add up all of them than to look for one, also in derivatives.
_FEW = 8


def at(a: Array, index: Array) -> Array:
    """a[index] of each body; a (J, *bodies), index (*many, *bodies)."""
    count = a.shape[0]
    a = a.reshape(count, *[1] * (index.ndim + 1 - a.ndim), *a.shape[1:])
    if count == 1:
        return jnp.broadcast_to(a[0], index.shape)
    index = jnp.clip(index, 0, count - 1)
    if count <= _FEW:
        each = jnp.arange(count, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
        return jnp.sum(jnp.where(each == index[None], a, 0), 0)
    a = jnp.broadcast_to(a, (count, *index.shape))
    return jnp.take_along_axis(a, index[None], 0)[0]
