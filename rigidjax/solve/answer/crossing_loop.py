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

from rigidjax.solve.engine.loop import (
    NONFINITE,
    Method,
    accept_and_adapt,
    choose,
    rows_at,
    step_ends,
)
from rigidjax.solve.programs.batching import Arrays, lift
from rigidjax.solve.steps.runge_kutta import Step, error_estimate, stages

# The largest number of guesses for one zero by Newton's method; after these guesses the interval
# that contains the zero is halved again and again. `_GUESSES` is also the largest number of times
# that a step is taken again because g has an extremum in it.
_GUESSES = 8
# The largest number of guesses and halvings for one zero.
_MOST = 70


class Path(NamedTuple):
    """Hold the arrays of a run that is searched; in a batch with a last axis of bodies."""

    t0: Array
    stops: Array  # (J,) the times at which the field jumps, then the end of the run
    y0: Array  # (n,) the state at t0
    rtol: Array  # the relative tolerance of a step
    atol: Array  # the absolute tolerance
    h0: Array  # the length of the first step; NaN if the search chooses it
    longest: Array  # the length of the longest step


class Measured(NamedTuple):
    """Hold a condition g at a time and a state, its rate, and the size of its round-off."""

    g: Array
    rate: Array  # dg/dt along the motion
    slope: Array  # (n, *bodies) dy/dt
    blur: Array  # the size that g may have from round-off alone


class Motion(NamedTuple):
    """Hold the motion of a body and a condition g along it; states are arrays (n, *bodies)."""

    # attempt(step) returns the state after the step, and the norm of its error divided by the
    # tolerance.
    attempt: Callable[[Step], tuple[Array, Array]]
    order: int  # the order of this error
    condition: Callable[[Array, Array], Measured]
    # counts(t, y, steps) returns whether a zero of g at the time t and the state y is a true zero,
    # and not caused by round-off alone. `steps` is the number of steps before it.
    counts: Callable[[Array, Array, Array], Array]
    project: Callable[[Array], Array]  # scales a quaternion to length 1


class Search(NamedTuple):
    """Describe which crossings to find."""

    direction: int  # 1: g goes up through zero, −1: down, 0: both
    max_crossings: int  # the largest number of crossings
    max_steps: int  # the largest number of passes through the loop


class Located(NamedTuple):
    """Hold the crossings found, and the end of the search; K is the largest number of crossings."""

    times: Array  # (K, *bodies), NaN after the last crossing
    states: Array  # (K, n, *bodies)
    jumps: Array  # (K, *bodies), whether g jumps over zero at the crossing
    number: Array  # the number of crossings found
    t: Array  # the time at which the search ended
    h: Array  # the length of the next step: 0 if none is left, NaN if the run met NaN
    steps: Array  # the number of passes through the loop


class _IntervalEnd(NamedTuple):
    """Hold one end of an interval, within a step, that contains a zero of g."""

    x: Array  # its time after the start of the step, s
    g: Array
    rate: Array  # dg/dt


class _SearchState(NamedTuple):
    """Hold the state of the search; a pass is a step, or a part of it that ends at a guess."""

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
    """Return the zeros of g along a run, from `run.t0` to the last of `run.stops`."""
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
        body = lax.while_loop(on, partial(_next_state, motion, search, run), body)
        return body._replace(found=body.found & motion.counts(body.t, body.y, body.steps))

    def row(state: Any) -> Any:
        body, times, states, jumps, k, count = state
        body = lax.while_loop(on, next_zero, body._replace(found=no))
        t = jnp.where(body.found, body.t, jnp.nan)
        y = jnp.where(lift(body.found, body.y), body.y, jnp.nan)
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
    """Return for each body whether its search goes on.

    It ends at a zero, at the end of the run, after the last pass, and if no next step is possible:
    its length is then 0 (below the round-off of the time) or NaN (the run met NaN).
    """
    ahead = (body.stop < run.stops.shape[0]) & (body.steps < search.max_steps)
    return ahead & (body.h > 0) & ~body.found


def _next_state(motion: Motion, search: Search, run: Path, body: _SearchState) -> _SearchState:
    """Return the state of the search after one more pass; an ended search keeps its state."""
    on = _is_searching(search, run, body)
    t, h, y, side = body.t, body.h, body.y, body.side
    begin, end = rows_at(run.stops, body.stop), rows_at(step_ends(run.stops), body.stop)
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

    # If the error of a step is below the tolerance, the step is accepted; or it is taken again up
    # to an extremum of g, because g may have two zeros beside it (`shorter`); or the zero of g in
    # the step is searched for (`crossed`).
    step = on & ~arrived & ~body.refining
    good, following = accept_and_adapt(norm, motion.order, length)
    # The shortest step that the time can resolve; near t = 0, where the round-off of t vanishes, of
    # the length of the run.
    eps = jnp.finfo(h.dtype).eps
    unit = 8 * eps * jnp.maximum(jnp.abs(t), eps * (run.stops[-1] - run.t0))
    # If a rejected step cannot be shortened, the next length is 0, or NaN if the error is not
    # finite. A step that a stop cut short does not shorten the next one.
    stuck = jnp.where(jnp.isfinite(norm), 0.0, jnp.nan).astype(h.dtype)
    longer = jnp.where(last, jnp.maximum(following, lax.stop_gradient(h)), following)
    following = jnp.where(good, longer, jnp.where(following > unit, following, stuck))
    following = jnp.minimum(following, run.longest)
    good = step & good
    hidden, turn = _hidden_zeros(side, start, here, blur)
    shorter = good & hidden & (turn > unit) & (body.tries < _GUESSES)
    # If g crosses zero in the direction that is not asked for, the time of the zero is not
    # computed: the step is accepted, and only the new sign of g is stored.
    crossed = good & ~shorter & other & asked
    accept = good & ~shorter & ~crossed
    next_h = jnp.where(shorter, turn, jnp.where(step & ~crossed, following, h))

    # A zero is searched for by Newton's method in the interval from `low` to `high`, at whose ends
    # g has opposite signs.
    refine = on & body.refining
    low = choose(refine & ~other, here, body.low)
    high = choose(refine & other, here, body.high)
    near, pinned, move, guess = _newton_step(body, low, high, here)
    done = refine & (near | pinned)
    move = jnp.where(done, move, jnp.zeros_like(move))
    low, high = choose(crossed, start, low), choose(crossed, here, high)

    new = accept | done
    reached = accept & last
    shifted = motion.project(after + slope * lift(move.astype(y.dtype), y))
    flipped = done | (accept & other)
    return _SearchState(
        t=jnp.where(new, jnp.where(reached, begin, late) + move, t),
        y=choose(new, choose(done, shifted, after), y),
        h=next_h,
        side=jnp.where(flipped, -side, jnp.where(accept & (side == 0), jnp.sign(g), side)),
        g=jnp.where(done, jnp.zeros_like(g), jnp.where(accept, g, body.g)),
        rate=jnp.where(new, rate, body.rate),
        stop=body.stop + (arrived | reached).astype(jnp.int32),
        refining=(body.refining | crossed) & ~done,
        x=jnp.where(crossed, _guess(side, low, high), guess),
        low=low,
        high=high,
        tries=jnp.where(shorter | (refine & ~done), body.tries + 1, 0).astype(jnp.int32),
        steps=body.steps + on.astype(jnp.int32),
        found=body.found | done,
        jumped=jnp.where(done, ~near, body.jumped),
    )


class _Newton(NamedTuple):
    """Hold a step of Newton's method towards a zero of g."""

    near: Array  # whether it is short enough to reach the zero
    # whether the search has to end at the guess all the same: no floating-point time lies between
    # the ends, or all guesses are used up
    pinned: Array
    move: Array  # its length, s, or 0 if it does not reach the zero
    guess: Array  # the next guess, s after the start of the step of the motion


def _newton_step(
    body: _SearchState, low: _IntervalEnd, high: _IntervalEnd, at_guess: _IntervalEnd
) -> _Newton:
    """Take one step of Newton's method towards a zero of g, from a guess."""
    rate, eps = at_guess.rate, jnp.finfo(body.h.dtype).eps
    move = (-at_guess.g / jnp.where(rate == 0, jnp.ones_like(rate), rate)).astype(at_guess.x.dtype)
    goal = at_guess.x + move
    width = high.x - low.x
    small = jnp.sqrt(eps) * body.h
    near = (jnp.abs(move) <= small) & (rate != 0)
    near = near & (goal >= low.x - small) & (goal <= high.x + small)
    unit = 2 * eps * jnp.maximum(jnp.abs(body.t), body.h)
    pinned = (width <= unit) | (body.tries >= _MOST)
    inside = (goal > low.x) & (goal < high.x) & (body.tries < _GUESSES)
    guess = jnp.where(inside, goal, low.x + 0.5 * width)
    return _Newton(near, pinned, jnp.where(near, move, jnp.zeros_like(move)), guess)


def _hidden_zeros(
    sign_at_low: Array, low: _IntervalEnd, high: _IntervalEnd, round_off: Array
) -> tuple[Array, Array]:
    """Return whether g may have two zeros that its signs hide, and the time after `low` between.

    The cubic polynomial with the values and slopes of g at both ends is examined. An extremum
    "beyond zero" is one at which it has the opposite sign of g at `low`, farther from zero than
    `round_off`.

    If g has the same sign at both ends, it may have two zeros if the polynomial has an extremum
    beyond zero; or if it has an extremum, and the tangents at both ends meet beyond zero. If g has
    opposite signs, it may have two more if an extremum with the sign of g at `low` follows one
    beyond zero.
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


def _guess(sign_at_low: Array, low: _IntervalEnd, high: _IntervalEnd) -> Array:
    """Return a first guess for the time of a zero, s after the start of the step.

    It is x(0) of the cubic polynomial x(g) with the times and the slopes dx/dg at both ends; the
    middle if g moves away from zero at `low` or towards it at `high`, or if x(0) lies outside.
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
    return jnp.where(steady & (x > low.x) & (x < high.x), x, middle)


def step_with_error(
    method: Method, constants: Arrays, run: Path, step: Step
) -> tuple[Array, Array]:
    """Return the state after a step, and its error over the tolerance, a root mean square."""
    there = stages(method.tableau, method.field, constants, step)
    right = method.project(there.end)
    # The error serves only to choose the lengths of steps, which derivatives hold constant. It
    # therefore needs no derivative.
    left, after, h, slopes = lax.stop_gradient((step.y, right, step.h, there.slopes))
    error = error_estimate(method.tableau, method.sizes, h, slopes)
    largest = jnp.maximum(jnp.abs(left), jnp.abs(after))
    scale = lift(run.atol, left) + lift(run.rtol, left) * largest
    return right, jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + float(jnp.finfo(error.dtype).tiny))


def result_of_search(h: Array, t: Array, end: Array, is_full: Array) -> dfx.RESULTS:
    """Return the result of a search that ended at `t`, s, before a step `h`, by `_is_searching`."""
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(h), NONFINITE),
        (h > 0, dfx.RESULTS.max_steps_reached),
        (t >= end, dfx.RESULTS.successful),
        (is_full, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    return result
