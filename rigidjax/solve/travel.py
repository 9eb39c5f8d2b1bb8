"""From the start to the end, with the states between at any times: values and derivatives.

The steps do not look at the times that are asked for. A state between two steps is one more step,
a shorter one, from the step's start: of the method's own order, on the group, and its error is less
than that of the step it lies in. All of them are worked out side by side.

In reverse mode the run is written down in chapters. The start of each is kept, and the steps of the
last; going back, each chapter but the last is run once more. For N steps at most this is memory for
N/2048 starts and 2048 steps.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import linear, march
from rigidjax.solve.abreast import back_through
from rigidjax.solve.backward import LANES, Bars, Chapter, within
from rigidjax.solve.march import Control, Rows, Stops, Walk
from rigidjax.solve.method import Method, spread
from rigidjax.solve.together import anywhere

# Steps in a chapter. One that is run again rounds differently, and at tight tolerances has other
# steps: most runs should need only one.
CHAPTER = 2048
# Steps between looks at the times asked for, where no step has to be kept: little memory to touch.
STRETCH = 256


class Given(NamedTuple):
    """What an answer depends on, all of it differentiable.

    **Fields:** `constants` of the field (`None` in the place of whole numbers); `t0`; `stops` (J,)
    where the torque jumps, and the last time; `between` (K,) times between the first and the last;
    `y0` (n,).
    """

    constants: Any
    t0: Array
    stops: Array
    between: Array
    y0: Array


class Fixed(NamedTuple):
    """What has no derivative: the rest of the field's constants, first step, tolerances."""

    rest: Any
    h0: Array
    rtol: Array
    atol: Array


class Answer(NamedTuple):
    """States `between` (K, n) and at the `end` (n,); where the run ended, and its counters."""

    between: Array
    end: Array
    t: Array
    h: Array
    steps: Array
    rejected: Array


class Saved(NamedTuple):
    """States at the times between, and how many there are by now; room for a batch more."""

    ys: Array
    known: Array


class _Chapters(NamedTuple):
    """The start of each chapter, how many there are, and the steps of the last."""

    starts: Walk
    number: Array
    rows: Rows
    length: Array


def forward(method: Method, max_steps: int, given: Given, fixed: Fixed) -> Answer:
    """The answer, differentiable in forward mode only: loops of unknown length have no transpose.

    **Arguments:** `max_steps` at which to give up; states that are not reached are NaN.
    """
    stops, control, values = _set_up(method, max_steps, given, fixed)
    step = partial(method.step_and_error, values)
    walk = march.start(given.t0, fixed.h0, tuple(given.y0))
    if not given.between.size:
        walk = march.unrecorded(step, control, stops, walk)
        return _answer(given, walk, jnp.zeros((0, *given.y0.shape), given.y0.dtype))

    def stretch(state: Any) -> Any:
        walk, saved, rows = state
        none = jnp.zeros((), jnp.int32)
        walk, rows, count = march.recorded(step, control, stops, walk, rows, none)
        saved = _look(method, values, given.between, stops, walk.t, rows, count, saved)
        return walk, saved, rows

    walk, saved, _ = lax.while_loop(
        lambda state: anywhere(march.going(state[0], stops, control)),
        stretch,
        (walk, _none_saved(given), march.empty(walk, STRETCH)),
    )
    return _answer(given, walk, _kept(saved, given))


def reverse(method: Method, max_steps: int, given: Given, fixed: Fixed) -> Answer:
    """The answer, differentiable in reverse mode.

    The derivative is that of the steps that were taken, their lengths held (but for those cut short
    at a stop, which follow it), as in `diffrax.RecursiveCheckpointAdjoint`. `jax.jvp` of the
    gradient gives second derivatives; the gradient of the gradient is refused by JAX.
    """
    answer = jax.custom_vjp(partial(forward, method, max_steps))
    answer.defvjp(partial(_written, method, max_steps), partial(_back, method, max_steps))
    return answer(given, fixed)


def _written(method: Method, max_steps: int, given: Given, fixed: Fixed) -> Any:
    stops, control, values = _set_up(method, max_steps, given, fixed)
    step = partial(method.step_and_error, values)
    walk = march.start(given.t0, fixed.h0, tuple(given.y0))
    room = _room(walk, max_steps)
    most = max_steps // (room - march.block_size(walk.y) + 1) + 1
    empty: Any = jax.tree.map(lambda a: jnp.zeros((most, *a.shape), a.dtype), walk)
    zero = jnp.zeros((), jnp.int32)
    book = _Chapters(empty, zero, march.empty(walk, room), zero)

    def chapter(state: Any) -> Any:
        walk, saved, book = state
        on = march.going(walk, stops, control)
        starts = jax.tree.map(lambda a, b: a.at[book.number].set(b), book.starts, walk)
        # Those who are through keep the steps of their last chapter.
        count = jnp.where(on, 0, book.length)
        walk, rows, count = march.recorded(step, control, stops, walk, book.rows, count)
        if given.between.size:
            saved = _look(method, values, given.between, stops, walk.t, rows, count, saved)
        return walk, saved, _Chapters(starts, book.number + on.astype(jnp.int32), rows, count)

    walk, saved, book = lax.while_loop(
        lambda state: anywhere(march.going(state[0], stops, control)),
        chapter,
        (walk, _none_saved(given), book),
    )
    return _answer(given, walk, _kept(saved, given)), (given, fixed, book)


def _back(method: Method, max_steps: int, kept: Any, cotangents: Answer) -> tuple[Given, None]:
    given, fixed, book = kept
    stops, control, values = _set_up(method, max_steps, given, fixed)
    empty: Rows = jax.tree.map(jnp.zeros_like, book.rows)
    # The start's time counts as a stop, the first.
    ends = jnp.zeros(stops.begin.shape[0] + 1, given.t0.dtype)
    constants = jax.tree.map(jnp.zeros_like, given.constants)
    bars = Bars(cotangents.end, constants, jnp.zeros_like(given.between), ends)

    def steps(number: Array) -> tuple[Rows, Array]:
        walk: Any = jax.tree.map(lambda a: a[number], book.starts)
        # Another form of the same step: slower, but quick to compile, and seldom needed.
        looped = partial(linear.looped_step, method, values)
        none = jnp.zeros_like(book.length)
        _, *again = march.recorded(looped, control, stops, walk, empty, none)
        last = number == book.number - 1
        kept = book.rows, book.length
        return jax.tree.map(lambda a, b: jnp.where(last, a, b), kept, tuple(again))

    def chapter(state: Any) -> Any:
        number, bars = state
        on, number = number > 0, jnp.maximum(number - 1, 0)
        rows, count = lax.cond(
            anywhere(on & (number < book.number - 1)),
            steps,
            lambda _: (book.rows, book.length),
            number,
        )
        field = given.constants, fixed.rest
        chapter = Chapter(on, stops, rows, count, *field, given.between, cotangents.between)
        return number, back_through(method, chapter, bars)

    begin = (book.number, bars)
    bars = lax.while_loop(lambda state: anywhere(state[0] > 0), chapter, begin)[1]
    ends = {"t0": bars.ends[0], "stops": bars.ends[1:]}
    return Given(bars.constants, between=bars.between, y0=bars.state, **ends), None


def _look(
    method: Method,
    values: Any,
    between: Array,
    stops: Stops,
    reach: Array,
    rows: Rows,
    count: Array,
    saved: Saved,
) -> Saved:
    """The states at the times between, as far as the run has come."""
    many = min(LANES, between.shape[0])

    def waiting(saved: Saved) -> Array:
        here = jnp.minimum(saved.known, between.shape[0] - 1)
        return (saved.known < between.shape[0]) & (between[here] <= reach) & (count > 0)

    def batch(saved: Saved) -> Saved:
        place = saved.known + jnp.arange(many, dtype=jnp.int32)
        late = between[jnp.minimum(place, between.shape[0] - 1)]
        ready = (place < between.shape[0]) & (late <= reach)
        _, lanes = within(stops, rows, count, jnp.where(ready, late, reach))
        ys = linear.ends_of(method, values, lanes).T
        ys = lax.dynamic_update_slice_in_dim(saved.ys, ys, saved.known, 0)
        return Saved(ys, saved.known + jnp.sum(ready, dtype=jnp.int32))

    return lax.while_loop(lambda saved: anywhere(waiting(saved)), batch, saved)


def _set_up(
    method: Method, max_steps: int, given: Given, fixed: Fixed
) -> tuple[Stops, Control, Any]:
    begin = given.stops
    before = jnp.nextafter(begin[:-1], jnp.full_like(begin[:-1], -jnp.inf))
    end = begin + lax.stop_gradient(jnp.concatenate([before, begin[-1:]]) - begin)
    least = jnp.finfo(begin.dtype).eps * lax.stop_gradient(begin[-1] - given.t0)
    control = Control(fixed.rtol, fixed.atol, least, method.tableau.order, max_steps)
    return Stops(begin, end), control, spread(eqx.combine(given.constants, fixed.rest))


def _room(walk: Walk, max_steps: int) -> int:
    return min(CHAPTER, max_steps) + march.block_size(walk.y) - 1


def _none_saved(given: Given) -> Saved:
    size = given.between.shape[0]
    more = min(LANES, size)
    ys = jnp.zeros((size + more, given.y0.shape[0]), given.y0.dtype)
    return Saved(ys, jnp.zeros((), jnp.int32))


def _kept(saved: Saved, given: Given) -> Array:
    size = given.between.shape[0]
    ys = saved.ys[:size]
    there = jnp.arange(size, dtype=jnp.int32) < saved.known
    return jnp.where(there[:, None], ys, jnp.full_like(ys, jnp.nan))


def _answer(given: Given, walk: Walk, between: Array) -> Answer:
    end = jnp.stack(walk.y)
    there = walk.t >= given.stops[-1]
    end = jnp.where(there, end, jnp.full_like(end, jnp.nan))
    # Under `vmap` JAX wants a result that is one for each of the batch wherever an input is: the
    # states between depend on their times, the end does not, and neither on a number never used.
    firsts = [leaf.reshape(-1)[0] for leaf in jax.tree.leaves(given) if leaf.size]
    own = jnp.stack([first == first for first in firsts]).any()
    end = jnp.where(own, end, end)
    between = jnp.where(own, between, between) if between.size else end[None][:0]
    return Answer(between, end, walk.t, walk.h, walk.steps, walk.rejected)
