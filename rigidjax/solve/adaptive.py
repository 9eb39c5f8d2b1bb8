"""A run with adaptive steps as one function of numbers, differentiable in both modes, batched."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax.motion import on_the_group
from rigidjax.solve import adaptive_loop, adjoint
from rigidjax.solve.adjoint import Inputs, Outputs
from rigidjax.solve.batching import Arrays, Layout, in_lanes, one
from rigidjax.solve.components import flat, leaf_sizes, unflat
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.linear_map import forward_only, linear_map
from rigidjax.solve.record import HALTED, Answer, Method, Record, Run
from rigidjax.solve.runge_kutta import Axes
from rigidjax.solve.step_control import NONFINITE
from rigidjax.solve.tableaus import Tableau


class Found(NamedTuple):
    """What `adaptive` returns.

    **Fields:** `ys` the states, of the type of `y0`, with a leading time axis; `num_steps`,
    `num_rejected` of the whole run; `result` a `diffrax.RESULTS`; `last_time`, `last` where the run
    ended.
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
    """The states at `ts`, with steps as long as the tolerances allow.

    The norm, the control of the step (integral, safety 0.9) and the first step are those of
    `diffrax.PIDController`.

    **Arguments:** `solver` an explicit method of this package; `field` a vector field
    `f(t, y, args)` such as `AttitudeEquations`; `ts` (T,) s; `y0` the state at `ts[0]`; `rtol`,
    `atol` scalars; `dt0` the first step, s, or `None`; `jumps` times, s, in any order, at which the
    field jumps: steps end there; `halt(t, y)` a condition, looked at after each step, that ends the
    run. Derivatives are by all numbers of the field, `ts`, `jumps` and
    `y0`, lengths of steps held; not by tolerances.

    **Returns** a `Found`. A run that needs more than `max_steps`, is halted, or meets a NaN that no
    shorter step avoids, ends early: its `result` says so, and the states not reached are NaN.

    **Raises:** `TypeError` for a state of several dtypes, or of another than `ts`.

    >>> import rigidjax as rj
    >>> field = rj.motion.AttitudeEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
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
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(out.h), NONFINITE),
        (out.h > 0, dfx.RESULTS.max_steps_reached),
        (out.t >= ts[-1], dfx.RESULTS.successful),
        (out.h == HALTED, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    rows = jnp.concatenate([numbers[None], out.between, out.end[None]])
    ys = jax.vmap(partial(unflat, like=y0))(rows)
    return Found(ys, out.steps, out.rejected, result, out.t, unflat(out.last, y0))


class _Program(NamedTuple):
    """What is compiled: a method whose `field(constants, t, y)` is of one body.

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

    def spread(self, layout: Layout, constants: Arrays, run: Run) -> tuple[Layout, Arrays]:
        """The constants that have derivatives, one a body."""
        if not layout.bodies:
            return layout, constants
        count = run.t0.shape[-1]
        own = [
            jnp.broadcast_to(c[..., None], (*c.shape, count)) if shared and smooth else c
            for c, shared, smooth in zip(constants, layout.shared, self.smooth, strict=True)
        ]
        shared = tuple(a and not b for a, b in zip(layout.shared, self.smooth, strict=True))
        return layout._replace(shared=shared), own


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

    of_one, constants = taken_out(flat_field, t0, flat(y0))
    count, ended = len(constants), None
    smooth = [bool(jnp.issubdtype(c.dtype, jnp.inexact)) for c in constants]
    if halt is not None:
        condition, more = taken_out(lambda t, y: halt(t, unflat(y, like)), t0, flat(y0))
        ended = lambda constants, t, y: condition(constants[count:], t, y)  # noqa: E731
        constants, smooth = [*constants, *more], [*smooth, *[False] * len(more)]
    method = Method(
        tableau,
        lambda constants, t, y: of_one(constants[:count], t, y),
        project,
        None,
        leaf_sizes(like),
        max_steps,
    )
    return _Program(method, ended, tuple(smooth)), constants


def taken_out(function: Callable[..., Any], *like: Any) -> tuple[Callable[..., Any], Arrays]:
    """`f(constants, t, y)` and the constants: what a function depends on, also by closure."""
    converted = eqx.filter_closure_convert(function, *like)
    arrays, rest = eqx.partition(converted, eqx.is_array)
    constants, tree = jax.tree.flatten(arrays)

    def of_constants(constants: Arrays, t: Array, y: Array) -> Any:
        return eqx.combine(jax.tree.unflatten(tree, constants), rest)(t, y)

    return of_constants, constants


def _solved(program: _Program, constants: Arrays, run: Run) -> Answer:
    number = len(constants)

    @jax.custom_jvp
    def answer(*args: Any) -> Arrays:
        layout = one(constants)
        return in_lanes(
            partial(_value, program), layout, list(args[:number]), list(args[number:]), []
        )[0]

    @answer.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        return _differentiated(program, list(primals), list(tangents))

    return Answer(*answer(*constants, *run))


def _value(
    program: _Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    del linear
    method, chosen = program.of(layout, constants)
    return list(adaptive_loop.value(method, chosen, Run(*each))), []


def _recorded(
    program: _Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    del linear
    method, chosen = program.of(layout, constants)
    run = Run(*each)
    answer, record = adaptive_loop.recording(method, chosen, run)
    record = record._replace(
        number=jnp.broadcast_to(record.number, run.t0.shape),
        filled=jnp.broadcast_to(record.filled, run.t0.shape),
    )
    return [*answer, *record], []


_RUN, _ANSWER = len(Run._fields), len(Answer._fields)


def _pushed(
    program: _Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    run, record = Run(*each[:_RUN]), Record(*each[_RUN:])
    layout, constants = program.spread(layout, constants, run)
    method, chosen = program.of(layout, constants)
    *of_constants, ends, between, y0 = linear
    along = Inputs(of_constants, ends, between, y0)
    axes = Axes(int(layout.bodies), int(layout.directions))
    answer, moved = adjoint.tangents(method, chosen, run, record, along, axes)
    return [], [*answer, *moved]


def _pulled(
    program: _Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    run, record = Run(*each[:_RUN]), Record(*each[_RUN:])
    layout, constants = program.spread(layout, constants, run)
    method, chosen = program.of(layout, constants)
    axes = Axes(int(layout.bodies), int(layout.directions))
    bars = adjoint.cotangents(method, chosen, run, record, Outputs(*linear), axes)
    return [], [*bars.constants, bars.ends, bars.between, bars.y0]


def _differentiated(program: _Program, primals: Arrays, tangents: Arrays) -> Any:
    number = len(program.smooth)
    smooth = [i for i, s in enumerate(program.smooth) if s]

    def forward(*args: Any) -> Arrays:
        constants, each = list(args[:number]), list(args[number:])
        return in_lanes(partial(_recorded, program), one(constants), constants, each, [])[0]

    def mapped(kind: Any, *args: Any) -> Arrays:
        constants, rest = list(args[:number]), list(args[number:])
        each, linear = rest[:kept], rest[kept:]
        return in_lanes(partial(kind, program), one(constants), constants, each, linear)[1]

    def push(*args: Any) -> Arrays:
        return mapped(_pushed, *args)[:2]

    def push_forward(*args: Any) -> Arrays:
        head = number + _RUN
        given = [*args[:head], *args[head + _ANSWER : number + kept + _ANSWER]]
        moved = args[number + kept + _ANSWER :]
        between, end, *moved_record = mapped(_pushed, *given, *_linear(smooth, moved))
        still = [jnp.zeros_like(a) for a in args[head + 2 : head + 5]]
        answer = [between, end, *still]
        return [*answer, *moved_record]

    kept = _RUN + len(Record._fields)
    found = forward_only(forward, push_forward)(*primals)
    answer, record = found[:_ANSWER], found[_ANSWER:]
    moved = [tangents[i] for i in smooth] + tangents[number:]
    between, end = linear_map(
        push, partial(mapped, _pulled), [*primals, *record], _linear(smooth, moved)
    )
    rest = [
        jnp.zeros_like(a)
        if jnp.issubdtype(a.dtype, jnp.inexact)
        else np.zeros(a.shape, jax.dtypes.float0)
        for a in answer[2:]
    ]
    return answer, [between, end, *rest]


def _linear(smooth: list[int], moved: Any) -> Arrays:
    """Tangents of the constants and of a `Run`, as `Inputs` in a list."""
    of_run = Run(*moved[len(smooth) :])
    ends = jnp.concatenate([of_run.t0[None], of_run.stops])
    return [*moved[: len(smooth)], ends, of_run.between, of_run.y0]
