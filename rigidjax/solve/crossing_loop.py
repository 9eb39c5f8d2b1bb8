"""Locate the zeros of a function g along a motion, by steps and by Newton's method within a step.

Each pass through the loop attempts the next step, or only a part of a step, which ends at the
guessed time of a zero. The state at a zero is therefore as accurate as the state at the end of a
step.

A step may contain two zeros that the signs of g at its ends do not show. Between two such zeros g
has an extremum. To look for them, the cubic polynomial with the values and slopes of g at both ends
of the step is examined. The step is taken once more, only up to the extremum of this polynomial, in
two cases: if the polynomial has two such zeros; or if it has none, but the tangents at both ends do
not exclude that g has two.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.adaptive_loop import (
    NONFINITE,
    acceptance_and_next_step_size,
    previous_float,
    row_of_each_body,
    starting_step,
)
from rigidjax.solve.batching import Arrays, add_leading_axes
from rigidjax.solve.runge_kutta import Field, Step, error_estimate, stages
from rigidjax.solve.tableaus import Tableau

# The largest number of guesses for one zero by Newton's method; after these guesses the interval
# that contains the zero is halved again and again. `_GUESSES` is also the largest number of times
# that a step is taken again because g has an extremum in it.
_GUESSES = 8
# The largest number of guesses and halvings for one zero.
_MOST = 70


class SearchMethod(NamedTuple):
    """Hold an explicit method and the field that it solves; states are arrays (n, *bodies).

    A state has n numbers. `*bodies` is one last axis for the bodies of a batch, and no axis for one
    body.
    """

    tableau: Tableau
    field: Field
    project: Callable[[Array], Array]  # scales a quaternion to length 1
    sizes: list[int]  # how many numbers each array of the state has


class Path(NamedTuple):
    """Hold the arrays of a run that is searched for zeros of a condition along its motion.

    In a batch each array has a last axis of bodies.
    """

    t0: Array
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    y0: Array  # (n,) the state at t0
    rtol: Array  # the relative tolerance of a step
    atol: Array  # the absolute tolerance
    h0: Array  # the length of the first step; NaN if the search chooses it

    @property
    def last_times_before_jumps(self) -> Array:
        """Return the last floating-point time before each jump, and the end of the run, (J,).

        The last stage of a step that ends at a jump is evaluated at this earlier time, so that it
        sees the field as it is before the jump.
        """
        return jnp.concatenate([previous_float(self.stops[:-1]), self.stops[-1:]])


class Motion(NamedTuple):
    """Hold the motion of a body and a condition g along it; states are arrays (n, *bodies).

    A state has n numbers. `*bodies` is one last axis for the bodies of a batch, and no axis for one
    body.
    """

    # attempt(step) returns the state after the step, and the norm of its error divided by the
    # tolerance.
    attempt: Callable[[Step], tuple[Array, Array]]
    order: int  # the order of this error
    longest: Array  # the length of the longest step
    # condition(t, y) returns g, dg/dt, dy/dt and the size that g may have from round-off alone.
    condition: Callable[[Array, Array], tuple[Array, ...]]
    # counts(t, y, steps) returns whether a zero of g at the time t and the state y is a true zero,
    # and not caused by round-off alone. `steps` is the number of steps before it.
    counts: Callable[[Array, Array, Array], Array]
    project: Callable[[Array], Array]  # scales a quaternion to length 1


class Search(NamedTuple):
    """Describe which crossings to find: their direction, and the largest number of them.

    A crossing is a zero of a condition g along a motion.
    """

    direction: int  # 1: g goes up through zero, −1: down, 0: both
    max_crossings: int  # the largest number of crossings
    max_steps: int  # the largest number of passes through the loop


class Located(NamedTuple):
    """Hold the crossings found, which are zeros of a condition g, and the end of the search.

    K is the largest number of crossings, and n the number of numbers of a state. `*bodies` is one
    last axis for the bodies of a batch, and no axis for one body.
    """

    times: Array  # (K, *bodies), NaN after the last crossing
    states: Array  # (K, n, *bodies)
    jumps: Array  # (K, *bodies), whether g jumps over zero at the crossing
    number: Array  # the number of crossings found
    t: Array  # the time at which the search ended
    h: Array  # the length of the next step: 0 if none is left, NaN if the run met NaN
    steps: Array  # the number of passes through the loop


class _IntervalEnd(NamedTuple):
    """Hold one end of an interval of time, within a step, that contains a zero of the condition g.

    - `x`: the time of the end, counted from the start of the step, s.
    - `g`, `rate`: g and dg/dt at this time.
    """

    x: Array
    g: Array
    rate: Array


class _SearchState(NamedTuple):
    """Hold the state of the search for zeros of g for one body, or for many in the last axis.

    The condition g is a function of the time and the state of a body. A pass of the search is one
    attempted step, or a part of a step that ends at a guess for a zero.
    """

    t: Array  # the time that is reached
    y: Array  # (n, *bodies) the state at t
    h: Array  # the length of the next step
    side: Array  # the sign of g: 1 or −1; 0 if g has been zero since the start
    g: Array  # the condition at t
    rate: Array  # dg/dt at t
    stop: Array  # the index in `Path.stops` of the next time at which a step ends
    refining: Array  # whether a zero in a step is searched for, between `low` and `high`
    x: Array  # the next guess for the zero, as a time after the start of the step
    low: _IntervalEnd  # the start of the interval that contains the zero
    high: _IntervalEnd  # the end of this interval
    tries: Array  # the number of guesses for a zero, or of steps taken again for an extremum of g
    steps: Array  # the number of passes
    found: Array  # whether a zero was found since the search went on from the zero before
    jumped: Array  # whether g jumps over zero at the zero that was found last


def locate_zeros(motion: Motion, search: Search, run: Path) -> Located:
    """Return the zeros of a condition g along a run, from `run.t0` to the last of `run.stops`.

    - `motion`: takes a step, and evaluates g and the round-off of g.
    - `search`: the direction of the zeros, their largest number, and the largest number of passes.
    - `run`: the time and state at the start of the run, the times at which steps end, the
      tolerances, and the length of the first step.
    """
    t0, y0 = run.t0, run.y0
    g, rate, *_ = motion.condition(t0, y0)
    # If g is zero at the start, to within the round-off of the time, the sign of g is not known.
    # Soon after the start g has the sign of dg/dt, which is taken instead.
    eps = jnp.finfo(t0.dtype).eps
    little = 16 * eps * jnp.maximum(jnp.abs(t0), jnp.abs(run.stops[-1])).astype(g.dtype)
    there = jnp.abs(g) <= little * jnp.abs(rate)
    side = jnp.where(there, jnp.sign(rate), jnp.sign(g))
    zero, none, no = jnp.zeros(t0.shape, jnp.int32), jnp.zeros_like(g), jnp.zeros(t0.shape, bool)
    sound = jnp.isfinite(g) & jnp.isfinite(run.stops[-1]) & jnp.all(jnp.isfinite(y0), 0)
    h, x = jnp.where(sound, run.h0, jnp.nan), jnp.zeros_like(t0)
    end = _IntervalEnd(x, none, none)
    g = jnp.where(there, none, g)
    body = _SearchState(t0, y0, h, side, g, rate, zero, no, x, end, end, zero, zero, no, no)
    on = lambda body: jnp.any(_is_searching(search, run, body))  # noqa: E731

    def next_zero(body: _SearchState) -> _SearchState:
        body = lax.while_loop(on, partial(_next_search_state, motion, search, run), body)
        return body._replace(found=body.found & motion.counts(body.t, body.y, body.steps))

    def row(state: Any) -> Any:
        body, times, states, jumps, k, count = state
        body = lax.while_loop(on, next_zero, body._replace(found=no))
        t = jnp.where(body.found, body.t, jnp.nan)
        y = jnp.where(add_leading_axes(body.found, body.y), body.y, jnp.nan)
        times = lax.dynamic_update_index_in_dim(times, t, k, 0)
        states = lax.dynamic_update_index_in_dim(states, y, k, 0)
        jumps = lax.dynamic_update_index_in_dim(jumps, body.found & body.jumped, k, 0)
        return body, times, states, jumps, k + 1, count + body.found.astype(jnp.int32)

    times = jnp.full((search.max_crossings, *t0.shape), jnp.nan, t0.dtype)
    states = jnp.full((search.max_crossings, *y0.shape), jnp.nan, y0.dtype)
    jumps = jnp.zeros(times.shape, bool)
    body, times, states, jumps, _, count = lax.while_loop(
        lambda state: (state[4] < search.max_crossings) & on(state[0]._replace(found=no)),
        row,
        (body, times, states, jumps, jnp.zeros((), jnp.int32), zero),
    )
    return Located(times, states, jumps, count, body.t, body.h, body.steps)


def _is_searching(search: Search, run: Path, body: _SearchState) -> Array:
    """Return for each body whether its search for a zero of a condition g goes on.

    The search of a body ends in any of four cases: a zero was found; the end of the run is reached;
    the largest number of passes is used up; or no next step is possible. In the last case the
    length of the next step is 0 if the step would be shorter than the round-off of the time, and
    NaN if the run met NaN.

    - `search`: holds the largest number of passes; a pass is one attempted step, or a part of one.
    - `run`: holds the stops, the times at which steps end; the last stop is the end of the run.
    - `body`: the state of the search.
    """
    ahead = (body.stop < run.stops.shape[0]) & (body.steps < search.max_steps)
    return ahead & (body.h > 0) & ~body.found


def _next_search_state(
    motion: Motion, search: Search, run: Path, body: _SearchState
) -> _SearchState:
    """Return the state of the search after one more attempted step, or part of a step.

    The search is for zeros of a condition g along a motion. A body whose search has ended keeps its
    state of the search.

    - `motion`: takes a step, and evaluates g and the size that g may have from round-off alone.
    - `search`: the direction of the zeros that are wanted, and the largest number of passes (of
      attempted steps and parts of steps).
    - `run`: holds the stops, which are the times at which steps end.
    - `body`: the state of the search before this pass; its arrays may have a last axis of bodies.
    """
    on = _is_searching(search, run, body)
    t, h, y, side = body.t, body.h, body.y, body.side
    begin, end = (
        row_of_each_body(run.stops, body.stop),
        row_of_each_body(run.last_times_before_jumps, body.stop),
    )
    arrived = on & ~body.refining & (t >= begin)
    left = end - t
    last = ~body.refining & (h >= left)
    length = jnp.where(body.refining, body.x, jnp.where(last, left, h))
    length = jnp.where(on & ~arrived, length, jnp.zeros_like(length))
    late = jnp.where(last, end, jnp.minimum(t + length, end))
    after, norm = motion.attempt(Step(t, length, late, y))
    g, rate, slope, blur = motion.condition(late, after)
    # g = 0 counts as a crossing only if g was not zero before. A zero at the start does not count,
    # and neither does a g that is always zero.
    other = (side * g < 0) | ((g == 0) & (body.g != 0) & (side != 0))
    wanted = -side if search.direction == 0 else jnp.full_like(side, search.direction)
    asked = -side == wanted
    start, here = (
        _IntervalEnd(jnp.zeros_like(length), body.g, body.rate),
        _IntervalEnd(length, g, rate),
    )

    # If the error of a step is below the tolerance, one of three things happens: the step is
    # accepted; or the step is taken again up to an extremum of g, because g may have two zeros
    # beside it (`shorter`); or the zero of g in the step is searched for (`crossed`).
    step = on & ~arrived & ~body.refining
    whole = run.stops[-1] - run.t0
    good, following = acceptance_and_next_step_of_search(
        norm, motion.order, t, length, h, last, whole
    )
    following = jnp.minimum(following, motion.longest)
    good = step & good
    hidden, turn = _may_hide_zeros(side, start, here, blur)
    eps = jnp.finfo(h.dtype).eps
    long_enough = turn > 8 * eps * jnp.maximum(jnp.abs(t), eps * whole)
    shorter = good & hidden & long_enough & (body.tries < _GUESSES)
    # If g crosses zero in the direction that is not asked for, the time of the zero is not
    # computed: the step is accepted, and only the new sign of g is stored.
    crossed = good & ~shorter & other & asked
    accept = good & ~shorter & ~crossed
    next_h = jnp.where(shorter, turn, jnp.where(step & ~crossed, following, h))

    # A zero is searched for by Newton's method in the interval from `low` to `high`, at whose ends
    # g has opposite signs.
    refine = on & body.refining
    low = _choose_end(refine & ~other, here, body.low)
    high = _choose_end(refine & other, here, body.high)
    near, pinned, move, guess = _newton_step(body, low, high, here)
    done = refine & (near | pinned)
    move = jnp.where(done, move, jnp.zeros_like(move))
    low, high = _choose_end(crossed, start, low), _choose_end(crossed, here, high)

    new = accept | done
    reached = accept & last
    shifted = motion.project(after + slope * add_leading_axes(move.astype(y.dtype), y))
    flipped = done | (accept & other)
    return _SearchState(
        t=jnp.where(new, jnp.where(reached, begin, late) + move, t),
        y=jnp.where(
            add_leading_axes(new, y), jnp.where(add_leading_axes(done, y), shifted, after), y
        ),
        h=next_h,
        side=jnp.where(flipped, -side, jnp.where(accept & (side == 0), jnp.sign(g), side)),
        g=jnp.where(done, jnp.zeros_like(g), jnp.where(accept, g, body.g)),
        rate=jnp.where(new, rate, body.rate),
        stop=body.stop + (arrived | reached).astype(jnp.int32),
        refining=(body.refining | crossed) & ~done,
        x=jnp.where(crossed, _guess_zero(side, low, high), guess),
        low=low,
        high=high,
        tries=jnp.where(shorter | (refine & ~done), body.tries + 1, 0).astype(jnp.int32),
        steps=body.steps + on.astype(jnp.int32),
        found=body.found | done,
        jumped=jnp.where(done, ~near, body.jumped),
    )


def _newton_step(
    body: _SearchState, low: _IntervalEnd, high: _IntervalEnd, here: _IntervalEnd
) -> tuple[Array, Array, Array, Array]:
    """Take one step of Newton's method towards a zero of g, from a guess between two interval ends.

    - `body`: the state of the search; only three of its fields are used: the time and the length of
      the step of the motion, and the number of guesses so far.
    - `low`, `high`: the ends of the interval, at which the condition g has opposite signs.
    - `here`: the guess, with g and dg/dt there.

    **Returns** four things:

    - whether Newton's step reaches the zero, because it is short enough;
    - whether the search has to end at the guess even if Newton's step does not reach the zero,
      because no floating-point time lies between `low` and `high` or all guesses are used up;
    - the length of Newton's step, s, or 0 if it does not reach the zero;
    - the next guess, as a time after the start of the step of the motion, s.
    """
    rate, eps = here.rate, jnp.finfo(body.h.dtype).eps
    move = (-here.g / jnp.where(rate == 0, jnp.ones_like(rate), rate)).astype(here.x.dtype)
    goal = here.x + move
    width = high.x - low.x
    small = jnp.sqrt(eps) * body.h
    near = (jnp.abs(move) <= small) & (rate != 0)
    near = near & (goal >= low.x - small) & (goal <= high.x + small)
    unit = 2 * eps * jnp.maximum(jnp.abs(body.t), body.h)
    pinned = (width <= unit) | (body.tries >= _MOST)
    inside = (goal > low.x) & (goal < high.x) & (body.tries < _GUESSES)
    guess = jnp.where(inside, goal, low.x + 0.5 * width)
    return near, pinned, jnp.where(near, move, jnp.zeros_like(move)), guess


def _choose_end(condition: Array, if_true: _IntervalEnd, if_false: _IntervalEnd) -> _IntervalEnd:
    """Return `if_true` for the bodies for which `condition` is true, and `if_false` for the others.

    - `condition`: one truth value for each body.
    - `if_true`, `if_false`: two ends of intervals, each a time with the values of g and dg/dt at
      this time; g is the function whose zero is searched for.
    """
    pairs = zip(if_true, if_false, strict=True)
    return _IntervalEnd(*(jnp.where(condition, x, y) for x, y in pairs))


def _may_hide_zeros(
    sign_at_low: Array, low: _IntervalEnd, high: _IntervalEnd, round_off: Array
) -> tuple[Array, Array]:
    """Return whether a condition g may have two zeros in an interval that its signs do not show.

    If g crosses zero two more times, its signs at the ends of the interval stay as they are. This
    function therefore examines the cubic polynomial that has the values and slopes of g at both
    ends. Below, an extremum "beyond zero" is one at which the polynomial has the opposite sign of g
    at `low`, and is farther from zero than `round_off`.

    If g has the same sign at both ends, it may have two zeros in two cases: if the polynomial has
    an extremum beyond zero in the interval; or if it has an extremum in the interval, and the
    tangents at both ends meet beyond zero. If g has opposite signs at the ends, it may have two
    more zeros in one case: if the polynomial has an extremum beyond zero in the interval, and after
    it an extremum with the sign of g at `low`.

    - `sign_at_low`: the sign of g at `low`, 1 or −1.
    - `low`, `high`: the ends of the interval, each a time after the start of the step, s, with the
      values of g and dg/dt at this time.
    - `round_off`: the size that g may have from round-off alone.

    **Returns** two things: whether g may have two zeros that its signs do not show; and the time of
    the extremum, s, counted from `low`. If g has two such zeros, one lies on each side of this
    extremum.
    """
    width = (high.x - low.x).astype(low.g.dtype)
    a, b = sign_at_low * low.rate * width, sign_at_low * high.rate * width
    first, last = sign_at_low * low.g, sign_at_low * high.g
    rise = last - first
    # The cubic polynomial with the values and slopes of g at both ends is multiplied by
    # `sign_at_low`, so that it is positive at `low`. Its slope is a + c x + d x², where x goes from
    # 0 at `low` to 1 at `high`.
    c, d = 2 * (3 * rise - 2 * a - b), 3 * (a + b - 2 * rise)
    root = jnp.sqrt(jnp.maximum(c * c - 4 * a * d, 0))
    q = -0.5 * (c + jnp.where(c < 0, -root, root))
    one, other = a / jnp.where(q == 0, 1, q), q / jnp.where(d == 0, 1, d)
    # The slope of the cubic has two zeros. It increases through zero at the minimum of the cubic,
    # and decreases through zero at the maximum.
    least, most = jnp.where(c < 0, other, one), jnp.where(c < 0, one, other)

    value = lambda x: first + x * (a + x * (0.5 * c + x * d / 3))  # noqa: E731
    within = lambda x: (x > 0) & (x < 1)  # noqa: E731
    # `touch` is true if the tangents at both ends meet beyond zero. A function with these tangents
    # and one extremum may then reach zero, even if the cubic does not.
    meet = (last - b - first) / jnp.where(a == b, 1, a - b)
    touch = (a < 0) & (b > 0) & (first + a * meet < -round_off)
    two = (last > 0) & ((value(least) < -round_off) | touch)
    three = (
        (last <= 0)
        & (value(least) < -round_off)
        & within(most)
        & (value(most) > 0)
        & (least < most)
    )
    known = (root != 0) & (q != 0) & ((c >= 0) | (d != 0))
    least = jnp.where(known, least, 0)
    return within(least) & (two | three), least.astype(low.x.dtype) * (high.x - low.x)


def _guess_zero(sign_at_low: Array, low: _IntervalEnd, high: _IntervalEnd) -> Array:
    """Return a first guess for the time of a zero of a condition g, counted from the step's start.

    The guess is in seconds. The condition g is a function of the time and the state of a body.

    - `sign_at_low`: the sign of g at `low`, 1 or −1; at `high` the sign is the opposite one.
    - `low`, `high`: the ends of the interval, each a time x after the start of the step, s, with
      the values of g and dg/dt at this time.

    The guess is x(0), where x(g) is the cubic polynomial in g that has the times and the slopes
    dx/dg at `low` and `high`. The guess is the middle of the interval if g moves away from zero at
    `low` or towards zero at `high`, or if x(0) lies outside of the interval.
    """
    steady = (sign_at_low * low.rate < 0) & (sign_at_low * high.rate < 0)
    rise = jnp.where(steady, high.g - low.g, 1)
    u = -low.g / rise
    width = (high.x - low.x).astype(low.g.dtype)
    left = 1 / jnp.where(steady, low.rate, 1)
    right = 1 / jnp.where(steady, high.rate, 1)
    x = width * u * u * (3 - 2 * u) + rise * u * (1 - u) * ((1 - u) * left - u * right)
    middle = low.x + 0.5 * (high.x - low.x)
    x = low.x + x.astype(low.x.dtype)
    inside = steady & (x > low.x) & (x < high.x)
    return jnp.where(inside, x, middle)


def step_with_error(
    method: SearchMethod, constants: Arrays, run: Path, step: Step
) -> tuple[Array, Array]:
    """Return the state after a step of an explicit method, and the error divided by the tolerance.

    - `method`: the explicit method and the field, dy/dt.
    - `constants`: the arrays on which the field depends.
    - `run`: holds the tolerances `rtol` and `atol`.
    - `step`: the time and state (n, *bodies) at the start of the step, and its length, s; `*bodies`
      is one last axis for the bodies of a batch, and no axis for one body.

    **Returns** two things: the state (n, *bodies) after the step; and the root mean square, over
    the n numbers of the state, of error divided by tolerance. This norm has no derivative.
    """
    there = stages(method.tableau, method.field, constants, step)
    right = method.project(there.end)
    # The error serves only to choose the lengths of steps, which derivatives hold constant. It
    # therefore needs no derivative.
    left, after, h, slopes = lax.stop_gradient((step.y, right, step.h, there.slopes))
    error = error_estimate(method.tableau, method.sizes, h, slopes)
    largest = jnp.maximum(jnp.abs(left), jnp.abs(after))
    scale = add_leading_axes(run.atol, left) + add_leading_axes(run.rtol, left) * largest
    tiny = float(jnp.finfo(error.dtype).tiny)
    return right, jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + tiny)


def acceptance_and_next_step_of_search(
    error_norm: Array,
    order: int,
    t: Array,
    h: Array,
    uncut_length: Array,
    ends_at_stop: Array,
    run_length: Array,
) -> tuple[Array, Array]:
    """Return whether a step is accepted, and the length of the next step, s.

    If the step is rejected, and a shorter step would be below the round-off of the time, there is
    no next step. The next length is then 0, or NaN if the error of the step is not finite.

    - `error_norm`: the error divided by the tolerance, as `step_with_error` returns it.
    - `order`: the order of this error.
    - `t`, `h`: the time at which the step began, and its length, s.
    - `uncut_length`: the length, s, that the step would have had if it had not been cut short.
    - `ends_at_stop`: whether the step was cut short to end at a stop, a time at which a step has to
      end. Such a step may be short although the next step can be long.
    - `run_length`: the length of the run, s, which gives a lower limit for the length of a step
      near t = 0, where the round-off of t vanishes.
    """
    good, following = acceptance_and_next_step_size(error_norm, order, h)
    uncut_length = lax.stop_gradient(uncut_length)
    eps = jnp.finfo(h.dtype).eps
    unit = 8 * eps * jnp.maximum(jnp.abs(t), eps * run_length)
    why = jnp.where(jnp.isfinite(error_norm), 0.0, jnp.nan).astype(h.dtype)
    shorter = jnp.where(following > unit, following, why)
    longer = jnp.where(ends_at_stop, jnp.maximum(following, uncut_length), following)
    return good, jnp.where(good, longer, shorter)


def result_of_search(h: Array, t: Array, end: Array, is_full: Array) -> dfx.RESULTS:
    """Return how a search for crossings ended, as a `diffrax.RESULTS`.

    - `h`: the length of the step that would follow, s: 0 if no step is left that is long enough,
      NaN if the run met NaN.
    - `t`: the time at which the search ended, s.
    - `end`: the time at which the run ends, s.
    - `is_full`: whether the search found the largest allowed number of crossings.
    """
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(h), NONFINITE),
        (h > 0, dfx.RESULTS.max_steps_reached),
        (t >= end, dfx.RESULTS.successful),
        (is_full, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    return result


def first_step_length(method: SearchMethod, constants: Arrays, run: Path) -> Array:
    """Return the length of the first step of a search, s, from the state and its slope at `run.t0`.

    - `method`: the explicit method and the field, dy/dt.
    - `constants`: the arrays on which the field depends.
    - `run`: holds the time and state at the start of the run, and the tolerances.
    """
    y0 = run.y0
    scale = add_leading_axes(run.atol, y0) + add_leading_axes(run.rtol, y0) * jnp.abs(y0)
    slope = method.field(constants, run.t0, y0)
    size, rate = (jnp.sqrt(jnp.mean((a / scale) ** 2, 0)) for a in (y0, slope))
    return starting_step(size, rate, method.tableau.order).astype(run.t0.dtype)
