"""Run an explicit method under any step controller of diffrax, for one body or for many.

The bodies are in the last axis of every array. For derivatives the steps are recorded. A run is
divided into segments of `SEGMENT` steps. The record stores the state at the start of each segment,
but the single steps of the last segment only. For a derivative each earlier segment is run once
more, from its stored state, to get its steps.
"""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, PyTree

from rigidjax.rotation.barrier import platform
from rigidjax.solve.programs.batching import Arrays, lift
from rigidjax.solve.steps.runge_kutta import (
    Field,
    Step,
    dense_change,
    error_estimate,
    stages,
    weights_of,
)
from rigidjax.solve.steps.tableaus import Tableau

# diffrax inherits this member from optimistix, and type checkers do not find it there.
NONFINITE: Any = dfx.RESULTS.nonfinite

# The largest number of steps in one segment, rejected steps included. A run whose steps are
# recorded for derivatives is divided into segments.
SEGMENT = 512
# The largest number of additional rows for a segment that is run again for derivatives: if the
# program for derivatives rounds differently from the program of the run, the segment may take a few
# more steps.
_MORE = 64
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte. The rows of steps
# are therefore collected in a block of at most `_BLOCK` bytes and `_MOST` rows, and each full block
# is copied to the record. (When each row was written directly to the record, second derivatives
# were wrong on jaxlib 0.12.0.1 for a batch of several blocks of bodies whose segments were run
# again.)
_BLOCK, _MOST = 560, 8
# The next step has the length that the error estimate suggests, times the safety factor `_SAFETY`.
# The ratio of this length to the length of the last step is limited to `_SMALLEST` … `_LARGEST`.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# The number of saved times of one body whose states are computed together.
_TOGETHER = 16


class Decision(NamedTuple):
    """Hold the decision of a step controller on one attempted step."""

    keep: Array  # whether the step is accepted
    t: Array  # the time at which the next step begins
    end: Array  # the time at which the next step is to end
    state: Any  # the new states of the step controller and the progress meter
    result: dfx.RESULTS  # the result of the run so far


class Method(NamedTuple):
    """Hold all of a run with adaptive steps but its arrays; states are arrays (n, *bodies).

    `*bodies` is one last axis for the bodies of a batch, or no axis for one body.
    """

    tableau: Tableau
    field: Field  # field(constants, t, y): dy/dt
    project: Callable[[Array], Array]  # project(y): the state y with its quaternion of length 1
    halt: Callable[..., Array] | None  # halt(t, y): whether the run ends at the time t
    # control(again, (state, times), (left, right, error)) returns the decision of the step
    # controller on one step. `again` is whether a recorded step is repeated for a derivative;
    # `state` holds the states of controller and progress meter; `times` are those at which the run
    # begins and ends, and those at which the step begins and ends; `left` and `right` are the
    # states of the body before and after the step; `error` is the error of the step. The result is
    # a `Decision`.
    control: Any
    sizes: list[int]  # how many numbers each array of the state has
    max_steps: int  # the largest number of steps, rejected steps included


class Run(NamedTuple):
    """Hold the arrays of a run with adaptive steps; in a batch each has a last axis of bodies."""

    t0: Array  # the time at which the run begins
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    between: Array  # (K,) the times whose states are saved
    y0: Array  # (n,) the state at t0
    end: Array  # the end of the first step
    result: dfx.RESULTS | None  # the result at the start; `None` stands for successful
    state: Any = None  # the states of the step controller and the progress meter at the start


class LoopState(NamedTuple):
    """Hold what the loop over steps carries; in a batch each array has a last axis of bodies."""

    y: Array  # (n, *bodies) the state at the time t
    t: Array  # the time that is reached
    end: Array  # the time at which the next step is to end
    stop: Array  # the index in `Run.stops` of the next stop
    steps: Array  # the number of steps so far, rejected steps included
    rejected: Array  # the number of rejected steps
    result: dfx.RESULTS  # anything but `successful` ends the run
    state: Any  # the states of the step controller and the progress meter


# Each recorded attempt at a step is one row (4 + n, *bodies), where n is the number of numbers of a
# state, and *bodies one last axis of bodies, or no axis. The first `HEAD` = 4 entries are the start
# time of the step, its length, its kind and the index of the next stop (a time at which a step has
# to end); the other n entries are the state at the start. The kind is NONE if the step was rejected
# or not taken, LAST if the accepted step ends at the next stop, and STEP for any other accepted
# step.
Rows = Array
HEAD = 4
NONE, STEP, LAST = range(3)


def pack_loop(loop: LoopState) -> Arrays:
    """Return the loop state as y (n, *bodies) and one array for each dtype of the other fields.

    XLA makes a kernel for each array that goes into or comes out of a loop over blocks of bodies.
    """
    leaves = jax.tree.leaves(loop._replace(y=None))
    row = lambda i, dtype: leaves[i].astype(dtype).reshape(-1, *loop.t.shape)  # noqa: E731
    groups = _groups(leaves).items()
    return [loop.y, *(jnp.concatenate([row(i, dtype) for i in own]) for dtype, own in groups)]


def unpack_loop(arrays: Arrays, like: LoopState) -> LoopState:
    """Return the loop state from its packed arrays, with the shapes and dtypes of `like`."""
    leaves, tree = jax.tree.flatten(like._replace(y=None))
    for own, array in zip(_groups(leaves).values(), arrays[1:], strict=True):
        ends = np.cumsum([leaves[i].size // max(like.t.size, 1) for i in own])
        for i, part in zip(own, jnp.split(array, ends[:-1]), strict=True):
            leaves[i] = part.reshape(leaves[i].shape).astype(leaves[i].dtype)
    return tree.unflatten(leaves)._replace(y=arrays[0])


def _groups(leaves: Arrays) -> dict[np.dtype, list[int]]:
    """Return the indices of the arrays packed together, by dtype: booleans go with int32."""
    groups: dict[np.dtype, list[int]] = {}
    for i, a in enumerate(leaves):
        kind = jnp.dtype(jnp.int32) if a.dtype == bool else a.dtype
        groups.setdefault(kind, []).append(i)
    return groups


class Record(NamedTuple):
    """Hold a recorded run: its state at the start of each segment, and its last segment's steps."""

    starts: Arrays  # (S, …) the packed loop state at the start of each segment, then at the end
    rows: Rows  # the rows of the last segment
    counts: Array  # (2,) the number of segments, and the number of rows of the last segment


class Segment(NamedTuple):
    """Hold the recorded steps of one segment."""

    rows: Rows  # one row for each attempted step
    times: Array  # the time at which each row begins, inf after the last row
    end: Array  # the time at which the segment ends
    number: Array  # the number of rows that are filled


def previous_float(t: Array) -> Array:
    """Return the largest floating-point number below the time `t`, as diffrax defines it.

    Below 0 it is the largest negative normal number, because XLA treats subnormal numbers as zero.
    """
    t = lax.stop_gradient(t)
    less = jnp.nextafter(t, jnp.full_like(t, -jnp.inf))
    return jnp.where(t == 0, -jnp.finfo(t.dtype).tiny, less).astype(t.dtype)


def step_ends(stops: Array) -> Array:
    """Return the last floating-point time before each jump, and the end of the run, (J,).

    The last stage of a step that ends at a jump is evaluated at this earlier time, so that it sees
    the field as it is before the jump.
    """
    jumps = lax.stop_gradient(stops[:-1])
    return jnp.concatenate([stops[:-1] + (previous_float(jumps) - jumps), stops[-1:]])


def step_times(run: Run, rows: Rows) -> tuple[Array, Array, Array]:
    """Return the start, the length and the end of recorded steps, s, with their derivatives.

    The start moves with the last stop before it, or with `run.t0`. The end of a step that ends at a
    stop moves with this stop; any other step keeps its length.
    """
    t, h, kind, stop = lax.stop_gradient(rows[:HEAD])
    stop, last = stop.astype(jnp.int32), kind == LAST
    t, h = t.astype(run.t0.dtype), h.astype(run.t0.dtype)
    begun = rows_at(jnp.concatenate([run.t0[None], run.stops]), stop)
    t = t + (begun - lax.stop_gradient(begun))
    end = rows_at(step_ends(run.stops), stop)
    h = jnp.where(last, end - t, h)
    return t, h, jnp.where(last, end, t + h)


def rows_at(rows: Array, index: Array) -> Array:
    """Return `rows[index]`, where each body has rows (J, *bodies) and indices of its own.

    An index out of range gives the nearest row.
    """
    count = rows.shape[0]
    rows = rows.reshape(count, *[1] * (index.ndim + 1 - rows.ndim), *rows.shape[1:])
    if count == 1:
        return jnp.broadcast_to(rows[0], index.shape)
    index = jnp.clip(index, 0, count - 1)
    # For so few rows a sum over a mask is quicker than an indexed look-up, also in derivatives.
    if count <= 8:
        each = jnp.arange(count, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
        return jnp.sum(jnp.where(each == index[None], rows, 0), 0).astype(rows.dtype)
    rows = jnp.broadcast_to(rows, (count, *index.shape))
    return jnp.take_along_axis(rows, index[None], 0)[0]


def is_finite(tree: PyTree) -> Bool[Array, ""]:
    """Return whether every number in `tree` is finite."""
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good = good & jnp.all(jnp.isfinite(leaf))
    return good


def starting_step(state_norm: Array, rate_norm: Array, order: Any) -> Array:
    """Return the length of the first step, s, from the norms of state and rate over tolerance.

    The formula is that of Hairer, Nørsett and Wanner (1993), II.4, but the norm of the second
    derivative is taken to be `rate_norm`²/`state_norm`, as for an oscillation: to measure it, the
    field would have to be compiled once more.
    """
    # A state of zeros gives no time scale, because `rate_norm`/`state_norm` would be infinite:
    # `state_norm` therefore gets a lower limit.
    quickness = rate_norm / jnp.maximum(state_norm, 1e-4 * rate_norm)
    guess = (0.01 / (rate_norm * jnp.maximum(quickness, 1))) ** (1 / order)
    length = jnp.where(rate_norm < 1e-5, 1e-4, jnp.minimum(1 / quickness, guess))
    return length.astype(state_norm.dtype)


def accept_and_adapt(error_norm: Array, order: Any, h: Any) -> tuple[Array, Array]:
    """Return whether a step is accepted, and the length of the next step, 0.2 to 10 times `h`.

    `error_norm` is error over tolerance; the limits are the defaults of `diffrax.PIDController`.
    """
    error_norm, h = lax.stop_gradient((error_norm, h))
    # NaN is treated as infinity, because it may come from a step that is too long: a shorter
    # step is tried.
    error_norm = jnp.where(jnp.isnan(error_norm), jnp.inf, error_norm)
    factor = jnp.clip(_SAFETY * error_norm ** (-1 / order), _SMALLEST, _LARGEST)
    return error_norm < 1, h * factor.astype(jnp.result_type(h))


def result_of_body(result: dfx.RESULTS, body: Any) -> dfx.RESULTS:
    """Return the result of a run, or `nonfinite_input` if a number of the body is not finite.

    In a batch an impossible inertia has become NaN, because no error can be raised for one body.
    """
    return dfx.RESULTS.where(is_finite(body), result, dfx.RESULTS.nonfinite_input)  # pyright: ignore


def over_bodies(run: Run, function: Callable[..., Any]) -> Callable[..., Any]:
    """Map a function of the arrays of one body over the bodies of a run, in the last axis."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if run.t0.ndim else function


def loop_at_start(run: Run) -> LoopState:
    """Return the state of the loop before the first step."""
    zero = jnp.zeros(run.t0.shape, jnp.int32)
    # A stop (a time at which a step has to end) that is not after the start of the run needs no
    # step, and counts as passed.
    passed = jnp.sum(run.stops[:-1] <= run.t0[None], 0, dtype=jnp.int32)
    still = lax.stop_gradient((run.t0, run.end))
    result = run.result
    if result is None:
        result = jax.tree.map(lambda a: jnp.full_like(zero, a), dfx.RESULTS.successful)
    return LoopState(run.y0, *still, passed, zero, zero, result, run.state)


def is_running(method: Method, run: Run, loop: LoopState, until: Array | None) -> Array:
    """Return for each body whether it has a step to take, to the end or to the time `until`."""
    well = over_bodies(run, lambda result: result == dfx.RESULTS.successful)(loop.result)
    last = lax.stop_gradient(run.stops[-1])
    last = last if until is None else jnp.minimum(last, until)
    return well & (loop.t < last) & (loop.steps < method.max_steps)


def loop_at_end(method: Method, constants: Arrays, run: Run) -> LoopState:
    """Run to the end, and save no earlier state."""
    return lax.while_loop(
        lambda loop: jnp.any(is_running(method, run, loop, None)),
        lambda loop: _attempt(method, constants, run, loop, None).loop,
        loop_at_start(run),
    )


def run_one(method: Method, constants: Arrays, run: Run) -> tuple[Array, LoopState]:
    """Run one body; return its states (K, n) at the saved times (NaN if not reached), and its end.

    The stages of dense output are evaluated only in steps that contain a saved time.
    """
    size = run.between.shape[0]

    def next_time(k: Array) -> Array:
        return jnp.where(k < size, run.between[jnp.minimum(k, size - 1)], jnp.inf)

    def one(state: Any) -> Any:
        loop, ys, k = state
        asked = next_time(k) <= loop.end
        after, _, step, slopes = _attempt(method, constants, run, loop, None, asked)

        def save(state: Any) -> Any:
            ys, k = state
            y = state_in_step(method, next_time(k), step, slopes)
            return lax.dynamic_update_index_in_dim(ys, y, k, 0), k + 1

        ys, k = lax.while_loop(lambda state: next_time(state[1]) <= after.t, save, (ys, k))
        return after, ys, k

    # The last number counts the saved times whose states are known. It begins at 0 even if the
    # first of these times is the start of the run: this time gets its state with the first accepted
    # step.
    state = (loop_at_start(run), _unsaved_states(run), jnp.zeros((), jnp.int32))
    more = lambda state: is_running(method, run, state[0], None)  # noqa: E731
    loop, ys, _ = lax.while_loop(more, one, state)
    return ys, loop


def _unsaved_states(run: Run) -> Array:
    """Return the array (K, n, *bodies) for saved states: NaN, or y0 if a run ends at its start."""
    ended = run.stops[-1] <= run.t0
    still = jnp.where(lift(ended, run.y0), run.y0, jnp.nan)
    return jnp.broadcast_to(still[None], (run.between.shape[0], *run.y0.shape))


class Segments(NamedTuple):
    """Hold how a record is divided into segments."""

    rows: int  # the number of rows of one segment
    spare: int  # the number of spare rows for a segment that is run again
    most: int  # the largest number of segments


def _segments(method: Method, run: Run) -> Segments:
    """Return how the record of a run is divided into segments.

    On a GPU the record of all bodies stays in memory, most of it empty. There it has about as many
    segments as a segment has steps, so that it grows as the root of `max_steps`.
    """
    # A record has at most one row for each step and one for each stop.
    most = method.max_steps + run.stops.shape[0]
    segment = min(SEGMENT, most if platform() == "cpu" else math.isqrt(most) + 1)
    return Segments(segment, min(_MORE, max(8, segment // 8)), -(-most // segment))


class Recorded(NamedTuple):
    """Hold a run whose steps were recorded."""

    ys: Array  # (K, n, *bodies) the saved states, NaN at a time that the run did not reach
    end: LoopState
    record: Record


def record_run(method: Method, constants: Arrays, run: Run) -> Recorded:
    """Run one body or many, and record the steps, from which derivatives are computed later."""
    loop, (segment, spare, most) = loop_at_start(run), _segments(method, run)
    starts = [jnp.zeros((most + 1, *a.shape), a.dtype) for a in pack_loop(loop)]
    ys = _unsaved_states(run)
    rows = jnp.zeros((segment + spare + _MOST, HEAD + run.y0.shape[0], *run.t0.shape), ys.dtype)
    zero = jnp.zeros((), jnp.int32)

    def put(into: Arrays, i: Array, loop: LoopState) -> Arrays:
        both = zip(into, pack_loop(loop), strict=True)
        return [lax.dynamic_update_index_in_dim(a, b, i, 0) for a, b in both]

    def one(state: Any) -> Any:
        loop, ys, starts, rows, number, _ = state
        after, rows, count = record_segment(method, constants, run, loop, rows, None)
        if run.between.shape[0]:
            ys = fill_saved(method, constants, run, segment_of(rows, after.t, count), ys)
        return after, ys, put(starts, number + 1, after), rows, number + 1, count

    state = (loop, ys, put(starts, zero, loop), rows, zero, zero)
    more = lambda state: jnp.any(is_running(method, run, state[0], None))  # noqa: E731
    loop, ys, starts, rows, *counts = lax.while_loop(more, one, state)
    each = jnp.stack([jnp.broadcast_to(count, run.t0.shape) for count in counts])
    return Recorded(ys, loop, Record(starts, rows, each))


class _Attempted(NamedTuple):
    """Hold an attempted step of every body."""

    loop: LoopState  # the state of the loop after it
    row: Array  # (4 + n, *bodies) its row in a record
    step: Step
    slopes: Array  # (n, s, *bodies) the values dy/dt at its stages


def _attempt(
    method: Method, constants: Arrays, run: Run, loop: LoopState, until: Array | None,
    dense: bool | Array = False,
) -> _Attempted:  # fmt: skip
    """Take one attempted step of every body that is running.

    `until` is `None`, or the time, s, at which a part of the run that is repeated for derivatives
    ends: only repeated steps have derivatives with respect to the times of the run. `dense` adds
    the stages of dense output.
    """
    # The loop that calls this function goes on while any body of a batch has a step to take. Bodies
    # that have no step to take are left as they are.
    on = is_running(method, run, loop, until) if run.t0.ndim else True
    ends = rows_at(run.stops, loop.stop), rows_at(step_ends(run.stops), loop.stop)
    stop, end = lax.stop_gradient(ends)
    # A body needs no step to a stop that it has already reached, such as the second of two stops at
    # the same time.
    arrived = on & (loop.t >= stop) if run.stops.shape[0] > 1 else False
    moving = on if arrived is False else on & ~arrived
    # No step goes beyond a stop, however the controller rounds: the stages of such a step would
    # evaluate the field on both sides of the jump.
    last = loop.end >= end
    end = jnp.where(last, end, loop.end)
    if until is not None:
        last, end = last & (end <= until), jnp.minimum(end, until)
    end = choose(moving, end, loop.t)
    h, kind = end - loop.t, jnp.where(last, LAST, STEP)
    step = Step(loop.t, h, end, loop.y)
    if until is not None:
        head = [a.astype(loop.y.dtype) for a in (loop.t, h, kind, loop.stop)]
        begin, length, late = choose(moving, step_times(run, jnp.stack(head)), step[:3])
        step = Step(begin, length, late, loop.y)
    there = stages(method.tableau, method.field, constants, step, dense)
    y = method.project(there.end)
    # The error serves only to choose the lengths of steps, which derivatives hold constant. It
    # therefore needs no derivative.
    left, right, slopes = lax.stop_gradient((loop.y, y, there.slopes))
    error = error_estimate(method.tableau, method.sizes, h, slopes)
    # NaN is treated as infinity, because it may come from a step that is too long: a shorter
    # step is tried.
    error = jnp.where(jnp.isfinite(error) & jnp.isfinite(right), error, jnp.inf)
    times = lax.stop_gradient((run.t0, run.stops[-1], loop.t, end))
    keep, t, following, state, result = method.control(
        until is not None, (loop.state, times), (left, right, error)
    )
    accept = moving & keep
    if until is None and method.halt is not None:
        met = accept & method.halt(t, y)
        ended = lambda met, why: dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, why)  # noqa: E731
        result = over_bodies(run, ended)(met, result)
    reached = accept & (t >= stop) | arrived if run.stops.shape[0] > 1 else 0
    after = LoopState(
        y=choose(accept, y, loop.y),
        t=choose(accept, t, loop.t),
        end=choose(moving, following, loop.end),
        stop=loop.stop + jnp.asarray(reached, jnp.int32),
        steps=loop.steps + jnp.asarray(moving, jnp.int32),
        rejected=loop.rejected + jnp.asarray(moving & ~keep, jnp.int32),
        result=choose(moving, result, loop.result),
        state=choose(moving, state, loop.state),
    )
    head = (loop.t, h, jnp.where(accept, kind, NONE), loop.stop)
    row = jnp.concatenate([jnp.stack([a.astype(y.dtype) for a in head]), loop.y])
    return _Attempted(after, row, step, there.slopes)


def choose(condition: Literal[True] | Array, new: PyTree, old: PyTree) -> PyTree:
    """Return the arrays of `new` for the bodies with a true `condition`, else those of `old`.

    The dtypes are those of `old`; `condition` may be the constant `True`.
    """
    if condition is True:
        return jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), new, old)
    one = lambda a, b: jnp.where(lift(condition, a), a, b).astype(b.dtype)  # noqa: E731
    return jax.tree.map(one, new, old)


class Filled(NamedTuple):
    """Hold the state of the loop after some steps, and their rows, of which `number` are filled."""

    loop: LoopState
    rows: Rows
    number: Array


def record_segment(
    method: Method, constants: Arrays, run: Run, loop: LoopState, rows: Rows, until: Array | None
) -> Filled:
    """Take the steps of one segment, and write them into `rows`.

    The segment ends when the rows are full or the run ends; repeated for derivatives, at `until`.
    """
    many = max(1, min(_MOST, _BLOCK // run.y0.dtype.itemsize // rows.shape[1]))
    segment, spare, _ = _segments(method, run)
    room = segment + (0 if until is None else spare)

    def filled(body: Callable[..., Any], loop: LoopState, rows: Rows, most: int) -> Filled:
        on = lambda now: jnp.any(is_running(method, run, now.loop, until)) & (now.number < most)  # noqa: E731
        return lax.while_loop(on, body, Filled(loop, rows, jnp.zeros((), jnp.int32)))

    def attempt(now: Filled) -> Filled:
        loop, row, *_ = _attempt(method, constants, run, now.loop, until)
        rows = lax.dynamic_update_slice_in_dim(now.rows, row[None], now.number, 0)
        return Filled(loop, rows, now.number + 1)

    def block(now: Filled) -> Filled:
        part = filled(attempt, now.loop, jnp.zeros((many, *rows.shape[1:]), rows.dtype), many)
        all_ = lax.dynamic_update_slice_in_dim(now.rows, part.rows, now.number, 0)
        return Filled(part.loop, all_, now.number + part.number)

    return filled(block, loop, rows, room)


def segment_of(rows: Rows, end: Array, count: Array) -> Segment:
    """Return the segment that ends at `end`, s, and whose steps are the first `count` rows."""
    there = jnp.arange(rows.shape[0], dtype=jnp.int32).reshape(-1, *[1] * end.ndim) < count
    times = jnp.where(there, lax.stop_gradient(rows[:, 0]).astype(end.dtype), jnp.inf)
    return Segment(rows, times, lax.stop_gradient(end), count)


def fill_saved(method: Method, constants: Arrays, run: Run, segment: Segment, ys: Array) -> Array:
    """Return the saved states (K, n, *bodies), with those in one segment computed."""
    size, many = run.between.shape[0], run.t0.ndim > 0
    width = 1 if many else min(size, _TOGETHER)
    # The steps that contain the saved times are looked up for all saved times at once: in a loop,
    # each look-up would be many small kernels.
    ts = lax.stop_gradient(run.between)
    search = over_bodies(run, lambda begun, ts: jnp.searchsorted(begun, ts).astype(jnp.int32) - 1)
    index = search(segment.times, ts)
    inside = (index >= 0) | (segment.times[0] <= lax.stop_gradient(run.t0))[None]
    index, inside = jnp.maximum(index, 0), inside & (ts <= segment.end[None])
    # For a saved time outside of the segment a step of length 0 at the segment's first state is
    # evaluated, because the field has a finite value there; the result is not used.
    still = segment.rows[0].at[1:3].set(0)
    pick = jax.vmap(lambda rows, i: rows[i], (-1 if many else None, -1), -1)
    if not many:
        # For one body, the saved times whose states are computed together are put into the last
        # axis, where the bodies of a batch would be.
        field, project = (
            jax.vmap(method.field, (None, -1, -1), -1),
            jax.vmap(method.project, -1, -1),
        )
        method, still = method._replace(field=field, project=project), still[:, None]

    def window(i: Array, ys: Array) -> Array:
        # Window number i is the next `width` saved times, whose states are computed together. A
        # window that would reach beyond the last saved time is moved back, so that some states are
        # computed twice.
        number = jnp.minimum(first + i * width, size - width)

        def cut(a: Array) -> Array:
            a = jnp.moveaxis(lax.dynamic_slice_in_dim(a, number, width), 0, -1)
            return a[..., 0] if many else a

        there, old = cut(inside), cut(ys)
        row = jnp.where(there[None], pick(segment.rows, cut(index)), still)
        step = Step(*step_times(run, row), row[HEAD:])
        slopes = stages(method.tableau, method.field, constants, step, True).slopes
        new = state_in_step(method, jnp.where(there, cut(run.between), step.t), step, slopes)
        new = jnp.where(there[None], new, old)
        return lax.dynamic_update_slice_in_dim(ys, new[None] if many else new.T, number, 0)

    used = jnp.any(inside.reshape(size, -1), 1)
    first = jnp.argmax(used).astype(jnp.int32)
    length = size - jnp.argmax(used[::-1]).astype(jnp.int32) - first
    count = jnp.where(jnp.any(used), (length + width - 1) // width, 0)
    return lax.fori_loop(jnp.zeros_like(count), count, window, ys)


def state_in_step(method: Method, t: Array, step: Step, slopes: Array) -> Array:
    """Return the state (n, *bodies) at the time `t` within a step, by dense output.

    `slopes` (n, s, *bodies) are those of all stages, those of dense output included.
    """
    theta = ((t - step.t) / jnp.where(step.h == 0, 1, step.h)).astype(slopes.dtype)
    # Dense output is the state at the start of the step plus its length times a weighted sum of the
    # slopes at the stages. The weights are polynomials in θ, the fraction of the step before the
    # time t. They are evaluated first: a weight is one number, while a slope has n numbers.
    rows = weights_of(method.tableau, slopes.dtype).dense
    shares = dense_change(theta[None], rows.reshape(*rows.shape, *[1] * theta.ndim))
    rise = jnp.sum(shares[None] * slopes, 1)
    return method.project(step.y + lift(step.h.astype(rise.dtype), rise) * rise)
