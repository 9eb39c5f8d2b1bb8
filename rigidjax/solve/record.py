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
    between are `known`; time, state and next stop where the last accepted step began.
    """

    t: Array
    h: Array
    y: Array
    stop: Array
    steps: Array
    rejected: Array
    known: Array
    back_t: Array
    back_y: Array
    back_stop: Array


# A recorded step is one row (4 + n, *bodies): start; length; kind; index of the stop ahead at the
# start; state at the start. Kinds: none was taken, a step, a step that ends on the stop, and from
# VISIT on a visit of one of the times between.
Rows = Array
HEAD = 4
NONE, STEP, LAST, VISIT = range(4)
# The next step of a run that has met the condition that ends it.
HALTED = -1.0


# The start of a segment is one row, too (8 + 2 n, *bodies): what is one number, then both states.
# Whole numbers are exact in it up to 2²⁴ in float32.
_NUMBERS = ("t", "h", "back_t", "stop", "steps", "rejected", "known", "back_stop")
_WHOLE = 3


def packed(loop: LoopState) -> Array:
    """A `LoopState` as one row."""
    numbers = [getattr(loop, name).astype(loop.y.dtype) for name in _NUMBERS]
    return jnp.concatenate([jnp.stack(numbers), loop.y, loop.back_y])


def unpacked(row: Array) -> LoopState:
    """What was `packed`."""
    head, (y, back_y) = row[: len(_NUMBERS)], jnp.split(row[len(_NUMBERS) :], 2)
    whole = head[_WHOLE:].astype(jnp.int32)
    numbers = dict(zip(_NUMBERS, [*head[:_WHOLE], *whole], strict=True))
    return LoopState(y=y, back_y=back_y, **numbers)


class SegmentEnd(NamedTuple):
    """Where a segment that is run again ends: time, and number of known states.

    Another program rounds otherwise, and may take other steps. The last one is taken as it was,
    from `back_t` on, because visits after the end begin there.
    """

    t: Array
    back_t: Array
    known: Array


class Record(NamedTuple):
    """A recorded run: the start of each segment (S, 8 + 2 n, *bodies), how many there are, and the
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


def visit_of(run: Run, number: Array, t: Array, stop: Array, y: Array) -> Step:
    """The step from `t` to the time between of that number, with the stop ahead of `t`."""
    late = at(run.between, number)
    # The limit is the last moment before a jump: it moves nothing, and has no derivative here.
    end = late + lax.stop_gradient(jnp.minimum(late, at(run.before, stop)) - late)
    return Step(t, late - t, end, y)


def row_of(run: Run, row: Array) -> tuple[Step, Array, Array]:
    """A recorded step, its kind, and the index of the stop ahead."""
    t, h, y = row[0], row[1], row[HEAD:]
    kind, stop = row[2].astype(jnp.int32), row[3].astype(jnp.int32)
    end = jnp.where(kind == LAST, at(run.before, stop), t + h)
    if run.between.shape[0]:
        visit = visit_of(run, kind - VISIT, t, stop, y)
        end = jnp.where(kind >= VISIT, visit.end, end)
    return Step(t, h, end, y), kind, stop


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


def replaced(a: Array, row: Array, index: Array) -> Array:
    return lax.dynamic_update_index_in_dim(a, row, index, 0)


def inserted(a: Array, rows: Array, index: Array) -> Array:
    return lax.dynamic_update_slice_in_dim(a, rows, index, 0)
