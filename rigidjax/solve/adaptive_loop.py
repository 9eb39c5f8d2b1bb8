"""Adaptive steps, for one body or many, with the states at any times. Bodies are in the last axis.

For saved states and derivatives the steps are recorded in segments: the start of each is kept, and
the steps of the last one; derivatives run the others once more. Steps with saved times in them are
taken once more after each segment.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from rigidjax.solve.batching import Arrays, lift
from rigidjax.solve.runge_kutta import Field, Step, error_estimate, nested, stages, weights
from rigidjax.solve.tableaus import Tableau

# diffrax inherits it from optimistix, where type checkers do not follow.
NONFINITE: Any = dfx.RESULTS.nonfinite

# The defaults of diffrax.PIDController.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0

# Steps in a segment, rejected ones included.
SEGMENT = 512
# More rows for one that is run again: it may take a few steps more.
_MORE = 64
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte: steps are written
# into a block that small, and blocks into the record. (Written row by row, second derivatives of
# several blocks of bodies with segments run again were wrong, on jaxlib 0.12.0.1.)
_BLOCK, _MOST = 560, 8
# Times of one body that are taken together.
_TOGETHER = 16


class Method(NamedTuple):
    """The parts of a run besides its numbers."""

    tableau: Tableau
    field: Field  # on (n, *bodies), as `project`
    project: Callable[[Array], Array]
    halt: Callable[..., Array] | None  # (t, y): whether the run ends here
    sizes: list[int]  # of the arrays of the state
    max_steps: int


class Run(NamedTuple):
    """The numbers of a run, a last axis of bodies in each."""

    t0: Array
    stops: Array  # (J,) where the torque jumps, and the last time
    between: Array  # (K,) times asked for
    y0: Array  # (n,)
    rtol: Array
    atol: Array
    h0: Array  # the first step, NaN to choose one
    longest: Array  # step

    @property
    def before(self) -> Array:
        """The last moment before each stop (J,): a stage there sees the torque before the jump."""
        jumps = lax.stop_gradient(self.stops[:-1])
        gap = jnp.nextafter(jumps, jnp.full_like(jumps, -jnp.inf)) - jumps
        return jnp.concatenate([self.stops[:-1] + gap, self.stops[-1:]])


class LoopState(NamedTuple):
    """The state of the loop, and the end of a run."""

    y: Array  # (n, *bodies)
    t: Array
    h: Array  # the next step: 0 or NaN if none is left to try, `HALTED`
    stop: Array  # index of the next one
    steps: Array
    rejected: Array


# A recorded attempt is one row (4 + n, *bodies): start, length, kind, index of the stop ahead, and
# the state at the start. Kinds: no step was taken; a step; a step that ends on the stop.
Rows = Array
HEAD = 4
NONE, STEP, LAST = range(3)
# The next step of a run that has met the condition that ends it.
HALTED = -1.0


def packed(loop: LoopState) -> Array:
    """A `LoopState` as one row. Whole numbers are exact in it up to 2²⁴ in float32."""
    return jnp.concatenate([jnp.stack([a.astype(loop.y.dtype) for a in loop[1:]]), loop.y])


def unpacked(row: Array) -> LoopState:
    """The inverse of `packed`."""
    head = len(LoopState._fields) - 1
    stop, steps, rejected = row[2:head].astype(jnp.int32)
    return LoopState(row[head:], row[0], row[1], stop, steps, rejected)


class Record(NamedTuple):
    """A recorded run."""

    starts: Array  # of each segment (S, 5 + n, *bodies), and the end of the last
    number: Array  # of segments
    rows: Rows  # of the last segment
    filled: Array  # their number


class Segment(NamedTuple):
    """A part of a run."""

    rows: Rows
    times: Array  # at which each row begins, inf where there is none
    end: Array
    number: Array  # of rows


def times_of(run: Run, rows: Rows) -> tuple[Array, Array, Array]:
    """Start, length and end of the steps of rows (4 + n, *bodies); they move with the stops."""
    t, h, kind, stop = lax.stop_gradient(rows[:HEAD])
    stop, last = stop.astype(jnp.int32), kind == LAST
    begun = at(jnp.concatenate([run.t0[None], run.stops]), stop)
    t = t + (begun - lax.stop_gradient(begun))
    end = at(run.before, stop)
    h = jnp.where(last, end - t, h)
    return t, h, jnp.where(last, end, t + h)


def at(a: Array, index: Array) -> Array:
    """a[index] of each body; a (J, *bodies), index (*many, *bodies)."""
    count = a.shape[0]
    a = a.reshape(count, *[1] * (index.ndim + 1 - a.ndim), *a.shape[1:])
    if count == 1:
        return jnp.broadcast_to(a[0], index.shape)
    index = jnp.clip(index, 0, count - 1)
    # Quicker than to look for one of so few rows, also in derivatives.
    if count <= 8:
        each = jnp.arange(count, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
        return jnp.sum(jnp.where(each == index[None], a, 0), 0)
    a = jnp.broadcast_to(a, (count, *index.shape))
    return jnp.take_along_axis(a, index[None], 0)[0]


def finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number in `tree` is finite."""
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good = good & jnp.all(jnp.isfinite(leaf))
    return good


def of_body(result: dfx.RESULTS, body: Any) -> dfx.RESULTS:
    """The result of a run; `nonfinite_input` where the body is NaN: no body has its numbers."""
    return dfx.RESULTS.where(finite(body), result, dfx.RESULTS.nonfinite_input)  # pyright: ignore


def tried(method: Method, constants: Arrays, run: Run, step: Step) -> tuple[Array, Array]:
    """The state a step later, and the root mean square of its error over the tolerance."""
    there = stages(method.tableau, method.field, constants, step)
    right = method.project(there.end)
    # Derivatives hold the chosen steps constant.
    left, after, h, slopes = lax.stop_gradient((step.y, right, step.h, there.slopes))
    error = error_estimate(method.tableau, method.sizes, h, slopes)
    largest = jnp.maximum(jnp.abs(left), jnp.abs(after))
    scale = lift(run.atol, left) + lift(run.rtol, left) * largest
    tiny = float(jnp.finfo(error.dtype).tiny)
    norm = jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + tiny)
    # NaN in a step too long says as little as infinity: try a shorter one.
    return right, jnp.where(jnp.isnan(norm), jnp.inf, norm)


def controlled(
    norm: Array, order: int, t: Array, h: Array, kept: Array, last: Array, length: Array
) -> tuple[Array, Array]:
    """Whether a step is accepted, and the next one: 0 where none is left to try, NaN after a NaN.

    `norm` as of `tried`; `kept` the step wanted before it was cut short as the `last` before a
    stop; `length` of the run, whose round-off counts where that of `t` vanishes.
    """
    norm, h, kept = lax.stop_gradient((norm, h, kept))
    good = norm < 1
    factor = jnp.clip(_SAFETY * norm ** (-1 / order), _SMALLEST, _LARGEST)
    following = h * factor.astype(h.dtype)
    eps = jnp.finfo(h.dtype).eps
    unit = 8 * eps * jnp.maximum(jnp.abs(t), eps * length)
    why = jnp.where(jnp.isfinite(norm), 0.0, jnp.nan).astype(h.dtype)
    shorter = jnp.where(following > unit, following, why)
    longer = jnp.where(last, jnp.maximum(following, kept), following)
    return good, jnp.where(good, longer, shorter)


def outcome(h: Array, t: Array, end: Array, met: Array) -> dfx.RESULTS:
    """The end of a run: its next step and time, the last time, whether it met what ends it."""
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(h), NONFINITE),
        (h > 0, dfx.RESULTS.max_steps_reached),
        (t >= end, dfx.RESULTS.successful),
        (met, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    return result


def first_step(method: Method, constants: Arrays, run: Run) -> tuple[Array, Array]:
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


def value(method: Method, constants: Arrays, run: Run) -> LoopState:
    """The end of a run whose states between are not asked for."""
    return lax.while_loop(
        lambda loop: jnp.any(going(method, run, loop, None)),
        lambda loop: _attempt(method, constants, run, loop, None)[0],
        start(method, constants, run),
    )


def recording(method: Method, constants: Arrays, run: Run) -> tuple[Array, LoopState, Record]:
    """States between (K, n, *bodies), NaN if not reached; the end; what derivatives need."""
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
            part = segment(rows, after.t, count)
            ys = saved(method, constants, run, part, ys)
        number = record.number + 1
        starts = lax.dynamic_update_index_in_dim(record.starts, packed(after), number, 0)
        return after, ys, Record(starts, number, rows, count)

    state = (loop, ys, Record(starts.at[0].set(first), zero, rows, zero))
    more = lambda state: jnp.any(going(method, run, state[0], None))  # noqa: E731
    loop, ys, record = lax.while_loop(more, one, state)
    number, filled = (jnp.broadcast_to(a, run.t0.shape) for a in (record.number, record.filled))
    return ys, loop, record._replace(number=number, filled=filled)


def start(method: Method, constants: Arrays, run: Run) -> LoopState:
    """A loop about to begin."""
    t0, y0 = run.t0, run.y0
    h, f0 = first_step(method, *lax.stop_gradient((constants, run)))
    # No step is short enough if f(t0) is not finite.
    sound = jnp.all(jnp.isfinite(f0) & jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    if method.halt is not None:
        h = jnp.where(method.halt(t0, y0), HALTED, h)
    zero = jnp.zeros(t0.shape, jnp.int32)
    # Stops at the start or behind it need no step.
    behind = jnp.sum(run.stops[:-1] <= t0[None], 0, dtype=jnp.int32)
    return LoopState(y0, t0, lax.stop_gradient(h), behind, zero, zero)


def going(method: Method, run: Run, loop: LoopState, until: Array | None) -> Array:
    """Whether a body has a step to take, until the time `until` at which a segment ends."""
    ahead = loop.stop < run.stops.shape[0]
    on = ahead & (loop.steps < method.max_steps) & (loop.h > 0)
    return on if until is None else on & (loop.t < until)


def _attempt(
    method: Method, constants: Arrays, run: Run, loop: LoopState, until: Array | None
) -> tuple[LoopState, Array]:
    """One attempt at a step of every body, and its row."""
    on = going(method, run, loop, until)
    begin, end = at(run.stops, loop.stop), at(run.before, loop.stop)
    # A stop that is passed already, such as the second of two at one time, needs no step.
    arrived = on & (loop.t >= begin)
    moving, own = on & ~arrived, lax.stop_gradient(jnp.minimum(loop.h, run.longest))
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
    if until is None and method.halt is not None:
        following = jnp.where(accept & method.halt(late, y), HALTED, following)
    reached = accept & last & ~cut
    after = LoopState(
        y=jnp.where(lift(accept, y), y, loop.y),
        t=jnp.where(accept, jnp.where(reached, begin, late), loop.t),
        h=lax.stop_gradient(following),
        # Those at the end are passed at once.
        stop=jnp.where(
            reached & (begin >= run.stops[-1]),
            run.stops.shape[0],
            loop.stop + (arrived | reached).astype(jnp.int32),
        ).astype(jnp.int32),
        steps=loop.steps + moving.astype(jnp.int32),
        rejected=loop.rejected + (moving & ~accept).astype(jnp.int32),
    )
    kind = jnp.where(accept, jnp.where(reached, LAST, STEP), NONE)
    head = [a.astype(h.dtype) for a in (loop.t, h, kind, loop.stop)]
    return after, jnp.concatenate([jnp.stack(head), loop.y])


def recorded(
    method: Method, constants: Arrays, run: Run, loop: LoopState, rows: Rows, until: Any
) -> tuple[LoopState, Rows, Array]:
    """The loop from here until the rows are full; and the number of rows."""
    many = max(1, min(_MOST, _BLOCK // run.y0.dtype.itemsize // rows.shape[1]))
    room = rows.shape[0] - (_MORE if until is None else 0) - _MOST

    def filled(body: Callable[..., Any], loop: LoopState, rows: Rows, most: int) -> Any:
        on = lambda state: jnp.any(going(method, run, state[0], until)) & (state[2] < most)  # noqa: E731
        return lax.while_loop(on, body, (loop, rows, jnp.zeros((), jnp.int32)))

    def attempt(state: Any) -> Any:
        loop, few, k = state
        loop, row = _attempt(method, constants, run, loop, until)
        return loop, lax.dynamic_update_slice_in_dim(few, row[None], k, 0), k + 1

    def block(state: Any) -> Any:
        loop, rows, count = state
        loop, few, k = filled(attempt, loop, jnp.zeros((many, *rows.shape[1:]), rows.dtype), many)
        return loop, lax.dynamic_update_slice_in_dim(rows, few, count, 0), count + k

    return filled(block, loop, rows, room)


def segment(rows: Rows, end: Array, count: Array) -> Segment:
    """A part of a run from its rows, of which there are `count`."""
    there = jnp.arange(rows.shape[0], dtype=jnp.int32).reshape(-1, *[1] * end.ndim) < count
    times = jnp.where(there, lax.stop_gradient(rows[:, 0]), jnp.inf)
    return Segment(rows, times, lax.stop_gradient(end), count)


def saved(method: Method, constants: Arrays, run: Run, part: Segment, ys: Array) -> Array:
    """`ys` (K, n, *bodies) with the states in a part of a run."""
    size, many = run.between.shape[0], run.t0.ndim > 0
    width = 1 if many else min(size, _TOGETHER)
    # All at once: in a loop each would be many small kernels.
    ts = lax.stop_gradient(run.between)
    search = per_body(run, lambda begun, ts: jnp.searchsorted(begun, ts).astype(jnp.int32) - 1)
    index = search(part.times, ts)
    index, inside = jnp.maximum(index, 0), (index >= 0) & (ts <= part.end[None])
    # What is not inside stands still at the first state, where the field has a value.
    still = part.rows[0].at[1:3].set(0)
    pick = jax.vmap(lambda rows, i: rows[i], (-1 if many else None, -1), -1)
    if not many:
        # Times of one body lie side by side as bodies do.
        field, project = (
            jax.vmap(method.field, (None, -1, -1), -1),
            jax.vmap(method.project, -1, -1),
        )
        method, still = method._replace(field=field, project=project), still[:, None]

    def window(i: Array, ys: Array) -> Array:
        # A window beyond the last time is moved back: states that are there are worked out again.
        number = jnp.minimum(first + i * width, size - width)

        def cut(a: Array) -> Array:
            a = jnp.moveaxis(lax.dynamic_slice_in_dim(a, number, width), 0, -1)
            return a[..., 0] if many else a

        there, old = cut(inside), cut(ys)
        row = jnp.where(there[None], pick(part.rows, cut(index)), still)
        step = Step(*times_of(run, row), row[HEAD:])
        slopes = stages(method.tableau, method.field, constants, step, True).slopes
        new = state_in_step(method, jnp.where(there, cut(run.between), row[0]), step, slopes)
        new = jnp.where(there[None], new, old)
        return lax.dynamic_update_slice_in_dim(ys, new[None] if many else new.T, number, 0)

    used = jnp.any(inside.reshape(size, -1), 1)
    first = jnp.argmax(used).astype(jnp.int32)
    length = size - jnp.argmax(used[::-1]).astype(jnp.int32) - first
    count = jnp.where(jnp.any(used), (length + width - 1) // width, 0)
    return lax.fori_loop(jnp.zeros_like(count), count, window, ys)


def per_body(run: Run, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one body's arrays as one of arrays with a last axis of bodies, if there is."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if run.t0.ndim else function


def state_in_step(method: Method, t: Array, step: Step, slopes: Array) -> Array:
    theta = ((t - step.t) / jnp.where(step.h == 0, 1, step.h)).astype(slopes.dtype)
    # Weights of the slopes are one number a stage; the rows F_r would be n.
    rows = weights(method.tableau, slopes.dtype).dense
    shares = nested(theta[None], rows.reshape(*rows.shape, *[1] * theta.ndim))
    rise = jnp.sum(shares[None] * slopes, 1)
    return method.project(step.y + lift(step.h.astype(rise.dtype), rise) * rise)
