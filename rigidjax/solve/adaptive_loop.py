"""Steps as long as the tolerances allow, for one body or many, with the states at any times.

The steps do not look at the times that are asked for. The state between two steps is that of the
method's dense output, whose stages are taken only in steps with such a time in them.

For derivatives the steps are recorded in segments: the start of each is kept, and the steps of the
last one; the others are run once more when they are needed.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import dense_output, runge_kutta
from rigidjax.solve.components import lift
from rigidjax.solve.record import (
    AGAIN,
    HALTED,
    HEAD,
    NONE,
    STEP,
    Answer,
    LoopState,
    Method,
    Record,
    Rows,
    Run,
    at,
    inserted,
    packed,
    per_body,
    window,
)
from rigidjax.solve.runge_kutta import Step
from rigidjax.solve.step_control import error_norm, first_step

# The defaults of diffrax.PIDController: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# Steps in a segment, rejected ones included.
SEGMENT = 512
# More rows for one that is run again: it may take a few steps more.
_MORE = 64
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte: steps are written
# into a block that small, and blocks into the record.
_BLOCK, _MOST = 560, 8


def value(method: Method, constants: list[Array], run: Run) -> Answer:
    """The answer, with nothing kept."""
    loop = start(method, constants, run)
    if not run.between.shape[0]:
        loop = lax.while_loop(
            lambda loop: jnp.any(going(method, run, loop, None)),
            lambda loop: _attempt(method, constants, run, loop, None, None, None)[0],
            loop,
        )
        return _answer(run, loop, run.y0[None][:0])
    loop, _, ys, _ = recorded(method, constants, run, loop, None, _none_saved(run), None)
    return _answer(run, loop, ys)


def recording(method: Method, constants: list[Array], run: Run) -> tuple[Answer, Record]:
    """The answer, and what derivatives need."""
    loop = start(method, constants, run)
    most = method.max_steps + run.stops.shape[0] + run.between.shape[0]
    first = packed(loop)
    starts = jnp.zeros((-(-most // SEGMENT), *first.shape), first.dtype)
    zero = jnp.zeros((), jnp.int32)

    def segment(state: Any) -> Any:
        loop, ys, record = state
        starts = lax.dynamic_update_index_in_dim(record.starts, packed(loop), record.number, 0)
        loop, rows, ys, count = recorded(method, constants, run, loop, record.rows, ys, None)
        return loop, ys, Record(starts, record.number + 1, rows, count)

    state = (loop, _none_saved(run), Record(starts, zero, empty_rows(run), zero))
    more = lambda state: jnp.any(going(method, run, state[0], None))  # noqa: E731
    loop, ys, record = lax.while_loop(more, segment, state)
    return _answer(run, loop, ys), record


def start(method: Method, constants: list[Array], run: Run) -> LoopState:
    """A loop about to begin."""
    t0, y0 = run.t0, run.y0
    h, f0 = lax.stop_gradient(first_step(method, constants, run))
    # Where f(t0) is not finite, no step is short enough.
    sound = jnp.all(jnp.isfinite(f0), 0) & jnp.all(jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    h = _unless_halted(method, t0, y0, h)
    zero = jnp.zeros(t0.shape, jnp.int32)
    return LoopState(t0, h, y0, zero, zero, zero, zero)


def going(method: Method, run: Run, loop: LoopState, until: LoopState | None) -> Array:
    """Whether a body has a step to take, until the state `until` at which a segment ends."""
    ahead = loop.stop < run.stops.shape[0]
    on = ahead & (loop.steps < method.max_steps) & (loop.h > 0)
    if until is None:
        return on
    return on & ((loop.t < until.t) | (loop.known < until.known))


def _attempt(
    method: Method,
    constants: list[Array],
    run: Run,
    loop: LoopState,
    until: LoopState | None,
    next_ts: tuple[Array, Array] | None,
    found: Array | None,
) -> tuple[LoopState, Array, Array | None]:
    """One attempt at a step of every body, its row, and `found` with the states at times in it.

    A step with more times in it than are looked at together is taken once more for the others.

    **Arguments:** `next_ts` the number of a time between and the times from there (W, *bodies);
    `found` their states, `None` where they are not wanted.
    """
    on = going(method, run, loop, until)
    if next_ts is not None:
        on = on & _looking(loop, next_ts)
    begin, end = at(run.stops, loop.stop), at(run.before, loop.stop)
    # A stop that is passed already, such as a jump before the start, needs no step.
    arrived = on & (loop.t >= begin)
    moving = on & ~arrived
    cut = over = jnp.zeros_like(on)
    own = loop.h
    if until is not None:
        # At its end a segment may have looked at some times in the step that is the next one's.
        over = loop.t >= until.t
        own = jnp.where(over, until.h, own)
        cut = ~over & (until.t < end)
        end = jnp.where(cut, until.t, end)
    left = end - loop.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = own >= left
    h = jnp.where(moving, jnp.where(last, left, own), jnp.zeros_like(own))
    late = jnp.where(last, end, loop.t + h)
    step = Step(loop.t, h, late, loop.y)
    reach = jnp.where(last & ~cut, begin, late)
    inside, dense, ts, number = None, None, loop.t, loop.known
    if next_ts is not None:
        first, ts = next_ts
        number = jnp.arange(ts.shape[0], dtype=jnp.int32).reshape(-1, *[1] * loop.t.ndim)
        inside = (number >= (loop.known - first)[None]) & (ts <= reach[None]) & moving[None]
        if until is not None:
            inside = inside & (number < (until.known - first)[None])
        dense = None if found is None else jnp.any(inside)
    there = runge_kutta.stages(method.tableau, method.field, constants, step, dense)
    y = method.project(there.end)
    error = runge_kutta.error_estimate(method.tableau, method.sizes, h, there.slopes)
    norm = error_norm(error, loop.y, y, run.rtol, run.atol)
    # NaN in a step too long says as little as infinity: try a shorter one.
    norm = lax.stop_gradient(jnp.where(jnp.isnan(norm), jnp.inf, norm))
    good = moving & ((norm < 1) | over)
    accept = good & ~over
    if inside is not None:
        accept = accept & ~inside[-1]
    order = method.tableau.order
    factor = jnp.clip(_SAFETY * norm ** (-1 / order), _SMALLEST, _LARGEST)
    following = lax.stop_gradient(h) * factor.astype(h.dtype)
    kept = lax.stop_gradient(loop.h)
    following = jnp.where(last & accept, jnp.maximum(following, kept), following)
    # Where no step is left to try the loop ends: h = 0, or NaN where it met one. Where t is 0 its
    # round-off is, too: then that of the run's length counts.
    least = jnp.finfo(h.dtype).eps * (run.stops[-1] - run.t0)
    unit = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(loop.t), least)
    why = jnp.where(jnp.isfinite(norm), 0.0, jnp.nan).astype(h.dtype)
    following = jnp.where(moving & ~good & ~(following > unit), why, following)
    reached = accept & last & ~cut
    following = jnp.where(moving & (accept | ~good), following, kept)
    if until is None:
        ended = _unless_halted(method, late, y, following)
        following = jnp.where(accept, ended, following)
    count = jnp.zeros_like(loop.known)
    if inside is not None:
        inside = inside & good[None]
        count = jnp.sum(inside, 0, dtype=jnp.int32)
        if found is not None:
            rows = runge_kutta.dense_rows(method.tableau, h, there.slopes)
            ts = jnp.where(inside, ts, loop.t[None])
            states = dense_output.states(method.project, ts, loop.t, h, loop.y, rows)
            found = jnp.where(jnp.expand_dims(inside, 1), states, found)
    after = LoopState(
        t=jnp.where(accept, jnp.where(reached, begin, late), loop.t),
        h=following,
        y=jnp.where(lift(accept, y), y, loop.y),
        stop=loop.stop + (arrived | reached).astype(jnp.int32),
        steps=loop.steps + (moving & (accept | ~good)).astype(jnp.int32),
        rejected=loop.rejected + (moving & ~good).astype(jnp.int32),
        known=loop.known + count,
    )
    kind = jnp.where(accept, STEP, jnp.where(good, AGAIN, NONE)).astype(jnp.int32)
    # Each kind that ends on the stop is the next number.
    kind = kind + (good & last & ~cut).astype(jnp.int32)
    head = [a.astype(h.dtype) for a in (loop.t, h, kind, loop.stop, loop.known, count)]
    return after, jnp.concatenate([jnp.stack(head), loop.y]), found


def _looking(loop: LoopState, next_ts: tuple[Array, Array]) -> Array:
    """Whether there may be more times in the step than those that were looked at."""
    first, ts = next_ts
    return loop.known < first + ts.shape[0]


def _unless_halted(method: Method, t: Array, y: Array, h: Array) -> Array:
    if method.halt is None:
        return h
    return jnp.where(method.halt(t, y), jnp.full_like(h, HALTED), h)


def recorded(
    method: Method,
    constants: list[Array],
    run: Run,
    loop: LoopState,
    rows: Rows | None,
    ys: Array | None,
    until: LoopState | None,
) -> tuple[LoopState, Any, Any, Array]:
    """From here on, as far as there is room for rows; and how many there were.

    **Arguments:** `rows` and `ys` the record and the states at the times between, `None` where they
    are not wanted.
    """
    bodies, numbers, width = run.t0.ndim, run.y0.shape[0], dense_output.width(run.between.shape[0])
    columns = (0 if rows is None else HEAD + numbers) or 1
    left = _BLOCK // run.y0.dtype.itemsize - (0 if ys is None else width * numbers)
    many = max(1, min(_MOST, left // columns))

    beyond = jnp.full((width, *run.t0.shape), jnp.inf, run.t0.dtype)
    later = jnp.concatenate([run.between, beyond])

    def on(loop: LoopState) -> Array:
        return going(method, run, loop, until)

    def block(state: Any) -> Any:
        loop, rows, ys, count = state
        few = found = next_ts = None
        base = loop.known
        if width:
            # Only the next times: all of them would make the state of this loop large.
            next_ts = (base, per_body(partial(window, size=width), bodies)(later, base))

        def attempt(state: Any) -> Any:
            loop, few, found, k = state
            loop, row, found = _attempt(method, constants, run, loop, until, next_ts, found)
            if few is not None:
                few = lax.dynamic_update_slice_in_dim(few, row[None], k, 0)
            return loop, few, found, k + 1

        def more(state: Any) -> Array:
            more = on(state[0])
            if next_ts is not None:
                more = more & _looking(state[0], next_ts)
            return jnp.any(more) & (state[-1] < many)

        if rows is not None:
            few = jnp.zeros((many, *rows.shape[1:]), rows.dtype)
        if ys is not None:
            found = jnp.zeros((width, *ys.shape[1:]), ys.dtype)
        state = (loop, few, found, jnp.zeros((), jnp.int32))
        loop, few, found, k = lax.while_loop(more, attempt, state)
        if rows is not None and few is not None:
            rows = lax.dynamic_update_slice_in_dim(rows, few, count, 0)
        if found is not None:
            # Those behind the known ones are written over.
            ys = per_body(inserted, bodies)(ys, found, base)
        return loop, rows, ys, count + k

    room = 0 if rows is None else rows.shape[0] - (_MORE if until is None else 0) - _MOST

    def more(state: Any) -> Array:
        loop, rows, _, count = state
        return jnp.any(on(loop)) & (True if rows is None else count < room)

    return lax.while_loop(more, block, (loop, rows, ys, jnp.zeros((), jnp.int32)))


def empty_rows(run: Run) -> Rows:
    """Space for the steps of a segment at least."""
    room = SEGMENT + _MORE + _MOST
    return jnp.zeros((room, HEAD + run.y0.shape[0], *run.t0.shape), run.y0.dtype)


def _none_saved(run: Run) -> Array | None:
    size = run.between.shape[0]
    if not size:
        return None
    return jnp.zeros((size + dense_output.width(size), *run.y0.shape), run.y0.dtype)


def _answer(run: Run, loop: LoopState, ys: Array | None) -> Answer:
    size = run.between.shape[0]
    between = run.y0[None][:0]
    if ys is not None and size:
        number = jnp.arange(size, dtype=jnp.int32).reshape(-1, *[1] * run.t0.ndim)
        there = (number < loop.known[None])[:, None]
        between = jnp.where(there, ys[:size], jnp.nan)
    there = loop.stop >= run.stops.shape[0]
    end = jnp.where(lift(there, loop.y), loop.y, jnp.nan)
    return Answer(between, end, loop.t, loop.y, loop.h, loop.steps, loop.rejected)
