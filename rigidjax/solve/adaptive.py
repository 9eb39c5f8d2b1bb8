"""A run with adaptive steps as one function of numbers, differentiable in both modes, batched."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from rigidjax.motion.equations import on_the_group
from rigidjax.solve import adaptive_loop, adjoint
from rigidjax.solve.batching import Arrays, Layout, in_lanes
from rigidjax.solve.components import flat, leaf_sizes, unflat
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.linear_map import is_smooth, linear_map, no_tangent, refuse
from rigidjax.solve.step_control import HALTED, Answer, Method, Record, Run, outcome
from rigidjax.solve.tableaus import Tableau


class Found(NamedTuple):
    """The result of `adaptive`.

    **Fields:** `ys` the states, of the type of `y0`, with a leading time axis; `num_steps`,
    `num_rejected` of the whole run; `result` a `diffrax.RESULTS`; `last_time`, `last` the time and
    state at the end.
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS
    last_time: Array
    last: Any


def adaptive(
    solver: AbstractExplicit,
    field: Callable[..., Any],
    ts: Array,
    y0: Any,
    *,
    rtol: Any,
    atol: Any,
    dt0: Any = None,
    max_steps: int = 100_000,
    jumps: Array | None = None,
    halt: Callable[..., Any] | None = None,
) -> Found:
    """The states at `ts`, with adaptive steps.

    The norm, the control of the step (integral, safety 0.9) and the first step are those of
    `diffrax.PIDController`.

    **Arguments:** `solver` an explicit method of this package; `field` a vector field
    `f(t, y, args)` as of `equations_of_motion`; `ts` (T,) s; `y0` the state at `ts[0]`; `rtol`,
    `atol` scalars; `dt0` the first step, s, or `None`; `jumps` times, s, in any order, at which the
    field jumps: steps end there; `halt(t, y)` a condition, tested after each step, that ends the
    run. Derivatives are by all numbers of the field, `ts`, `jumps` and
    `y0`, lengths of steps held; not by tolerances.

    **Returns** `ys`, `num_steps`, `num_rejected`, `result`, `last_time`, `last` (`Found`). A run
    that needs more than `max_steps`, is halted, or meets a NaN that no shorter step avoids, ends
    early: its `result` says so, and the states not reached are NaN.

    **Raises:** `TypeError` for a state of several dtypes, or of another than `ts`.

    >>> import rigidjax as rj
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> solver, ts = rj.solvers.Tsitouras5(), jnp.array([0.0, 1.0])
    >>> adaptive(solver, field, ts, start, rtol=1e-9, atol=1e-9).ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    numbers = flat(y0)
    if ts.dtype != numbers.dtype:
        raise TypeError(
            f"adaptive: wanted times and state of one dtype, got {ts.dtype} and {numbers.dtype}"
        )
    program, constants = _program(solver.tableau, field, halt, ts[0], y0, max_steps)
    stops = ts[-1:]
    if jumps is not None and jumps.size:
        inside = jnp.clip(jnp.sort(jumps.astype(ts.dtype)), ts[0], ts[-1])
        stops = jnp.concatenate([inside, stops])
    run = Run(
        ts[0],
        stops,
        ts[1:-1],
        numbers,
        jnp.asarray(rtol, numbers.dtype),
        jnp.asarray(atol, numbers.dtype),
        jnp.asarray(jnp.nan if dt0 is None else dt0, ts.dtype),
    )
    out = _solved(program, constants, run)
    result = outcome(out.h, out.t, ts[-1], out.h == HALTED)
    rows = jnp.concatenate([numbers[None], out.between, out.end[None]])
    ys = jax.vmap(partial(unflat, like=y0))(rows)
    return Found(ys, out.steps, out.rejected, result, out.t, unflat(out.last, y0))


class _Program(NamedTuple):
    """The compiled program: a method whose `field(constants, t, y)` is for one body.

    **Fields:** `halt(constants, t, y)` the condition that ends a run, or `None`; `smooth` which of
    the constants have derivatives.
    """

    method: Method
    halt: Callable[..., Any] | None
    smooth: tuple[bool, ...]

    def of(self, layout: Layout, constants: Arrays) -> tuple[Method, Arrays]:
        """The method on (n, *bodies), and those of the constants that have derivatives."""
        method, field, halt = self.method, self.method.field, self.halt
        if layout.bodies:
            shared = [None if s else -1 for s in layout.shared]
            field = jax.vmap(field, (shared, -1, -1), -1)
            halt = None if halt is None else jax.vmap(halt, (shared, -1, -1), -1)
            method = method._replace(project=jax.vmap(method.project, -1, -1))

        def of_smooth(chosen: Arrays, t: Array, y: Array) -> Array:
            mixed, rest = iter(chosen), constants
            both = [next(mixed) if s else c for c, s in zip(rest, self.smooth, strict=True)]
            return field(both, t, y)

        chosen = [c for c, s in zip(constants, self.smooth, strict=True) if s]
        if halt is not None:
            method = method._replace(halt=partial(halt, constants))
        return method._replace(field=of_smooth), chosen


def _program(
    tableau: Tableau,
    field: Callable[..., Any],
    halt: Callable[..., Any] | None,
    t0: Array,
    y0: Any,
    max_steps: int,
) -> tuple[_Program, Arrays]:
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), y0)

    def flat_field(t: Array, y: Array) -> Array:
        return flat(field(t, unflat(y, like), None))

    def project(y: Array) -> Array:
        return flat(on_the_group(unflat(y, like)))

    functions: list[Any] = [flat_field]
    if halt is not None:
        functions.append(lambda t, y: halt(t, unflat(y, like)))
    (of_one, *ended), constants, count = taken_out(functions, t0, flat(y0))
    # The condition that ends a run has no derivative.
    smooth = [i < count and is_smooth(c) for i, c in enumerate(constants)]
    method = Method(tableau, of_one, project, None, leaf_sizes(like), max_steps)
    return _Program(method, ended[0] if ended else None, tuple(smooth)), constants


def taken_out(
    functions: list[Callable[..., Any]], *like: Any
) -> tuple[list[Callable[..., Any]], Arrays, int]:
    """Each function as `f(constants, *args)`; the constants: what they depend on, also by closure.

    **Returns** the functions, the constants of all, and how many of these are the first one's.
    """
    constants: Arrays = []
    out, counts = [], []
    for function in functions:
        arrays, rest = eqx.partition(eqx.filter_closure_convert(function, *like), eqx.is_array)
        own, tree = jax.tree.flatten(arrays)
        counts.append(len(own))
        out.append(
            partial(_of_constants, slice(len(constants), len(constants) + len(own)), tree, rest)
        )
        constants += own
    return out, constants, counts[0]


def _of_constants(part: slice, tree: Any, rest: Any, constants: Arrays, *args: Any) -> Any:
    return eqx.combine(jax.tree.unflatten(tree, constants[part]), rest)(*args)


def _solved(program: _Program, constants: Arrays, run: Run) -> Answer:
    # The states between and at the end are what has derivatives.
    number, ends = len(constants), 2

    def mapped(kind: Any, linear: int, *args: Any) -> Arrays:
        return in_lanes(partial(kind, program), list(args[:number]), list(args[number:]), linear)

    @jax.custom_jvp
    def answer(*args: Any) -> Arrays:
        return mapped(_value, 0, *args)

    @jax.custom_jvp
    def recorded(*args: Any) -> Arrays:
        return mapped(_recorded, 0, *args)

    def tangents_of(primals: Any, tangents: Any, pull: Any = None) -> tuple[Arrays, Arrays]:
        """The result of `recorded`, and the tangents of its states; transposed by `pull`."""
        # A number without a tangent needs no derivative.
        there = [not isinstance(t, SymbolicZero) for t in tangents]
        smooth = tuple(s and t for s, t in zip(program.smooth, there[:number], strict=True))
        moving = _Moving(smooth, tuple(there[number:]))
        along = [t for t, m in zip(tangents, (*smooth, *moving.run), strict=True) if m]
        found = recorded(*primals)
        given = [*primals, *found[len(Answer._fields) :]]
        push = partial(mapped, partial(_pushed, moving), len(along))
        if pull is None:
            return found, linear_map(push, refuse, given, along)
        back = partial(mapped, partial(pull, moving), ends)
        return found, linear_map(lambda *args: push(*args)[:ends], back, given, along)

    def of_answer(primals: Any, tangents: Any) -> Any:
        found, moved = tangents_of(primals, tangents, _pulled)
        out = found[: len(Answer._fields)]
        return out, [*moved, *(no_tangent(a) for a in out[ends:])]

    def of_record(primals: Any, tangents: Any) -> Any:
        found, moved = tangents_of(primals, tangents)
        rest = [no_tangent(a) for a in found]
        between, end, starts, rows = moved
        head = len(Answer._fields)
        record = Record(*rest[head:])._replace(starts=starts, rows=rows)
        return found, [between, end, *rest[ends:head], *record]

    answer.defjvp(of_answer, symbolic_zeros=True)
    recorded.defjvp(of_record, symbolic_zeros=True)
    return Answer(*answer(*constants, *run))


class _Moving(NamedTuple):
    """A mask of the constants and the numbers of a run that have tangents."""

    constants: tuple[bool, ...]
    run: tuple[bool, ...]


def _value(program: _Program, layout: Layout, constants: Arrays, each: Arrays) -> Arrays:
    method, chosen = program.of(layout, constants)
    return list(adaptive_loop.value(method, chosen, Run(*each)))


def _recorded(program: _Program, layout: Layout, constants: Arrays, each: Arrays) -> Arrays:
    method, chosen = program.of(layout, constants)
    run = Run(*each)
    answer, record = adaptive_loop.recording(method, chosen, run)
    number, filled = (jnp.broadcast_to(a, run.t0.shape) for a in (record.number, record.filled))
    return [*answer, *record._replace(number=number, filled=filled)]


def _again(
    moving: _Moving, program: _Program, layout: Layout, constants: Arrays, each: Arrays
) -> tuple[Method, Arrays, Run, Record, Arrays]:
    """A recorded run, those of the constants that move one a body; tangents or cotangents."""
    many, whole = len(Run._fields), len(Run._fields) + len(Record._fields)
    run, record = Run(*each[:many]), Record(*each[many:whole])
    if layout.bodies:
        own = zip(constants, layout.shared, moving.constants, strict=True)
        constants = [
            jnp.broadcast_to(c[..., None], (*c.shape, *run.t0.shape)) if shared and moves else c
            for c, shared, moves in own
        ]
        shared = (a and not b for a, b in zip(layout.shared, moving.constants, strict=True))
        layout = layout._replace(shared=tuple(shared))
    method, chosen = program._replace(smooth=moving.constants).of(layout, constants)
    return method, chosen, run, record, each[whole:]


def _pushed(
    moving: _Moving, program: _Program, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    method, chosen, run, record, along = _again(moving, program, layout, constants, each)
    rest = iter(along[len(chosen) :])
    still = zip(run, moving.run, strict=True)
    of_run = Run(*(next(rest) if moves else jnp.zeros_like(a) for a, moves in still))

    def again(chosen: Arrays, run: Run) -> tuple[Array, ...]:
        return adjoint.replayed(method, chosen, run, record)

    return list(jax.jvp(again, (chosen, run), (along[: len(chosen)], of_run))[1])


def _pulled(
    moving: _Moving, program: _Program, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    method, chosen, run, record, bars = _again(moving, program, layout, constants, each)
    timed = any(moving.run[:3])
    total, of_run = adjoint.cotangents(method, chosen, run, record, bars, timed)
    return [*total, *(a for a, moves in zip(of_run, moving.run, strict=True) if moves)]
