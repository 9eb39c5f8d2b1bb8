"""The way back along a chapter: one body, many of its steps side by side.

See `rigidjax.solve.linear`. Many bodies go back in `rigidjax.solve.abreast`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import linear
from rigidjax.solve.march import Rows, Stops
from rigidjax.solve.method import Method, spread
from rigidjax.solve.scalarise import atoms_of, gathered
from rigidjax.solve.together import anywhere

# Steps and saved states that are worked on side by side.
LANES = 32


class Chapter(NamedTuple):
    """Steps to go back along.

    **Fields:** `on` whether there are any; the first `length` of `rows`; `constants` and `rest` of
    the field; `between` (K,) times asked for, `seeds` (K, n) the cotangents of the states there.
    """

    on: Array
    stops: Stops
    rows: Rows
    length: Array
    constants: Any
    rest: Any
    between: Array
    seeds: Array


class Bars(NamedTuple):
    """Cotangents by now: of the `state` (n,), and sums of those of the others.

    `ends` (1 + J,) of the start's time and the stops.
    """

    state: Array
    constants: Any
    between: Array
    ends: Array


def alone(method: Method, chapter: Chapter, bars: Bars) -> Bars:
    """From the end of a chapter to its start.

    First from the states between steps to the starts of their steps, then along these.
    """
    extra = jnp.zeros_like(chapter.rows.y)
    if chapter.between.size:
        extra, bars = _from_between(method, chapter, extra, bars)
    values = spread(eqx.combine(chapter.constants, chapter.rest))
    rows, count = chapter.rows, chapter.length
    size, many = bars.state.shape[0], min(LANES, rows.t.shape[0])
    # The step is transposed before its cotangent is known: n of them, in each lane.
    units = jnp.broadcast_to(jnp.eye(size, dtype=rows.y.dtype)[..., None], (size, size, many))

    def batch(state: Any) -> Any:
        number, bars = state
        on, number = number > 0, jnp.maximum(number - 1, 0)
        place = number * many + jnp.arange(many, dtype=jnp.int32)
        # Lanes beyond the last step repeat it: their numbers must be good ones.
        there, index = on & (place < count), jnp.clip(place, 0, count - 1)
        here = jax.tree.map(lambda a: a[index], rows)
        lanes = steps_of(chapter.stops, here)
        stages = linear.stages_of(method, values, lanes)
        pull = linear.pulled(method, stages, lanes.h, units)

        def back(bar: Array, step: Any) -> tuple[Array, Array]:
            matrix, here, more = step
            before = (matrix * bar[None]).sum(1) + more
            return jnp.where(here, before, bar), jnp.where(here, bar, jnp.zeros_like(bar))

        steps = (pull.start.transpose(2, 0, 1), there, extra[index])
        state, after = lax.scan(back, bars.state, steps, reverse=True, unroll=8)
        slopes = (pull.slopes * after.T[None, None]).sum(2)
        constants, times = linear.fed(method, values, stages, slopes)
        constants = jax.tree.map(jnp.add, bars.constants, constants)
        lengths = linear.lengths(method, stages, lanes.h, slopes, times)
        # A step that ends on a stop is as long as from its start to there.
        cut = jnp.where(here.code % 2 == 1, lengths, jnp.zeros_like(lengths))
        ends = bars.ends.at[here.code // 2].add(times.sum(0) - cut)
        ends = ends.at[here.code // 2 + 1].add(cut)
        return number, Bars(state, constants, bars.between, ends)

    batches = jnp.where(chapter.on, (count + many - 1) // many, 0)
    return lax.while_loop(lambda state: anywhere(state[0] > 0), batch, (batches, bars))[1]


def _from_between(method: Method, chapter: Chapter, extra: Array, bars: Bars) -> tuple[Array, Bars]:
    """From the states between steps to the starts of theirs: `extra` cotangents of the rows."""
    values = spread(eqx.combine(chapter.constants, chapter.rest))
    atoms, replaced = atoms_of(values)
    between, rows = chapter.between, chapter.rows
    many = min(LANES, between.shape[0])
    first, last = asked(chapter.stops, rows, chapter.length, between)

    def field(atoms: list[Array], t: Array, y: Any) -> Any:
        return jax.vmap(lambda t, y: method.field(replaced(atoms), t, *y))(t, y)

    def batch(state: Any) -> Any:
        next, extra, found, asked_for, ends = state
        place = next + jnp.arange(many, dtype=jnp.int32)
        there, which = chapter.on & (place < last), jnp.clip(place, 0, jnp.maximum(last - 1, 0))
        row, lanes = within(chapter.stops, rows, chapter.length, between[which])
        seeds = jnp.where(there[:, None], chapter.seeds[which], jnp.zeros_like(extra[:1]))
        before, more, times, lengths = linear.step_back(method, field, atoms, lanes, seeds.T)
        ends = ends.at[rows.code[row] // 2].add(times - lengths)
        sums = extra.at[row].add(before.T), jax.tree.map(jnp.add, found, more)
        return next + many, *sums, asked_for.at[which].add(lengths), ends

    none = jax.tree.map(jnp.zeros_like, atoms)
    begin = jnp.where(chapter.on, first, last), extra, none, bars.between, bars.ends
    _, extra, found, asked_for, ends = lax.while_loop(
        lambda state: anywhere(state[0] < last), batch, begin
    )
    constants = jax.tree.map(jnp.add, bars.constants, gathered(values, found))
    return extra, Bars(bars.state, constants, asked_for, ends)


def steps_of(stops: Stops, rows: Rows) -> linear.Lanes:
    """What is written in these rows (R,)."""
    late = jnp.where(rows.code % 2 == 1, stops.end[rows.code // 2], rows.t + rows.h)
    return linear.Lanes(rows.t, rows.h, late, rows.y.T)


def asked(stops: Stops, rows: Rows, count: Array, between: Array) -> tuple[Array, Array]:
    """The first of the times between in these rows, and the first after them."""
    final = count - 1
    code = rows.code[final]
    reach = jnp.where(code % 2 == 1, stops.begin[code // 2], rows.t[final] + rows.h[final])
    first = jnp.sum(between <= rows.t[0], dtype=jnp.int32)
    return first, jnp.sum(between <= reach, dtype=jnp.int32)


def within(stops: Stops, rows: Rows, count: Array, late: Array) -> tuple[Array, linear.Lanes]:
    """The rows that these times lie in, and the steps from their starts to there."""
    index = jnp.maximum(_number_before(rows.t, count, late) - 1, 0)
    t, h, code = rows.t[index], rows.h[index], rows.code[index]
    limit = jnp.where(code % 2 == 1, stops.end[code // 2], t + h)
    # The limit is the last moment before a jump: it moves nothing, and has no derivative here.
    end = late + lax.stop_gradient(jnp.minimum(late, limit) - late)
    return index, linear.Lanes(t, end - t, end, rows.y[index].T)


def _number_before(begin: Array, count: Array, late: Array) -> Array:
    """How many of the first `count` of `begin`, in order, lie before each of `late`: by halving."""

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) // 2
        before = (middle < high) & (begin[jnp.minimum(middle, begin.shape[0] - 1)] < late)
        return jnp.where(before, middle + 1, low), jnp.where(before, high, middle)

    ends = jnp.zeros(late.shape, jnp.int32), jnp.broadcast_to(count, late.shape)
    return lax.fori_loop(0, begin.shape[0].bit_length(), halve, ends)[0]
