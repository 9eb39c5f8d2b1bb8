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
from rigidjax.solve.batching import Arrays, add_leading_axes
from rigidjax.solve.runge_kutta import (
    Field,
    Step,
    arrays_of_tableau,
    change_within_step,
    error_estimate,
    stages,
)
from rigidjax.solve.tableaus import Tableau

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


class Method(NamedTuple):
    """Hold what a run with adaptive steps needs besides arrays, such as the method and the field.

    The functions work on states (n, *bodies): a state has n numbers, and `*bodies` is one last axis
    for the bodies of a batch, or no axis for one body.
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
    # five things: whether the step is accepted, the time after it, the time at which the next step
    # is to end, the new `state`, and the result of the run so far.
    control: Callable[..., Any]
    sizes: list[int]  # how many numbers each array of the state has
    max_steps: int  # the largest number of steps, rejected steps included


class Run(NamedTuple):
    """Hold the arrays of a run with adaptive steps: its times, and the state at its start.

    In a batch each array has a last axis of bodies.
    """

    t0: Array  # the time at which the run begins
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    between: Array  # (K,) the times whose states are saved
    y0: Array  # (n,) the state at t0
    end: Array  # the end of the first step
    result: dfx.RESULTS | None  # the result at the start; `None` stands for successful
    state: Any = None  # the states of the step controller and the progress meter at the start

    @property
    def last_times_before_jumps(self) -> Array:
        """Return the last floating-point time before each jump, and the end of the run, (J,).

        The last stage of a step that ends at a jump is evaluated at this earlier time, so that it
        sees the field as it is before the jump.
        """
        jumps = lax.stop_gradient(self.stops[:-1])
        gap = previous_float(jumps) - jumps
        return jnp.concatenate([self.stops[:-1] + gap, self.stops[-1:]])


class LoopState(NamedTuple):
    """Hold all that the loop over steps carries from step to step.

    After the last step it describes the end of the run. In a batch every array has a last axis of
    bodies.
    """

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


def pack_loop_state(loop: LoopState) -> Arrays:
    """Return the state of the loop over steps as a short list of arrays.

    `unpack_loop_state` turns this list back into the loop state. The first array is the state y of
    shape (n, *bodies), where `*bodies` is one last axis for the bodies of a batch, or no axis for
    one body. All other fields are joined, with one array for each dtype. Few arrays are wanted
    because XLA makes a kernel for each array that goes into or comes out of a loop over blocks of
    bodies.
    """
    rest = _group_by_dtype(loop._replace(y=None))
    join = lambda leaves: jnp.concatenate([a.reshape(-1, *loop.t.shape) for a in leaves])  # noqa: E731
    return [loop.y, *(join([a.astype(dtype) for a in leaves]) for dtype, leaves in rest.items())]


def unpack_loop_state(arrays: Arrays, like: LoopState) -> LoopState:
    """Return the loop state from the `arrays` that `pack_loop_state` returned for it.

    `like` is a loop state whose arrays have the wanted shapes and dtypes.
    """
    rest, tree = jax.tree.flatten(like._replace(y=None))
    parts = {}
    for (kind, leaves), array in zip(_group_by_dtype(rest).items(), arrays[1:], strict=True):
        sizes = [a.size // max(like.t.size, 1) for a in leaves]
        parts[kind] = iter(jnp.split(array, np.cumsum(sizes)[:-1]))
    rest = [
        next(parts[_dtype_or_int32_for_booleans(a)]).reshape(a.shape).astype(a.dtype) for a in rest
    ]
    return tree.unflatten(rest)._replace(y=arrays[0])


def _dtype_or_int32_for_booleans(array: Array) -> np.dtype:
    """Return int32 for an array of booleans, and the dtype of any other array.

    The arrays of the loop over steps are joined, with one array for each dtype. Booleans are stored
    as integers so that they need no array of their own.
    """
    return jnp.dtype(jnp.int32) if array.dtype == bool else array.dtype


def _group_by_dtype(tree: PyTree) -> dict[np.dtype, Arrays]:
    """Return the arrays of a tree in lists, one list for each dtype.

    Each key of the result is a dtype, int32 also for boolean arrays; its value is the list of
    arrays, in the order of the tree.
    """
    parts: dict[np.dtype, Arrays] = {}
    for a in jax.tree.leaves(tree):
        parts.setdefault(_dtype_or_int32_for_booleans(a), []).append(a)
    return parts


class Record(NamedTuple):
    """Hold a recorded run: its state at the start of each segment, and its last segment's steps.

    A segment is a part of the run of about `SEGMENT` steps.
    """

    starts: Arrays  # (S, …) the packed loop state at the start of each segment, then at the end
    rows: Rows  # the rows of the last segment
    counts: Array  # (2,) the number of segments, and the number of rows of the last segment


class Segment(NamedTuple):
    """Hold the recorded steps of one segment, a part of a run of about `SEGMENT` steps."""

    rows: Rows  # one row for each attempted step
    times: Array  # the time at which each row begins, inf after the last row
    end: Array  # the time at which the segment ends
    number: Array  # the number of rows that are filled


def previous_float(t: Array) -> Array:
    """Return the largest floating-point number below the time `t`, as diffrax defines it.

    For t = 0 the result is the largest negative normal number, because XLA treats subnormal numbers
    as zero.
    """
    t = lax.stop_gradient(t)
    less = jnp.nextafter(t, jnp.full_like(t, -jnp.inf))
    return jnp.where(t == 0, -jnp.finfo(t.dtype).tiny, less).astype(t.dtype)


def start_length_and_end_of_steps(run: Run, rows: Rows) -> tuple[Array, Array, Array]:
    """Return the start, length and end of recorded steps, s, with their derivatives.

    Stops are the times at which steps have to end, because the field jumps there. The derivatives
    are those with respect to the stops and to `run.t0`, the time at which the run begins. The start
    of a step moves with the last stop before it, or with `run.t0` if there is no such stop. The end
    of a step that ends at a stop moves with this stop. Any other step keeps its length, and its end
    moves with its start.

    - `run`: holds the time `t0` at which the run begins, and the stops.
    - `rows`: (4 + n, …) the recorded steps: in each row the start time, the length, the kind of the
      step, the index of the next stop, and the n numbers of the state at the start.
    """
    t, h, kind, stop = lax.stop_gradient(rows[:HEAD])
    stop, last = stop.astype(jnp.int32), kind == LAST
    t, h = t.astype(run.t0.dtype), h.astype(run.t0.dtype)
    begun = row_of_each_body(jnp.concatenate([run.t0[None], run.stops]), stop)
    t = t + (begun - lax.stop_gradient(begun))
    end = row_of_each_body(run.last_times_before_jumps, stop)
    h = jnp.where(last, end - t, h)
    return t, h, jnp.where(last, end, t + h)


def row_of_each_body(rows: Array, index: Array) -> Array:
    """Return `rows[index]`, where each body of a batch has rows and indices of its own.

    An index out of range is replaced by the nearest one that is in range.

    - `rows`: (J, *bodies) the rows; `*bodies` is one last axis for the bodies of a batch, or no
      axis.
    - `index`: (…, *bodies) integers from 0 to J − 1.

    **Returns** an array of the shape of `index`.
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


def finite(tree: PyTree) -> Bool[Array, ""]:
    """Return whether every number in `tree` is finite."""
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good = good & jnp.all(jnp.isfinite(leaf))
    return good


def starting_step(state_norm: Array, rate_norm: Array, order: Any) -> Array:
    """Return the length of the first step of a run, s, from the norms of the state and its rate.

    - `state_norm`: the norm of the state at the start, each number divided by its tolerance.
    - `rate_norm`: the norm of the time derivative of the state, each number divided by its
      tolerance, 1/s.
    - `order`: the order of the error estimate.

    The formula is that of Hairer, Nørsett and Wanner (1993), II.4, with one change: the norm of the
    second derivative is taken to be `rate_norm`²/`state_norm`, as for an oscillation. To measure
    the second derivative, the field would have to be compiled once more.
    """
    # A state of zeros gives no time scale, because `rate_norm`/`state_norm` would be infinite:
    # `state_norm` therefore gets a lower limit.
    quickness = rate_norm / jnp.maximum(state_norm, 1e-4 * rate_norm)
    guess = (0.01 / (rate_norm * jnp.maximum(quickness, 1))) ** (1 / order)
    length = jnp.where(rate_norm < 1e-5, 1e-4, jnp.minimum(1 / quickness, guess))
    return length.astype(state_norm.dtype)


def acceptance_and_next_step_size(error_norm: Array, order: Any, h: Any) -> tuple[Array, Array]:
    """Return whether a step is accepted, and the length of the next step, s.

    - `error_norm`: the norm of the step's error, divided by the tolerance; a step is accepted below
      1.
    - `order`: the order of this error.
    - `h`: the length of the step, s.

    The next length is at least 0.2 and at most 10 times `h`. These limits are the defaults of
    `diffrax.PIDController`.
    """
    error_norm, h = lax.stop_gradient((error_norm, h))
    # NaN is treated as infinity, because it may come from a step that is too long: a shorter
    # step is tried.
    error_norm = jnp.where(jnp.isnan(error_norm), jnp.inf, error_norm)
    factor = jnp.clip(_SAFETY * error_norm ** (-1 / order), _SMALLEST, _LARGEST)
    return error_norm < 1, h * factor.astype(jnp.result_type(h))


def result_or_nonfinite_input(result: dfx.RESULTS, body: Any) -> dfx.RESULTS:
    """Return the result of a run, or `nonfinite_input` if a number of the body is not finite.

    Such a body occurs in a batch: there an inertia that no real body can have has been replaced by
    NaN, because no error can be raised for a single body.

    - `result`: how the run ended, a `diffrax.RESULTS`.
    - `body`: the body of the run, or `None`.
    """
    return dfx.RESULTS.where(finite(body), result, dfx.RESULTS.nonfinite_input)  # pyright: ignore


def map_over_bodies(run: Run, function: Callable[..., Any]) -> Callable[..., Any]:
    """Map a function of the arrays of one body over all bodies of a run.

    The bodies are in the last axis of all arrays.

    - `run`: tells whether there is an axis of bodies. Without it `function` is returned unchanged.
    - `function`: takes and returns arrays of one body.
    """
    return jax.vmap(function, in_axes=-1, out_axes=-1) if run.t0.ndim else function


def initial_loop_state(run: Run) -> LoopState:
    """Return the state of the loop over steps before the first step of `run`."""
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
    """Return for each body whether its run still has a step to take.

    A run goes on to the last of the `run.stops`, unless it fails or has taken the largest number of
    steps, `method.max_steps`.

    - `method`: holds the largest number of steps.
    - `run`: holds the stops, the times at which steps end; the last stop is the end of the run.
    - `loop`: the state of the loop over steps.
    - `until`: if only a part of the run is repeated, the time, s, at which this part ends; else
      `None`.
    """
    well = map_over_bodies(run, lambda result: result == dfx.RESULTS.successful)(loop.result)
    last = lax.stop_gradient(run.stops[-1])
    last = last if until is None else jnp.minimum(last, until)
    return well & (loop.t < last) & (loop.steps < method.max_steps)


def loop_state_at_end(method: Method, constants: Arrays, run: Run) -> LoopState:
    """Return the state of the loop over steps at the end of a run; no earlier state is saved.

    - `method`: the explicit method, the field and the largest number of steps.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start of the run, and the times at which steps end.
    """
    return lax.while_loop(
        lambda loop: jnp.any(is_running(method, run, loop, None)),
        lambda loop: _attempt_step(method, constants, run, loop, None)[0],
        initial_loop_state(run),
    )


def run_one_body(method: Method, constants: Arrays, run: Run) -> tuple[Array, LoopState]:
    """Run one body with adaptive steps, and return its states at the saved times.

    - `method`: the explicit method, the field and the largest number of steps.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start, the times at which steps end, and the K saved times
      `run.between`.

    **Returns** two things: the states (K, n), NaN at a time that the run did not reach; and the
    state of the loop over steps at the end. The stages of dense output are evaluated only in steps
    that contain a saved time.
    """
    size = run.between.shape[0]

    def next_time(k: Array) -> Array:
        return jnp.where(k < size, run.between[jnp.minimum(k, size - 1)], jnp.inf)

    def one(state: Any) -> Any:
        loop, ys, k = state
        asked = next_time(k) <= loop.end
        after, _, (step, slopes) = _attempt_step(method, constants, run, loop, None, asked)

        def save(state: Any) -> Any:
            ys, k = state
            y = state_in_step(method, next_time(k), step, slopes)
            return lax.dynamic_update_index_in_dim(ys, y, k, 0), k + 1

        ys, k = lax.while_loop(lambda state: next_time(state[1]) <= after.t, save, (ys, k))
        return after, ys, k

    # The last number counts the saved times whose states are known. It begins at 0 even if the
    # first of these times is the start of the run: this time gets its state with the first accepted
    # step.
    state = (initial_loop_state(run), _array_for_saved_states(run), jnp.zeros((), jnp.int32))
    more = lambda state: is_running(method, run, state[0], None)  # noqa: E731
    loop, ys, _ = lax.while_loop(more, one, state)
    return ys, loop


def _array_for_saved_states(run: Run) -> Array:
    """Return the array (K, n, *bodies) into which the states at the K saved times will be written.

    Here n is the number of numbers of a state, and `*bodies` is one last axis for the bodies of a
    batch, or no axis for one body. All values are NaN, except for a body whose run ends where it
    starts: this run has no step, so that its values are the state at the start.

    - `run`: holds the times at which the run begins and ends, and the saved times `run.between`.
    """
    ended = run.stops[-1] <= run.t0
    still = jnp.where(add_leading_axes(ended, run.y0), run.y0, jnp.nan)
    return jnp.broadcast_to(still[None], (run.between.shape[0], *run.y0.shape))


def _largest_number_of_rows(method: Method, run: Run) -> int:
    """Return the largest number of rows of a recorded run: its steps, and one row for each stop.

    - `method`: holds the largest number of steps.
    - `run`: holds the stops, the times at which steps end.
    """
    return method.max_steps + run.stops.shape[0]


def _rows_of_segment(method: Method, run: Run) -> tuple[int, int]:
    """Return the number of steps in one segment of a recorded run, and the number of spare rows.

    The spare rows serve a segment that is run again and takes a few more steps. On a GPU the record
    of all bodies stays in memory, and most of it stays empty. There it has about as many segments
    as a segment has steps, so that it grows as the root of `method.max_steps`.

    - `method`: holds the largest number of steps.
    - `run`: holds the stops, the times at which steps end.
    """
    most = _largest_number_of_rows(method, run)
    segment = min(SEGMENT, most if platform() == "cpu" else math.isqrt(most) + 1)
    return segment, min(_MORE, max(8, segment // 8))


def record_run(method: Method, constants: Arrays, run: Run) -> tuple[Array, LoopState, Record]:
    """Run one body or many and record the steps, from which derivatives are computed later.

    - `method`: the explicit method, the field and the largest number of steps.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start, the times at which steps end, and the K saved times
      `run.between`.

    **Returns** three things: the states (K, n, *bodies) at the saved times, NaN at a time that the
    run did not reach; the state of the loop over steps at the end; and the record of the run.
    `*bodies` is one last axis for the bodies of a batch, or no axis for one body.
    """
    loop, (segment, spare) = initial_loop_state(run), _rows_of_segment(method, run)
    count = -(-_largest_number_of_rows(method, run) // segment) + 1
    starts = [jnp.zeros((count, *a.shape), a.dtype) for a in pack_loop_state(loop)]
    ys = _array_for_saved_states(run)
    rows = jnp.zeros((segment + spare + _MOST, HEAD + run.y0.shape[0], *run.t0.shape), ys.dtype)
    zero = jnp.zeros((), jnp.int32)

    def put(into: Arrays, i: Array, loop: LoopState) -> Arrays:
        both = zip(into, pack_loop_state(loop), strict=True)
        return [lax.dynamic_update_index_in_dim(a, b, i, 0) for a, b in both]

    def one(state: Any) -> Any:
        loop, ys, starts, rows, number, _ = state
        after, rows, count = record_segment(method, constants, run, loop, rows, None)
        if run.between.shape[0]:
            part = segment_of_rows(rows, after.t, count)
            ys = fill_saved_states_of_segment(method, constants, run, part, ys)
        return after, ys, put(starts, number + 1, after), rows, number + 1, count

    state = (loop, ys, put(starts, zero, loop), rows, zero, zero)
    more = lambda state: jnp.any(is_running(method, run, state[0], None))  # noqa: E731
    loop, ys, starts, rows, *counts = lax.while_loop(more, one, state)
    each = jnp.stack([jnp.broadcast_to(count, run.t0.shape) for count in counts])
    return ys, loop, Record(starts, rows, each)


def _attempt_step(
    method: Method, constants: Arrays, run: Run, loop: LoopState, until: Array | None,
    dense: bool | Array = False,
) -> tuple[LoopState, Array, tuple[Step, Array]]:  # fmt: skip
    """Compute one attempted step of every body; return the loop state after it and the step itself.

    - `method`: the explicit method, the field, the step controller and the largest number of steps.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start of the run, and the times at which steps end (stops).
    - `loop`: the loop state before the step.
    - `until`: if recorded steps are repeated for derivatives, the time in seconds at which the
      repeated part of the run ends; else `None`. Only repeated steps have derivatives with respect
      to the times of the run.
    - `dense`: whether the stages of dense output, which gives states within a step, are evaluated,
      too.

    **Returns** three things: the loop state after the attempt; an array (4 + n, *bodies) that
    records the attempt (the start time, the length and the kind of the step, the index of the next
    stop, and the n numbers of the state before it); and a pair of the step and the slopes dy/dt
    (n, s, *bodies) at its s stages. `*bodies` is one last axis for the bodies of a batch, or no
    axis for one body.
    """
    # The loop that calls this function goes on while any body of a batch has a step to take. Bodies
    # that have no step to take are left as they are.
    on = is_running(method, run, loop, until) if run.t0.ndim else True
    stop, end = lax.stop_gradient(
        (
            row_of_each_body(run.stops, loop.stop),
            row_of_each_body(run.last_times_before_jumps, loop.stop),
        )
    )
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
    end = _choose_for_each_body(moving, end, loop.t)
    h, kind = end - loop.t, jnp.where(last, LAST, STEP)
    step = Step(loop.t, h, end, loop.y)
    if until is not None:
        head = [a.astype(loop.y.dtype) for a in (loop.t, h, kind, loop.stop)]
        begin, length, late = _choose_for_each_body(
            moving, start_length_and_end_of_steps(run, jnp.stack(head)), step[:3]
        )
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
    found = method.control(until is not None, (loop.state, times), (left, right, error))
    keep, t, following, state, result = found
    accept = moving & keep
    if until is None and method.halt is not None:
        met = accept & method.halt(t, y)
        ended = lambda met, why: dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, why)  # noqa: E731
        result = map_over_bodies(run, ended)(met, result)
    reached = accept & (t >= stop) | arrived if run.stops.shape[0] > 1 else 0
    after = LoopState(
        y=_choose_for_each_body(accept, y, loop.y),
        t=_choose_for_each_body(accept, t, loop.t),
        end=_choose_for_each_body(moving, following, loop.end),
        stop=loop.stop + jnp.asarray(reached, jnp.int32),
        steps=loop.steps + jnp.asarray(moving, jnp.int32),
        rejected=loop.rejected + jnp.asarray(moving & ~keep, jnp.int32),
        result=_choose_for_each_body(moving, result, loop.result),
        state=_choose_for_each_body(moving, state, loop.state),
    )
    head = (loop.t, h, jnp.where(accept, kind, NONE), loop.stop)
    row = jnp.concatenate([jnp.stack([a.astype(y.dtype) for a in head]), loop.y])
    return after, row, (step, there.slopes)


def _choose_for_each_body(condition: Literal[True] | Array, new: PyTree, old: PyTree) -> PyTree:
    """Return the arrays of `new` for the bodies for which `condition` is true, else those of `old`.

    - `condition`: one truth value for each body, or the constant `True`, for which `new` is
      returned for all bodies.
    - `new`, `old`: two trees of arrays (…, *bodies) of equal structure, where `*bodies` is one last
      axis for the bodies of a batch, or no axis. The result has the dtypes of `old`.
    """
    if condition is True:
        return jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), new, old)
    choose = lambda a, b: jnp.where(add_leading_axes(condition, a), a, b).astype(b.dtype)  # noqa: E731
    return jax.tree.map(choose, new, old)


def record_segment(
    method: Method, constants: Arrays, run: Run, loop: LoopState, rows: Rows, until: Array | None
) -> tuple[LoopState, Rows, Array]:
    """Take the steps of one segment (a part of a run), and return them as rows.

    A segment that is recorded for the first time ends when the array of rows is full or the run
    ends. For derivatives the segment is run again, up to the time at which it ended the first time.

    - `method`: the explicit method, the field and the largest number of steps.
    - `constants`: the arrays on which the field depends.
    - `run`: the time and state at the start of the run, and the times at which steps end.
    - `loop`: the loop state at the start of the segment.
    - `rows`: the array into which one row is written for each attempted step.
    - `until`: `None` for the first time; else the time at which the segment ends, s.

    **Returns** three things: the loop state after the segment; its rows; and the number of the rows
    that are filled.
    """
    many = max(1, min(_MOST, _BLOCK // run.y0.dtype.itemsize // rows.shape[1]))
    segment, spare = _rows_of_segment(method, run)
    room = segment + (0 if until is None else spare)

    def filled(body: Callable[..., Any], loop: LoopState, rows: Rows, most: int) -> Any:
        on = lambda state: jnp.any(is_running(method, run, state[0], until)) & (state[2] < most)  # noqa: E731
        return lax.while_loop(on, body, (loop, rows, jnp.zeros((), jnp.int32)))

    def attempt(state: Any) -> Any:
        loop, few, k = state
        loop, row, _ = _attempt_step(method, constants, run, loop, until)
        return loop, lax.dynamic_update_slice_in_dim(few, row[None], k, 0), k + 1

    def block(state: Any) -> Any:
        loop, rows, count = state
        loop, few, k = filled(attempt, loop, jnp.zeros((many, *rows.shape[1:]), rows.dtype), many)
        return loop, lax.dynamic_update_slice_in_dim(rows, few, count, 0), count + k

    return filled(block, loop, rows, room)


def segment_of_rows(rows: Rows, end: Array, count: Array) -> Segment:
    """Return the segment (a part of a run) whose steps are recorded in the first rows of an array.

    - `rows`: (N, 4 + n, *bodies) the recorded steps.
    - `end`: the time at which the segment ends, s.
    - `count`: the number of rows that are filled.
    """
    there = jnp.arange(rows.shape[0], dtype=jnp.int32).reshape(-1, *[1] * end.ndim) < count
    times = jnp.where(there, lax.stop_gradient(rows[:, 0]).astype(end.dtype), jnp.inf)
    return Segment(rows, times, lax.stop_gradient(end), count)


def fill_saved_states_of_segment(
    method: Method, constants: Arrays, run: Run, segment: Segment, ys: Array
) -> Array:
    """Compute the saved states whose times lie in one segment, and return all saved states.

    - `method`: the explicit method and the field.
    - `constants`: the arrays on which the field depends.
    - `run`: holds the K saved times `run.between`, in increasing order.
    - `segment`: the segment, a part of the run, with its recorded steps.
    - `ys`: (K, n, *bodies) the saved states so far; `*bodies` is one last axis for the bodies of a
      batch, or no axis for one body.
    """
    size, many = run.between.shape[0], run.t0.ndim > 0
    width = 1 if many else min(size, _TOGETHER)
    # The steps that contain the saved times are looked up for all saved times at once: in a loop,
    # each look-up would be many small kernels.
    ts = lax.stop_gradient(run.between)
    search = map_over_bodies(
        run, lambda begun, ts: jnp.searchsorted(begun, ts).astype(jnp.int32) - 1
    )
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
        step = Step(*start_length_and_end_of_steps(run, row), row[HEAD:])
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
    """Return the state (n, *bodies) at a time within a step, by dense output.

    `*bodies` is one last axis for the bodies of a batch, or no axis for one body.

    - `method`: holds the weights of the method, and scales a quaternion to length 1.
    - `t`: the time, in seconds.
    - `step`: the start time and the length of the step, and the state at its start.
    - `slopes`: (n, s, *bodies) the values of the field at all s stages of the step, those of dense
      output included; n is the number of numbers of the state.
    """
    theta = ((t - step.t) / jnp.where(step.h == 0, 1, step.h)).astype(slopes.dtype)
    # Dense output is the state at the start of the step plus its length times a weighted sum of the
    # slopes at the stages. The weights are polynomials in θ, the fraction of the step before the
    # time t. They are evaluated first: a weight is one number, while a slope has n numbers.
    rows = arrays_of_tableau(method.tableau, slopes.dtype).dense
    shares = change_within_step(theta[None], rows.reshape(*rows.shape, *[1] * theta.ndim))
    rise = jnp.sum(shares[None] * slopes, 1)
    return method.project(step.y + add_leading_axes(step.h.astype(rise.dtype), rise) * rise)
