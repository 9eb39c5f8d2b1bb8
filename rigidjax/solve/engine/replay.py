"""Define `ReplayAdjoint`, by which diffrax runs the explicit methods of this package.

It runs any vector field of the user, not only the equations of motion of a body.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.motion.equations import project_to_group
from rigidjax.solve.engine.control import NORM, StandardController, Stopping, Watched
from rigidjax.solve.engine.loop import Decision, LoopState, Method, Run
from rigidjax.solve.engine.record import run_replayed
from rigidjax.solve.programs.batching import Arrays
from rigidjax.solve.programs.traced import trace_program
from rigidjax.solve.steps.explicit import AbstractExplicit

# These controllers do not read `args`. They get `None`, because `args` may be large, and a batch
# would need a copy of `args` for each body.
_CONTROLLERS = (
    dfx.PIDController, dfx.ClipStepSizeController, dfx.ConstantStepSize, dfx.StepTo,
    StandardController, Stopping, Watched,
)  # fmt: skip

# If a step would end within this many units of round-off before the end of the run, it is extended
# to the end, as in diffrax.
_SLIVER = 100


class ReplayAdjoint(dfx.AbstractAdjoint):
    """Run `diffrax.diffeqsolve`, record its steps, and repeat the recorded steps in derivatives.

    It runs any vector field under the explicit methods of `rigidjax.solvers`. The steps are those
    that the step controller chooses. Derivatives in forward and reverse mode hold the lengths of
    the steps constant. `jax.grad`, `jax.jacfwd`, `jax.jacrev` and `jax.hessian` (forward over
    reverse) work with respect to all inputs: the arrays that the field closes over, `args`, the
    state at the start, t0, t1, the saved times and the `jump_ts` of a
    `diffrax.ClipStepSizeController`. Under `jax.vmap` the bodies are in the last axis of all arrays
    of a step, which makes batches several times faster on CPU.

    **Arguments:** `otherwise` is another adjoint, which is used for any run that `ReplayAdjoint`
    cannot do:

    - a run with a solver that is no explicit method of `rigidjax.solvers`;
    - a run with a step controller of the user's own, instead of those of diffrax;
    - a run with `max_steps=None`, `SaveAt(dense=True)`, `SaveAt(steps=…)` or several `SubSaveAt`s
      with times;
    - a run with an event that has a `root_finder`, a real number as its condition, or several
      conditions (`ReplayAdjoint` can end a run only by one boolean condition);
    - a run whose state has complex numbers or several dtypes.

    `between` is for `simulate`: times, s, at which the run is saved besides those of the `SaveAt`,
    known to be in order. diffrax checks the times of a `SaveAt` by a call of Python, which
    `jax.export` refuses.

    **Raises:** `TypeError` for `jax.grad` of a `jax.grad`: second derivatives are forward over
    reverse.

    >>> import diffrax
    >>> def end(rate):
    ...     return diffrax.diffeqsolve(
    ...         diffrax.ODETerm(lambda t, y, rate: -rate * y), rj.solvers.DormandPrince8(),
    ...         0.0, 1.0, None, jnp.array([1.0]), rate, adjoint=ReplayAdjoint(),
    ...         stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    ...     ).ys[-1, 0]
    >>> slope = jax.grad(end)(0.5)   # −exp(−rate)
    >>> bool(abs(slope + jnp.exp(-0.5)) < 1e-9)
    True
    """

    otherwise: dfx.AbstractAdjoint = dfx.RecursiveCheckpointAdjoint()
    between: Array | None = None

    def __check_init__(self) -> None:
        _checks.require_instance(self.otherwise, dfx.AbstractAdjoint, "otherwise")

    def loop(
        self, *, args: Any, terms: Any, solver: Any, stepsize_controller: Any, event: Any,
        saveat: Any, t0: Any, t1: Any, dt0: Any, max_steps: Any, init_state: Any,
        progress_meter: Any, **rest: Any,
    ) -> Any:  # fmt: skip
        how = dict(terms=terms, solver=solver, stepsize_controller=stepsize_controller)
        how |= dict(saveat=saveat, t0=t0, t1=t1, dt0=dt0, max_steps=max_steps)
        asked = saveat, event, init_state.event_values
        if not can_run(solver, stepsize_controller, max_steps, init_state.y, *asked):
            more = dict(args=args, event=event, init_state=init_state)
            return self.otherwise.loop(progress_meter=progress_meter, **how, **more, **rest)
        y0, tree = ravel_pytree(init_state.y)
        # In a run backwards in time diffrax uses −t as the time, so that the field changes its
        # sign.
        way = jnp.where(jnp.asarray(terms.contr(t0, t1)) < 0, -1, 1).astype(y0.dtype)
        if self.between is not None:
            (sub,), (saved,) = saveat.subs, init_state.save_state
            saveat = dfx.SaveAt(subs=[sub, dfx.SubSaveAt(ts=way * self.between, fn=sub.fn)])
            init_state = dataclasses.replace(init_state, save_state=[saved, saved])
        program = trace_program(
            lambda t, y: way * ravel_pytree(terms.vf(t, tree(y), args))[0].astype(y.dtype), t0, y0
        )
        constants, count, halt = program.jax_constants, len(program.jax_constants), None
        if event is not None:
            condition = trace_program(lambda t, y: event.cond_fn(t, tree(y), args, **how), t0, y0)
            constants = constants + condition.jax_constants
            halt = lambda given, t, y: condition.call(given[count:], t, y)  # noqa: E731
        arrays, static = eqx.partition((stepsize_controller, progress_meter), eqx.is_array)
        arrays, arrays_tree = jax.tree.flatten(lax.stop_gradient(arrays))
        given = lambda constants: arrays_tree.unflatten(constants[len(constants) - len(arrays) :])  # noqa: E731
        constants = constants + arrays
        controlled_by = _nested_controllers(stepsize_controller)
        # If all step controllers have the default norm, they get the state as one vector of its
        # numbers; else they get it in its own type.
        rows = all(getattr(c, "norm", NORM) is NORM for c in controlled_by)
        method = Method(
            tableau=solver.tableau,
            field=lambda given, t, y: program.call(given[:count], t, y),
            project=lambda y: ravel_pytree(project_to_group(tree(y)))[0],
            halt=halt,
            control=_Control(
                static, given, (lambda y: y) if rows else tree, solver.error_order(terms)
            ),
            sizes=[leaf.size for leaf in jax.tree.leaves(init_state.y)],
            max_steps=max_steps,
        )
        between = next((s.ts for s in _sub_saveats(saveat) if s.ts is not None), t0[None][:0])
        state = (init_state.controller_state, init_state.progress_meter_state)
        state = lax.stop_gradient(jax.tree.map(jnp.asarray, state))
        jumps = [c.stops for c in controlled_by if type(c) is Stopping]
        for c in controlled_by:
            if type(c) is dfx.ClipStepSizeController and c.jump_ts is not None:
                ts = c.jump_ts.astype(t0.dtype)
                # No step ends at a jump after t1, and no step is needed to a jump at or before t0.
                # Both are replaced by t0, so that the array keeps its length.
                jumps.append(jnp.sort(jnp.where((t0 < ts) & (ts <= t1), ts, t0)))
        jumps = [jnp.sort(jnp.concatenate(jumps))] if len(jumps) > 1 else jumps
        stops = jnp.concatenate([*jumps, t1[None]])  # the times, s, at which steps end
        ended = None if event is None else init_state.result
        run = Run(t0, stops, between, y0, lax.stop_gradient(init_state.tnext), ended)
        # The first `count` constants are those of the field. Only they have derivatives: the
        # condition that ends a run has none, nor has the controller.
        smooth = [i < count and eqx.is_inexact_array(c) for i, c in enumerate(constants)]
        ys, end = run_replayed(method, smooth, constants, state, run)
        final = _final_state(init_state, saveat, event, args, tree, run, ys, end)
        return final, {"next_step": end.end - end.t}


class _Control(NamedTuple):
    """Choose by a controller of diffrax whether a step of one body is accepted."""

    static: Any  # controller and progress meter, without the arrays in them
    # A function that selects the arrays of controller and progress meter from the constants of the
    # run.
    arrays: Callable[[Arrays], Any]
    # A function that converts the vector of the numbers of a state to the form in which the
    # controller gets the state: the state itself or, if the controller needs no more, the vector.
    tree: Callable[[Array], Any]
    order: Any  # the order of the error of a step

    def __call__(self, again: bool, constants: Arrays, given: Any, numbers: Any) -> Decision:
        """Return the decision on a step; if it is repeated (`again`), no progress is shown."""
        controller, meter = eqx.combine(self.arrays(constants), self.static)
        (control, progress), (t0, last, begin, end) = given
        *states, error = (self.tree(y) for y in numbers)
        keep, t, following, _, control, result = controller.adapt_step_size(
            begin, end, *states, None, error, self.order, control
        )
        # As in diffrax, a next step that would end just before the end of the run is extended to
        # the end, so that no step of a few units of round-off is left.
        t = jnp.minimum(t, last)
        near = last - _SLIVER * jnp.finfo(t.dtype).eps * jnp.abs(last)
        following = jnp.where(keep & (following > near), last, following)
        if not again:
            progress = meter.step(progress, (t - t0) / (last - t0))
        return jax.tree.map(jnp.asarray, Decision(keep, t, following, (control, progress), result))


def can_run(
    solver: dfx.AbstractSolver, controller: Any, max_steps: int | None, state: Any,
    saveat: dfx.SaveAt | None = None, event: dfx.Event | None = None, event_values: Any = None,
) -> bool:  # fmt: skip
    """Return whether `ReplayAdjoint` itself can do a run.

    It takes an explicit method of this package, a step controller of diffrax, a largest number of
    steps, and numbers of one floating-point dtype; no dense output, save at every step or several
    sets of saved times; and an event of one boolean condition without a root finder.
    """
    kinds = {jnp.result_type(leaf) for leaf in jax.tree.leaves(state)}
    plain = isinstance(solver, AbstractExplicit) and max_steps is not None and len(kinds) == 1
    plain = plain and jnp.issubdtype(min(kinds, key=str), jnp.floating)
    plain = plain and all(type(c) in _CONTROLLERS for c in _nested_controllers(controller))
    if event is not None:
        kind = jnp.result_type(jax.tree.leaves(event_values)[0])
        plain = plain and event.root_finder is None and callable(event.cond_fn)
        plain = plain and jnp.issubdtype(kind, jnp.bool_)
    if saveat is None:
        return plain
    subs = _sub_saveats(saveat)
    few = sum(sub.ts is not None for sub in subs) <= 1 and not any(sub.steps for sub in subs)
    return plain and few and not saveat.dense


def _nested_controllers(controller: Any) -> list[Any]:
    """Return a step controller and those inside it, the outermost first."""
    inner = getattr(controller, "controller", None)
    return [controller, *(_nested_controllers(inner) if inner is not None else ())]


def _sub_saveats(saveat: dfx.SaveAt) -> list[dfx.SubSaveAt]:
    """Return the `diffrax.SubSaveAt`s of a `diffrax.SaveAt`."""
    is_sub = lambda s: isinstance(s, dfx.SubSaveAt)  # noqa: E731
    return [s for s in jax.tree.leaves(saveat.subs, is_leaf=is_sub) if is_sub(s)]


def _final_state(
    state: Any, saveat: dfx.SaveAt, event: dfx.Event | None, args: Any,
    make_state: Callable[[Array], Any], run: Run, ys: Array, end: LoopState,
) -> Any:  # fmt: skip
    """Return the state of `diffrax.diffeqsolve` at the end of a run, with all that it saves.

    `ys` (K, n) are the states at the saved times.
    """
    t1 = run.stops[-1]
    # Before its first accepted step a run saves nothing, unless the run has no step because t1 is
    # not after t0.
    reached = (run.between <= end.t) & ((end.t > run.t0) | (t1 <= run.t0))

    def saved(sub: Any, old: Any) -> Any:
        ts, states, there = [], [], []
        if sub.t0:
            ts, states, there = [run.t0[None]], [run.y0[None]], [jnp.ones(1, bool)]
        if sub.ts is not None:
            ts, states, there = [*ts, sub.ts], [*states, ys], [*there, reached]
        if sub.t1:
            ts, there = [*ts, end.t[None]], [*there, jnp.ones(1, bool)]
            states.append(end.y[None])
        ts, states, there = (jnp.concatenate(a) for a in (ts, states, there))
        if sub.ts is not None:
            # `sub.fn` computes from a state what the user wants to save. At a saved time that the
            # run did not reach, it is called with the state at the start, for which it has a finite
            # value; `masked` then replaces the result by infinity.
            states = jnp.where(there[:, None], states, run.y0)
            if sub.t1:
                # The end of the run follows the saved times that it reached, as in diffrax.
                order = jnp.argsort(~there)
                ts, states, there = ts[order], states[order], there[order]
        out = jax.vmap(lambda t, y: sub.fn(t, make_state(y), args))(ts, states)
        if sub.ts is None:
            return dataclasses.replace(old, ts=ts, ys=out, save_index=jnp.asarray(len(ts)))
        masked = lambda a: jnp.where(there.reshape(-1, *[1] * (a.ndim - 1)), a, jnp.inf)  # noqa: E731
        new = dict(ts=masked(ts), ys=jax.tree.map(masked, out), save_index=jnp.sum(there))
        return dataclasses.replace(old, **new)

    is_sub = lambda s: isinstance(s, dfx.SubSaveAt)  # noqa: E731
    short = (end.result == dfx.RESULTS.successful) & (end.t < t1)
    control, progress = end.state
    new = dict(
        y=make_state(lax.stop_gradient(end.y)),
        tprev=end.t,
        tnext=end.end,
        controller_state=control,
        progress_meter_state=progress,
        result=dfx.RESULTS.where(short, dfx.RESULTS.max_steps_reached, end.result),
        num_steps=end.steps,
        num_rejected_steps=end.rejected,
        num_accepted_steps=end.steps - end.rejected,
        save_state=jax.tree.map(saved, saveat.subs, state.save_state, is_leaf=is_sub),
    )
    if event is not None:
        met = end.result == dfx.RESULTS.event_occurred
        new["event_mask"] = jax.tree.map(lambda _: met, event.cond_fn)
    return dataclasses.replace(state, **new)
