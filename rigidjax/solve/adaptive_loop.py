"""Steps as long as the tolerances allow, for one body or many, with the states at any times.

The steps do not look at the times that are asked for. A state between two steps is one more step,
a shorter one, from the step's start, taken as soon as the loop is past it: of the method's own
order, on the group, with an error less than that of the step it lies in. Such a visit goes through
the same stages as a step, so that it costs nothing to compile.

For derivatives the steps are recorded in segments: the start of each is kept, and the steps of the
last one; the others are run once more when they are needed.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import runge_kutta
from rigidjax.solve.components import lift
from rigidjax.solve.record import (
    HALTED,
    HEAD,
    LAST,
    NONE,
    STEP,
    VISIT,
    Answer,
    LoopState,
    Method,
    Record,
    Rows,
    Run,
    SegmentEnd,
    at,
    inserted,
    packed,
    per_body,
    replaced,
    visit_of,
)
from rigidjax.solve.runge_kutta import Step
from rigidjax.solve.step_control import error_norm, first_step

# What diffrax.PIDController does unless told: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# Steps in a segment, rejected ones and visits included.
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
            lambda loop: _attempt(method, constants, run, loop, None)[0],
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
    # Where there is no slope to begin with, no step is short enough.
    sound = jnp.all(jnp.isfinite(f0), 0) & jnp.all(jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    h = _unless_halted(method, t0, y0, h)
    zero = jnp.zeros(t0.shape, jnp.int32)
    return LoopState(t0, h, y0, zero, zero, zero, zero, t0, y0, zero)


def going(method: Method, run: Run, loop: LoopState, until: SegmentEnd | None) -> Array:
    """Whether a body has a step to take or a time to visit."""
    return _stepping(method, run, loop, until) | _visiting(run, loop, until)


def _stepping(method: Method, run: Run, loop: LoopState, until: SegmentEnd | None) -> Array:
    ahead = loop.stop < run.stops.shape[0]
    on = ahead & (loop.steps < method.max_steps) & (loop.h > 0)
    return on if until is None else on & (loop.t < until.t)


def _visiting(run: Run, loop: LoopState, until: SegmentEnd | None) -> Array:
    size = run.between.shape[0]
    if not size:
        return jnp.zeros(loop.t.shape, bool)
    there = (loop.known < size) & (at(run.between, loop.known) <= loop.t)
    return there if until is None else there & (loop.known < until.known)


def _attempt(
    method: Method, constants: list[Array], run: Run, loop: LoopState, until: SegmentEnd | None
) -> tuple[LoopState, Array, Array]:
    """One attempt at a step, or a visit, of every body; its row, and the state at its end."""
    visiting = _visiting(run, loop, until)
    on = _stepping(method, run, loop, until) & ~visiting
    begin, end = at(run.stops, loop.stop), at(run.before, loop.stop)
    # A stop that is passed already, such as a jump before the start, needs no step.
    arrived = on & (loop.t >= begin)
    moving = on & ~arrived
    cut = forced = jnp.zeros_like(on)
    if until is not None:
        forced = moving & (loop.t >= until.back_t)
        goal = jnp.where(forced, until.t, until.back_t)
        cut = goal < end
        end = jnp.minimum(end, goal)
    left = end - loop.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = (loop.h >= left) | forced
    h = jnp.where(moving, jnp.where(last, left, loop.h), jnp.zeros_like(loop.h))
    late = jnp.where(last, end, loop.t + h)
    step, index = Step(loop.t, h, late, loop.y), loop.stop
    if run.between.shape[0]:
        step = visit_of(run, loop.known, loop.back_t, loop.back_stop, loop.back_y)
        index = jnp.where(visiting, loop.back_stop, loop.stop)
        step = Step(
            jnp.where(visiting, step.t, loop.t),
            jnp.where(visiting, step.h, h),
            jnp.where(visiting, step.end, late),
            jnp.where(lift(visiting, loop.y), step.y, loop.y),
        )
    there = runge_kutta.stages(method.tableau, method.field, constants, step)
    y = method.project(there.end)
    slope = None
    if runge_kutta.needs_last_slope(method.tableau):
        slope = method.field(constants, step.end, y)
    error = runge_kutta.error_estimate(method.tableau, method.sizes, h, there.slopes, slope)
    size = error_norm(error, loop.y, y, run.rtol, run.atol)
    # NaN in a step too long says as little as infinity: try a shorter one.
    size = lax.stop_gradient(jnp.where(jnp.isnan(size), jnp.inf, size))
    accept = moving & ((size < 1) | forced)
    order = method.tableau.order
    factor = jnp.clip(_SAFETY * size ** (-1 / order), _SMALLEST, _LARGEST)
    following = lax.stop_gradient(h) * factor.astype(h.dtype)
    kept = lax.stop_gradient(loop.h)
    following = jnp.where(last & accept, jnp.maximum(following, kept), following)
    # Where no step is left to try the loop ends: h = 0, or NaN where it met one. Where t is 0 its
    # round-off is, too: then that of the run's length counts.
    least = jnp.finfo(h.dtype).eps * (run.stops[-1] - run.t0)
    unit = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(loop.t), least)
    why = jnp.where(jnp.isfinite(size), 0.0, jnp.nan).astype(h.dtype)
    following = jnp.where(moving & ~accept & ~(following > unit), why, following)
    reached = accept & last & ~cut
    following = jnp.where(moving, following, kept)
    if until is None:
        ended = _unless_halted(method, late, y, following)
        following = jnp.where(accept, ended, following)
    wide = lift(accept, y)
    after = LoopState(
        t=jnp.where(accept, jnp.where(reached, begin, late), loop.t),
        h=following,
        y=jnp.where(wide, y, loop.y),
        stop=loop.stop + (arrived | reached).astype(jnp.int32),
        steps=loop.steps + moving.astype(jnp.int32),
        rejected=loop.rejected + (moving & ~accept).astype(jnp.int32),
        known=loop.known + visiting.astype(jnp.int32),
        back_t=jnp.where(accept, loop.t, loop.back_t),
        back_y=jnp.where(wide, loop.y, loop.back_y),
        back_stop=jnp.where(accept, loop.stop, loop.back_stop),
    )
    kind = jnp.where(accept, jnp.where(reached, LAST, STEP), NONE)
    kind = jnp.where(visiting, VISIT + loop.known, kind.astype(jnp.int32))
    head = jnp.stack([step.t, step.h, kind.astype(h.dtype), index.astype(h.dtype)])
    return after, jnp.concatenate([head, step.y]), y


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
    until: SegmentEnd | None,
) -> tuple[LoopState, Any, Any, Array]:
    """From here on, as far as there is room for rows; and how many there were.

    **Arguments:** `rows` and `ys` the record and the states at the times between, `None` where they
    are not wanted.
    """
    size = run.y0.shape[0]
    columns = (0 if rows is None else HEAD + size) + (0 if ys is None else size)
    many = max(1, min(_MOST, _BLOCK // (run.y0.dtype.itemsize * columns)))
    bodies = run.t0.ndim

    def on(loop: LoopState) -> Array:
        return jnp.any(going(method, run, loop, until))

    beyond = jnp.full((many + 1, *run.t0.shape), jnp.inf, run.t0.dtype)
    later = jnp.concatenate([run.between, beyond])

    def block(state: Any) -> Any:
        loop, rows, ys, count = state
        few = found = None
        base, here, until_here = loop.known, run, until
        if run.between.shape[0]:
            # Only the times that this block can come to: all of them would make its state large.
            few_times = partial(lax.dynamic_slice_in_dim, slice_size=many + 1)
            here = run._replace(between=per_body(few_times, bodies)(later, base))
            loop = loop._replace(known=jnp.zeros_like(base))
            if until is not None:
                until_here = until._replace(known=until.known - base)

        def attempt(state: Any) -> Any:
            loop, few, found, k = state
            after, row, y = _attempt(method, constants, here, loop, until_here)
            if few is not None:
                few = lax.dynamic_update_slice_in_dim(few, row[None], k, 0)
            if found is not None:
                # What is no visit goes to the place beyond the last.
                place = jnp.where(after.known > loop.known, loop.known, many)
                found = per_body(replaced, bodies)(found, y, place)
            return after, few, found, k + 1

        if rows is not None:
            few = jnp.zeros((many, *rows.shape[1:]), rows.dtype)
        if ys is not None:
            found = jnp.zeros((many + 1, *ys.shape[1:]), ys.dtype)
        state = (loop, few, found, jnp.zeros((), jnp.int32))
        more = lambda s: jnp.any(going(method, here, s[0], until_here)) & (s[-1] < many)  # noqa: E731
        loop, few, found, k = lax.while_loop(more, attempt, state)
        if run.between.shape[0]:
            loop = loop._replace(known=loop.known + base)
            if few is not None:
                visits = jnp.where(few[:, 2] >= VISIT, base, 0)
                few = few.at[:, 2].add(visits.astype(few.dtype))
        if rows is not None and few is not None:
            rows = lax.dynamic_update_slice_in_dim(rows, few, count, 0)
        if found is not None:
            ys = per_body(inserted, bodies)(ys, found[:many], base)
        return loop, rows, ys, count + k

    room = 0 if rows is None else rows.shape[0] - (_MORE if until is None else 0) - _MOST

    def more(state: Any) -> Array:
        loop, rows, _, count = state
        return on(loop) if rows is None else on(loop) & (count < room)

    return lax.while_loop(more, block, (loop, rows, ys, jnp.zeros((), jnp.int32)))


def empty_rows(run: Run) -> Rows:
    """Space for the steps of a segment at least."""
    room = SEGMENT + _MORE + _MOST
    return jnp.zeros((room, HEAD + run.y0.shape[0], *run.t0.shape), run.y0.dtype)


def _none_saved(run: Run) -> Array | None:
    size = run.between.shape[0]
    if not size:
        return None
    return jnp.zeros((size + _MOST, *run.y0.shape), run.y0.dtype)


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
