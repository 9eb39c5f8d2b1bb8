"""Steps as long as the tolerances allow, for one body or many, with the states at any times.

The steps do not look at the times that are asked for. A state between two steps is one more step,
a shorter one, from the step's start, taken as soon as the loop is past it: of the method's own
order, on the group, with an error less than that of the step it lies in. Such a visit goes through
the same stages as a step, so that it costs nothing to compile.

For derivatives the steps are recorded in segments: the start of each is kept, and the steps of the
last one; the others are run once more when they are needed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve import runge_kutta
from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Field, Step
from rigidjax.solve.tableaus import Tableau

# What diffrax.PIDController does unless told: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# Steps in a segment, rejected ones and visits included.
SEGMENT = 512
# More rows for one that is run again: it may take a few steps more.
_MORE = 64
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte: steps are written
# into a block that small, and blocks into the record.
_BLOCK, _MOST = 560, 8


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


class Walk(NamedTuple):
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
_NUMBERS = ("t", "h", "back_t", "stop", "steps", "rejected", "known", "back_stop")
_WHOLE = 3


def packed(walk: Walk) -> Array:
    """A `Walk` as one row."""
    numbers = [getattr(walk, name).astype(walk.y.dtype) for name in _NUMBERS]
    return jnp.concatenate([jnp.stack(numbers), walk.y, walk.back_y])


def unpacked(row: Array) -> Walk:
    """What was `packed`."""
    head, (y, back_y) = row[: len(_NUMBERS)], jnp.split(row[len(_NUMBERS) :], 2)
    whole = head[_WHOLE:].astype(jnp.int32)
    numbers = dict(zip(_NUMBERS, [*head[:_WHOLE], *whole], strict=True))
    return Walk(y=y, back_y=back_y, **numbers)


class Until(NamedTuple):
    """Where a segment that is run again ends: time, and number of known states.

    Another program rounds otherwise, and may take other steps. The last one is taken as it was,
    from `back_t` on, because visits after the end begin there.
    """

    t: Array
    back_t: Array
    known: Array


class Book(NamedTuple):
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


def value(method: Method, constants: list[Array], run: Run) -> Answer:
    """The answer, with nothing kept."""
    walk = start(method, constants, run)
    if not run.between.shape[0]:
        walk = lax.while_loop(
            lambda walk: jnp.any(going(method, run, walk, None)),
            lambda walk: _attempt(method, constants, run, walk, None)[0],
            walk,
        )
        return _answer(run, walk, run.y0[None][:0])
    walk, _, ys, _ = recorded(method, constants, run, walk, None, _none_saved(run), None)
    return _answer(run, walk, ys)


def recording(method: Method, constants: list[Array], run: Run) -> tuple[Answer, Book]:
    """The answer, and what derivatives need."""
    walk = start(method, constants, run)
    most = method.max_steps + run.stops.shape[0] + run.between.shape[0]
    first = packed(walk)
    starts = jnp.zeros((-(-most // SEGMENT), *first.shape), first.dtype)
    zero = jnp.zeros((), jnp.int32)

    def segment(state: Any) -> Any:
        walk, ys, book = state
        starts = lax.dynamic_update_index_in_dim(book.starts, packed(walk), book.number, 0)
        walk, rows, ys, count = recorded(method, constants, run, walk, book.rows, ys, None)
        return walk, ys, Book(starts, book.number + 1, rows, count)

    state = (walk, _none_saved(run), Book(starts, zero, empty_rows(run), zero))
    more = lambda state: jnp.any(going(method, run, state[0], None))  # noqa: E731
    walk, ys, book = lax.while_loop(more, segment, state)
    return _answer(run, walk, ys), book


def start(method: Method, constants: list[Array], run: Run) -> Walk:
    """A loop about to begin."""
    t0, y0 = run.t0, run.y0
    h, f0 = lax.stop_gradient(_first_step(method, constants, run))
    # Where there is no slope to begin with, no step is short enough.
    sound = jnp.all(jnp.isfinite(f0), 0) & jnp.all(jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    h = _unless_halted(method, t0, y0, h)
    zero = jnp.zeros(t0.shape, jnp.int32)
    return Walk(t0, h, y0, zero, zero, zero, zero, t0, y0, zero)


def going(method: Method, run: Run, walk: Walk, until: Until | None) -> Array:
    """Whether a body has a step to take or a time to visit."""
    return _stepping(method, run, walk, until) | _visiting(run, walk, until)


def _stepping(method: Method, run: Run, walk: Walk, until: Until | None) -> Array:
    ahead = walk.stop < run.stops.shape[0]
    on = ahead & (walk.steps < method.max_steps) & (walk.h > 0)
    return on if until is None else on & (walk.t < until.t)


def _visiting(run: Run, walk: Walk, until: Until | None) -> Array:
    size = run.between.shape[0]
    if not size:
        return jnp.zeros(walk.t.shape, bool)
    there = (walk.known < size) & (at(run.between, walk.known) <= walk.t)
    return there if until is None else there & (walk.known < until.known)


def _attempt(
    method: Method, constants: list[Array], run: Run, walk: Walk, until: Until | None
) -> tuple[Walk, Array, Array]:
    """One attempt at a step, or a visit, of every body; its row, and the state at its end."""
    visiting = _visiting(run, walk, until)
    on = _stepping(method, run, walk, until) & ~visiting
    begin, end = at(run.stops, walk.stop), at(run.before, walk.stop)
    # A stop that is passed already, such as a jump before the start, needs no step.
    arrived = on & (walk.t >= begin)
    moving = on & ~arrived
    cut = forced = jnp.zeros_like(on)
    if until is not None:
        forced = moving & (walk.t >= until.back_t)
        goal = jnp.where(forced, until.t, until.back_t)
        cut = goal < end
        end = jnp.minimum(end, goal)
    left = end - walk.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = (walk.h >= left) | forced
    h = jnp.where(moving, jnp.where(last, left, walk.h), jnp.zeros_like(walk.h))
    late = jnp.where(last, end, walk.t + h)
    step, index = Step(walk.t, h, late, walk.y), walk.stop
    if run.between.shape[0]:
        step = visit_of(run, walk.known, walk.back_t, walk.back_stop, walk.back_y)
        index = jnp.where(visiting, walk.back_stop, walk.stop)
        step = Step(
            jnp.where(visiting, step.t, walk.t),
            jnp.where(visiting, step.h, h),
            jnp.where(visiting, step.end, late),
            jnp.where(lift(visiting, walk.y), step.y, walk.y),
        )
    there = runge_kutta.stages(method.tableau, method.field, constants, step)
    y = method.project(there.end)
    slope = None
    if runge_kutta.needs_last_slope(method.tableau):
        slope = method.field(constants, step.end, y)
    error = runge_kutta.error_estimate(method.tableau, method.sizes, h, there.slopes, slope)
    size = _size_of(error, walk.y, y, run.rtol, run.atol)
    # NaN in a step too long says as little as infinity: try a shorter one.
    size = lax.stop_gradient(jnp.where(jnp.isnan(size), jnp.inf, size))
    accept = moving & ((size < 1) | forced)
    order = method.tableau.order
    factor = jnp.clip(_SAFETY * size ** (-1 / order), _SMALLEST, _LARGEST)
    following = lax.stop_gradient(h) * factor.astype(h.dtype)
    kept = lax.stop_gradient(walk.h)
    following = jnp.where(last & accept, jnp.maximum(following, kept), following)
    # Where no step is left to try the loop ends: h = 0, or NaN where it met one. Where t is 0 its
    # round-off is, too: then that of the run's length counts.
    least = jnp.finfo(h.dtype).eps * (run.stops[-1] - run.t0)
    unit = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(walk.t), least)
    why = jnp.where(jnp.isfinite(size), 0.0, jnp.nan).astype(h.dtype)
    following = jnp.where(moving & ~accept & ~(following > unit), why, following)
    reached = accept & last & ~cut
    following = jnp.where(moving, following, kept)
    if until is None:
        ended = _unless_halted(method, late, y, following)
        following = jnp.where(accept, ended, following)
    wide = lift(accept, y)
    after = Walk(
        t=jnp.where(accept, jnp.where(reached, begin, late), walk.t),
        h=following,
        y=jnp.where(wide, y, walk.y),
        stop=walk.stop + (arrived | reached).astype(jnp.int32),
        steps=walk.steps + moving.astype(jnp.int32),
        rejected=walk.rejected + (moving & ~accept).astype(jnp.int32),
        known=walk.known + visiting.astype(jnp.int32),
        back_t=jnp.where(accept, walk.t, walk.back_t),
        back_y=jnp.where(wide, walk.y, walk.back_y),
        back_stop=jnp.where(accept, walk.stop, walk.back_stop),
    )
    kind = jnp.where(accept, jnp.where(reached, LAST, STEP), NONE)
    kind = jnp.where(visiting, VISIT + walk.known, kind.astype(jnp.int32))
    head = jnp.stack([step.t, step.h, kind.astype(h.dtype), index.astype(h.dtype)])
    return after, jnp.concatenate([head, step.y]), y


def _unless_halted(method: Method, t: Array, y: Array, h: Array) -> Array:
    if method.halt is None:
        return h
    return jnp.where(method.halt(t, y), jnp.full_like(h, HALTED), h)


def visit_of(run: Run, number: Array, t: Array, stop: Array, y: Array) -> Step:
    """The step from `t` to the time between of that number, with the stop ahead of `t`."""
    late = at(run.between, number)
    # The limit is the last moment before a jump: it moves nothing, and has no derivative here.
    end = late + lax.stop_gradient(jnp.minimum(late, at(run.before, stop)) - late)
    return Step(t, late - t, end, y)


def recorded(
    method: Method,
    constants: list[Array],
    run: Run,
    walk: Walk,
    rows: Rows | None,
    ys: Array | None,
    until: Until | None,
) -> tuple[Walk, Any, Any, Array]:
    """From here on, as far as there is room for rows; and how many there were.

    **Arguments:** `rows` and `ys` the record and the states at the times between, `None` where they
    are not wanted.
    """
    size = run.y0.shape[0]
    columns = (0 if rows is None else HEAD + size) + (0 if ys is None else size)
    many = max(1, min(_MOST, _BLOCK // (run.y0.dtype.itemsize * columns)))
    bodies = run.t0.ndim

    def on(walk: Walk) -> Array:
        return jnp.any(going(method, run, walk, until))

    def attempt(state: Any) -> Any:
        walk, few, found, base, k = state
        after, row, y = _attempt(method, constants, run, walk, until)
        if few is not None:
            few = lax.dynamic_update_slice_in_dim(few, row[None], k, 0)
        if found is not None:
            # What is no visit goes to the place beyond the last.
            place = jnp.where(after.known > walk.known, walk.known - base, many)
            found = per_body(_replaced, bodies)(found, y, place)
        return after, few, found, base, k + 1

    def block(state: Any) -> Any:
        walk, rows, ys, count = state
        few = found = None
        if rows is not None:
            few = jnp.zeros((many, *rows.shape[1:]), rows.dtype)
        if ys is not None:
            found = jnp.zeros((many + 1, *ys.shape[1:]), ys.dtype)
        base = walk.known
        state = (walk, few, found, base, jnp.zeros((), jnp.int32))
        more = lambda s: on(s[0]) & (s[-1] < many)  # noqa: E731
        walk, few, found, _, k = lax.while_loop(more, attempt, state)
        if rows is not None and few is not None:
            rows = lax.dynamic_update_slice_in_dim(rows, few, count, 0)
        if found is not None:
            ys = per_body(_inserted, bodies)(ys, found[:many], base)
        return walk, rows, ys, count + k

    room = 0 if rows is None else rows.shape[0] - (_MORE if until is None else 0) - _MOST

    def more(state: Any) -> Array:
        walk, rows, _, count = state
        return on(walk) if rows is None else on(walk) & (count < room)

    return lax.while_loop(more, block, (walk, rows, ys, jnp.zeros((), jnp.int32)))


def _replaced(a: Array, row: Array, index: Array) -> Array:
    return lax.dynamic_update_index_in_dim(a, row, index, 0)


def _inserted(a: Array, rows: Array, index: Array) -> Array:
    return lax.dynamic_update_slice_in_dim(a, rows, index, 0)


def empty_rows(run: Run) -> Rows:
    """Space for the steps of a segment at least."""
    room = SEGMENT + _MORE + _MOST
    return jnp.zeros((room, HEAD + run.y0.shape[0], *run.t0.shape), run.y0.dtype)


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


def _none_saved(run: Run) -> Array | None:
    size = run.between.shape[0]
    if not size:
        return None
    return jnp.zeros((size + _MOST, *run.y0.shape), run.y0.dtype)


def _answer(run: Run, walk: Walk, ys: Array | None) -> Answer:
    size = run.between.shape[0]
    between = run.y0[None][:0]
    if ys is not None and size:
        number = jnp.arange(size, dtype=jnp.int32).reshape(-1, *[1] * run.t0.ndim)
        there = (number < walk.known[None])[:, None]
        between = jnp.where(there, ys[:size], jnp.nan)
    there = walk.stop >= run.stops.shape[0]
    end = jnp.where(lift(there, walk.y), walk.y, jnp.nan)
    return Answer(between, end, walk.t, walk.y, walk.h, walk.steps, walk.rejected)


def _size_of(error: Array, left: Array, right: Array, rtol: Array, atol: Array) -> Array:
    """Root mean square of error over tolerance, as `diffrax.PIDController` takes it."""
    scale = lift(atol, left) + lift(rtol, left) * jnp.maximum(jnp.abs(left), jnp.abs(right))
    tiny = float(jnp.finfo(error.dtype).tiny)
    return jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + tiny)


def _first_step(method: Method, constants: list[Array], run: Run) -> tuple[Array, Array]:
    """The starting step of Hairer, Nørsett and Wanner (1993), II.4; the slope at the start."""
    y0, t0 = run.y0, run.t0
    scale = lift(run.atol, y0) + lift(run.rtol, y0) * jnp.abs(y0)

    def norm(a: Array) -> Array:
        return jnp.sqrt(jnp.mean((a / scale) ** 2, 0))

    d0 = norm(y0)

    def slope(_: Array, state: Any) -> Any:
        # At the start, then after a short step of Euler's: one field to compile.
        h, first, _ = state
        now = method.field(constants, t0 + h.astype(t0.dtype), y0 + lift(h, y0) * first)
        d1 = norm(now)
        small = (d0 < 1e-5) | (d1 < 1e-5)
        short = jnp.where(small, 1e-6, 0.01 * d0 / jnp.where(small, 1.0, d1)).astype(d0.dtype)
        begun = h != 0
        return jnp.where(begun, h, short), jnp.where(lift(begun, y0), first, now), now

    h = jnp.zeros_like(d0)
    state = (h, jnp.zeros_like(y0), jnp.zeros_like(y0))
    h, first, last = lax.fori_loop(np.int32(0), np.int32(2), slope, state)
    d2 = norm(last - first) / h
    largest = jnp.maximum(norm(first), d2)
    flat = largest <= 1e-15
    guess = (0.01 / jnp.where(flat, 1.0, largest)) ** (1 / method.tableau.order)
    h = jnp.minimum(100 * h, jnp.where(flat, jnp.maximum(1e-6, 1e-3 * h), guess))
    return h.astype(t0.dtype), first
