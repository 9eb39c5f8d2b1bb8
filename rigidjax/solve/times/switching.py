"""Find the equations of a traced vector field that switch at times of their own, and replace them.

A law that a user writes, such as `jnp.where(t < self.te, push, 0.0)`, declares no `jump_times`, but
the traced field contains its comparison. One interpreter of the traced field is run twice. The
first run skips what depends on the state, and meets each comparison that depends on the time alone:
the module `switching_times` finds from it the times at which the comparisons change. The second run
evaluates the whole field, but takes the results of these comparisons from the times that are
passed. The results therefore do not depend on rounding, and two comparisons that change at the same
time are treated separately.

| written | what comes |
|---|---|
| <, <=, >, >=, sign, floor, ceil, round, rem, int(…), searchsorted of the time | stops, with \
derivatives |
| ==, !=, isnan, isfinite, a pole (1 / (t − p) > 0), atan2 that leaps by 2π | stops, with first \
derivatives |
| max, min, abs, clamp of at most `FEW_KINKS` elements | stops at the kinks |
| cond, switch, jit, remat, custom_jvp, custom_vjp | as their bodies |
| loops, callbacks, argmax, argmin, sort, bits of numbers, more than `MOST` elements | a warning |
| what depends on the state | left alone |
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportPrivateImportUsage]
    Jaxpr,
    Literal,
)
from jax.extend.source_info_util import summarize
from jaxtyping import Array

from rigidjax.solve.programs.batching import Arrays

# The scope (`jax.named_scope`) of laws that declare their jumps, which are not searched.
DECLARED = "rigidjax_declared_jumps"
MOST = 256  # the most elements, and the most changes, of the switches of one law
FEW_KINKS = 8  # steps do not end at the kinks of an operation that has more

# How a value depends on the time: not at all, by jumps alone, as a straight line, only rising or
# only falling, in any other way; or that it depends on the state.
FIXED, PIECES, STRAIGHT, MONOTONE, BENT, STATEFUL = range(6)

_COMPARISONS = {"lt", "le", "gt", "ge", "lt_to", "le_to", "eq", "ne"}
_LEVELS = {"floor", "ceil", "round", "rem", "convert_element_type"}  # jump at each whole number
_KINKS = {"max", "min", "abs", "clamp"}
_KEPT = _KINKS | {"atan2"}  # the field evaluates them as they stand
_FOUND = _COMPARISONS | _LEVELS | _KEPT | {"sign", "is_finite", "searchsorted"}
_UNFOUND = {
    "argmax", "argmin", "sort", "top_k", "bitcast_convert_type", "nextafter", "pure_callback",
    "io_callback", "custom_call", "ffi_call",
}  # fmt: skip
_CALLS = {"jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2"}
_RULES = {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}
_SMOOTH = {"expm"}  # functions of JAX that compare only to choose between equal formulas
_ELEMENTWISE = {
    "add", "sub", "add_any", "neg", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze",
    "slice", "transpose", "rev", "concatenate", "expand_dims", "convert_element_type",
    "stop_gradient", "optimization_barrier", "gather", "dynamic_slice", "select_n", "stack",
    "unstack",
}  # fmt: skip
_SUMS = {"reduce_sum", "cumsum"}
_PRODUCTS = {"mul", "div", "dot_general"}
# Operations whose result has no narrow peak in the time if their operands have none.
PLAIN = (_ELEMENTWISE - {"gather", "dynamic_slice"}) | _SUMS | _FOUND | {
    "mul", "dot_general", "sin", "cos", "sqrt", "cbrt", "square", "reduce_max", "reduce_min", "pad",
    "split", "real", "imag", "complex", "conj",
}  # fmt: skip
_RISING = {
    "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "tanh", "logistic", "erf", "sinh",
    "asinh", "atan", "max", "min", "clamp",
}  # fmt: skip

_HOME = str(Path(__file__).parents[2]) + os.sep  # the folder of rigidjax
_SCHEDULES = os.path.join(_HOME, "motion", "torques", "piecewise.py")
_DIFFRAX = f"{os.sep}diffrax{os.sep}"
_EQUINOX = os.path.dirname(os.path.abspath(eqx.__file__)) + os.sep


def _name(eqn: Any) -> str:
    called = eqn.params.get("name")
    return called if called in {"searchsorted", *_SMOOTH} else eqn.primitive.name


def _kind(name: str, kinds: list[int]) -> int:
    """Return how the result of a primitive depends on the time, from how its operands do."""
    kind, moving = max(kinds, default=FIXED), sum(k > FIXED for k in kinds)
    if kind in (FIXED, PIECES, STATEFUL):
        return kind
    if name in ("floor", "ceil", "round", "sign"):
        return PIECES
    linear = name in _ELEMENTWISE | _SUMS or (
        name in _PRODUCTS and moving == 1 and (name != "div" or kinds[1] == FIXED)
    )
    linear = linear and all(k in (FIXED, kind) for k in kinds)
    if linear and kind == STRAIGHT:
        return STRAIGHT
    rising = name in _RISING or (linear and name not in _SUMS | {"dot_general"})
    return MONOTONE if moving == 1 and rising and kind < BENT else BENT


def _bodies(eqn: Any) -> list[Any]:
    """Return the programs among the parameters of an equation, such as the branches of `cond`."""
    parts = [p for v in eqn.params.values() for p in (v if isinstance(v, list | tuple) else [v])]
    return [getattr(p, "jaxpr", p) for p in parts if isinstance(p, ClosedJaxpr | Jaxpr)]


def _may_switch(eqn: Any) -> bool:
    name, to = _name(eqn), eqn.params.get("new_dtype")
    real = eqn.invars and jnp.issubdtype(eqn.invars[-1].aval.dtype, jnp.floating)
    inexact = to is not None and jnp.issubdtype(to, jnp.inexact)
    return bool(real) and name in _FOUND | _UNFOUND and not inexact


def _contains_switch(jaxpr: Any, kinks: bool = False) -> bool:
    return any(
        (_may_switch(eqn) and (kinks or _name(eqn) not in _KINKS))
        or any(_contains_switch(body, kinks) for body in _bodies(eqn))
        for eqn in jaxpr.eqns
        if _name(eqn) not in _SMOOTH
    )


def _live_equations(
    jaxpr: Any, results: Iterable[tuple[Any, bool]], roots: Iterable[int] = ()
) -> tuple[list[Any], set[Any]]:
    """Return the equations that the wanted `results` and the `roots` need, and their variables.

    A root is the `id` of an equation. Equations with an effect, such as a print, are needed, too.
    """
    used = {atom for atom, wanted in results if wanted and not isinstance(atom, Literal)}
    live, roots = [], set(roots)
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or id(eqn) in roots or any(v in used for v in eqn.outvars):
            live.append(eqn)
            used.update(atom for atom in eqn.invars if not isinstance(atom, Literal))
    return live[::-1], used


def _asks_for_nan(eqn: Any) -> bool:
    same = _name(eqn) in _COMPARISONS and eqn.invars[0] is eqn.invars[1]
    return same or _name(eqn) == "is_finite"


def _height_and_value(eqn: Any, inputs: Any, result: Array) -> tuple[Array, Array]:
    """Return, for each element of a switch `eqn`, its height, at whose zeros or whole values the
    equation switches, and the value that then jumps.
    """
    name, x = _name(eqn), inputs[0]
    if _asks_for_nan(eqn):
        height, value = x, result
    elif name in _COMPARISONS:
        height, value = x - inputs[1], result
    elif name in ("max", "min"):
        height, value = x - inputs[1], x > inputs[1]
    elif name == "clamp":
        height = jnp.stack(jnp.broadcast_arrays(inputs[1] - x, inputs[1] - inputs[2]))
        value = height > 0
    elif name == "searchsorted":  # of each edge and each time, whether the edge is passed
        height = inputs[1][..., None] - x
        value = result[..., None] > np.arange(x.shape[0], dtype=result.dtype)
    elif name == "rem":
        height, value = x / inputs[1], jnp.trunc(x / inputs[1])
    elif name == "atan2":
        height, value = x, (x < 0) & (inputs[1] < 0)
    else:
        height, value = x, x > 0 if name == "abs" else result
    height, value = jnp.broadcast_arrays(height, value)
    return height, value


class Switch(NamedTuple):
    """Hold an equation whose result jumps, or has a kink, at times independent of the state."""

    path: tuple[Any, ...]  # the equations of the calls around it, the outermost first, and its own
    kind: int  # how its height depends on the time
    size: int
    line: str  # its primitive and its line of code
    leaps: bool  # whether an element may change many times while its height only rises
    asks_for_nan: bool

    def result(self, values: Array, inputs: Any, result: Array) -> Array:
        """Return the result of the equation, from the values (m,) of its elements."""
        name = _name(self.path[-1])
        if name in _KEPT:
            return result
        if name == "searchsorted":
            return jnp.sum(values.reshape(*result.shape, -1), -1).astype(result.dtype)
        values = values.reshape(result.shape)
        if name == "rem":
            return inputs[0] - inputs[1] * values.astype(result.dtype)
        return values > 0.5 if result.dtype == bool else values.astype(result.dtype)


# What the interpreter calls at each equation that switches by the time: `meet(path, inputs, result,
# kind of the height)` returns the result to go on with.
Meet = Callable[[tuple[Any, ...], Any, Array, int], Array]


class Interpreter(NamedTuple):
    """Evaluate a traced function, and call `meet` at each equation that switches by the time.

    Each value comes with its kind of dependence on the time (`FIXED`, `STRAIGHT`, …). Unless
    `whole`, nothing that depends on the state is evaluated, and its value is `None`.
    """

    meet: Meet
    whole: bool
    hidden: Callable[[tuple[Any, ...]], Any] = lambda path: None  # told what cannot be searched
    around: tuple[Any, ...] = ()  # the equations of the calls around, the outermost first
    see: Callable[..., Any] = lambda path, inputs, kinds, out: None  # told what is evaluated

    def run(self, jaxpr: Any, consts: Any, args: Any, asked: Any = None) -> list[tuple[Any, int]]:
        """Return the results of a `jaxpr`; those that are not `asked` for may be `None`."""
        known = dict(zip(jaxpr.constvars, ((c, FIXED) for c in consts), strict=True))
        known |= dict(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> tuple[Any, int]:
            return (
                (atom.val, FIXED) if isinstance(atom, Literal) else known.get(atom, (None, FIXED))
            )

        asked = asked or [True] * len(jaxpr.outvars)
        live, used = _live_equations(jaxpr, zip(jaxpr.outvars, asked, strict=True))
        for eqn in live:
            wanted = [variable in used for variable in eqn.outvars]
            found = self.equation(eqn, [read(atom) for atom in eqn.invars], wanted)
            known.update(zip(eqn.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[Any], wanted: list[bool]) -> list[tuple[Any, int]]:
        name, inputs, kinds = _name(eqn), [a for a, _ in args], [k for _, k in args]
        kind, moves = _kind(name, kinds), any(STRAIGHT <= k <= BENT for k in kinds)
        inside = self._replace(around=(*self.around, eqn))
        if name == "cond" and any(PIECES <= k <= BENT for k in kinds):
            return inside.cond(eqn, args)
        of_body: list[tuple[Any, int]] = []
        if name in _CALLS | _RULES and any(k > FIXED for k in kinds):
            body = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
            body = body if isinstance(body, ClosedJaxpr) else ClosedJaxpr(body, ())
            of_body = inside.run(body.jaxpr, body.consts, args, wanted)
            # A `custom_jvp` is called as it stands, so that its rule is kept.
            if name in _CALLS or not self.whole:
                return of_body
        elif moves and name not in _FOUND | _SMOOTH:
            if (name in _UNFOUND and _may_switch(eqn)) or any(map(_contains_switch, _bodies(eqn))):
                self.hidden(inside.around)
        if (kind == STATEFUL or eqn.effects) and not self.whole:
            return [(None, STATEFUL)] * len(eqn.outvars)
        out = eqn.primitive.bind(*inputs, **eqn.primitive.get_bind_params(eqn.params))
        out = list(out) if eqn.primitive.multiple_results else [out]
        self.see(inside.around, inputs, kinds, out)
        timed = moves and kind < STATEFUL
        if timed and name in _FOUND and _may_switch(eqn):
            height = BENT if name in ("clamp", "atan2") else _kind("sub", kinds)
            height = _kind("div", kinds) if name == "rem" else height
            out = [self.meet(inside.around, inputs, out[0], height)]
        whole = lambda x: timed and not jnp.issubdtype(jnp.result_type(x), jnp.inexact)  # noqa: E731
        kinds = [k for _, k in of_body] or [PIECES if whole(x) else kind for x in out]
        return list(zip(out, kinds, strict=True))

    def cond(self, eqn: Any, args: list[Any]) -> list[tuple[Any, int]]:
        """Return the results of the chosen branch, each with how it depends on the time.

        If `whole`, only this branch is evaluated, by `lax.switch`; else all are.
        """
        (index, by), *args = args
        kinds: list[list[int]] = []

        def branch(body: Any) -> Callable[..., list[Any]]:
            def enter(*inputs: Any) -> list[Any]:
                given = [(x, k) for x, (_, k) in zip(inputs, args, strict=True)]
                out = self.run(body.jaxpr, body.consts, given)
                kinds.append([k for _, k in out])
                return [x for x, _ in out]

            return enter

        branches, inputs = [branch(body) for body in eqn.params["branches"]], [x for x, _ in args]
        results = lax.switch(index, branches, *inputs) if self.whole else None
        each = [] if self.whole else [enter(*inputs) for enter in branches]
        found = [_kind("select_n", [by, *k]) for k in zip(*kinds, strict=True)]
        if results is not None:
            return list(zip(results, found, strict=True))
        chosen = []
        for kind, *xs in zip(found, *each, strict=True):
            if kind == STATEFUL:
                chosen.append((None, kind))
                continue
            xs = [jnp.asarray(x) for x in xs]
            which = jnp.clip(index, 0, len(xs) - 1).astype(jnp.int32)
            chosen.append((lax.select_n(jnp.broadcast_to(which, xs[0].shape), *xs), kind))
        return chosen


def _searched_line(path: tuple[Any, ...]) -> str:
    """Return the line of code of an equation, "" for one that is not to be searched.

    The line is that of the outermost call, since JAX traces its own functions only once. Not
    searched are laws that declare their jumps, and the lines of this package, which compares to
    choose between equal formulas, but for its tables. Within the derivative rule of a call, JAX
    gives every equation the line of that call: a line of this package therefore counts only if
    `trace_program` is among the frames.
    """
    if any(DECLARED in str(eqn.source_info.name_stack) for eqn in path):
        return ""
    frames = summarize(path[0].source_info, num_frames=1000).splitlines()
    frames = [frame for frame in frames if not frame.startswith(_EQUINOX)]
    line = frames[-1] if frames else "a line that is not known"
    ours = line.startswith(_HOME) and not line.startswith(_SCHEDULES)
    return "" if ours and any("trace_program" in frame for frame in frames) else line


class Switches(NamedTuple):
    """Hold a traced field f(t, y, …) of one result, and its switches, of m elements in all."""

    traced: ClosedJaxpr
    timed: Jaxpr  # the equations that the switches need
    switches: list[Switch]
    unfound: list[str]  # the primitives, and their lines, that may switch at times not found

    def of_elements(self, fact: Callable[[Switch], Any]) -> np.ndarray:
        """Return (m,) the number `fact(switch)` of the switch of each element."""
        return np.array([fact(s) for s in self.switches for _ in range(s.size)], int)

    def heights_and_values(self, consts: Arrays, t: Array) -> tuple[Array, Array]:
        """Return the heights (m,) and the values (m,) of all elements (see `_height_and_value`)."""
        rows = {}

        def meet(path: Any, inputs: Any, result: Array, kind: int) -> Array:
            pair = _height_and_value(path[-1], inputs, result)
            rows[_ids(path)] = [a.ravel().astype(t.dtype) for a in pair]
            return result

        args = [(t, STRAIGHT), *((None, STATEFUL) for _ in self.timed.invars[1:])]
        Interpreter(meet, False).run(self.timed, consts, args)
        height, value = zip(*(rows[_ids(s.path)] for s in self.switches), strict=True)
        return jnp.concatenate(height), jnp.concatenate(value)

    def field(self, values: Array, over: Array, consts: Arrays, t: Array, *rest: Any) -> Any:
        """Return the field's value, its switches at `values` (m,) or, if `over`, at their own."""
        parts = np.cumsum([s.size for s in self.switches])[:-1]
        own = dict(
            zip(
                (_ids(s.path) for s in self.switches),
                zip(self.switches, jnp.split(values, parts), strict=True),
                strict=True,
            )
        )

        def meet(path: Any, inputs: Any, result: Array, kind: int) -> Array:
            if _ids(path) not in own:
                return result
            switch, values = own[_ids(path)]
            return jnp.where(over, result, switch.result(values, inputs, result))

        args = [(t, STRAIGHT), *((leaf, STATEFUL) for leaf in rest)]
        ((out, _),) = Interpreter(meet, True).run(self.traced.jaxpr, consts, args)
        return out


def _ids(path: tuple[Any, ...]) -> tuple[int, ...]:
    return tuple(map(id, path))


def find_switches(traced: ClosedJaxpr) -> Switches:
    """Return the switches of a traced field f(t, y, …) of one result.

    The module `switching_times` finds the times at which they change.
    """
    jaxpr, switches, unfound = traced.jaxpr, [], []

    def hidden(path: tuple[Any, ...], more: str = "") -> None:
        line = _searched_line(path)
        # An interpolation in a long table has kinks, no jumps.
        kinks = _DIFFRAX in line or any(eqn.params.get("name") == "_interp" for eqn in path)
        if line and not (more and kinks):
            unfound.append(f"{_name(path[-1])}{more}, {line}")

    def meet(path: tuple[Any, ...], inputs: Any, result: Array, kind: int) -> Array:
        eqn, name = path[-1], _name(path[-1])
        size = _height_and_value(eqn, inputs, result)[0].size
        if name in _KINKS and size > FEW_KINKS:
            return result
        if size > MOST:
            hidden(path, f" of {size} elements")
        elif line := _searched_line(path):
            leaps = name in _LEVELS and result.dtype != bool
            switch = Switch(path, kind, size, f"{name}, {line}", leaps, _asks_for_nan(eqn))
            switches.append(switch)
        return result

    def look(t: Array) -> None:
        given = [(t, STRAIGHT), *((None, STATEFUL) for _ in jaxpr.invars[1:])]
        Interpreter(meet, False, hidden).run(jaxpr, traced.consts, given)

    if _contains_switch(jaxpr, kinks=True):
        jax.eval_shape(look, traced.in_avals[0])
    timed, _ = _live_equations(jaxpr, (), [id(s.path[0]) for s in switches])
    lean = jaxpr.replace(eqns=timed, outvars=[v for eqn in timed for v in eqn.outvars])
    return Switches(traced, lean, switches, list(dict.fromkeys(unfound)))
