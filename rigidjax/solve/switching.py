"""Find the equations of a traced vector field that switch at times independent of the state.

A law that a user writes, such as `jnp.where(t < self.te, push, 0.0)`, declares no `jump_times`, but
the traced program of the field contains its comparison. If the comparison depends on the time but
not on the state, the times at which its result changes are found before the run, by halving
intervals. This finds even the ends of a very short pulse, because many comparisons change only
once: a comparison of two linear functions of time does, and a comparison of a constant with a
function of time that only rises or only falls. The steps of the run end at the times found, which
are called stops. During the run the comparison is not evaluated: its result follows from the stops
that the step has passed. The result therefore does not depend on rounding, and two comparisons that
change at the same time are treated separately.

The switching function g of a comparison is the difference of its two operands. It is a function of
the time t and of the constants p of the field. The equation `g(p, t) = 0` defines the switching
time t as an implicit function of p, and gives the derivatives of this time.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportPrivateImportUsage]
    Jaxpr,
    Literal,
)
from jax.extend.source_info_util import summarize

from rigidjax.solve.batching import Arrays

# The name of the scope (`jax.named_scope`) in which a law that declares its jumps is called. No
# switch is searched for in the equations of this scope.
DECLARED = "rigidjax_declared_jumps"
_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_EQUINOX = os.path.dirname(os.path.abspath(eqx.__file__)) + os.sep
# The number of innermost calls among which a line outside of JAX and Equinox is looked for.
_FRAMES = 8

# `COMPARISONS`: primitives whose result changes when the first operand becomes equal to the second.
# `_LEVELS`: primitives whose result changes when the first operand (for `rem` the quotient of the
# two operands) passes a whole number. `sign`, whose result changes when its operand passes zero, is
# in neither set; the function `_may_jump` adds it.
COMPARISONS = {"lt", "le", "gt", "ge", "lt_to", "le_to"}
_LEVELS = {"floor", "ceil", "round", "convert_element_type", "rem"}
# Primitives whose result has a kink when two operands become equal or, for `abs`, when the operand
# passes zero.
KINKS = {"max", "min", "abs", "clamp"}
# Primitives whose result may jump, but whose jumps are not searched for, because they choose or
# order elements of an array, or work on the bits of a number.
_CHOICES = {"argmax", "argmin", "sort", "top_k", "bitcast_convert_type", "nextafter"}
# Primitives whose content cannot be read.
_OPAQUE = {"pure_callback", "io_callback", "custom_call", "ffi_call"}
# Primitives whose result jumps, but is not constant between its jumps, like a saw tooth.
_SAWS = {"rem", "atan2", "sort", "top_k", "nextafter"}
# A flat program is a traced function as one list of equations. `_CALLS`: calls whose body is
# written out in the flat program. `_WHOLE`: calls that stay one equation of the flat program; their
# bodies are nevertheless searched for switches.
_CALLS = {"jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2"}
_WHOLE = {"cond", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}
# `_LINEAR`: primitives that are linear in all operands together. `_PRODUCTS`: primitives that are
# linear in each of two operands alone.
_LINEAR = {
    "add", "sub", "add_any", "neg", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze",
    "slice", "transpose", "rev", "concatenate", "reduce_sum", "cumsum", "expand_dims",
    "convert_element_type", "stop_gradient", "optimization_barrier", "gather", "dynamic_slice",
}  # fmt: skip
_PRODUCTS = {"mul", "dot_general"}
# Primitives of one operand whose result only rises or only falls when the operand rises.
_MONOTONE = {
    "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "tanh", "logistic", "erf", "sinh",
    "asinh", "atan",
}  # fmt: skip
# How a value depends on the time. `CONSTANT`: not at all. `PIECES`: it is constant except for
# jumps. `STRAIGHT`: it is a linear function of the time. `MONOTONE`: it only rises or only falls.
# `BENT`: in any other way.
CONSTANT, PIECES, STRAIGHT, MONOTONE, BENT = range(5)

MOST = 64  # the largest number of switching times of one law, or of one `floor`, `round`, …
_FEW = 32  # a comparison of more elements than this is treated as a table, not as a switch
_FEW_KINKS = 3  # steps do not end at the kinks of an operation that has more kinks than this
# The changes of a switch whose operand may rise and fall in time (`BENT`) are searched for on a
# grid of times. Between two points of the grid an element may change twice. Such changes are
# searched for near at most `NEAR` points of the grid: those where the switch comes closest to a
# change.
NEAR = 16


class Equation(NamedTuple):
    """Hold an equation of a flat program, in which each value is identified by an integer.

    A flat program is a traced function as one list of equations. An input of an equation is the
    integer of a value or a literal, and an output is the integer of a value.
    """

    primitive: Any
    params: dict[str, Any]
    inputs: list[Any]
    outputs: list[int]
    dtypes: list[Any]  # the dtype of each input that has one
    shapes: list[Any]  # the shape and dtype of each output
    sources: tuple[Any, ...]  # where the equation and, from inside out, the calls around it stand
    declared: bool  # whether it belongs to a part that declares its jumps

    @property
    def line_of_code(self) -> str:
        """Return the line of code that wrote this equation: its file and its number.

        Lines of JAX and Equinox are passed over. JAX traces some of its own functions only once,
        such as `jnp.round`. Their equations name no other line, and the line that calls the
        function is returned.
        """
        for source in self.sources:
            for line in reversed(summarize(source, num_frames=_FRAMES).splitlines()):
                if line and not line.startswith(_EQUINOX):
                    return line
        return ""

    @property
    def primitive_name(self) -> str:
        """Return the name of the equation's primitive, or "searchsorted" for `jnp.searchsorted`."""
        return _primitive_name(self)


class Program(NamedTuple):
    """Hold a function f(t, y, …) as a flat list of equations; integers identify its values.

    Value 0 is the time t, and value 1 is the state y.
    """

    equations: list[Equation]  # the equations, in the order of evaluation
    constants: list[int]  # the values that are constants of the traced function
    inner: dict[int, Any]  # the constants of inner calls; the keys are the integers of these values
    inputs: list[int]  # the values that are arguments of the function
    output: Any  # the value that the function returns


class Switch(NamedTuple):
    """Hold an equation whose result jumps, or has a kink, at times independent of the state.

    An example is the comparison in `jnp.where(t < 1, push, 0.0)`. A comparison of arrays has
    several elements, each of which changes at times of its own.
    """

    equation: Equation
    time_dependence: int  # how the operands depend on the time: `STRAIGHT`, …
    size: int  # the number of elements that are compared
    jumps: bool  # whether the result jumps; else it has a kink

    @property
    def most_changes_if_monotonic(self) -> int:
        """Return how many changes of each element of this switch are stored, if it is monotonic.

        An element is one number of the result of the switch, which may be an array. The switch is
        monotonic if its operand only rises or only falls in time. A comparison changes at most once
        in this case, so that the number is 1. A function such as `floor` may change any number of
        times; at most `MOST` of its changes are stored.
        """
        return MOST if self.equation.primitive_name in _LEVELS else 1

    @property
    def storable_changes(self) -> int:
        """Return how many changes of this switch, at its switching times, can be stored in all.

        The number is for all elements together, such as those of a comparison of arrays.
        """
        return (
            MOST + 2 * NEAR
            if self.time_dependence == BENT
            else self.size * self.most_changes_if_monotonic
        )

    @property
    def stores_all_changes(self) -> bool:
        """Return whether all changes of this switch can be stored, however many there are.

        This is so, for example, for a comparison whose operand only rises or only falls in time,
        because each element then changes at most once.
        """
        return self.time_dependence < BENT and self.most_changes_if_monotonic == 1

    @property
    def primitive_and_line(self) -> str:
        """Return the name of the primitive of this switch, and the line of code that wrote it.

        The line is one of the user's code, given by its file and its number.
        """
        return f"{self.equation.primitive_name}, {self.equation.line_of_code}"


class Analysis(NamedTuple):
    """Hold the switches of a program, and the lines of code whose switches cannot be found.

    A switch is an equation, such as the comparison `t < 1`, whose result jumps or has a kink at
    times that do not depend on the state.
    """

    program: Program
    switches: list[Switch]
    # Operations with so many kinks that no steps end at these kinks. The times of the kinks are
    # computed only because they help to find the changes of switches whose operand may rise and
    # fall in time (`BENT`).
    kinks: list[Switch]
    by_state: list[str]  # the lines of code whose result switches at values of the state
    unseen: list[str]  # the lines of code that may switch at times that cannot be searched for


def _inner_programs(params: dict[str, Any]) -> Iterator[tuple[Jaxpr, Sequence[Any]]]:
    """Yield each program (a `Jaxpr`) among the parameters of an equation, and its constants.

    - `params`: the parameters of an equation of a `Jaxpr`; a `cond`, for example, has one program
      for each branch.
    """
    for value in params.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            if isinstance(part, ClosedJaxpr):
                yield part.jaxpr, part.consts
            elif isinstance(part, Jaxpr):
                yield part, ()


def _primitive_name(eqn: Any) -> str:
    """Return the name of an equation's primitive, or "searchsorted" for `jnp.searchsorted`.

    - `eqn`: an equation of a `Jaxpr`, or an `Equation` of this module.
    """
    called = eqn.params.get("name")
    return "searchsorted" if called == "searchsorted" else eqn.primitive.name


def _dtypes_of_inputs(eqn: Any) -> list[Any]:
    """Return the dtypes of the inputs of `eqn`, an equation of a `Jaxpr`.

    An input without a dtype is left out.
    """
    return [atom.aval.dtype for atom in eqn.invars if hasattr(atom.aval, "dtype")]


def _is_float(dtype: Any) -> bool:
    """Return whether `dtype` is a floating-point dtype."""
    return jnp.issubdtype(dtype, jnp.floating)


def _may_jump(name: str, params: dict[str, Any], dtypes: list[Any]) -> bool:
    """Return whether the result of an equation may jump while its operands change continuously.

    The answer is no if the first operand is a boolean or a whole number, because such an operand
    never changes continuously.

    - `name`, `params`: the name of the primitive of the equation, such as "lt" for `t < 1`, and its
      parameters.
    - `dtypes`: the dtypes of the operands of the equation.
    """
    if not dtypes or not _is_float(dtypes[0]):
        return False
    if name == "convert_element_type":
        return not _is_float(params["new_dtype"])
    return name in COMPARISONS | _LEVELS | _CHOICES | {"sign", "atan2", "searchsorted"}


def _may_have_kink(name: str, dtypes: list[Any]) -> bool:
    """Return whether the result of an equation may have a kink although its operands have none.

    At a kink the slope jumps and the value does not; `abs`, for example, has a kink at 0.

    - `name`: the name of the primitive of the equation, such as "abs".
    - `dtypes`: the dtypes of the operands of the equation.
    """
    return bool(dtypes) and _is_float(dtypes[-1]) and name in KINKS


def _contains_switch(jaxpr: Jaxpr, with_kinks: bool = False) -> bool:
    """Return whether a program, or a program inside it, has an equation whose result may jump.

    The answer is also yes for an equation whose content cannot be read, such as a callback.

    - `jaxpr`: the program.
    - `with_kinks`: whether the answer is also yes for an equation whose result may have a kink, at
      which its slope jumps.
    """
    for eqn in jaxpr.eqns:
        name, dtypes = _primitive_name(eqn), _dtypes_of_inputs(eqn)
        if (
            _may_jump(name, eqn.params, dtypes)
            or (with_kinks and _may_have_kink(name, dtypes))
            or name in _OPAQUE
        ):
            return True
        if any(_contains_switch(body, with_kinks) for body, _ in _inner_programs(eqn.params)):
            return True
    return False


def flatten_traced_function(traced: ClosedJaxpr) -> Program:
    """Return a traced function as one flat list of equations, in which calls are written out.

    A call such as `jit` is replaced by the equations of its body. A call such as `cond` cannot be
    replaced, and stays one equation; the equations of its body follow it in the list, so that
    switches among them are found.

    An equation on which the result does not depend is left out, unless it has an effect, such as a
    print.

    - `traced`: the traced function f(t, y, …).
    """
    numbers, equations, inner = count(), [], {}

    def enter(
        jaxpr: Any, consts: Any, inputs: list[Any], around: tuple[tuple[Any, ...], bool],
        wanted: list[bool],
    ) -> list[Any]:  # fmt: skip
        # `around` describes the calls around this program: where they stand, and whether they
        # belong to a part that declares its jumps. `wanted` says which results are used.
        scope: dict[Any, Any] = dict(zip(jaxpr.invars, inputs, strict=True))
        scope |= dict(zip(jaxpr.constvars, consts, strict=True))
        read = lambda atom: atom if isinstance(atom, Literal) else scope[atom]  # noqa: E731
        live, used = _live_equations(jaxpr, wanted)
        for eqn in live:
            args, name = [read(atom) for atom in eqn.invars], _primitive_name(eqn)
            sources = (eqn.source_info, *around[0])
            own = around[1] or DECLARED in str(eqn.source_info.name_stack)
            if name in _CALLS:
                ((body, held),) = _inner_programs(eqn.params)
                asked = [variable in used for variable in eqn.outvars]
                outputs = enter(body, kept(held), args, (sources, own), asked)
            else:
                outputs = [next(numbers) for _ in eqn.outvars]
                shapes = [variable.aval for variable in eqn.outvars]
                equation = Equation(
                    eqn.primitive, eqn.params, args, outputs, _dtypes_of_inputs(eqn), shapes,
                    sources, own,
                )  # fmt: skip
                equations.append(equation)
                if name in _WHOLE:
                    for body, held in _inner_programs(eqn.params):
                        given, every = args[len(args) - len(body.invars) :], [True]
                        enter(body, kept(held), given, (sources, own), every * len(body.outvars))
            scope.update(zip(eqn.outvars, outputs, strict=True))
        return [
            read(atom) if use else None for atom, use in zip(jaxpr.outvars, wanted, strict=True)
        ]

    def kept(consts: Any) -> list[int]:
        names = [next(numbers) for _ in consts]
        inner.update(zip(names, consts, strict=True))
        return names

    inputs = [next(numbers) for _ in traced.jaxpr.invars]
    constants = [next(numbers) for _ in traced.consts]
    (output,) = enter(traced.jaxpr, constants, inputs, ((), False), [True])
    return Program(equations, constants, inner, inputs, output)


def _live_equations(jaxpr: Jaxpr, wanted: list[bool]) -> tuple[list[Any], set[Any]]:
    """Return the equations of a program on which its wanted results depend, and their variables.

    Equations with effects, such as a print, are returned, too.

    - `jaxpr`: the program.
    - `wanted`: for each result of the program, whether it is wanted.

    **Returns** two things: the equations in the order of evaluation; and the set of the variables
    that the equations, or the caller of the program, read.
    """
    results = zip(jaxpr.outvars, wanted, strict=True)
    used = {atom for atom, use in results if use and not isinstance(atom, Literal)}
    live = []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or any(variable in used for variable in eqn.outvars):
            live.append(eqn)
            used.update(atom for atom in eqn.invars if not isinstance(atom, Literal))
    return live[::-1], used


def depends_on_time(traced_field: ClosedJaxpr) -> bool:
    """Return whether the result of a traced field f(t, y, …) depends on the time t.

    A field may compute a number from the time that it does not use, as a uniformly turning frame
    computes its rotation matrix.
    """
    program = flatten_traced_function(traced_field)
    time = program.inputs[0]
    return program.output == time or any(time in each.inputs for each in program.equations)


def time_dependence_of(equation: Equation, operand_dependences: list[int]) -> int:
    """Return how the result of an equation depends on the time.

    The result is `CONSTANT`, `PIECES` (constant except for jumps), `STRAIGHT` (linear), `MONOTONE`
    (only rising or only falling), or `BENT` (in any other way).

    - `equation`: the equation.
    - `operand_dependences`: how each operand depends on the time, as one of the same five values.
    """
    operands = operand_dependences
    timed, name = [d for d in operands if d != CONSTANT], equation.primitive_name
    if not timed:
        return CONSTANT
    if max(timed) == PIECES:
        return PIECES
    if _may_jump(name, equation.params, equation.dtypes):
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


def find_switches(traced_field: ClosedJaxpr) -> Analysis | None:
    """Return the switches of a traced field f(t, y, …), or `None` if nothing in it can switch.

    A switch is an equation, such as the comparison `t < 1`, whose result jumps or has a kink at
    times that do not depend on the state. This function finds the equations; the module
    `switching_times` finds the times.

    - `traced_field`: the field after tracing, whose first two arguments are the time and the state.
    """
    if not _contains_switch(traced_field.jaxpr, with_kinks=True):
        return None
    program = flatten_traced_function(traced_field)
    degrees, of_state = {program.inputs[0]: STRAIGHT}, set(program.inputs[1:])
    switches, kinks, by_state, unseen = [], [], [], []
    for equation in program.equations:
        inputs = [i for i in equation.inputs if not isinstance(i, Literal)]
        look = lambda i: CONSTANT if isinstance(i, Literal) else degrees.get(i, CONSTANT)  # noqa: E731
        operands = [look(i) for i in equation.inputs]
        stateful = any(i in of_state for i in inputs)
        degrees.update(dict.fromkeys(equation.outputs, time_dependence_of(equation, operands)))
        if stateful:
            of_state.update(equation.outputs)
        # If all operands are constant except for jumps, the result changes only at these jumps.
        # Their times are searched for at the equations that cause them.
        timed = max(operands, default=CONSTANT) > PIECES
        if (
            not (timed or stateful)
            or equation.declared
            or not _may_switch(equation)
            or _is_of_this_package(equation)
        ):
            continue
        where = f"{equation.primitive_name}, {equation.line_of_code}"
        jumps = _may_jump(equation.primitive_name, equation.params, equation.dtypes)
        if jumps and stateful:
            by_state.append(where)
        elif _may_hide_switches(equation):
            unseen += [where] * timed
        elif timed and not stateful:
            switch = _switch_of(program, equation, operands, jumps)
            if switch.size <= (_FEW if jumps else _FEW_KINKS):
                switches.append(switch)
            elif switch.size <= _FEW:
                kinks.append(switch)
    bent = any(switch.time_dependence == BENT for switch in switches)
    return Analysis(program, switches, kinks if bent else [], by_state, unseen)


def _is_of_this_package(equation: Equation) -> bool:
    """Return whether this package, and not the user's code, wrote the equation `equation`.

    The torque laws of this package state the times of their jumps themselves, so that these times
    need not be searched for in their equations.
    """
    return equation.line_of_code.startswith(_PACKAGE)


def _may_switch(equation: Equation) -> bool:
    """Return whether the result of the equation `equation` may jump or have a kink.

    At a kink the slope jumps and the value does not. The answer is also yes for an equation that
    contains a program, such as `cond`, because there may be a jump inside this program, and for an
    equation whose content cannot be read, such as a callback.
    """
    name = equation.primitive_name
    jumps = _may_jump(name, equation.params, equation.dtypes) or _may_have_kink(
        name, equation.dtypes
    )
    return jumps or name in _OPAQUE or any(True for _ in _inner_programs(equation.params))


def _may_hide_switches(equation: Equation) -> bool:
    """Return whether the result of an equation may jump at times that cannot be searched for.

    Examples of such equations are `argmax` of an array, a callback, and a loop that contains a
    comparison.
    """
    if equation.primitive_name in _CHOICES | {"atan2"}:
        return True
    if equation.primitive_name in _WHOLE | {"searchsorted"}:
        return False
    return equation.primitive_name in _OPAQUE or any(
        _contains_switch(body) for body, _ in _inner_programs(equation.params)
    )


def _switch_of(
    program: Program, equation: Equation, operand_dependences: list[int], jumps: bool
) -> Switch:
    """Return an equation as a `Switch`, which says how the result of the equation changes in time.

    - `program`: the program that contains the equation.
    - `equation`: the equation, whose result depends on the time but not on the state.
    - `operand_dependences`: how each operand depends on the time: `CONSTANT` (not at all), `PIECES`
      (constant except for jumps), `STRAIGHT` (linear), `MONOTONE` (only rising or only falling) or
      `BENT` (in any other way).
    - `jumps`: whether the result jumps; else it has a kink, at which its slope jumps.
    """
    name = equation.primitive_name
    compared = operand_dependences[: 1 if name in _LEVELS - {"rem"} else 3]
    timed = [d for d in compared if d != CONSTANT]
    steady = len(timed) == 1 or set(timed) == {STRAIGHT}
    steady = steady and not (name == "rem" and compared[1] != CONSTANT)
    steady = steady and not (name == "searchsorted" and compared[0] != CONSTANT)
    shape = equation.shapes[0].shape
    size = int(np.prod(shape)) * (2 if name == "clamp" else 1)
    if name == "searchsorted":
        # A `searchsorted` for one time among sorted edges is a switch. A `searchsorted` for many
        # times is treated as a table, which is no switch: its size is set to one that is too large
        # for a switch.
        size = _number_of_searchsorted_edges(equation) if shape == () else _FEW + 1
    return Switch(equation, max(timed) if steady else BENT, size, jumps)


def _number_of_searchsorted_edges(equation: Equation) -> int:
    """Return the length of the sorted array (the edges) in which a call of `searchsorted` searches.

    - `equation`: the equation that calls `searchsorted`.
    """
    body: Any
    ((body, _),) = _inner_programs(equation.params)
    return int(np.prod(body.invars[0].aval.shape))


def evaluator(
    program: Program, wanted: list[int | Literal], replaced: dict[int, Any] | None = None
) -> Callable[..., list[Any]]:
    """Return a function that evaluates the `wanted` values of a program, and nothing else.

    - `program`: the program, in which each value is identified by an integer.
    - `wanted`: the values to be returned: integers, or literals.
    - `replaced`: a dict of equations that are not evaluated, or `None` for none. The key is the
      integer of the output of the equation. The value is an object that computes this output: its
      method `result(read, inputs)` returns the output, where `read(i)` is the value with the
      integer i and `inputs` are the arguments of the program. Its member `needed_inputs` lists the
      inputs of the equation that `result` reads.

    **Returns** a function `(constants, *inputs)` that returns the list of the wanted values. Its
    arguments are the constants of the program and the arguments of the program.
    """
    replaced = replaced or {}
    needed, equations = {i for i in wanted if not isinstance(i, Literal)}, []
    for equation in reversed(program.equations):
        if any(output in needed for output in equation.outputs):
            equations.append(equation)
            own = replaced.get(equation.outputs[0])
            inputs = equation.inputs if own is None else own.needed_inputs
            needed.update(i for i in inputs if not isinstance(i, Literal))

    def evaluate(constants: Arrays, *inputs: Any) -> list[Any]:
        known = dict(zip(program.constants, constants, strict=True)) | program.inner
        known |= dict(zip(program.inputs, inputs, strict=False))
        read = lambda i: i.val if isinstance(i, Literal) else known[i]  # noqa: E731
        for equation in reversed(equations):
            if equation.outputs[0] in replaced:
                known[equation.outputs[0]] = replaced[equation.outputs[0]].result(read, inputs)
                continue
            params = equation.primitive.get_bind_params(equation.params)
            out = equation.primitive.bind(*(read(i) for i in equation.inputs), **params)
            out = out if equation.primitive.multiple_results else [out]
            known.update(zip(equation.outputs, out, strict=True))
        return [read(i) for i in wanted]

    return evaluate
