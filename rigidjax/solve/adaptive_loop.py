"""Adaptive steps, for one body or many, with the states at any times.

For saved states and derivatives the steps are recorded in segments: the start of each is kept, and
the steps of the last one; derivatives run the others once more.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import dense_output
from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Step
from rigidjax.solve.step_control import (
    HALTED,
    HEAD,
    LAST,
    NONE,
    STEP,
    Answer,
    LoopState,
    Method,
    Record,
    Rows,
    Run,
    Segment,
    at,
    controlled,
    first_step,
    packed,
    tried,
)

# Steps in a segment, rejected ones included.
SEGMENT = 512
# More rows for one that is run again: it may take a few steps more.
_MORE = 64
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte: steps are written
# into a block that small, and blocks into the record.
_BLOCK, _MOST = 560, 8


def value(method: Method, constants: list[Array], run: Run) -> Answer:
    """The answer, with nothing kept."""
    if run.between.shape[0]:
        return recording(method, constants, run)[0]
    loop = lax.while_loop(
        lambda loop: jnp.any(going(method, run, loop, None)),
        lambda loop: _attempt(method, constants, run, loop, None)[0],
        start(method, constants, run),
    )
    return _answer(run, loop, run.y0[None][:0])


def recording(method: Method, constants: list[Array], run: Run) -> tuple[Answer, Record]:
    """The answer, and what derivatives need."""
    loop = start(method, constants, run)
    first, most = packed(loop), method.max_steps + run.stops.shape[0]
    starts = jnp.zeros((-(-most // SEGMENT) + 1, *first.shape), first.dtype)
    ys = jnp.full((run.between.shape[0], *run.y0.shape), jnp.nan, run.y0.dtype)
    rows = jnp.zeros((SEGMENT + _MORE + _MOST, HEAD + run.y0.shape[0], *run.t0.shape), ys.dtype)
    zero = jnp.zeros((), jnp.int32)

    def one(state: Any) -> Any:
        loop, ys, record = state
        after, rows, count = recorded(method, constants, run, loop, record.rows, None)
        if run.between.shape[0]:
            part = segment(rows, loop.t, after.t, count)
            ys = dense_output.saved(method, constants, run, part, rows[:, HEAD:], ys)
        number = record.number + 1
        starts = lax.dynamic_update_index_in_dim(record.starts, packed(after), number, 0)
        return after, ys, Record(starts, number, rows, count)

    state = (loop, ys, Record(starts.at[0].set(first), zero, rows, zero))
    more = lambda state: jnp.any(going(method, run, state[0], None))  # noqa: E731
    loop, ys, record = lax.while_loop(more, one, state)
    number, filled = (jnp.broadcast_to(a, run.t0.shape) for a in (record.number, record.filled))
    return _answer(run, loop, ys), record._replace(number=number, filled=filled)


def start(method: Method, constants: list[Array], run: Run) -> LoopState:
    """A loop about to begin."""
    t0, y0 = run.t0, run.y0
    h, f0 = first_step(method, constants, run)
    # No step is short enough if f(t0) is not finite.
    sound = jnp.all(jnp.isfinite(f0) & jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    h = lax.stop_gradient(_unless_halted(method, t0, y0, h))
    zero = jnp.zeros(t0.shape, jnp.int32)
    return LoopState(t0, h, zero, zero, zero, y0)


def going(method: Method, run: Run, loop: LoopState, until: Array | None) -> Array:
    """Whether a body has a step to take, until the time `until` at which a segment ends."""
    ahead = loop.stop < run.stops.shape[0]
    on = ahead & (loop.steps < method.max_steps) & (loop.h > 0)
    return on if until is None else on & (loop.t < until)


def _attempt(
    method: Method, constants: list[Array], run: Run, loop: LoopState, until: Array | None
) -> tuple[LoopState, Array]:
    """One attempt at a step of every body, and its row."""
    on = going(method, run, loop, until)
    begin, end = at(run.stops, loop.stop), at(run.before, loop.stop)
    # A stop that is passed already, such as a jump before the start, needs no step.
    arrived = on & (loop.t >= begin)
    moving, own = on & ~arrived, lax.stop_gradient(loop.h)
    cut = jnp.zeros_like(on)
    if until is not None:
        cut = until < end
        end = jnp.where(cut, until, end)
    left = end - loop.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = own >= left
    h = jnp.where(moving, jnp.where(last, left, own), jnp.zeros_like(own))
    late = jnp.where(last, end, loop.t + h)
    y, norm = tried(method, constants, run, Step(loop.t, h, late, loop.y))
    length = run.stops[-1] - run.t0
    good, following = controlled(norm, method.tableau.order, loop.t, h, own, last, length)
    accept = moving & good
    following = jnp.where(moving, following, own)
    if until is None:
        following = jnp.where(accept, _unless_halted(method, late, y, following), following)
    reached = accept & last & ~cut
    after = LoopState(
        t=jnp.where(accept, jnp.where(reached, begin, late), loop.t),
        h=lax.stop_gradient(following),
        stop=loop.stop + (arrived | reached).astype(jnp.int32),
        steps=loop.steps + moving.astype(jnp.int32),
        rejected=loop.rejected + (moving & ~accept).astype(jnp.int32),
        y=jnp.where(lift(accept, y), y, loop.y),
    )
    kind = jnp.where(accept, jnp.where(reached, LAST, STEP), NONE)
    head = [a.astype(h.dtype) for a in (loop.t, h, kind, loop.stop)]
    return after, jnp.concatenate([jnp.stack(head), loop.y])


def _unless_halted(method: Method, t: Array, y: Array, h: Array) -> Array:
    if method.halt is None:
        return h
    return jnp.where(method.halt(t, y), jnp.full_like(h, HALTED), h)


def recorded(
    method: Method, constants: list[Array], run: Run, loop: LoopState, rows: Rows, until: Any
) -> tuple[LoopState, Rows, Array]:
    """The loop from here until the rows are full; and the number of rows."""
    many = max(1, min(_MOST, _BLOCK // run.y0.dtype.itemsize // rows.shape[1]))

    room = rows.shape[0] - (_MORE if until is None else 0) - _MOST
    none = jnp.zeros((), jnp.int32)

    def more(most: int, state: Any) -> Array:
        loop, _, count = state
        return jnp.any(going(method, run, loop, until)) & (count < most)

    def attempt(state: Any) -> Any:
        loop, few, k = state
        loop, row = _attempt(method, constants, run, loop, until)
        return loop, lax.dynamic_update_slice_in_dim(few, row[None], k, 0), k + 1

    def block(state: Any) -> Any:
        loop, rows, count = state
        few = jnp.zeros((many, *rows.shape[1:]), rows.dtype)
        loop, few, k = lax.while_loop(partial(more, many), attempt, (loop, few, none))
        return loop, lax.dynamic_update_slice_in_dim(rows, few, count, 0), count + k

    return lax.while_loop(partial(more, room), block, (loop, rows, none))


def segment(rows: Rows, begin: Array, end: Array, count: Array) -> Segment:
    """A part of a run from its rows, of which there are `count`."""
    begin, end = lax.stop_gradient((begin, end))
    there = jnp.arange(rows.shape[0], dtype=jnp.int32).reshape(-1, *[1] * begin.ndim) < count
    times = jnp.where(there, lax.stop_gradient(rows[:, 0]), jnp.inf)
    return Segment(rows, times, begin, end, count)


def _answer(run: Run, loop: LoopState, between: Array) -> Answer:
    there = loop.stop >= run.stops.shape[0]
    end = jnp.where(lift(there, loop.y), loop.y, jnp.nan)
    return Answer(between, end, loop.t, loop.y, loop.h, loop.steps, loop.rejected)
