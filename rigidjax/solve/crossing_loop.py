"""Where a function of the motion crosses zero: a march in steps, and Newton within the step.

A pass through the loop is one step of the method from where a body is: an attempt at the next step,
or a part of it, up to where the crossing is looked for. So a crossing is as accurate as a step, and
costs about three passes. It is the start of the next step: two crossings in one step are nothing
special. Where g turns back towards where it came from within a step, the turn is looked for, until
the tangents at both ends show that g does not get to zero, or g has another sign there. Where the
cubic through both ends has more zeros than their signs tell, the step is taken again, shorter.

Nothing here is differentiated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.components import lift
from rigidjax.solve.record import at

# Newton's guesses in a step; from then on halves.
_GUESSES = 8
_MOST = 70
MARCH, REFINE, TURN = range(3)


class Motion(NamedTuple):
    """How a body gets on, on (n, *bodies).

    **Fields:** `attempt(t, h, end, y) → (y, size, h_next)` the state a step later, its error over
    the tolerance, the next step; `condition(t, y) → (g, dg/dt, dy/dt)`; `project`.
    """

    attempt: Callable[..., tuple[Array, Array, Array]]
    condition: Callable[..., tuple[Array, Array, Array]]
    project: Callable[[Array], Array]


class Search(NamedTuple):
    """What is looked for: crossings upwards (1), downwards (−1) or both (0); so many at most."""

    direction: int
    many: int
    max_steps: int


class Located(NamedTuple):
    """Times (K, *bodies), NaN beyond the last, states (K, n, *bodies), their number (*bodies),
    where each body is at the end, its next step (NaN where it met one), and steps.
    """

    times: Array
    states: Array
    number: Array
    t: Array
    h: Array
    steps: Array


class _End(NamedTuple):
    """An offset in the step, and g and dg/dt there."""

    x: Array
    g: Array
    rate: Array


class _Body(NamedTuple):
    """Time, state, next step; the side of zero that g is on, g and dg/dt there; index of the next
    stop; what is looked for, where, between which ends; counters; whether a crossing was found.
    """

    t: Array
    y: Array
    h: Array
    side: Array
    g: Array
    rate: Array
    stop: Array
    mode: Array
    x: Array
    low: _End
    high: _End
    tries: Array
    sure: Array
    steps: Array
    found: Array


def locate(
    motion: Motion, search: Search, t0: Array, stops: Array, before: Array, y0: Array, h0: Array
) -> Located:
    """The crossings on the way from `t0` through `stops` (J, *bodies).

    A start on the section is none.
    """
    g, rate, _ = motion.condition(t0, y0)
    # On the section but for round-off of the time: then the side is where g goes.
    eps = jnp.finfo(t0.dtype).eps
    little = 16 * eps * jnp.maximum(jnp.abs(t0), jnp.abs(stops[-1])).astype(g.dtype)
    there = jnp.abs(g) <= little * jnp.abs(rate)
    side = jnp.where(there, jnp.sign(rate), jnp.sign(g))
    zero, none = jnp.zeros(t0.shape, jnp.int32), jnp.zeros_like(g)
    sound = jnp.isfinite(g) & jnp.isfinite(stops[-1]) & jnp.all(jnp.isfinite(y0), 0)
    no = jnp.zeros(t0.shape, bool)
    end = _End(jnp.zeros_like(t0), none, none)
    h0 = jnp.where(sound, h0, jnp.nan)
    body = _Body(
        t0, y0, h0, side, jnp.where(there, none, g), rate, zero, zero, jnp.zeros_like(t0), end, end,
        zero, no, zero, no,
    )  # fmt: skip

    def row(state: Any) -> Any:
        body, times, states, k, count = state
        body = body._replace(found=no)
        body = lax.while_loop(
            lambda body: jnp.any(_going(search, stops, body)),
            lambda body: _pass(motion, search, stops, before, body),
            body,
        )
        t = jnp.where(body.found, body.t, jnp.nan)
        y = jnp.where(lift(body.found, body.y), body.y, jnp.nan)
        times = lax.dynamic_update_index_in_dim(times, t, k, 0)
        states = lax.dynamic_update_index_in_dim(states, y, k, 0)
        return body, times, states, k + 1, count + body.found.astype(jnp.int32)

    def more(state: Any) -> Array:
        body, _, _, k, _ = state
        on = _going(search, stops, body._replace(found=no))
        return (k < search.many) & jnp.any(on)

    times = jnp.full((search.many, *t0.shape), jnp.nan, t0.dtype)
    states = jnp.full((search.many, *y0.shape), jnp.nan, y0.dtype)
    start: Any = (body, times, states, jnp.zeros((), jnp.int32), zero)
    body, times, states, _, count = lax.while_loop(more, row, start)
    return Located(times, states, count, body.t, body.h, body.steps)


def _going(search: Search, stops: Array, body: _Body) -> Array:
    ahead = (body.stop < stops.shape[0]) & (body.steps < search.max_steps)
    return ahead & (body.h > 0) & ~body.found


def _pass(motion: Motion, search: Search, stops: Array, before: Array, body: _Body) -> _Body:
    on = _going(search, stops, body)
    t, h, y, side = body.t, body.h, body.y, body.side
    marching, refining = body.mode == MARCH, body.mode == REFINE
    begin, end = at(stops, body.stop), at(before, body.stop)
    arrived = on & marching & (t >= begin)
    left = end - t
    last = marching & (h >= left)
    length = jnp.where(marching, jnp.where(last, left, h), body.x)
    length = jnp.where(on & ~arrived, length, jnp.zeros_like(length))
    late = jnp.where(last, end, jnp.minimum(t + length, end))
    after, size, following = motion.attempt(t, length, late, y)
    g, rate, slope = motion.condition(late, after)
    size = jnp.where(jnp.isnan(size), jnp.inf, size)
    # Zero counts only where g came to it: not at the start, and not where it is zero all along.
    other = (side * g < 0) | ((g == 0) & (body.g != 0) & (side != 0))
    wanted = -side if search.direction == 0 else jnp.full_like(side, search.direction)
    asked = -side == wanted
    here = _End(length, g, rate)

    # A step: accepted, and nothing between its ends; or else one of two searches within it.
    on = on & ~arrived
    step = on & marching
    good = step & (size < 1)
    start = _End(jnp.zeros_like(length), body.g, body.rate)
    turns = good & ~other & ~body.sure & _may_touch(side, start, here)
    # Further crossings within the step: a shorter one, up to where the first is alone.
    hidden, share = _hidden(side, start, here)
    eps = jnp.finfo(h.dtype).eps
    floor = 8 * eps * jnp.maximum(jnp.abs(t), eps * jnp.abs(stops[-1]))
    shorter = good & hidden & ~turns & ~body.sure & (share * length > floor)
    good = good & ~shorter
    # A crossing the other way is not looked for, but for where it ended.
    passed = good & other & ~asked
    crossed = good & other & asked
    accept = good & ~crossed & ~turns
    why = jnp.where(jnp.isfinite(size), 0.0, jnp.nan).astype(h.dtype)
    stuck = step & ~good & ~shorter & ~(following > floor)
    shown = jnp.where(last & accept, jnp.maximum(following, h), following)
    next_h = jnp.where(accept | (step & ~good), jnp.where(stuck, why, shown), h)
    next_h = jnp.where(shorter, share.astype(h.dtype) * length, next_h)

    # Newton's method between two ends of which one is on either side.
    refine = on & refining
    low = _choose(refine & ~other, here, body.low)
    high = _choose(refine & other, here, body.high)
    move = (-g / jnp.where(rate == 0, jnp.ones_like(rate), rate)).astype(length.dtype)
    goal = length + move
    width = high.x - low.x
    small = jnp.sqrt(jnp.finfo(h.dtype).eps) * h
    near = (
        (jnp.abs(move) <= small) & (rate != 0) & (goal >= low.x - small) & (goal <= high.x + small)
    )
    unit = 2 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t), h)
    pinned = (width <= unit) | (body.tries >= _MOST)
    done = refine & (near | pinned)
    move = jnp.where(near, move, jnp.zeros_like(move))
    inside = (goal > low.x) & (goal < high.x) & (body.tries < _GUESSES)
    guess = jnp.where(inside, goal, low.x + 0.5 * width)
    found = body.found | (done & asked)

    # The turn of g between two ends on the same side: a secant of dg/dt.
    turning = on & (body.mode == TURN)
    back = side * rate < 0
    dip = turning & other
    low = _choose(turning & ~other & back, here, low)
    high = _choose(turning & ~other & ~back, here, high)
    lost = turning & ~other & (~_may_touch(side, low, high) | (body.tries >= _GUESSES))
    begun = turns | (turning & ~dip & ~lost)
    low, high = _choose(turns, start, low), _choose(turns, here, high)
    # A crossing lies between the start of the search and where g has changed its sign.
    enter = crossed | dip
    low = _choose(crossed, start, low)
    high = _choose(enter, here, high)
    bottom = _between(low.x, high.x, low.x + (high.x - low.x) * _share(low.rate, high.rate))
    x = jnp.where(begun, bottom, jnp.where(enter, _first_guess(side, low, high), guess))

    new = accept | done
    mode = jnp.where(enter, REFINE, jnp.where(turns, TURN, body.mode))
    mode = jnp.where(done | lost, MARCH, mode).astype(jnp.int32)
    reached = accept & last
    place = jnp.where(reached, begin, late) + jnp.where(done, move, jnp.zeros_like(move))
    shifted = motion.project(after + slope * lift(jnp.where(done, move, 0).astype(y.dtype), y))
    return _Body(
        t=jnp.where(new, place, t),
        y=jnp.where(lift(new, y), jnp.where(lift(done, y), shifted, after), y),
        h=next_h,
        side=jnp.where(done | passed, -side, jnp.where(accept & (side == 0), jnp.sign(g), side)),
        g=jnp.where(done, jnp.zeros_like(g), jnp.where(accept, g, body.g)),
        rate=jnp.where(new, rate, body.rate),
        stop=body.stop + (arrived | reached).astype(jnp.int32),
        mode=mode,
        x=x,
        low=low,
        high=high,
        tries=jnp.where(enter | turns | (body.mode == MARCH), 0, body.tries + 1).astype(jnp.int32),
        sure=jnp.where(lost, True, jnp.where(new, False, body.sure)),
        steps=body.steps + on.astype(jnp.int32),
        found=found,
    )


def _choose(which: Array, a: _End, b: _End) -> _End:
    return _End(*(jnp.where(which, x, y) for x, y in zip(a, b, strict=True)))


def _between(low: Array, high: Array, x: Array) -> Array:
    """`x`, or the middle where it is not well inside."""
    width = high - low
    well = (x > low + 1e-3 * width) & (x < high - 1e-3 * width)
    return jnp.where(well, x, low + 0.5 * width)


def _share(a: Array, b: Array) -> Array:
    """Where between 0 and 1 the line from `a` to `b` is zero."""
    gap = a - b
    return jnp.where(gap == 0, 0.5, a / jnp.where(gap == 0, 1, gap))


def _may_touch(side: Array, low: _End, high: _End) -> Array:
    """Whether g turns back between two ends, and its tangents there meet beyond zero."""
    turns = (side * low.rate < 0) & (side * high.rate > 0)
    width = (high.x - low.x).astype(low.g.dtype)
    gap = low.rate - high.rate
    place = (high.g - high.rate * width - low.g) / jnp.where(gap == 0, 1, gap)
    return turns & (side * (low.g + low.rate * place) <= 0)


def _hidden(side: Array, low: _End, high: _End) -> tuple[Array, Array]:
    """Whether the cubic in the offset through both ends with their slopes has more zeros between
    them than their signs tell, and where from 0 to 1 it is first on the other side of zero.
    """
    width = (high.x - low.x).astype(low.g.dtype)
    a, b = side * low.rate * width, side * high.rate * width
    first, last = side * low.g, side * high.g
    rise = last - first
    # Its slope is a + c x + d x².
    c, d = 2 * (3 * rise - 2 * a - b), 3 * (a + b - 2 * rise)
    root = jnp.sqrt(jnp.maximum(c * c - 4 * a * d, 0))
    q = -0.5 * (c + jnp.where(c < 0, -root, root))
    u = q / jnp.where(d == 0, 1, d)
    v = a / jnp.where(q == 0, 1, q)
    early, late = jnp.minimum(u, v), jnp.maximum(u, v)

    def value(x: Array) -> Array:
        return first + x * (a + x * (0.5 * c + x * d / 3))

    def within(x: Array) -> Array:
        return (x > 0) & (x < 1)

    flat = (d == 0) | (q == 0) | (root == 0)
    below, above = within(early) & (value(early) < 0), within(late) & (value(late) > 0)
    back = within(late) & (value(late) < 0)
    three, two = (last <= 0) & below & above, (last > 0) & (below | back)
    return ~flat & (three | two), jnp.where(below, early, late)


def _first_guess(side: Array, low: _End, high: _End) -> Array:
    """The cubic in g through both ends with their slopes, at g = 0; or the middle."""
    steady = (side * low.rate < 0) & (side * high.rate < 0)
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
