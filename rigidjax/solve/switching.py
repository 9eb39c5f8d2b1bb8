"""Find the times at which a vector field switches by the time, from its traced program.

A law of one's own such as `jnp.where(t < self.te, push, 0.0)` declares no `jump_times`. The program
of the field holds its comparison; if that depends on the time and on no state, the times at which
it changes are found before the run by halving, however short a firing is: a comparison of straight
lines in time, or of what only rises or only falls, changes once. The steps of the run end there.
In the run each such comparison is replaced by the side of its stops that a step is on, so that no
rounding decides it, and of two that change at the same time each has its own side. The derivative
of a switching time is that of the implicit function `gap(p, t) = 0`.
"""

import os
import warnings
from collections.abc import Callable, Iterator
from itertools import count, pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jax.extend.source_info_util import summarize
from jaxtyping import Array

from rigidjax.solve.batching import Arrays

# The scope of a part that declares its jumps: no switch is looked for in it.
DECLARED = "rigidjax_declared_jumps"
_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep

# Primitives whose result changes where the first operand meets the second, where it meets zero, and
# where it meets another whole number.
_COMPARISONS = {"lt", "le", "gt", "ge", "lt_to", "le_to"}
_LEVELS = {"floor", "ceil", "round", "convert_element_type", "rem"}
# The ones whose result has a kink there.
_KINKS = {"max", "min", "abs", "clamp"}
# Primitives that choose by a comparison of elements, those that nothing is known of, and the ones
# whose result varies between its jumps.
_CHOICES = {"argmax", "argmin", "sort", "top_k", "bitcast_convert_type", "nextafter"}
_OPAQUE = {"pure_callback", "io_callback", "custom_call", "ffi_call"}
_SAWS = {"rem", "atan2", "sort", "top_k", "nextafter"}
# Calls whose body becomes part of the program; and calls that stay whole, whose body is looked at.
_CALLS = {"jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2"}
_WHOLE = {"cond", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}
# Primitives that are linear in all operands, or in either of two.
_LINEAR = {
    "add", "sub", "add_any", "neg", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze",
    "slice", "transpose", "rev", "concatenate", "reduce_sum", "cumsum", "expand_dims",
    "convert_element_type", "stop_gradient", "optimization_barrier", "gather", "dynamic_slice",
}  # fmt: skip
_PRODUCTS = {"mul", "dot_general"}
# Functions of one operand that rise or fall everywhere.
_MONOTONE = {
    "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "tanh", "logistic", "erf", "sinh",
    "asinh", "atan",
}  # fmt: skip
# How a value depends on the time: not; in constant pieces, which change only where another value
# does; in a straight line; by rising or falling only; otherwise.
CONSTANT, PIECES, STRAIGHT, MONOTONE, BENT = range(5)

MOST = 64  # times of one law, and of one rounding
_FEW = 32  # a comparison of more elements is a table
_FEW_KINKS = 3  # more kinks in one operation cost more steps than they save
_HALVINGS = {"float64": 62, "float32": 36}
_GRID = 4096  # points of the search for a switch that is bent in time
_NEAR = 16  # places at which it is looked for between them


class Node(NamedTuple):
    """An equation of a flat program: its values have numbers, its inputs are these or literals."""

    primitive: Any
    params: dict[str, Any]
    inputs: list[Any]
    outputs: list[int]
    kinds: list[Any]  # the dtype of each input
    shapes: list[Any]  # of the outputs
    source: Any
    declared: bool  # whether it belongs to a part that declares its jumps

    @property
    def name(self) -> str:
        """The primitive's name; that of the function for a call of `searchsorted`."""
        return _name(self)


class Program(NamedTuple):
    """A function f(t, y, …) as a flat list of equations: value 0 is the time, value 1 the state."""

    nodes: list[Node]
    constants: list[int]
    inner: dict[int, Any]  # the constants of inner calls
    inputs: list[int]
    output: Any


class Switch(NamedTuple):
    """An equation whose result changes at once, or has a kink, at times that no state decides."""

    node: Node
    degree: int
    size: int  # of the elements that are compared
    jumps: bool

    @property
    def most(self) -> int:
        """The number of times at which one element may change, if it only rises or falls."""
        return MOST if self.node.name in _LEVELS else 1

    @property
    def places(self) -> int:
        """The number of changes that are looked for."""
        return MOST + 2 * _NEAR if self.degree == BENT else self.size * self.most

    @property
    def exact(self) -> bool:
        """Whether no element can change more often than is looked for."""
        return self.degree < BENT and self.most == 1

    @property
    def line(self) -> str:
        """The primitive and the user's line that wrote the equation."""
        return f"{self.node.name}, {summarize(self.node.source)}"


class Analysis(NamedTuple):
    """The `switches` of a program, the lines that switch by the state, and those not understood.

    `kinks` are too many for steps to end at each, and serve the search for bent switches.
    """

    program: Program
    switches: list[Switch]
    kinks: list[Switch]
    by_state: list[str]
    unseen: list[str]


def _bodies(params: dict[str, Any]) -> Iterator[tuple[Any, Any]]:
    """Yield each program among the parameters of an equation, with its constants."""
    for value in params.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            if isinstance(part, ClosedJaxpr):
                yield part.jaxpr, part.consts
            elif isinstance(part, Jaxpr):
                yield part, ()


def _name(eqn: Any) -> str:
    called = eqn.params.get("name")
    return "searchsorted" if called == "searchsorted" else eqn.primitive.name


def _kinds(eqn: Any) -> list[Any]:
    return [atom.aval.dtype for atom in eqn.invars if hasattr(atom.aval, "dtype")]


def _is_float(kind: Any) -> bool:
    return jnp.issubdtype(kind, jnp.floating)


def _jumps(name: str, params: dict[str, Any], kinds: list[Any]) -> bool:
    """Return whether the result of an equation jumps where its floating operands do not."""
    if not kinds or not _is_float(kinds[0]):
        return False
    if name == "convert_element_type":
        return not _is_float(params["new_dtype"])
    return name in _COMPARISONS | _LEVELS | _CHOICES | {"sign", "atan2", "searchsorted"}


def _bends(name: str, kinds: list[Any]) -> bool:
    """Return whether the result of an equation has a kink where its floating operands have none."""
    return bool(kinds) and _is_float(kinds[-1]) and name in _KINKS


def _any_switch(jaxpr: Any, bent: bool = False) -> bool:
    """Return whether a program, or one within it, holds a jump, or if `bent` a kink."""
    for eqn in jaxpr.eqns:
        name, kinds = _name(eqn), _kinds(eqn)
        if _jumps(name, eqn.params, kinds) or (bent and _bends(name, kinds)) or name in _OPAQUE:
            return True
        if any(_any_switch(body, bent) for body, _ in _bodies(eqn.params)):
            return True
    return False


def flatten(closed: ClosedJaxpr) -> Program:
    """Write a traced function as one list of equations; bodies of calls become part of it."""
    numbers, nodes, inner = count(), [], {}

    def enter(jaxpr: Any, consts: Any, inputs: list[Any], declared: bool) -> list[Any]:
        scope: dict[Any, Any] = dict(zip(jaxpr.invars, inputs, strict=True))
        scope |= dict(zip(jaxpr.constvars, consts, strict=True))
        read = lambda atom: atom if isinstance(atom, Literal) else scope[atom]  # noqa: E731
        for eqn in jaxpr.eqns:
            args, name = [read(atom) for atom in eqn.invars], _name(eqn)
            own = declared or DECLARED in str(eqn.source_info.name_stack)
            if name in _CALLS:
                ((body, held),) = _bodies(eqn.params)
                outputs = enter(body, kept(held), args, own)
            else:
                outputs = [next(numbers) for _ in eqn.outvars]
                shapes = [variable.aval for variable in eqn.outvars]
                node = Node(
                    eqn.primitive, eqn.params, args, outputs, _kinds(eqn), shapes,
                    eqn.source_info, own,
                )  # fmt: skip
                nodes.append(node)
                if name in _WHOLE:
                    for body, held in _bodies(eqn.params):
                        enter(body, kept(held), args[len(args) - len(body.invars) :], own)
            scope.update(zip(eqn.outvars, outputs, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def kept(consts: Any) -> list[int]:
        names = [next(numbers) for _ in consts]
        inner.update(zip(names, consts, strict=True))
        return names

    inputs = [next(numbers) for _ in closed.jaxpr.invars]
    constants = [next(numbers) for _ in closed.consts]
    outputs = enter(closed.jaxpr, constants, inputs, False)
    return Program(nodes, constants, inner, inputs, outputs[0])


def degree_of(node: Node, operands: list[int]) -> int:
    """Return how the result of an equation depends on the time, from how its operands do."""
    timed, name = [d for d in operands if d != CONSTANT], node.name
    if not timed:
        return CONSTANT
    if max(timed) == PIECES:
        return PIECES
    if _jumps(name, node.params, node.kinds):
        return BENT if name in _SAWS else PIECES
    if name in ("gather", "dynamic_slice") and max(operands[1:], default=CONSTANT) > CONSTANT:
        return BENT
    alone = len(timed) == 1
    if name in _LINEAR:
        return max(timed) if alone or set(timed) == {STRAIGHT} else BENT
    if alone and (name in _PRODUCTS or (name == "div" and operands[1] == CONSTANT)):
        return timed[0]
    if alone and name in _MONOTONE | {"max", "min"} and timed[0] <= MONOTONE:
        return MONOTONE
    if alone and name == "clamp" and operands[1] in (STRAIGHT, MONOTONE):
        return MONOTONE
    if name == "select_n" and operands[0] == CONSTANT and len(set(timed)) == 1:
        return timed[0]
    return BENT


def analysis_of(closed: ClosedJaxpr) -> Analysis | None:
    """Find the places where a traced field f(t, y, …) switches; `None` if it has no comparison."""
    if not _any_switch(closed.jaxpr, bent=True):
        return None
    program = flatten(closed)
    degrees, of_state = {program.inputs[0]: STRAIGHT}, set(program.inputs[1:])
    switches, kinks, by_state, unseen = [], [], [], []
    for node in program.nodes:
        inputs = [i for i in node.inputs if not isinstance(i, Literal)]
        look = lambda i: CONSTANT if isinstance(i, Literal) else degrees.get(i, CONSTANT)  # noqa: E731
        operands = [look(i) for i in node.inputs]
        stateful = any(i in of_state for i in inputs)
        degrees.update(dict.fromkeys(node.outputs, degree_of(node, operands)))
        if stateful:
            of_state.update(node.outputs)
        # What is constant between the times of other switches has no times of its own.
        timed = max(operands, default=CONSTANT) > PIECES
        if not (timed or stateful) or node.declared or not _may_switch(node) or _is_ours(node):
            continue
        where = f"{node.name}, {summarize(node.source)}"
        jumps = _jumps(node.name, node.params, node.kinds)
        if jumps and stateful:
            by_state.append(where)
        elif _hides(node):
            unseen += [where] * timed
        elif timed and not stateful:
            switch = _switch_of(program, node, operands, jumps)
            if switch.size <= (_FEW if jumps else _FEW_KINKS):
                switches.append(switch)
            elif switch.size <= _FEW:
                kinks.append(switch)
    bent = any(switch.degree == BENT for switch in switches)
    return Analysis(program, switches, kinks if bent else [], by_state, unseen)


def _is_ours(node: Node) -> bool:
    """Return whether an equation is of this package, whose laws declare their jumps."""
    return summarize(node.source).startswith(_PACKAGE)


def _may_switch(node: Node) -> bool:
    name = node.name
    jumps = _jumps(name, node.params, node.kinds) or _bends(name, node.kinds)
    return jumps or name in _OPAQUE or any(True for _ in _bodies(node.params))


def _hides(node: Node) -> bool:
    """Return whether an equation may switch where no switch can be looked for."""
    if node.name in _CHOICES | {"atan2"}:
        return True
    if node.name in _WHOLE | {"searchsorted"}:
        return False
    return node.name in _OPAQUE or any(_any_switch(body) for body, _ in _bodies(node.params))


def _switch_of(program: Program, node: Node, operands: list[int], jumps: bool) -> Switch:
    """Return the switch that an equation is."""
    name = node.name
    compared = operands[: 1 if name in _LEVELS - {"rem"} else 3]
    timed = [d for d in compared if d != CONSTANT]
    steady = len(timed) == 1 or set(timed) == {STRAIGHT}
    steady = steady and not (name == "rem" and compared[1] != CONSTANT)
    steady = steady and not (name == "searchsorted" and compared[0] != CONSTANT)
    shape = node.shapes[0].shape
    size = int(np.prod(shape)) * (2 if name == "clamp" else 1)
    if name == "searchsorted":
        # Of one time among edges.
        size = _edges(program, node) if shape == () else _FEW + 1
    return Switch(node, max(timed) if steady else BENT, size, jumps)


def _edges(program: Program, node: Node) -> int:
    """Return the number of edges that one time is searched among."""
    ((body, _),) = _bodies(node.params)
    return int(np.prod(body.invars[0].aval.shape))


def evaluator(
    program: Program, wanted: list[Any], replaced: dict[int, Any] | None = None
) -> Callable[..., list[Any]]:
    """Return a function (constants, *inputs) → the wanted values, of the equations they need.

    `replaced` has a function (read, *inputs) for the output of some equations.
    """
    replaced = replaced or {}
    needed, nodes = {i for i in wanted if not isinstance(i, Literal)}, []
    for node in reversed(program.nodes):
        if any(output in needed for output in node.outputs):
            nodes.append(node)
            own = replaced.get(node.outputs[0])
            inputs = node.inputs if own is None else own.reads
            needed.update(i for i in inputs if not isinstance(i, Literal))

    def evaluate(constants: Arrays, *inputs: Any) -> list[Any]:
        known = dict(zip(program.constants, constants, strict=True)) | program.inner
        known |= dict(zip(program.inputs, inputs, strict=False))
        read = lambda i: i.val if isinstance(i, Literal) else known[i]  # noqa: E731
        for node in reversed(nodes):
            if node.outputs[0] in replaced:
                known[node.outputs[0]] = replaced[node.outputs[0]].value(read, inputs)
                continue
            params = node.primitive.get_bind_params(node.params)
            out = node.primitive.bind(*(read(i) for i in node.inputs), **params)
            out = out if node.primitive.multiple_results else [out]
            known.update(zip(node.outputs, out, strict=True))
        return [read(i) for i in wanted]

    return evaluate


def _gap(switch: Switch, x: Any, *rest: Any) -> Any:
    """Return what is zero, or a whole number, where the elements of a switch change."""
    name = switch.node.name
    if name == "clamp":
        return jnp.concatenate([jnp.ravel(rest[0] - x), jnp.ravel(rest[0] - rest[1])])
    if name == "searchsorted":
        return jnp.ravel(x - rest[0])
    if name in _COMPARISONS | {"max", "min"}:
        return jnp.ravel(x - rest[0])
    return jnp.ravel(x / rest[0] if name == "rem" else x)


def _value(switch: Switch, x: Any, *rest: Any) -> Any:
    """Return what changes, as numbers, an element each."""
    name = switch.node.name
    if name in _KINKS | {"searchsorted"}:
        return _gap(switch, x, *rest) > 0
    return jnp.ravel(jnp.trunc(x / rest[0]) if name == "rem" else rest[-1])


class Times(NamedTuple):
    """The times at which the switches of a field may change, in s, one for each place.

    A place is one change of one element of one switch.
    """

    times: Array  # (k,) with derivatives; the end of the run where nothing changes
    element: Array  # (k,) of the switch
    change: Array  # (k,) of the element's value
    first: Arrays  # the values of the elements of each switch at the start
    outputs: Arrays  # of the equations at the start
    over: Array  # whether an element changes more often than it has places


class _Watched(NamedTuple):
    """Some switches of a program as functions of the time, all their elements in one array."""

    analysis: Analysis
    switches: list[Switch]
    constants: Arrays

    def operands(self, t: Any) -> list[list[Any]]:
        """Return the operands and the result of each equation."""
        wanted = [i for s in self.switches for i in (*s.node.inputs, s.node.outputs[0])]
        found = evaluator(self.analysis.program, wanted)(self.constants, t)
        ends = np.cumsum([0, *(len(s.node.inputs) + 1 for s in self.switches)])
        return [found[i:j] for i, j in pairwise(ends)]

    def _each(self, of: Callable[..., Any], t: Array) -> list[Array]:
        both = zip(self.switches, self.operands(t), strict=True)
        return [of(switch, *operands).astype(t.dtype) for switch, operands in both]

    def values(self, t: Array) -> list[Array]:
        return self._each(_value, t)

    def value(self, t: Array) -> Array:
        return jnp.concatenate(self.values(t))

    def gap(self, t: Array) -> Array:
        return jnp.concatenate(self._each(_gap, t))


def times_of(analysis: Analysis, constants: Arrays, a: Array, b: Array) -> Times:
    """Find the times in a < t ≤ b at which the switches of a field change."""
    start, end = lax.stop_gradient((a, b))
    # What changes within some round-off of the start has changed.
    start = start + 8 * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(start), jnp.abs(end - start))
    steady = [s for s in analysis.switches + analysis.kinks if s.degree <= MONOTONE]
    parts, over, known = {}, jnp.asarray(False), jnp.zeros(0, a.dtype)
    if steady:
        watched = _Watched(analysis, steady, constants)
        *places, over = _of_steady(watched, start, end)
        known = places[0]
        ends = np.cumsum([0, *(s.places for s in steady)])
        for switch, i, j in zip(steady, ends[:-1], ends[1:], strict=True):
            parts[id(switch)] = [place[i:j] for place in places]
    for switch in analysis.switches:
        if switch.degree == BENT:
            *places, more = _of_bent(_Watched(analysis, [switch], constants), start, end, known)
            parts[id(switch)], over = places, over | more
            known = jnp.concatenate([known, places[0]])
    columns = zip(*(parts[id(switch)] for switch in analysis.switches), strict=True)
    t, element, change = (jnp.concatenate(column) for column in columns)
    whole = _Watched(analysis, analysis.switches, constants)
    outputs = [operands[-1] for operands in whole.operands(start)]
    return Times(jnp.where(t < end, t, b), element, change, whole.values(start), outputs, over)


def _of_steady(watched: _Watched, start: Array, end: Array) -> tuple[Array, ...]:
    """Return times, elements, changes and whether there are more, of what only rises or falls."""
    whole, element, level = _levels(watched.switches)
    first, last = watched.value(start), watched.value(end)
    rise = (last - first)[whole]
    there = jnp.abs(rise) >= np.asarray(level, rise.dtype)
    low, high = (jnp.full(whole.shape, edge) for edge in (start, end))
    t, _ = _halved(watched, low, high, whole, first[whole], level)
    t, _ = _moving(watched, jnp.where(there, t, end), whole, there)
    once = np.concatenate([np.full(s.places, s.most == 1) for s in watched.switches])
    most = np.concatenate([np.full(s.size, s.most) for s in watched.switches])
    over = jnp.any((jnp.abs(last - first) > most.astype(rise.dtype)) & (most > 1))
    change = jnp.where(there, jnp.where(once, rise, jnp.sign(rise)), 0)
    return t, jnp.asarray(element), change, over


def _levels(switches: list[Switch]) -> tuple[np.ndarray, ...]:
    """Return the element of each place, through all switches and in its own, and which change."""
    parts, before = [], 0
    for switch in switches:
        element, level = (np.ravel(a) for a in np.mgrid[: switch.size, 1 : switch.most + 1])
        parts.append((before + element, element, level))
        before += switch.size
    whole, element, level = (np.concatenate(column) for column in zip(*parts, strict=True))
    return whole, element, level


def _of_bent(watched: _Watched, start: Array, end: Array, known: Array) -> tuple[Array, ...]:
    """Return what `_of_steady` does of one switch, by a grid with the `known` times of others."""
    low, high, element, over = _cells(watched, start, end, lax.stop_gradient(known))
    base = jax.vmap(lambda t, i: watched.value(t)[i])(low, element)
    t, value = _halved(watched, low, high, element, base, np.full(low.shape, 0.5))
    there = value != base
    t, moves = _moving(watched, jnp.where(there, t, end), element, there)
    if known.shape[0]:
        # Where an operand jumps, the switch moves as that jump does.
        near = jnp.argmin(jnp.abs(known[None] - t[:, None]), 1)
        still = lax.stop_gradient(t)
        there_too = jnp.abs(known[near] - still) <= 8 * jnp.finfo(t.dtype).eps * jnp.abs(still)
        t = jnp.where(there & ~moves & there_too, known[near], t)
    return t, element, jnp.where(there, value - base, 0), over


def _cells(watched: _Watched, start: Array, end: Array, known: Array) -> tuple[Array, ...]:
    """Return intervals (k,) in which an element changes once, the element, and whether all fit."""
    size, dtype = watched.switches[0].size, start.dtype
    grid = start + (end - start) * jnp.linspace(0.0, 1.0, max(256, _GRID // size), dtype=dtype)
    if known.shape[0]:
        beside = jnp.nextafter(known, jnp.full_like(known, -jnp.inf))
        grid = jnp.sort(
            jnp.concatenate([grid, jnp.clip(jnp.stack([known, beside]), start, end).ravel()])
        )
    value, gap = jax.vmap(watched.value)(grid), jax.vmap(watched.gap)(grid)
    changes = jnp.ravel(value[1:] != value[:-1])
    many = jnp.sum(changes)
    # The first of them: `nonzero` takes five times as long to compile.
    _, cell = lax.top_k(changes.astype(jnp.int32), MOST)
    row, element = cell // size, cell % size
    low = grid[row]
    high = jnp.where(jnp.arange(MOST) < many, grid[row + 1], low)
    # Between two points it may be met twice, near where the gap comes closest to zero.
    middle, sides = jnp.abs(gap[1:-1]), jnp.stack([jnp.abs(gap[:-2]), jnp.abs(gap[2:])])
    calm = (value[1:-1] == value[:-2]) & (value[1:-1] == value[2:]) & jnp.all(middle[None] <= sides, 0)
    depth = jnp.max(sides, 0) - middle + jnp.finfo(dtype).tiny
    nearness, cell = lax.top_k(-jnp.ravel(jnp.where(calm, middle / depth, jnp.inf)), _NEAR)
    row, which = cell // size, cell % size
    left = grid[row]
    right = jnp.where(jnp.isfinite(nearness), grid[row + 2], left)
    sign = jnp.sign(gap[row + 1, which])
    distance = jax.vmap(lambda t, i, sign: sign * watched.gap(t)[i])

    def shorter(_: Any, ends: Any) -> Any:
        left, right = ends
        third = (right - left) / 3
        falls = distance(left + third, which, sign) > distance(right - third, which, sign)
        return jnp.where(falls, left + third, left), jnp.where(falls, right, right - third)

    a, b = lax.fori_loop(0, _HALVINGS[dtype.name], shorter, (left, right))
    lowest = 0.5 * (a + b)
    low, high = jnp.concatenate([low, left, lowest]), jnp.concatenate([high, lowest, right])
    return low, high, jnp.concatenate([element, which, which]), many > MOST


def _halved(
    watched: _Watched, low: Array, high: Array, element: Any, base: Array, level: Any
) -> tuple[Array, Array]:
    """Return the first times (k,) at which an element is so far from its `base`; its value then."""
    at = jax.vmap(lambda t, i: watched.value(t)[i])

    def half(_: Any, ends: Any) -> Any:
        low, high = ends
        middle = low + 0.5 * (high - low)
        new = jnp.abs(at(middle, element) - base) >= np.asarray(level, low.dtype)
        return jnp.where(new, low, middle), jnp.where(new, middle, high)

    given = lax.stop_gradient((low, high))
    t = lax.fori_loop(0, _HALVINGS[low.dtype.name], half, given)[1]
    return t, at(t, element)


def _moving(watched: _Watched, t: Array, element: Any, there: Array) -> tuple[Array, Array]:
    """Return the times with the derivatives of implicit functions, and whether they have some."""
    gap = jax.vmap(lambda t, i: watched.gap(t)[i])
    bent = any(s.degree == BENT for s in watched.switches)
    t, moves, slope = lax.stop_gradient(t), there, jnp.zeros_like(t)
    still, here = t, jnp.zeros_like(t)
    # Each step of Newton's method of value zero adds an order of derivatives.
    for _ in range(1 if all(s.degree == STRAIGHT for s in watched.switches) else 2):
        here, slope = jax.jvp(lambda t: gap(t, element), (t,), (jnp.ones_like(t),))
        moves = moves & jnp.isfinite(slope) & (slope != 0)
        rise = here - lax.stop_gradient(here)
        t = t - jnp.where(moves, rise / jnp.where(moves, slope, 1), 0)
    if bent:
        # A jump of the operand itself is no zero of its gap.
        beside = jnp.nextafter(still, jnp.full_like(still, -jnp.inf))
        step, eps = jnp.abs(slope) * (still - beside), jnp.finfo(t.dtype).eps
        jump = jnp.abs(here - gap(beside, element))
        moves = moves & (jump <= 64 * (step + eps * (1 + jnp.abs(here))))
    return t, moves


class _Side(NamedTuple):
    """An equation's result by the stops that a step is past, in the place of its comparison."""

    switch: Switch
    number: int
    places: slice

    @property
    def reads(self) -> list[Any]:
        """The inputs of the equation that are still needed."""
        return [] if self.switch.exact else self.switch.node.inputs

    def value(self, read: Callable[[Any], Any], inputs: tuple[Any, ...]) -> Any:
        """Return the result at the time `inputs[0]`, from the stops and values `inputs[-1]`."""
        node, (stops, found) = self.switch.node, inputs[-1]
        past = inputs[0] >= stops[self.places]
        steps = jnp.where(past, found.change[self.places], 0)
        if self.switch.size > 1:
            own = found.element[self.places][None] == np.arange(self.switch.size)[:, None]
            steps = jnp.sum(jnp.where(own, steps[None], 0), 1)
        else:
            steps = jnp.sum(steps)
        here, out = found.first[self.number] + steps, node.shapes[0]
        if node.name == "searchsorted":
            return found.outputs[self.number] - jnp.sum(steps).astype(out.dtype)
        operands = [read(i) for i in self.reads]
        if node.name in _COMPARISONS:
            here = here > 0.5
        if node.name == "rem":
            x, y = operands
            here = x - y * here.reshape(out.shape).astype(x.dtype)
        here = here.reshape(out.shape).astype(out.dtype)
        if self.switch.exact:
            return here
        params = node.primitive.get_bind_params(node.params)
        return jnp.where(found.over, node.primitive.bind(*operands, **params), here)


def by_sides(analysis: Analysis) -> Callable[..., Array]:
    """Return the field f(constants, t, y, …, (stops, `Times`)) with its switches at the stops."""
    replaced, begin = {}, 0
    for number, switch in enumerate(analysis.switches):
        if switch.jumps:
            places = slice(begin, begin + switch.places)
            replaced[switch.node.outputs[0]] = _Side(switch, number, places)
        begin += switch.places
    evaluate = evaluator(analysis.program, [analysis.program.output], replaced)
    return lambda constants, *inputs: evaluate(constants, *inputs)[0]


def separated(times: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Return stops between a and b in order, and those of each of `times` (k,); equal ones apart.

    Two jumps at the same time have a very short step between them, so that each has its derivative.
    """
    inside = (times > a) & (times < b)
    t = jnp.where(inside, times, jnp.where(times <= a, a, b))
    order = jnp.argsort(lax.stop_gradient(t), stable=True)
    t, inside = t[order], inside[order]
    still, last = lax.stop_gradient((t, b))
    gap = 4 * jnp.finfo(t.dtype).eps * lax.stop_gradient(jnp.maximum(jnp.abs(a), jnp.abs(b)))
    shift = gap * jnp.arange(t.shape[0]).astype(t.dtype)
    pushed = lax.cummax(jnp.where(inside, still - shift, -jnp.inf)) + shift
    apart = jnp.where(inside, jnp.maximum(still, jnp.minimum(pushed, last)), still)
    t = t + (apart - still)
    return t, t[jnp.argsort(order)]


def say_unseen(analysis: Analysis) -> None:
    """Warn of comparisons with the time in which no switch can be looked for."""
    for line in dict.fromkeys(analysis.unseen):
        warnings.warn(
            f"simulate: a law may jump at a time that is not found before the run ({line}): steps "
            "do not end there, and the derivative by that time is lost. Give the law `jump_times`, "
            "its jumps in s, or end the run there and begin another",
            stacklevel=2,
        )


class Traced(NamedTuple):
    """A traced function as `call(constants, *args)`, where the constants are arrays."""

    closed: ClosedJaxpr
    tree: Any  # of its result

    @property
    def constants(self) -> Arrays:
        """The arrays that the function holds; numbers of NumPy stay in its program."""
        return [c for c in self.closed.consts if eqx.is_array(c)]

    def consts(self, constants: Arrays) -> Arrays:
        """Return all constants of the program, with these arrays."""
        arrays = iter(constants)
        return [next(arrays) if eqx.is_array(c) else c for c in self.closed.consts]

    def call(self, constants: Arrays, *args: Any) -> Any:
        closed = ClosedJaxpr(self.closed.jaxpr, self.consts(constants))
        return self.tree.unflatten(jaxpr_as_fun(closed)(*jax.tree.leaves(args)))


def traced(function: Callable[..., Any], *like: Any) -> Traced:
    """Trace a function of such arguments once."""
    closed, out = jax.make_jaxpr(function, return_shape=True)(*like)
    return Traced(closed, jax.tree.structure(out))


class Stopped(NamedTuple):
    """A field whose steps end at `stops` (k,), s, in order: where it jumps, or has a kink."""

    field: Callable[..., Array]  # (constants, t, y)
    constants: Arrays
    smooth: int  # of the constants the first, which may have derivatives
    stops: Array
    over: Array | None  # whether a part switches more often than it has places for


def stopped(
    function: Callable[..., Array], declared: list[Array], a: Array, b: Array, y: Array
) -> Stopped:
    """Return the field `function(t, y, *sides)` between times a and b with all its stops.

    `declared` are the jump times of each part that declares some; if there are more than one, each
    part gets its stops as one of `sides`, in s.
    """
    declared = [times.astype(a.dtype) for times in declared if times.size]
    likes = declared if len(declared) > 1 else []
    program = traced(function, a, y, *likes)
    analysis, number = analysis_of(program.closed), len(program.constants)
    if analysis is not None:
        say_unseen(analysis)
    if analysis is None or not analysis.switches:
        if not likes:
            stops = jnp.clip(jnp.sort(declared[0]), a, b) if declared else jnp.zeros(0, a.dtype)
            return Stopped(program.call, program.constants, number, stops, None)
        stops, each = separated(jnp.concatenate(declared), a, b)
        sides = _split(lax.stop_gradient(each), declared)
        call = lambda given, t, y: program.call(given[:number], t, y, *given[number:])  # noqa: E731
        return Stopped(call, [*program.constants, *sides], number, stops, None)
    found = times_of(analysis, program.closed.consts, a, b)
    stops, each = separated(jnp.concatenate([*declared, found.times]), a, b)
    *sides, own = _split(lax.stop_gradient(each), [*declared, found.times])
    over, most = found.over, MOST + sum(times.shape[0] for times in declared)
    if stops.shape[0] > most:
        stops, over = stops[:most], over | (stops[most] < b)
    more, tree = jax.tree.flatten((sides if likes else [], (own, lax.stop_gradient(found))))
    field = by_sides(analysis)

    def call(given: Arrays, t: Array, y: Array) -> Array:
        sides, places = tree.unflatten(given[number:])
        return field(program.consts(given[:number]), t, y, *sides, places)

    return Stopped(call, [*program.constants, *more], number, stops, over)


def _split(whole: Array, like: list[Array]) -> list[Array]:
    return list(jnp.split(whole, np.cumsum([a.shape[0] for a in like])[:-1]))
