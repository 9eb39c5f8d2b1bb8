"""A run with adaptive steps as one function of numbers, differentiable in both modes, batched."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from rigidjax.motion.equations import project_to_group
from rigidjax.solve import adaptive_loop, adjoint, validation
from rigidjax.solve.adaptive_loop import HALTED, LoopState, Method, Record, Run, outcome
from rigidjax.solve.batching import Arrays, Layout, in_lanes
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.linear_map import linear_map, refuse
from rigidjax.solve.stops import stopped, traced


class Found(NamedTuple):
    """The result of `adaptive`.

    **Fields:** `ys` the states at `ts`; `num_steps` accepted and rejected, `num_rejected` of these;
    `result` a `diffrax.RESULTS`; `last` the state at the end, `last_time`, and
    `next_step`, the length of the step that would follow; `over` whether a part
    switches by the time more often than is looked for (`None`: nothing does).
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS
    last_time: Array
    last: Any
    next_step: Array
    over: Array | None


def adaptive(
    solver: AbstractExplicit,
    field: Callable[..., Any],
    ts: Array,
    y0: Any,
    *,
    rtol: Any,
    atol: Any,
    dt0: Any = None,
    max_step: Any = None,
    max_steps: int = 100_000,
    jumps: Array | Sequence[Array] | None = None,
    halt: Callable[..., Any] | None = None,
) -> Found:
    """The states at `ts`, with adaptive steps, controlled as by `diffrax.PIDController`.

    **Arguments:** `solver` an explicit method of this package; `field` a vector field
    `f(t, y, args)` as of `equations_of_motion`; `ts` (T,) s; `y0` the state at `ts[0]`; `rtol`,
    `atol` scalars; `dt0` the first step and `max_step` the longest, s, or `None`; `jumps` times,
    s, in any order, at which the field jumps: steps end there (several arrays: one of each part of
    the field, which gets the stops of each as its `args`); times with which the field compares the
    time itself are found; `halt(t, y)` a condition, tested after each step, that ends the run.
    Derivatives are by all numbers of the field, `ts`, `jumps` and `y0`, lengths of steps held.

    **Returns** a `Found`. A run that needs more than `max_steps`, is halted, or meets a NaN that no
    shorter step avoids, ends early: its `result` says so, and the states not reached are NaN.

    **Raises:** `TypeError` for a state of several dtypes, or of another than `ts`.

    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> solver, ts = rj.solvers.Tsitouras5(), jnp.array([0.0, 1.0])
    >>> adaptive(solver, field, ts, start, rtol=1e-9, atol=1e-9).ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    validation.one_dtype((ts, y0), "ts, y0")
    numbers, tree = ravel_pytree(y0)
    of_one = lambda t, y, *sides: ravel_pytree(field(t, tree(y), sides or None))[0]  # noqa: E731
    declared: Any = [] if jumps is None else jumps
    declared = list(declared) if isinstance(declared, list | tuple) else [declared]
    ready = stopped(of_one, declared, ts[0], ts[-1], numbers)
    constants, ends, count = ready.constants, None, len(ready.constants)
    if halt is not None:
        condition = traced(lambda t, y: halt(t, tree(y)), ts[0], numbers)
        constants = constants + condition.constants
        ends = lambda given, t, y: condition.call(given[count:], t, y)  # noqa: E731
    # Neither the condition that ends a run nor the side of a switch has a derivative.
    smooth = [i < ready.smooth and eqx.is_inexact_array(c) for i, c in enumerate(constants)]
    project = lambda y: ravel_pytree(project_to_group(tree(y)))[0]  # noqa: E731
    sizes = [leaf.size for leaf in jax.tree.leaves(y0)]
    of_field = lambda given, t, y: ready.field(given[:count], t, y)  # noqa: E731
    method = Method(solver.tableau, of_field, project, ends, sizes, max_steps)
    stops = jnp.concatenate([ready.stops, ts[-1:]]) if ready.stops.size else ts[-1:]
    rtol, atol = (jnp.asarray(a, ts.dtype) for a in (rtol, atol))
    h0 = jnp.asarray(jnp.nan if dt0 is None else dt0, ts.dtype)
    longest = lax.stop_gradient(jnp.asarray(jnp.inf if max_step is None else max_step, ts.dtype))
    run = Run(ts[0], stops, ts[1:-1], numbers, rtol, atol, h0, longest)
    between, end = _solved(method, smooth, constants, run)
    result = outcome(end.h, end.t, ts[-1], end.h == HALTED)
    last = jnp.where(end.t >= ts[-1], end.y, jnp.nan)
    ys = jax.vmap(tree)(jnp.concatenate([numbers[None], between, last[None]]))
    state = tree(lax.stop_gradient(end.y))
    return Found(ys, end.steps, end.rejected, result, end.t, state, end.h, ready.over)


def taken_out(
    functions: list[Callable[..., Any]], *like: Any
) -> tuple[list[Callable[..., Any]], Arrays]:
    """Each function as `f(constants, *args)`, and the constants of all."""
    programs = [traced(function, *like) for function in functions]
    ends = np.cumsum([0, *(len(program.constants) for program in programs)])

    def call(i: int, constants: Arrays, *args: Any) -> Any:
        return programs[i].call(constants[ends[i] : ends[i + 1]], *args)

    calls = [partial(call, i) for i in range(len(programs))]
    return calls, [c for program in programs for c in program.constants]


def _solved(
    method: Method, smooth: list[bool], constants: Arrays, run: Run
) -> tuple[Array, LoopState]:
    """The states between, and the end; `smooth` says which of the constants have derivatives."""
    # The first two results, the states between and at the end, have derivatives.
    number, ends, head = len(constants), 2, 1 + len(LoopState._fields)

    def mapped(program: Any, linear: int, *args: Any) -> Arrays:
        return in_lanes(partial(program, method), list(args[:number]), list(args[number:]), linear)

    answer: Any = jax.custom_jvp(partial(mapped, partial(_forward, False), 0))
    recorded: Any = jax.custom_jvp(partial(mapped, partial(_forward, True), 0))

    def tangents_of(
        primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...], pull: Any = None
    ) -> tuple[Arrays, Arrays]:
        """The result of `recorded`, and the tangents of its states; transposed by `pull`."""
        # A number without a tangent needs no derivative.
        there = [not isinstance(t, SymbolicZero) for t in tangents]
        moving = [s and t for s, t in zip(smooth, there[:number], strict=True)], there[number:]
        along = [t for t, m in zip(tangents, [*moving[0], *moving[1]], strict=True) if m]
        found = recorded(*primals)
        push = partial(mapped, partial(_pushed, moving), len(along))
        given = [*primals, *found[head:]]
        if pull is None:
            return found, linear_map(push, refuse, given, along)
        back = partial(mapped, partial(pull, moving), ends)
        return found, linear_map(lambda *args: push(*args)[:ends], back, given, along)

    def of_answer(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        found, moved = tangents_of(primals, tangents, _pulled)
        return found[:head], [*moved, *(zero_from_primal(a) for a in found[ends:head])]

    def of_record(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        found, (between, end, starts, rows) = tangents_of(primals, tangents)
        rest = [zero_from_primal(a) for a in found]
        record = Record(*rest[head:])._replace(starts=starts, rows=rows)
        return found, [between, end, *rest[ends:head], *record]

    answer.defjvp(of_answer, symbolic_zeros=True)
    recorded.defjvp(of_record, symbolic_zeros=True)
    between, *end = answer(*constants, *run)
    return between, LoopState(*end)


def _over_bodies(method: Method, layout: Layout, constants: Arrays) -> Method:
    """The method on (n, *bodies); that of one body has `halt(constants, t, y)`."""
    halt = None if method.halt is None else partial(layout.over(method.halt), constants)
    project = jax.vmap(method.project, -1, -1) if layout.bodies else method.project
    return method._replace(field=layout.over(method.field), project=project, halt=halt)


def _forward(
    record: bool, method: Method, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    """The states between and the end, with the `record` if asked for."""
    method, run = _over_bodies(method, layout, constants), Run(*each)
    if record or run.between.shape[0]:
        between, end, kept = adaptive_loop.recording(method, constants, run)
        return [between, *end, *kept] if record else [between, *end]
    return [run.y0[None][:0], *adaptive_loop.value(method, constants, run)]


# Which of the constants and which numbers of a run have tangents.
Moving = tuple[list[bool], list[bool]]


def _again(
    moving: Moving, method: Method, layout: Layout, constants: Arrays, each: Arrays
) -> tuple[Method, Arrays, Run, Record, Arrays]:
    """A recorded run, the constants that move, one a body; and tangents or cotangents."""
    many, whole = len(Run._fields), len(Run._fields) + len(Record._fields)
    run, record = Run(*each[:many]), Record(*each[many:whole])
    layout, constants = layout.owned(constants, moving[0], run.t0)
    method = _over_bodies(method, layout, constants)

    def of_moving(chosen: Arrays, t: Array, y: Array) -> Array:
        rest = iter(chosen)
        mixed = [next(rest) if m else c for c, m in zip(constants, moving[0], strict=True)]
        return method.field(mixed, t, y)

    chosen = [c for c, m in zip(constants, moving[0], strict=True) if m]
    return method._replace(field=of_moving), chosen, run, record, each[whole:]


def _pushed(
    moving: Moving, method: Method, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    method, chosen, run, record, along = _again(moving, method, layout, constants, each)
    rest = iter(along[len(chosen) :])
    still = zip(run, moving[1], strict=True)
    of_run = Run(*(next(rest) if moves else jnp.zeros_like(a) for a, moves in still))

    again = lambda chosen, run: adjoint.replayed(method, chosen, run, record)  # noqa: E731
    return list(jax.jvp(again, (chosen, run), (along[: len(chosen)], of_run))[1])


def _pulled(
    moving: Moving, method: Method, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    method, chosen, run, record, bars = _again(moving, method, layout, constants, each)
    total, of_run = adjoint.cotangents(method, chosen, run, record, bars, any(moving[1][:3]))
    return [*total, *(a for a, moves in zip(of_run, moving[1], strict=True) if moves)]
