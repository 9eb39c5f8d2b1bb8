"""Locate the times at which a traced field switches, and evaluate the field between them.

A switch is an equation of the field, such as the comparison `t < 1`, whose result changes at times
that do not depend on the state. Its switching function g is the difference of its operands. If g
only rises or only falls in time, the switch changes once. The time of this change is found by
halving the interval from the start to the end of the run. Any other switch is called bent. Its
changes are searched for on a grid of times, and also between grid points, where g comes closest to
zero. The equation `g(p, t) = 0` defines the time t of each change as an implicit function of the
constants p of the field, and gives the derivatives of this time.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve.batching import Arrays
from rigidjax.solve.switching import (
    BENT,
    COMPARISONS,
    KINKS,
    MONOTONE,
    MOST,
    NEAR,
    STRAIGHT,
    Analysis,
    Program,
    Switch,
    evaluator,
)

_HALVINGS = {"float64": 62, "float32": 36}
# The changes of a switch whose switching function may rise and fall are searched for on a grid of
# times. For a switch of one element the grid has about this many times; for a switch of several
# elements it has fewer.
_GRID = 4096


def _switching_function_of_operands(
    switch: Switch, first_operand: Any, *others_and_result: Any
) -> Array:
    """Return the switching function of each element of a switch, which shows where it changes.

    A switch is an equation, such as the comparison `t < 1`, whose result changes at certain times.
    The switching function is the difference of its two operands, here t − 1, and the result changes
    where this function is zero. Other equations have other switching functions:

    - `clamp` has two: the differences between its number and the two bounds.
    - For `abs` and `sign` it is the operand.
    - For functions such as `floor` it is the operand, and for `rem` it is the quotient of the two
      operands. The result changes where the switching function passes a whole number.

    **Arguments:**

    - `switch`: the equation.
    - `first_operand`: its first operand.
    - `others_and_result`: its other operands, followed by its result.

    **Returns** an array (m,), with one number for each of the m elements, such as those of a
    comparison of arrays.
    """
    name, x, rest = switch.equation.primitive_name, first_operand, others_and_result
    if name == "clamp":
        return jnp.concatenate([jnp.ravel(rest[0] - x), jnp.ravel(rest[0] - rest[1])])
    if name == "searchsorted":
        return jnp.ravel(x - rest[0])
    if name in COMPARISONS | {"max", "min"}:
        return jnp.ravel(x - rest[0])
    return jnp.ravel(x / rest[0] if name == "rem" else x)


def _piecewise_constant_value(switch: Switch, first_operand: Any, *others_and_result: Any) -> Array:
    """Return for each element of a switch a value that is constant in time, but for the times at
    which the element switches.

    - `switch`: the equation, such as the comparison `t < 1`.
    - `first_operand`: its first operand.
    - `others_and_result`: its other operands, followed by its result.

    **Returns** an array (m,), with one value for each of the m elements, such as those of a
    comparison of arrays. The value is the result of the equation, with three exceptions. For `rem`
    it is the whole part of the quotient of the operands. For `searchsorted`, and for operations
    with a kink, such as `max`, it is whether the switching function is positive. The switching
    function is the difference of the operands or, for `abs`, the operand.
    """
    name, x, rest = switch.equation.primitive_name, first_operand, others_and_result
    if name in KINKS | {"searchsorted"}:
        return _switching_function_of_operands(switch, x, *rest) > 0
    return jnp.ravel(jnp.trunc(x / rest[0]) if name == "rem" else rest[-1])


class SwitchingTimes(NamedTuple):
    """Hold the times at which the switches of a field may change, in k places.

    A switch is an equation, such as the comparison `t < 1`, whose result changes at certain times.
    Each place stores one change of one element of one switch.
    """

    times: Array  # (k,) s, with derivatives; the end of the run at a place where nothing changes
    element: Array  # (k,) the index of the element that changes
    change: Array  # (k,) the change of the element's value, 0 at a place where nothing changes
    first: Arrays  # for each switch, the values of its elements at the start of the run
    # For each switch, its result at the start of the run if it is a `searchsorted`, else an empty
    # array.
    outputs: Arrays
    over: Array  # whether an element changes more often than it has places


class _TimedSwitch(NamedTuple):
    """Evaluate the elements of a switch at any time; a switch is an equation such as `t < 1`.

    A comparison of arrays, for example, has several elements, each of which changes at times of its
    own.

    - `program`: the program that contains the equation.
    - `switch`: the equation.
    - `constants`: the constants of the program.
    """

    program: Program
    switch: Switch
    constants: Arrays

    @property
    def with_fixed_constants(self) -> "_TimedSwitch":
        """Return this switch, with constants of its program that have no derivatives."""
        return self._replace(constants=lax.stop_gradient(self.constants))

    def operands_and_result(self, t: Array) -> list[Any]:
        """Return the operands of the switch, followed by its result, at one time `t`, s.

        The switch is an equation of the program, such as the comparison `t < 1`.
        """
        equation = self.switch.equation
        wanted = [*equation.inputs, equation.outputs[0]]
        return evaluator(self.program, wanted)(self.constants, t)

    def element_values(self, t: Array) -> Array:
        """Return the values (m,) of the m elements of the switch at one time `t`, s, as floats.

        The value of an element, such as 0 or 1 for a comparison, is constant except where the
        element changes.
        """
        return _piecewise_constant_value(self.switch, *self.operands_and_result(t)).astype(t.dtype)

    def switching_functions(self, t: Array) -> Array:
        """Return the switching functions (m,) of the m elements of the switch at one time `t`, s.

        For a comparison the switching function is the difference of the operands, and the element
        changes where this function is zero. For a function such as `floor` it is the operand, and
        the element changes where the operand passes a whole number.
        """
        return _switching_function_of_operands(self.switch, *self.operands_and_result(t)).astype(
            t.dtype
        )

    def values_of_one_element(self, t: Array, element: Array | np.ndarray) -> Array:
        """Return the value of an element of the switch at each of k times, an array (k,).

        The value of an element, such as 0 or 1 for a comparison, is constant except where the
        element changes.

        - `t`: (k,) s, the times.
        - `element`: (k,) for each time, the index of the element.
        """
        return self._at_each_time(self.element_values, t, element)

    def switching_function_of_one_element(self, t: Array, element: Array | np.ndarray) -> Array:
        """Return the switching function of an element of the switch at each of k times, (k,).

        For a comparison the switching function is the difference of the operands, and the element
        changes where this function is zero. For a function such as `floor` it is the operand, and
        the element changes where the operand passes a whole number.

        - `t`: (k,) s, the times.
        - `element`: (k,) for each time, the index of the element.
        """
        return self._at_each_time(self.switching_functions, t, element)

    def _at_each_time(
        self, function: Callable[[Array], Array], t: Array, element: Array | np.ndarray
    ) -> Array:
        """Return the number that a function has for one element, at each of k times: an array (k,).

        - `function`: a function of one time that returns one number for each element of the switch.
        - `t`: (k,) s, the times.
        - `element`: (k,) for each time, the index of the element whose number is returned.
        """
        if self.switch.size == 1:
            return jax.vmap(lambda t: function(t).reshape(()))(t)
        return jax.vmap(lambda t, i: function(t)[i])(t, element)


# Four arrays for one switch, which has k places to store changes: the times (k,) of the changes;
# the elements (k,) that change; the changes (k,) of their values; and whether there are so many
# changes that some are missing.
_ChangesOfSwitch = tuple[Array, Array, Array, Array]


def find_switching_times(
    analysis: Analysis, constants: Arrays, t0: Array, t1: Array
) -> SwitchingTimes:
    """Return the times after t0 and until t1, s, at which the switches of a field change.

    A switch is an equation, such as the comparison `t < 1`, whose result changes at certain times.
    The times have derivatives with respect to the constants.

    - `analysis`: the program of the field, and its switches.
    - `constants`: the constants of this program.
    - `t0`, `t1`: the start and the end of the run, s.
    """
    start, end = lax.stop_gradient((t0, t1))
    # If a switch changes within 8 units of round-off after the start, it is treated as if it had
    # changed before the start.
    start = start + 8 * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(start), jnp.abs(end - start))
    timed_switches = [_TimedSwitch(analysis.program, s, constants) for s in analysis.switches]
    others = [_TimedSwitch(analysis.program, s, constants) for s in analysis.kinks]
    steady = [one for one in timed_switches + others if one.switch.time_dependence <= MONOTONE]
    found = _times_of_monotonic_switches(steady, start, end)
    known = [places[0] for places in found]
    parts: list[_ChangesOfSwitch] = []
    for one in timed_switches:
        if one.switch.time_dependence == BENT:
            parts.append(_times_of_nonmonotonic_switch(one, start, end, known))
            known.append(parts[-1][0])
        else:
            parts.append(found.pop(0))
    t, element, change = (jnp.concatenate([part[i] for part in parts]) for i in range(3))
    over = jnp.any(jnp.stack([part[3] for part in parts]))
    first = [one.with_fixed_constants.element_values(start) for one in timed_switches]
    outputs = [
        one.with_fixed_constants.operands_and_result(start)[-1]
        if one.switch.equation.primitive_name == "searchsorted"
        else start[None][:0]
        for one in timed_switches
    ]
    return SwitchingTimes(jnp.where(t < end, t, t1), element, change, first, outputs, over)


def _times_of_monotonic_switches(
    timed_switches: list[_TimedSwitch], start: Array, end: Array
) -> list[_ChangesOfSwitch]:
    """Return the times at which monotonic switches change.

    A switch is an equation, such as the comparison `t < 1`, with one or more elements. Its
    switching function is here t − 1. The result changes where the switching function is zero or,
    for functions such as `floor`, where the switching function passes a whole number. A switch is
    monotonic if its switching function only rises or only falls in time.

    - `timed_switches`: the switches.
    - `start`, `end`: the times between which changes are searched for, s.

    **Returns** for each switch four things: k times (k,), s; the elements (k,) that change at these
    times; the changes (k,) of the values of these elements, 0 at a time at which nothing changes;
    and whether some changes are missing, because an element changes more often than can be stored.
    """
    starts, rises, elements, levels = [], [], [], []
    for one in timed_switches:
        element, level = (
            np.ravel(a)
            for a in np.mgrid[: one.switch.size, 1 : one.switch.most_changes_if_monotonic + 1]
        )
        first, last = (
            one.with_fixed_constants.element_values(start),
            one.with_fixed_constants.element_values(end),
        )
        starts, rises = [*starts, first[element]], [*rises, last - first]
        elements, levels = [*elements, element], [*levels, level.astype(start.dtype)]
    edges = [(jnp.full(a.shape, start), jnp.full(a.shape, end)) for a in elements]
    found = _bisect(timed_switches, edges, elements, starts, levels)
    parts = []
    for one, t, element, level, change in zip(
        timed_switches, found, elements, levels, rises, strict=True
    ):
        rise, most = change[element], one.switch.most_changes_if_monotonic
        there = jnp.abs(rise) >= level
        t, _ = _differentiable_times(one, jnp.where(there, t, end), element, there)
        over = jnp.any(jnp.abs(change) > most) & (most > 1)
        change = jnp.where(there, rise if most == 1 else jnp.sign(rise), 0)
        parts.append((t, jnp.asarray(element, jnp.int32), change, over))
    return parts


def _times_of_nonmonotonic_switch(
    timed_switch: _TimedSwitch, start: Array, end: Array, other_times: list[Array]
) -> _ChangesOfSwitch:
    """Return the times at which a nonmonotonic switch changes.

    A switch is an equation, such as the comparison `t < 1`, with one or more elements. Its
    switching function is here t − 1. The result changes where the switching function is zero or,
    for functions such as `floor`, where the switching function passes a whole number. A switch is
    nonmonotonic if its switching function may rise and fall. The changes are searched for on a grid
    of times.

    - `timed_switch`: the switch.
    - `start`, `end`: the times between which changes are searched for, s.
    - `other_times`: arrays of times, s, at which other switches change. The grid includes these
      times.

    **Returns** four things: k times (k,), s; the elements (k,) that change at these times; the
    changes (k,) of the values of these elements, 0 at a time at which nothing changes; and whether
    there are more than 64 changes on the grid, so that some are missing.
    """
    before = jnp.concatenate(other_times) if other_times else jnp.zeros(0, start.dtype)
    low, high, element, over = _intervals_with_one_change(
        timed_switch.with_fixed_constants, start, end, lax.stop_gradient(before)
    )
    base = timed_switch.with_fixed_constants.values_of_one_element(low, element)
    level = np.full(low.shape, 0.5, start.dtype)
    (t,) = _bisect([timed_switch], [(low, high)], [element], [base], [level])
    value = timed_switch.with_fixed_constants.values_of_one_element(t, element)
    there = value != base
    t, moves = _differentiable_times(timed_switch, jnp.where(there, t, end), element, there)
    if other_times:
        # If the switch changes because an operand jumps, the time of the change is the time at
        # which the operand jumps. This is one of the `other_times`. It replaces the time that was
        # found here, because it may have derivatives.
        near, still = jnp.argmin(jnp.abs(before[None] - t[:, None]), 1), lax.stop_gradient(t)
        same = jnp.abs(before[near] - still) <= 8 * jnp.finfo(t.dtype).eps * jnp.abs(still)
        t = jnp.where(there & ~moves & same, before[near], t)
    return t, element, jnp.where(there, value - base, 0), over


def _intervals_with_one_change(
    timed_switch: _TimedSwitch, start: Array, end: Array, other_times: Array
) -> tuple[Array, ...]:
    """Return k intervals of time, in each of which one element of a switch changes at most once.

    - `timed_switch`: the switch, an equation such as the comparison `t < 1`.
    - `start`, `end`: the times between which changes are searched for on a grid, s.
    - `other_times`: (j,) s, times at which other switches change. The grid includes these times.

    **Returns** four things: the starts (k,) of the intervals, s; the ends (k,) of the intervals, s;
    for each interval the index (k,) of the element; and whether the grid shows more than 64
    changes, so that some changes are in no interval.
    """
    size, dtype = timed_switch.switch.size, start.dtype
    grid = start + (end - start) * jnp.linspace(0.0, 1.0, max(256, _GRID // size), dtype=dtype)
    if other_times.shape[0]:
        beside = jnp.nextafter(other_times, jnp.full_like(other_times, -jnp.inf))
        grid = jnp.sort(
            jnp.concatenate([grid, jnp.clip(jnp.stack([other_times, beside]), start, end).ravel()])
        )
    value = jax.vmap(timed_switch.element_values)(grid)
    height = jax.vmap(timed_switch.switching_functions)(grid)
    changes = jnp.ravel(value[1:] != value[:-1])
    many = jnp.sum(changes)
    # `top_k` finds the first changes; `nonzero` would take five times as long to compile.
    _, cell = lax.top_k(changes.astype(jnp.int32), MOST)
    row, element = cell // size, cell % size
    low = grid[row]
    high = jnp.where(jnp.arange(MOST) < many, grid[row + 1], low)
    # Between two points of the grid an element may change twice, near the time at which its
    # switching function comes closest to zero. This time is searched for below. It divides the
    # interval into two, each with at most one change.
    middle, sides = jnp.abs(height[1:-1]), jnp.stack([jnp.abs(height[:-2]), jnp.abs(height[2:])])
    calm = (
        (value[1:-1] == value[:-2]) & (value[1:-1] == value[2:]) & jnp.all(middle[None] <= sides, 0)
    )
    depth = jnp.max(sides, 0) - middle + jnp.finfo(dtype).tiny
    nearness, cell = lax.top_k(-jnp.ravel(jnp.where(calm, middle / depth, jnp.inf)), NEAR)
    row, which = cell // size, cell % size
    left = grid[row]
    right = jnp.where(jnp.isfinite(nearness), grid[row + 2], left)
    sign = jnp.sign(height[row + 1, which])

    def shorter(_: Any, ends: Any) -> Any:
        left, right = ends
        third = (right - left) / 3
        ends = (
            timed_switch.switching_function_of_one_element(t, which)
            for t in (left + third, right - third)
        )
        falls = sign * next(ends) > sign * next(ends)
        return jnp.where(falls, left + third, left), jnp.where(falls, right, right - third)

    a, b = lax.fori_loop(0, _HALVINGS[dtype.name], shorter, (left, right))
    lowest = 0.5 * (a + b)
    low, high = jnp.concatenate([low, left, lowest]), jnp.concatenate([high, lowest, right])
    return low, high, jnp.concatenate([element, which, which]), many > MOST


def _bisect(
    timed_switches: list[_TimedSwitch],
    edges: list[tuple[Array, Array]],
    elements: Sequence[Array | np.ndarray],
    bases: list[Array],
    levels: Sequence[Array | np.ndarray],
) -> list[Array]:
    """Return for each switch the times at which its elements change, found by halving intervals.

    A switch is an equation of a traced program, such as `b = t < 1`, whose result jumps in time. It
    may have several elements, such as those of a comparison of arrays. Each of the following lists
    has one entry for each switch, with arrays for k intervals of this switch:

    - `timed_switches`: the switches.
    - `edges`: the starts (k,) and the ends (k,) of the intervals, s.
    - `elements`: the indices (k,) of the elements.
    - `bases`: the values (k,) of these elements before the change.
    - `levels`: the sizes (k,) of the changes: an element has changed when its value differs from
      its base by at least its level.

    **Returns** a list with one array (k,), s, for each switch: the times of the changes in its k
    intervals. If nothing changes in an interval, the time is the end of the interval.
    """

    def half(_: Any, edges: Any) -> Any:
        halves = []
        for one, (low, high), element, base, level in zip(
            timed_switches, edges, elements, bases, levels, strict=True
        ):
            middle = low + 0.5 * (high - low)
            new = (
                jnp.abs(one.with_fixed_constants.values_of_one_element(middle, element) - base)
                >= level
            )
            halves.append((jnp.where(new, low, middle), jnp.where(new, middle, high)))
        return halves

    if not timed_switches:
        return []
    edges = lax.stop_gradient(edges)
    count = _HALVINGS[edges[0][0].dtype.name]
    return [high for _, high in lax.fori_loop(0, count, half, edges)]


def _differentiable_times(
    timed_switch: _TimedSwitch, t: Array, element: Array | np.ndarray, has_change: Array
) -> tuple[Array, Array]:
    """Return the times at which elements of a switch change, with their derivatives.

    A switch is an equation, such as the comparison `t < 1`. Its switching function, here t − 1, has
    a fixed value at these times: zero or, for functions such as `floor`, a whole number. The times
    are therefore implicit functions of the constants of the field.

    - `timed_switch`: the switch.
    - `t`: (k,) s, the times, without derivatives.
    - `element`: (k,) the index of the element that changes at each time.
    - `has_change`: (k,), true for a time at which a change was found. Where none was found, the
      time is only the end of the interval that was searched.

    **Returns** two things: the times (k,), s; and for each time whether it has derivatives. A time
    has no derivatives if the slope of the switching function is zero at this time, or if the
    switching function jumps there because an operand jumps.
    """
    degree = timed_switch.switch.time_dependence
    still, moves, slope, here = (
        lax.stop_gradient(t),
        has_change,
        jnp.zeros_like(t),
        jnp.zeros_like(t),
    )
    t = still
    # Each of these steps of Newton's method leaves the values of `t` as they are, and makes
    # derivatives of one more order correct.
    for _ in range(1 if degree == STRAIGHT else 2):
        g = lambda t: timed_switch.switching_function_of_one_element(t, element)  # noqa: E731
        here, slope = jax.jvp(g, (t,), (jnp.ones_like(t),))
        moves = moves & jnp.isfinite(slope) & (slope != 0)
        rise = here - lax.stop_gradient(here)
        t = t - jnp.where(moves, rise / jnp.where(moves, slope, 1), 0)
    if degree == BENT:
        # If the switch changes because an operand jumps, the switching function jumps over zero.
        # The equation "switching function = 0" then does not define the time of the change, which
        # gets no derivatives. A jump is recognised by the value of the switching function at the
        # time `beside`, just before the change.
        beside = jnp.nextafter(still, jnp.full_like(still, -jnp.inf))
        step, eps = jnp.abs(slope) * (still - beside), jnp.finfo(t.dtype).eps
        jump = jnp.abs(here - timed_switch.switching_function_of_one_element(beside, element))
        moves = moves & (jump <= 64 * (step + eps * (1 + jnp.abs(here))))
    return t, moves


class _ResultFromStops(NamedTuple):
    """Compute the result of a switch by counting which stops the run has passed.

    A switch is an equation: a comparison, such as `t < 1`, or a function such as `floor`. The stops
    are the times at which steps end because the result of the equation changes there.
    """

    switch: Switch
    number: int  # the index of the switch in the analysis
    places: slice  # the places of the switch in `SwitchingTimes`

    @property
    def needed_inputs(self) -> list[Any]:
        """Return those inputs of the switch, an equation, whose values the method `result` reads.

        If the stops that the run has passed are enough to give the result, the list is empty.
        """
        return [] if self.switch.stores_all_changes else self.switch.equation.inputs

    def result(self, read_input: Callable[[Any], Any], field_arguments: tuple[Any, ...]) -> Array:
        """Return the result of the equation at a time, by the stops that are not after this time.

        - `read_input`: a function that returns the value of an input of the equation.
        - `field_arguments`: the arguments of the field. The first is the time, s. The last is a
          pair of two things: the stops, s, and the `SwitchingTimes`, which say by how much the
          result changes at each stop.
        """
        equation, (stops, found) = self.switch.equation, field_arguments[-1]
        past = field_arguments[0] >= stops[self.places]
        steps, size = jnp.where(past, found.change[self.places], 0), self.switch.size
        if self.switch.time_dependence < BENT:
            steps = steps.reshape(size, -1)
        else:
            element = found.element[self.places][None]
            own = element == np.arange(size, dtype=element.dtype)[:, None]
            steps = jnp.where(own, steps[None], 0)
        steps = jnp.sum(steps, 1)
        here, out = found.first[self.number] + steps, equation.shapes[0]
        if equation.primitive_name == "searchsorted":
            return (found.outputs[self.number] - jnp.sum(steps)).astype(out.dtype)
        operands = [read_input(i) for i in self.needed_inputs]
        if equation.primitive_name in COMPARISONS:
            here = here > 0.5
        if equation.primitive_name == "rem":
            x, y = operands
            here = x - y * here.reshape(out.shape).astype(x.dtype)
        here = here.reshape(out.shape).astype(out.dtype)
        if self.switch.stores_all_changes:
            return here
        params = equation.primitive.get_bind_params(equation.params)
        return jnp.where(found.over > 0, equation.primitive.bind(*operands, **params), here)


def replace_comparisons_by_stops(analysis: Analysis) -> Callable[..., Array]:
    """Return a vector field whose comparisons with the time are replaced by stops.

    The stops are the times at which the results of these comparisons change; steps end at the
    stops. The result of a comparison then follows from the stops that the run has passed.

    - `analysis`: the program of the field, and its switches, which are these comparisons.

    **Returns** the field as a function `f(constants, t, y, …, (stops, times))`. Its last argument
    is a pair of the stops, s, and the `SwitchingTimes`.
    """
    replaced, begin = {}, 0
    for number, switch in enumerate(analysis.switches):
        if switch.jumps:
            places = slice(begin, begin + switch.storable_changes)
            replaced[switch.equation.outputs[0]] = _ResultFromStops(switch, number, places)
        begin += switch.storable_changes
    evaluate = evaluator(analysis.program, [analysis.program.output], replaced)
    return lambda constants, *inputs: evaluate(constants, *inputs)[0]


def separate_equal_times(times: Array, t0: Array, t1: Array) -> tuple[Array, Array]:
    """Return the times at which steps end (stops), in order, with equal times moved slightly apart.

    Two stops at the same time are moved apart by some units of round-off. Between two jumps at the
    same time the run then takes a very short step, so that each jump time has its own derivative.

    - `times`: (k,) s, the times of jumps, in any order.
    - `t0`, `t1`: the start and the end of the run, s. A time outside of the run is replaced by the
      nearer of the two.

    **Returns** two things: the stops (k,), s, in order; and an array (k,), s, with the stop that
    belongs to each of the `times`.
    """
    inside = (times > t0) & (times < t1)
    t = jnp.where(inside, times, jnp.where(times <= t0, t0, t1))
    still, last = lax.stop_gradient((t, t1))
    count = np.arange(t.shape[0])
    # The times are put in order by their ranks. `earlier` compares all pairs of times, which is
    # faster than sorting for so few times.
    earlier = still[None] < still[:, None]
    earlier = earlier | ((still[None] == still[:, None]) & (count[None] < count[:, None]))
    rank = jnp.sum(earlier, 1)
    here = rank[None] == count[:, None]
    ordered = lambda a: jnp.sum(jnp.where(here, a[None], 0), 1)  # noqa: E731
    t = ordered(t)
    still, inside = lax.stop_gradient(t), ordered(inside.astype(t.dtype)) > 0
    gap = 4 * jnp.finfo(t.dtype).eps * lax.stop_gradient(jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    shift = gap * count.astype(t.dtype)
    pushed = lax.cummax(jnp.where(inside, still - shift, -jnp.inf)) + shift
    apart = jnp.where(inside, jnp.maximum(still, jnp.minimum(pushed, last)), still)
    t = t + (apart - still)
    return t, t[rank]
