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
from rigidjax.solve.march import Control, Rows, Stops, Walk
from rigidjax.solve.method import Method, spread

# Steps in a chapter; steps and saved states that are worked on side by side. A chapter that is run
# again rounds differently, and at tight tolerances has other steps: most runs should need only one.
CHAPTER, LANES = 2048, 64


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
    room = _room(walk, max_steps)

    def chapter(state: Any) -> Any:
        walk, saved = state
        walk, rows, count = march.recorded(step, control, stops, walk, room)
        return walk, _look(method, values, given.between, stops, walk.t, rows, count, saved)

    walk, saved = lax.while_loop(
        lambda state: march.going(state[0], stops, control), chapter, (walk, _none_saved(given))
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
    shapes: Any = jax.eval_shape(lambda: march.recorded(step, control, stops, walk, room)[1])
    rows: Any = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    zero = jnp.zeros((), jnp.int32)

    def chapter(state: Any) -> Any:
        walk, saved, book = state
        starts = jax.tree.map(lambda a, b: a.at[book.number].set(b), book.starts, walk)
        walk, rows, count = march.recorded(step, control, stops, walk, room)
        if given.between.size:
            saved = _look(method, values, given.between, stops, walk.t, rows, count, saved)
        return walk, saved, _Chapters(starts, book.number + 1, rows, count)

    walk, saved, book = lax.while_loop(
        lambda state: march.going(state[0], stops, control),
        chapter,
        (walk, _none_saved(given), _Chapters(empty, zero, rows, zero)),
    )
    return _answer(given, walk, _kept(saved, given)), (given, fixed, book)


def _back(method: Method, max_steps: int, kept: Any, cotangents: Answer) -> tuple[Given, None]:
    given, fixed, book = kept
    stops, control, values = _set_up(method, max_steps, given, fixed)
    room = book.rows.t.shape[0]
    bars = jax.tree.map(jnp.zeros_like, given)
    # The start's time counts as a stop, the first.
    ends = jnp.zeros(stops.begin.shape[0] + 1, given.t0.dtype)

    def again(walk: Walk) -> tuple[Rows, Array]:
        # Another form of the same step: slower, but quick to compile, and seldom needed.
        looped = partial(linear.looped_step, method, values)
        _, rows, count = march.recorded(looped, control, stops, walk, room)
        return rows, count

    def chapter(state: Any) -> Any:
        number, bar, bars, ends = state
        number = number - 1
        walk: Any = jax.tree.map(lambda a: a[number], book.starts)
        # The last chapter is there. No `cond`: under `vmap` both its branches run; a walk without
        # a step ahead takes none.
        last = number == book.number - 1
        rows, count = again(walk._replace(h=jnp.where(last, jnp.zeros_like(walk.h), walk.h)))
        rows, count = jax.tree.map(
            lambda a, b: jnp.where(last, a, b), (book.rows, book.length), (rows, count)
        )
        context = _Context(method, values, stops, rows, count)
        bar, bars, ends = _back_through(context, given, cotangents.between, bar, bars, ends)
        return number, bar, bars, ends

    begin = (book.number, cotangents.end, bars, ends)
    _, bar, bars, ends = lax.while_loop(lambda state: state[0] > 0, chapter, begin)
    bars = bars._replace(y0=bar, t0=ends[0], stops=ends[1:])
    return bars, None


class _Context(NamedTuple):
    method: Method
    values: Any
    stops: Stops
    rows: Rows
    length: Array

    def lanes(self, index: Array) -> linear.Lanes:
        """The steps of these rows."""
        t, h, code = self.rows.t[index], self.rows.h[index], self.rows.code[index]
        late = jnp.where(code % 2 == 1, self.stops.end[code // 2], t + h)
        return linear.Lanes(t, h, late, self.rows.y[index].T)


def _back_through(
    context: _Context, given: Given, seeds: Array, bar: Array, bars: Given, ends: Array
) -> Any:
    """From the end of a chapter to its start: `bar` (n,), the state's cotangent, and the others.

    First from the states between steps (`seeds`) to the starts of their steps, then along these.
    """
    method, rows, count = context.method, context.rows, context.length
    size, many = given.y0.shape[0], min(LANES, rows.t.shape[0])
    first, last = _asked(context, given.between)
    chain = (count + many - 1) // many
    # The step is transposed before its cotangent is known: n of them, in each lane.
    units = jnp.broadcast_to(jnp.eye(size, dtype=given.y0.dtype)[..., None], (size, size, many))

    def batch(state: Any) -> Any:
        number, bar, bars, ends, extra = state
        number = number - 1
        place = number * many + jnp.arange(many, dtype=jnp.int32)
        # Lanes beyond the last step repeat it: their numbers must be good ones.
        there, index = place < count, jnp.clip(place, 0, count - 1)
        lanes = context.lanes(index)
        linked, which = number < chain, place
        if given.between.size:
            asked = first + place - chain * many
            which = jnp.clip(asked, 0, jnp.maximum(last - 1, 0))
            row, short = _within(context.stops, rows, count, given.between[which])
            lanes = jax.tree.map(lambda a, b: jnp.where(linked, a, b), lanes, short)
            index = jnp.where(linked, index, row)
            there = jnp.where(linked, there, (asked >= first) & (asked < last))
        stages = linear.stages_of(method, context.values, lanes)
        pull = linear.pulled(method, stages, lanes.h, units)

        def back(bar: Array, step: Any) -> tuple[Array, Array]:
            matrix, here, more = step
            before = (matrix * bar[None]).sum(1) + more
            return jnp.where(here, before, bar), jnp.where(here, bar, jnp.zeros_like(bar))

        steps = (pull.start.transpose(2, 0, 1), there & linked, extra[index])
        bar, after = lax.scan(back, bar, steps, reverse=True, unroll=8)
        if given.between.size:
            own = jnp.where((there & ~linked)[:, None], seeds[which], jnp.zeros_like(after))
            extra = extra.at[index].add((pull.start * own.T[None]).sum(1).T)
            after = after + own
        slopes = (pull.slopes * after.T[None, None]).sum(2)
        constants, times = linear.fed(method, context.values, stages, slopes)
        bars = bars._replace(constants=jax.tree.map(jnp.add, bars.constants, constants))
        lengths = linear.lengths(method, stages, lanes.h, slopes, times)
        code = rows.code[index]
        # A step that ends on a stop, or on a time asked for, is as long as from its start to there.
        cut = jnp.where((code % 2 == 1) | ~linked, lengths, jnp.zeros_like(lengths))
        ends = ends.at[code // 2].add(times.sum(0) - cut)
        ends = ends.at[code // 2 + 1].add(jnp.where(linked, cut, jnp.zeros_like(cut)))
        if given.between.size:
            asked_for = jnp.where(linked, jnp.zeros_like(cut), cut)
            bars = bars._replace(between=bars.between.at[which].add(asked_for))
        return number, bar, bars, ends, extra

    batches = chain + (last - first + many - 1) // many
    begin = (batches, bar, bars, ends, jnp.zeros_like(rows.y))
    _, bar, bars, ends, _ = lax.while_loop(lambda state: state[0] > 0, batch, begin)
    return bar, bars, ends


def _asked(context: _Context, between: Array) -> tuple[Array, Array]:
    """The first of the times between in these rows, and the first after them."""
    rows, final = context.rows, context.length - 1
    cut = rows.code[final] % 2 == 1
    reach = jnp.where(
        cut, context.stops.begin[rows.code[final] // 2], rows.t[final] + rows.h[final]
    )
    first = jnp.sum(between <= rows.t[0], dtype=jnp.int32)
    return first, jnp.sum(between <= reach, dtype=jnp.int32)


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
        _, lanes = _within(stops, rows, count, jnp.where(ready, late, reach))
        ys = linear.ends_of(method, values, lanes).T
        ys = lax.dynamic_update_slice_in_dim(saved.ys, ys, saved.known, 0)
        return Saved(ys, saved.known + jnp.sum(ready, dtype=jnp.int32))

    return lax.while_loop(waiting, batch, saved)


def _within(stops: Stops, rows: Rows, count: Array, late: Array) -> tuple[Array, linear.Lanes]:
    """The rows that these times lie in, and the steps from their starts to there."""
    written = jnp.arange(rows.t.shape[0], dtype=jnp.int32) < count
    before = (rows.t[None] < late[:, None]) & written[None]
    index = jnp.maximum(jnp.sum(before, axis=1, dtype=jnp.int32) - 1, 0)
    t, h, code = rows.t[index], rows.h[index], rows.code[index]
    limit = jnp.where(code % 2 == 1, stops.end[code // 2], t + h)
    # The limit is the last moment before a jump: it moves nothing, and has no derivative here.
    end = late + lax.stop_gradient(jnp.minimum(late, limit) - late)
    return index, linear.Lanes(t, end - t, end, rows.y[index].T)


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
