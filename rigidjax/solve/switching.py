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
from itertools import count
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jax.extend.source_info_util import summarize
from jax.flatten_util import ravel_pytree
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
    outputs: Arrays  # of a search among edges at the start; empty for other switches
    over: Array  # whether an element changes more often than it has places


class _Watched(NamedTuple):
    """A switch of a program with its constants: its `size` elements as functions of the time."""

    program: Program
    switch: Switch
    constants: Arrays

    @property
    def still(self) -> "_Watched":
        """The same switch without derivatives."""
        return self._replace(constants=lax.stop_gradient(self.constants))

    def operands(self, t: Array) -> list[Any]:
        """Return the operands and the result of the equation."""
        node = self.switch.node
        wanted = [*node.inputs, node.outputs[0]]
        return evaluator(self.program, wanted)(self.constants, t)

    def value(self, t: Array) -> Array:
        return _value(self.switch, *self.operands(t)).astype(t.dtype)

    def gap(self, t: Array) -> Array:
        return _gap(self.switch, *self.operands(t)).astype(t.dtype)

    def values(self, t: Array, element: Any) -> Array:
        """Return the value of one element at each of the times t (k,)."""
        return self._of_each(self.value, t, element)

    def gaps(self, t: Array, element: Any) -> Array:
        return self._of_each(self.gap, t, element)

    def _of_each(self, of: Callable[[Array], Array], t: Array, element: Any) -> Array:
        if self.switch.size == 1:
            return jax.vmap(lambda t: of(t).reshape(()))(t)
        return jax.vmap(lambda t, i: of(t)[i])(t, element)


# Times, elements and changes at the places of a switch, and whether there are more.
_Places = tuple[Array, Array, Array, Array]


def times_of(analysis: Analysis, constants: Arrays, a: Array, b: Array) -> Times:
    """Find the times in a < t ≤ b at which the switches of a field change."""
    start, end = lax.stop_gradient((a, b))
    # What changes within some round-off of the start has changed.
    start = start + 8 * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(start), jnp.abs(end - start))
    watched = [_Watched(analysis.program, s, constants) for s in analysis.switches]
    others = [_Watched(analysis.program, s, constants) for s in analysis.kinks]
    steady = [one for one in watched + others if one.switch.degree <= MONOTONE]
    found = _of_steady(steady, start, end)
    known = [places[0] for places in found]
    parts: list[_Places] = []
    for one in watched:
        if one.switch.degree == BENT:
            parts.append(_of_bent(one, start, end, known))
            known.append(parts[-1][0])
        else:
            parts.append(found.pop(0))
    t, element, change = (jnp.concatenate([part[i] for part in parts]) for i in range(3))
    over = jnp.any(jnp.stack([part[3] for part in parts]))
    first = [one.still.value(start) for one in watched]
    outputs = [
        one.still.operands(start)[-1] if one.switch.node.name == "searchsorted" else start[None][:0]
        for one in watched
    ]
    return Times(jnp.where(t < end, t, b), element, change, first, outputs, over)


def _of_steady(watched: list[_Watched], start: Array, end: Array) -> list[_Places]:
    """Find the changes of what only rises or only falls."""
    starts, rises, elements, levels = [], [], [], []
    for one in watched:
        element, level = (np.ravel(a) for a in np.mgrid[: one.switch.size, 1 : one.switch.most + 1])
        first, last = one.still.value(start), one.still.value(end)
        starts, rises = [*starts, first[element]], [*rises, last - first]
        elements, levels = [*elements, element], [*levels, level.astype(start.dtype)]
    edges = [(jnp.full(a.shape, start), jnp.full(a.shape, end)) for a in elements]
    found = _halved(watched, edges, elements, starts, levels)
    parts = []
    for one, t, element, level, change in zip(watched, found, elements, levels, rises, strict=True):
        rise, most = change[element], one.switch.most
        there = jnp.abs(rise) >= level
        t, _ = _moving(one, jnp.where(there, t, end), element, there)
        over = jnp.any(jnp.abs(change) > most) & (most > 1)
        change = jnp.where(there, rise if most == 1 else jnp.sign(rise), 0)
        parts.append((t, jnp.asarray(element), change, over))
    return parts


def _of_bent(one: _Watched, start: Array, end: Array, known: list[Array]) -> _Places:
    """Find the changes of a switch by a grid, to which the `known` times of others are added."""
    before = jnp.concatenate(known) if known else jnp.zeros(0, start.dtype)
    low, high, element, over = _cells(one.still, start, end, lax.stop_gradient(before))
    base = one.still.values(low, element)
    level = np.full(low.shape, 0.5, start.dtype)
    (t,) = _halved([one], [(low, high)], [element], [base], [level])
    value = one.still.values(t, element)
    there = value != base
    t, moves = _moving(one, jnp.where(there, t, end), element, there)
    if known:
        # Where an operand jumps, the switch moves as that jump does.
        near, still = jnp.argmin(jnp.abs(before[None] - t[:, None]), 1), lax.stop_gradient(t)
        same = jnp.abs(before[near] - still) <= 8 * jnp.finfo(t.dtype).eps * jnp.abs(still)
        t = jnp.where(there & ~moves & same, before[near], t)
    return t, element, jnp.where(there, value - base, 0), over


def _cells(one: _Watched, start: Array, end: Array, known: Array) -> tuple[Array, ...]:
    """Return intervals (k,) in which an element changes once, the element, and whether all fit."""
    size, dtype = one.switch.size, start.dtype
    grid = start + (end - start) * jnp.linspace(0.0, 1.0, max(256, _GRID // size), dtype=dtype)
    if known.shape[0]:
        beside = jnp.nextafter(known, jnp.full_like(known, -jnp.inf))
        grid = jnp.sort(
            jnp.concatenate([grid, jnp.clip(jnp.stack([known, beside]), start, end).ravel()])
        )
    value, gap = jax.vmap(one.value)(grid), jax.vmap(one.gap)(grid)
    changes = jnp.ravel(value[1:] != value[:-1])
    many = jnp.sum(changes)
    # The first of them: `nonzero` takes five times as long to compile.
    _, cell = lax.top_k(changes.astype(jnp.int32), MOST)
    row, element = cell // size, cell % size
    low = grid[row]
    high = jnp.where(jnp.arange(MOST) < many, grid[row + 1], low)
    # Between two points it may be met twice, near where the gap comes closest to zero.
    middle, sides = jnp.abs(gap[1:-1]), jnp.stack([jnp.abs(gap[:-2]), jnp.abs(gap[2:])])
    calm = (
        (value[1:-1] == value[:-2]) & (value[1:-1] == value[2:]) & jnp.all(middle[None] <= sides, 0)
    )
    depth = jnp.max(sides, 0) - middle + jnp.finfo(dtype).tiny
    nearness, cell = lax.top_k(-jnp.ravel(jnp.where(calm, middle / depth, jnp.inf)), _NEAR)
    row, which = cell // size, cell % size
    left = grid[row]
    right = jnp.where(jnp.isfinite(nearness), grid[row + 2], left)
    sign = jnp.sign(gap[row + 1, which])

    def shorter(_: Any, ends: Any) -> Any:
        left, right = ends
        third = (right - left) / 3
        ends = (one.gaps(t, which) for t in (left + third, right - third))
        falls = sign * next(ends) > sign * next(ends)
        return jnp.where(falls, left + third, left), jnp.where(falls, right, right - third)

    a, b = lax.fori_loop(0, _HALVINGS[dtype.name], shorter, (left, right))
    lowest = 0.5 * (a + b)
    low, high = jnp.concatenate([low, left, lowest]), jnp.concatenate([high, lowest, right])
    return low, high, jnp.concatenate([element, which, which]), many > MOST


def _halved(
    watched: list[_Watched], edges: Any, elements: Any, bases: list[Array], levels: Any
) -> list[Array]:
    """Return the first times (k,) at which elements are so far from their bases, of each switch."""

    def half(_: Any, edges: Any) -> Any:
        halves = []
        for one, (low, high), element, base, level in zip(
            watched, edges, elements, bases, levels, strict=True
        ):
            middle = low + 0.5 * (high - low)
            new = jnp.abs(one.still.values(middle, element) - base) >= level
            halves.append((jnp.where(new, low, middle), jnp.where(new, middle, high)))
        return halves

    if not watched:
        return []
    edges = lax.stop_gradient(edges)
    count = _HALVINGS[edges[0][0].dtype.name]
    return [high for _, high in lax.fori_loop(0, count, half, edges)]


def _moving(one: _Watched, t: Array, element: Any, there: Array) -> tuple[Array, Array]:
    """Return the times with the derivatives of implicit functions, and whether they have some."""
    degree = one.switch.degree
    still, moves, slope, here = lax.stop_gradient(t), there, jnp.zeros_like(t), jnp.zeros_like(t)
    t = still
    # Each step of Newton's method of value zero adds an order of derivatives.
    for _ in range(1 if degree == STRAIGHT else 2):
        gaps = lambda t: one.gaps(t, element)  # noqa: E731
        here, slope = jax.jvp(gaps, (t,), (jnp.ones_like(t),))
        moves = moves & jnp.isfinite(slope) & (slope != 0)
        rise = here - lax.stop_gradient(here)
        t = t - jnp.where(moves, rise / jnp.where(moves, slope, 1), 0)
    if degree == BENT:
        # A jump of the operand itself is no zero of its gap.
        beside = jnp.nextafter(still, jnp.full_like(still, -jnp.inf))
        step, eps = jnp.abs(slope) * (still - beside), jnp.finfo(t.dtype).eps
        jump = jnp.abs(here - one.gaps(beside, element))
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
        steps, size = jnp.where(past, found.change[self.places], 0), self.switch.size
        if self.switch.degree < BENT:
            steps = steps.reshape(size, -1)
        else:
            element = found.element[self.places][None]
            own = element == np.arange(size, dtype=element.dtype)[:, None]
            steps = jnp.where(own, steps[None], 0)
        steps = jnp.sum(steps, 1)
        here, out = found.first[self.number] + steps, node.shapes[0]
        if node.name == "searchsorted":
            return (found.outputs[self.number] - jnp.sum(steps)).astype(out.dtype)
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
        return jnp.where(found.over > 0, node.primitive.bind(*operands, **params), here)


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
    still, last = lax.stop_gradient((t, b))
    count = np.arange(t.shape[0])
    # Comparisons of few with each other are quicker than a sort.
    earlier = still[None] < still[:, None]
    earlier = earlier | ((still[None] == still[:, None]) & (count[None] < count[:, None]))
    rank = jnp.sum(earlier, 1)
    here = rank[None] == count[:, None]
    ordered = lambda a: jnp.sum(jnp.where(here, a[None], 0), 1)  # noqa: E731
    t = ordered(t)
    still, inside = lax.stop_gradient(t), ordered(inside) > 0
    gap = 4 * jnp.finfo(t.dtype).eps * lax.stop_gradient(jnp.maximum(jnp.abs(a), jnp.abs(b)))
    shift = gap * count.astype(t.dtype)
    pushed = lax.cummax(jnp.where(inside, still - shift, -jnp.inf)) + shift
    apart = jnp.where(inside, jnp.maximum(still, jnp.minimum(pushed, last)), still)
    t = t + (apart - still)
    return t, t[rank]


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
    # As one array: a loop that carries many is slower.
    places = lax.stop_gradient((own, found._replace(times=own[:0])))
    one, unpacked = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(a.dtype), places))
    more, field = [*(sides if likes else []), one], by_sides(analysis)

    def call(given: Arrays, t: Array, y: Array) -> Array:
        *sides, one = given[number:]
        return field(program.consts(given[:number]), t, y, *sides, unpacked(one))

    return Stopped(call, [*program.constants, *more], number, stops, over)


def _split(whole: Array, like: list[Array]) -> list[Array]:
    return list(jnp.split(whole, np.cumsum([a.shape[0] for a in like])[:-1]))
