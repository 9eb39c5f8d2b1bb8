"""A run of a vector field as one `diffrax.diffeqsolve`, whose steps end where the field jumps."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax.solve import validation
from rigidjax.solve.adaptive_loop import NONFINITE, finite
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.replay_adjoint import ReplayAdjoint
from rigidjax.solve.step_control import StandardController, Stopping, Watched
from rigidjax.solve.stops import stopped

REPLAY, NO_METER = ReplayAdjoint(), dfx.NoProgressMeter()


class AdaptiveRun(NamedTuple):
    """The result of `adaptive`.

    **Fields:** `ys` the states at `ts`, NaN where the run did not get; `num_steps` accepted and
    rejected, `num_rejected` of these; `result` a `diffrax.RESULTS`; `last_time` at the end of the
    run and `last` the state there; `next_step` the length of the step that would follow, NaN
    under another adjoint than `ReplayAdjoint`; `missed` whether a part of the field switches by the
    time more often than is looked for (`None`: nothing does).
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS
    last_time: Array
    last: Any
    next_step: Array
    missed: Array | None


class _FieldOfNumbers(eqx.Module):
    """A field of the numbers of a state as one of states, for diffrax."""

    constants: Any
    field: Any = eqx.field(static=True)
    tree: Any = eqx.field(static=True)

    def __call__(self, t: Any, y: Any, args: object = None) -> Any:
        return self.tree(self.field(self.constants, t, ravel_pytree(y)[0]))


def _numbers(t: Any, y: Any, args: object) -> Array:
    """Return the numbers of a state in a row."""
    return ravel_pytree(y)[0]


def integrated(
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
    """Return the states at `ts` (T,) s of a run of diffrax under any controller.

    **Arguments:** those of `adaptive` and of `diffrax.diffeqsolve`. `jumps` are times at which the
    field jumps, an array for each part of it; with them the `ts` increase, steps end at these times
    and at those with which the field compares the time. With `None` they end at none.
    """
    missed = None
    if jumps is not None:
        numbers, tree = ravel_pytree(y0)
        of_one = lambda t, y, *sides: ravel_pytree(field(t, tree(y), sides or None))[0]  # noqa: E731
        program = stopped(of_one, jumps, ts[0], ts[-1], numbers)
        field, missed = _FieldOfNumbers(program.constants, program.field, tree), program.over
        if program.stops.size:
            controller = Stopping(controller, program.stops)
    # The last state needs no dense output.
    subs = [dfx.SubSaveAt(t1=True, fn=_numbers)]
    subs += [dfx.SubSaveAt(ts=ts[1:-1], fn=_numbers)] if ts.shape[0] > 2 else []
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
        # Where nothing was saved, diffrax says t = inf: not to be taken for a state.
        there = jnp.isfinite(times[0])[:, None]
        rows = [jnp.where(there, between[0], jnp.nan), *rows]
    numbers, tree = ravel_pytree(y0)
    ys = jax.vmap(tree)(jnp.concatenate([numbers[None], *rows]))
    ill = ~done
    if not isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        # Equal steps look at no error, and would go on with NaN.
        ill = ill | ~finite(ys)
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
    """Return the states at `ts` with adaptive steps.

    **Arguments:** `solver` an explicit method of this package; `field` a vector field
    `f(t, y, args)` as of `equations_of_motion`; `ts` (T,) s; `y0` the state at `ts[0]`; `rtol`,
    `atol` scalars; `dt0` the first step and `max_step` the longest, s, or `None`; `jumps` times,
    s, in any order, at which the field jumps: steps end there (several arrays: one of each part of
    the field, which gets the stops of each as its `args`); times with which the field compares the
    time itself are found; `halt(t, y)` a condition, tested after each step, that ends the run.
    Derivatives are by all numbers of the field, `ts`, `jumps` and `y0`, lengths of steps held.

    **Returns** an `AdaptiveRun`. A run that needs more than `max_steps`, is halted, or meets a NaN
    that no shorter step avoids, ends early: its `result` says so, and states not reached are NaN.

    **Raises:** `TypeError` for a state of several dtypes, or of another than `ts`.

    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> solver, ts = rj.solvers.Tsitouras5(), jnp.array([0.0, 1.0])
    >>> adaptive(solver, field, ts, start, rtol=1e-9, atol=1e-9).ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    validation.one_dtype((ts, y0), "ts, y0")
    declared: Any = [] if jumps is None else jumps
    declared = list(declared) if isinstance(declared, list | tuple) else [declared]
    rtol, atol = (jnp.asarray(a, ts.dtype) for a in (rtol, atol))
    controller = Watched(StandardController(rtol, atol, max_step))
    how = dict(jumps=declared, halt=halt, dt0=dt0, max_steps=max_steps)
    return integrated(solver, field, ts, y0, controller, **how)
