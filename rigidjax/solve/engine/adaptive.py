"""Solve a vector field in one call of `diffrax.diffeqsolve`; steps end where the field jumps."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.solve.engine.control import StandardController, Stopping, Watched
from rigidjax.solve.engine.loop import NONFINITE, is_finite
from rigidjax.solve.engine.replay import ReplayAdjoint, can_run
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.times.stops import program_with_stops

REPLAY, NO_METER = ReplayAdjoint(), dfx.NoProgressMeter()


class AdaptiveRun(NamedTuple):
    """Hold the result of a run with adaptive steps: the states, and how the run ended.

    **Fields:**

    - `ys`: the states at `ts`; NaN at a time that the run did not reach.
    - `num_steps`: the number of all steps, rejected steps included.
    - `num_rejected`: the number of rejected steps.
    - `result`: a `diffrax.RESULTS`, which says how the run ended.
    - `last_time`: the time at the end of the run, s.
    - `last`: the state at `last_time`.
    - `next_step`: the length of the step that would follow, s; NaN if the run was made with another
      adjoint than `ReplayAdjoint`, which records the steps.
    - `missed`: whether some part of the field switches at more times than can be stored; steps then
      do not end at all of these times. `None` if no switch of the field depends on the time.
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS
    last_time: Array
    last: Any
    next_step: Array
    missed: Array | None


class _FieldOnTree(eqx.Module):
    """Evaluate, on a state that is a pytree, a `field` of the vector of its numbers."""

    constants: Any
    field: Any = eqx.field(static=True)
    tree: Any = eqx.field(static=True)

    def __call__(self, t: Any, y: Any, args: object = None) -> Any:
        return self.tree(self.field(self.constants, t, ravel_pytree(y)[0]))


def integrate(
    solver: dfx.AbstractSolver,
    field: Callable[..., Any],
    ts: Array,
    y0: Any,
    controller: dfx.AbstractStepSizeController,
    *,
    jumps: list[Array] | None = None,
    halt: Callable[..., Any] | None = None,
    dt0: Any = None,
    max_steps: int | None = 100_000,
    adjoint: dfx.AbstractAdjoint = REPLAY,
    progress_meter: dfx.AbstractProgressMeter = NO_METER,
) -> AdaptiveRun:
    """Run diffrax under any step size controller, and return the states at the times `ts`.

    `jumps` has one array of times, s, for each part of the field that jumps; steps end at these,
    and at each time with which the field compares its t. The field gets them, as they are reached,
    as `args`. With `None` no step is cut short for a jump. A `halt(t, y)` is tested after each
    accepted step.
    """
    missed, looks_at_error = None, isinstance(controller, dfx.AbstractAdaptiveStepSizeController)
    if jumps is not None:
        numbers, tree = ravel_pytree(y0)
        of_one = lambda t, y, *sides: ravel_pytree(field(t, tree(y), sides or None))[0]  # noqa: E731
        program = program_with_stops(of_one, jumps, ts[0], ts[-1], numbers)
        field, missed = _FieldOnTree(program.constants, program.field, tree), program.over
        if program.stops.size:
            controller = Stopping(controller, program.stops)
    # The last of `ts` is the end of the last step, so that the state there needs no dense output.
    vector = lambda t, y, args: ravel_pytree(y)[0]  # noqa: E731
    subs = [dfx.SubSaveAt(t1=True, fn=vector)]
    if (
        ts.shape[0] > 2
        and isinstance(adjoint, ReplayAdjoint)
        and can_run(solver, controller, max_steps, y0)
    ):
        adjoint = dataclasses.replace(adjoint, between=ts[1:-1])
    elif ts.shape[0] > 2:
        subs += [dfx.SubSaveAt(ts=ts[1:-1], fn=vector)]
    out = dfx.diffeqsolve(
        dfx.ODETerm(field), solver, ts[0], ts[-1], dt0, y0,
        saveat=dfx.SaveAt(subs=subs), stepsize_controller=controller, adjoint=adjoint,
        event=None if halt is None else dfx.Event(lambda t, y, args, **_: halt(t, y)),
        max_steps=max_steps, throw=False, progress_meter=progress_meter,
    )  # fmt: skip
    saved: Any = (out.ts, out.ys)
    ((last_time,), *times), (last, *between) = saved
    done = jnp.where(ts[0] > ts[-1], last_time <= ts[-1], last_time >= ts[-1])
    rows = [jnp.where(done, last, jnp.nan)][: ts.shape[0] - 1]
    if between:
        # diffrax writes t = inf into each row that the run did not reach; the numbers in the state
        # of such a row mean nothing.
        there = jnp.isfinite(times[0])[:, None]
        rows = [jnp.where(there, between[0], jnp.nan), *rows]
    numbers, tree = ravel_pytree(y0)
    ys = jax.vmap(tree)(jnp.concatenate([numbers[None], *rows]))
    ill = ~done
    if not looks_at_error:
        # A controller of equal steps does not look at the error estimate. After a NaN it therefore
        # goes on to the end of the run and reports success.
        ill = ill | ~is_finite(ys)
    ill = ill & (out.result == dfx.RESULTS.successful)
    result = dfx.RESULTS.where(ill, NONFINITE, out.result)
    following = out.stats.get("next_step", jnp.full_like(last_time, jnp.nan))
    counts = out.stats["num_steps"], out.stats["num_rejected_steps"]
    return AdaptiveRun(ys, *counts, result, last_time, tree(last[0]), following, missed)


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
) -> AdaptiveRun:
    """Solve a vector field with adaptive steps, and return its states at the times `ts`.

    **Arguments:**

    - `solver`: an explicit method of `rigidjax.solvers`.
    - `field`: a vector field `f(t, y, args)`, such as `equations_of_motion` returns.
    - `ts`: (T,) the times of the states, s, in increasing order.
    - `y0`: the state at `ts[0]`.
    - `rtol`, `atol`: scalars, the relative and the absolute tolerance of each step.
    - `dt0`: the length of the first step, s; with `None` the length is chosen from the field.
    - `max_step`: the longest step, s; `None` sets no limit.
    - `max_steps`: the largest number of steps, rejected steps included.
    - `jumps`: times, s, in any order, at which the field jumps; a step ends at each of them. If
      several parts of the field jump, give a list with one array for each part. The field then gets
      such a list as its `args`: for each part the times at which steps end. Times with which the
      field compares its argument t, as in `jnp.where(t < 1, …)`, need not be given.
    - `halt`: a condition `halt(t, y)`, tested after each accepted step; the run ends where the
      condition is true.

    The result has derivatives with respect to all numbers of the field, `ts`, `jumps` and `y0`;
    these derivatives hold the lengths of the steps constant.

    **Returns** an `AdaptiveRun`. A run ends early if it needs more than `max_steps` steps, if
    `halt` is true, or if it meets a NaN that no shorter step avoids. The field `result` then gives
    the reason, and each state that the run did not reach is NaN.

    **Raises:** `TypeError` for a state of several dtypes, or of another dtype than `ts`.

    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> solver, ts = rj.solvers.Tsitouras5(), jnp.array([0.0, 1.0])
    >>> adaptive(solver, field, ts, start, rtol=1e-9, atol=1e-9).ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    _checks.common_dtype((ts, y0), "ts, y0")
    declared: Any = [] if jumps is None else jumps
    declared = list(declared) if isinstance(declared, list | tuple) else [declared]
    rtol, atol = (jnp.asarray(a, ts.dtype) for a in (rtol, atol))
    controller = Watched(StandardController(rtol, atol, max_step))
    how = dict(jumps=declared, halt=halt, dt0=dt0, max_steps=max_steps)
    return integrate(solver, field, ts, y0, controller, **how)
