"""Locate the times at which a traced field switches, and evaluate the field between them.

The height of a switch is the difference of the operands of a comparison, or the operand of a
function such as `floor`: the switch changes where its height passes zero, or a whole number. If the
height only rises or only falls in time, a halving of the run finds the change, however short it
lasts. Any other height is called bent: its changes are searched for on a grid of times and, between
these, where the height comes closest to zero. Not seen is a bump narrower than an interval of the
grid, and two of three changes within one. The equation `height(p, t) = 0` defines the time t of a
change as an implicit function of the constants p of the field, and gives its derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.rotation.barrier import barrier
from rigidjax.solve.programs.batching import Arrays
from rigidjax.solve.programs.linear_map import with_derivatives
from rigidjax.solve.times.switching import BENT, MOST, STRAIGHT, Switches

_HALVINGS = {"float64": 62, "float32": 36}
_GRID = 4096
_CHUNK = 32  # so many times are searched for at once


class Changes(NamedTuple):
    """Hold k changes of the m elements of the switches of a field, in the time of a run."""

    times: Array  # (k,) s, with derivatives; the end of the run where nothing changes
    sizes: Array  # (k,) by how much the value of the element changes; 0 where nothing changes
    bent: Array  # the elements, as floats, of the last of these changes: those of bent heights
    first: Array  # (m,) the values of the elements at the start of the run
    over: Array  # whether there are more changes than can be stored


def _monotonic_elements(switches: Switches) -> tuple[np.ndarray, np.ndarray]:
    """Return the elements whose heights are not bent, and the numbers of their changes, from 0.

    An element of a function such as `floor` stands there `MOST` times.
    """
    kinds, leaps = switches.of_elements(lambda s: s.kind), switches.of_elements(lambda s: s.leaps)
    element = np.repeat(np.arange(kinds.size), np.where(kinds < BENT, np.where(leaps, MOST, 1), 0))
    return element, (np.arange(element.size) - np.searchsorted(element, element)).astype(float)


def find_changes(switches: Switches, consts: Arrays, t0: Array, t1: Array) -> Changes:
    """Return the changes of the switches of a field after the time t0 and until t1, s."""
    still, (begin, end) = lax.stop_gradient((consts, (t0, t1)))
    # A change within 8 units of round-off after the start counts as one before it.
    begin = begin + 8 * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(begin), jnp.abs(end - begin))
    first, last = (switches.heights_and_values(still, t)[1] for t in (begin, end))
    kinds, leaps = (
        switches.of_elements(lambda s: s.kind),
        switches.of_elements(lambda s: s.leaps) > 0,
    )
    element, number = _monotonic_elements(switches)
    rise, level = (last - first)[element], jnp.asarray(number + 0.5, t0.dtype)
    there = jnp.abs(rise) > level
    sizes = jnp.where(there, jnp.where(leaps[element], jnp.sign(rise), rise), 0)
    over = jnp.any(jnp.where((kinds < BENT) & leaps, jnp.abs(last - first) > MOST, False))
    low, high = jnp.full(element.size, begin), jnp.full(element.size, end)
    t = _bisect(switches, still, low, high, element, first[element], level)
    bent = np.flatnonzero(kinds == BENT)
    others, which = t, jnp.zeros(0, jnp.int32)
    if bent.size:
        cells = _cells_with_one_change(switches, still, begin, end, bent, others)

        def bisect(low: Array, high: Array, element: Array, value: Array) -> Array:
            return _bisect(switches, still, low, high, element, value, 0.5)

        cell = cells.low, cells.high, cells.element, cells.value
        t = jnp.concatenate([t, _in_chunks(bisect, jnp.sum(cells.change != 0), *cell)])
        sizes, which = jnp.concatenate([sizes, cells.change]), cells.element
        over = over | cells.over
        element = jnp.concatenate([element, which])
    t = _times_with_derivatives(switches, consts, t, jnp.asarray(element), sizes != 0)
    t = jnp.where(sizes != 0, t, t1)
    # A change that is not stored has no derivative: then none is known.
    t = with_derivatives(lax.stop_gradient(t), jnp.where(over, jnp.nan, 1.0).astype(t.dtype) * t)
    return Changes(t, sizes, which.astype(t.dtype), first, over)


def _at(values: Array, i: Array) -> Array:
    """Return `values[i]` by a sum, which compiles faster than an index."""
    return jnp.sum(jnp.where(np.arange(values.size) == i, values, 0))


def _bisect(
    switches: Switches,
    consts: Arrays,
    low: Array,
    high: Array,
    element: Any,
    base: Array,
    level: Any,
) -> Array:
    """Return, in each interval, the time at which the `element` differs from `base` by `level`."""
    pick = jax.vmap(lambda t, i: _at(switches.heights_and_values(consts, t)[1], i))

    def half(_: Any, ends: Any) -> Any:
        middle = ends[0] + 0.5 * (ends[1] - ends[0])
        new = jnp.abs(pick(middle, element) - base) >= level
        return jnp.where(new, ends[0], middle), jnp.where(new, middle, ends[1])

    if not low.size:
        return low
    return lax.fori_loop(0, _HALVINGS[low.dtype.name], half, (low, high))[1]


def lowest_between(
    function: Callable[[Array], Array], low: Array, high: Array, count: int | Array
) -> Array:
    """Return the times (k,) between `low` and `high` at which k functions have their minimum.

    Each of `count` steps leaves two thirds of an interval; a function has one minimum in it.
    """

    def shorter(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        third = (high - low) / 3
        falls = function(low + third) > function(high - third)
        return jnp.where(falls, low + third, low), jnp.where(falls, high, high - third)

    low, high = lax.fori_loop(0, count, shorter, (low, high))
    return 0.5 * (low + high)


def _in_chunks(function: Callable[..., Array], count: Array, *arrays: Array) -> Array:
    """Evaluate a function of the rows of arrays, of which only the first `count` are needed."""

    def body(i: Array, out: Array) -> Array:
        rows = [lax.dynamic_slice_in_dim(a, i * _CHUNK, _CHUNK) for a in arrays]
        return lax.dynamic_update_slice_in_dim(out, function(*rows), i * _CHUNK, 0)

    return lax.fori_loop(0, (count + _CHUNK - 1) // _CHUNK, body, arrays[0])


class _Cells(NamedTuple):
    """Hold intervals of time, in each of which one element changes once."""

    low: Array
    high: Array
    element: Array
    value: Array  # of the element before the change
    change: Array  # 0 where there is none; the others come first
    over: Array


def _cells_with_one_change(
    switches: Switches,
    consts: Arrays,
    begin: Array,
    end: Array,
    bent_elements: np.ndarray,
    other_times: Array,
) -> _Cells:
    """Return `MOST` cells of time, at whose ends one of the `bent_elements` has two values.

    Cells without a change come last. The grid of times contains `other_times`, at which elements of
    other heights change.
    """
    bent, m, both = (
        bent_elements,
        bent_elements.size,
        lambda t: switches.heights_and_values(consts, t),
    )
    count = _GRID if m <= 8 else max(256, 8 * _GRID // m)
    grid = begin + (end - begin) * jnp.linspace(0.0, 1.0, count, dtype=begin.dtype)
    if other_times.size:
        before = jnp.nextafter(other_times, jnp.full_like(other_times, -jnp.inf))
        grid = jnp.sort(
            jnp.concatenate([grid, jnp.clip(jnp.concatenate([other_times, before]), begin, end)])
        )
    height, value = (a[:, bent] for a in jax.vmap(both)(grid))
    # Between two times an element may change twice, near its closest approach to zero.
    left, middle, right = jnp.abs(height[:-2]), jnp.abs(height[1:-1]), jnp.abs(height[2:])
    depth = jnp.maximum(left, right) - middle
    near = (middle <= left) & (middle <= right) & (middle <= depth) & (depth > 0)
    near &= (value[1:-1] == value[:-2]) & (value[1:-1] == value[2:])
    distance = jnp.where(near, middle / depth, jnp.inf).ravel()
    nearness, cell = lax.top_k(-distance.astype(jnp.float32), MOST)
    row, which = cell // m, cell % m
    side = jnp.sign(height[row + 1, which])
    pick = jax.vmap(lambda t, i, side: side * _at(both(t)[0], i))

    def closest(low: Array, high: Array, element: Array, side: Array) -> Array:
        count = _HALVINGS[low.dtype.name]
        return lowest_between(lambda t: pick(t, element, side), low, high, count)

    low, high = grid[row], grid[row + 2]
    dips = jnp.sum(jnp.isfinite(nearness))
    at = _in_chunks(closest, dips, low, high, jnp.asarray(bent)[which], side)
    there = jnp.arange(MOST) < dips
    value_at = jax.vmap(lambda t, i: _at(both(t)[1], i))(at, jnp.asarray(bent)[which])
    twice = jnp.where(there, value_at - value[row, which], 0)
    changes = jnp.concatenate([(value[1:] - value[:-1]).ravel(), twice, -twice])
    index = lax.top_k((changes != 0).astype(jnp.float32), MOST)[1]
    cells = [jnp.repeat(a, m) for a in (grid[:-1], grid[1:])]
    element = jnp.concatenate([jnp.tile(bent, grid.size - 1), *[jnp.asarray(bent)[which]] * 2])
    before = jnp.concatenate([value[:-1].ravel(), value[row, which], value_at])
    lows, highs = jnp.concatenate([cells[0], low, at]), jnp.concatenate([cells[1], at, high])
    leaps = np.flatnonzero(switches.of_elements(lambda s: s.leaps)[bent])
    over = (jnp.sum(changes != 0) > MOST) | (jnp.sum(near) > MOST)
    over |= jnp.any(jnp.abs(value[1:, leaps] - value[:-1, leaps]) > 1)
    return _Cells(lows[index], highs[index], element[index], before[index], changes[index], over)


def _times_with_derivatives(
    switches: Switches, consts: Arrays, t: Array, element: Array, is_change: Array
) -> Array:
    """Return the times t of changes with derivatives by `consts`, where there `is_change`.

    A step of Newton's method leaves the times as they are, and makes the derivatives of one more
    order right.
    """
    height = jax.vmap(
        lambda c, t, i: _at(switches.heights_and_values(c, t)[0], i), in_axes=(None, 0, 0)
    )
    sloped = lambda c, t: jax.jvp(lambda t: height(c, t, element), (t,), (jnp.ones_like(t),))  # noqa: E731
    straight = switches.of_elements(lambda s: s.kind <= STRAIGHT) > 0
    moves, at, eps = is_change, t, jnp.finfo(t.dtype).eps
    if not straight.all():
        # At a pole, or at the end of the numbers with a result, the height is taken beside it.
        still = lax.stop_gradient(consts)
        unit = 8 * eps * jnp.maximum(jnp.abs(t), jnp.max(jnp.abs(t)) / 16)
        beside = jnp.stack([t, t - unit, t + unit])
        h, slope = jax.vmap(lambda t: sloped(still, t))(beside)
        use = jnp.argmax(jnp.isfinite(h) & jnp.isfinite(slope), 0)[None]
        here, rate, beside = (jnp.take_along_axis(a, use, 0)[0] for a in (h, slope, beside))

        def close(a: Array, b: Array, rate: Array) -> Array:
            return jnp.abs(a - b) <= 64 * (2 * unit * jnp.abs(rate) + eps * (1 + jnp.abs(a)))

        # Where an operand jumps, the height jumps over zero, and its zero is not the time.
        passes = close(h[1], h[2], rate) | close(1 / h[1], 1 / h[2], rate / here**2)
        passes |= jnp.asarray(straight | (switches.of_elements(lambda s: s.asks_for_nan) > 0))[
            element
        ]
        moves = is_change & passes & jnp.isfinite(rate)
        at = jnp.where(moves, beside, t)
    moved = jnp.zeros_like(t)
    for _ in range(1 if straight.all() else 2):
        here, slope = sloped(consts, at + moved)
        moves = moves & (slope != 0)
        step = (here - lax.stop_gradient(here)) / jnp.where(moves, slope, 1)
        moved = moved - jnp.where(moves, step, 0)
    t = t + moved
    if not straight.all():  # the time of a jump of an operand is that of another change
        t, known = barrier((t, jnp.where(moves, lax.stop_gradient(t), jnp.inf)))
        apart = jnp.abs(known[None] - lax.stop_gradient(t)[:, None])
        same = apart <= 8 * eps * jnp.abs(lax.stop_gradient(t))[:, None]
        count = jnp.sum(same, 1, dtype=t.dtype)
        mean = jnp.sum(jnp.where(same, t[None], 0), 1) / jnp.maximum(count, 1)
        t = jnp.where(~moves & (count > 0), mean, t)
    return t


def values_between(switches: Switches, changes: Changes, stops: Array, t: Array) -> Array:
    """Return the values (m,) at the time t, after the changes whose `stops` (k,) it passed."""
    element, number = _monotonic_elements(switches)
    sizes = jnp.where(t >= stops, changes.sizes, 0)
    plain, bent = sizes[: element.size], sizes[element.size :]
    values = changes.first
    if number.any():
        own = element[None] == np.arange(values.size)[:, None]
        values = values + jnp.sum(jnp.where(own, plain[None], 0), 1)
    elif element.size:
        values = values.at[element].add(plain) if element.size < values.size else values + plain
    if bent.size:
        own = changes.bent[None] == np.arange(values.size, dtype=bent.dtype)[:, None]
        values = values + jnp.sum(jnp.where(own, bent[None], 0), 1)
    return values


def separate_equal_times(times: Array, t0: Array, t1: Array) -> tuple[Array, Array]:
    """Return the times at which steps end (stops), in order, with equal times moved slightly apart.

    Two stops at the same time are moved apart by some units of round-off. Between two jumps at the
    same time the run then takes a very short step, so that each jump time has its own derivative.

    Times outside of the run become its start or its end. The second result is the stop (k,) of each
    of the `times`.
    """
    inside = (times > t0) & (times < t1)
    t = jnp.where(inside, times, jnp.where(times <= t0, t0, t1))
    still, last = lax.stop_gradient((t, t1))
    count, order = np.arange(t.shape[0]), jnp.argsort(still)
    t, inside = t[order], inside[order]
    still = lax.stop_gradient(t)
    gap = 4 * jnp.finfo(t.dtype).eps * lax.stop_gradient(jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    shift = gap * count.astype(t.dtype)
    pushed = lax.cummax(jnp.where(inside, still - shift, -jnp.inf)) + shift
    apart = jnp.where(inside, jnp.maximum(still, jnp.minimum(pushed, last)), still)
    t = t + (apart - still)
    return t, t[jnp.argsort(order)]
