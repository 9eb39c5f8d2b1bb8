"""Simulate the motion of a body or a particle, saved at given times."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import AbstractScene, MovingFrame
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.suspension import AbstractSuspension
from rigidjax.solve.answer import validation
from rigidjax.solve.answer.crossings import Event, checked_state, solve_until_event
from rigidjax.solve.answer.error import estimate_error_of_run, solve_to_accuracy
from rigidjax.solve.answer.run import (
    AnyRun,
    ClosedFormRun,
    DiffraxRun,
    explain_max_steps,
    has_closed_form,
    hoist,
    raise_if_ended,
    require_complete,
    solve,
    time_direction,
    warn_of_missed,
)
from rigidjax.solve.answer.solution import Solution, State, with_error
from rigidjax.solve.engine.adaptive import NO_METER, REPLAY
from rigidjax.solve.engine.projection import Projected
from rigidjax.solve.engine.replay import ReplayAdjoint
from rigidjax.solve.steps.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.steps.splitting import AbstractSplitting

# A function of the type `Law` must accept the type of the state. Type checkers therefore refuse
# gravity on a `Spin`, which has no attitude.
Law = Callable[[Any, State, Any], Any] | AbstractScene | MovingFrame | AbstractSuspension | None

# The solver `SOLVER` and the adjoint `ADJOINT` are made only once, because building a Module takes
# as long as ten steps.
SOLVER = Projected(dfx.Dopri8())
ADJOINT = dfx.RecursiveCheckpointAdjoint()
# `ReplayAdjoint` can do all that these adjoints of diffrax can, and is used instead of each of
# them.
_EITHER_MODE = (type(None), dfx.ForwardMode, dfx.RecursiveCheckpointAdjoint)
# When reverse mode repeats a step, the step may be rounded differently. At a tolerance below
# `_TIGHT`, close to round-off, the length of the step then differs, too: at a tolerance of 1e-13
# this changed a gradient by 2e-4 of its value. With 4096 checkpoints the start of every step is
# stored, except in runs of more than 4096 steps.
_TIGHT, _EVERY_STEP = 1e-10, dfx.RecursiveCheckpointAdjoint(checkpoints=4096)


@suggest_arguments
def simulate(
    body: Inertia | MassProperties | None,
    state0: State,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Law[State] = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    accuracy: ScalarLike | None = None,
    dt0: ScalarLike | None = None,
    max_step: ScalarLike | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    event: Event | Callable[..., Any] | None = None,
    max_steps: int | None = 100_000,
    throw: bool = True,
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> Solution[State]:
    """Simulate the motion of a rigid body from the state `state0`, saved at the times `ts`.

    **Arguments:**

    - `body`: the body. It is an `Inertia`, about the point that the body turns about, for a `Spin`
      or an `Attitude`; `MassProperties` for a `Rigid`, and for a `Turn` if gravity swings it; and
      `None` for a `Point`.
    - `state0`: the state of one body at the time `ts[0]`: `Spin(omega)`, `Attitude(q, omega)`,
      `Rigid(x, v, q, omega)`, `Turn(angle, rate)`, or a `Point(x, v)`. For many bodies write
      `jax.vmap(lambda body, state: rj.simulate(body, state, ts).ys)`; with `throw=False` return
      `.result`, too, which says of each body how its run ended.
    - `ts`: (T,) the times to save, s, of which the first is the start. They increase, or they
      decrease for a run backwards in time.
    - `torque`: a torque of `rigidjax.torques`, or any callable Module `(t, state, body) → (3,)`,
      N m, body frame; `None` for a free body. Steps end at the jumps that it declares
      (`jump_times`). Steps also end where it compares the time with a value that no state changes
      (`jnp.where(t < te, …)`): these times are found before the run, and have derivatives. Steps do
      not end where the torque switches by the state, and the derivative of such a switch is lost:
      end the run there by an `event`, and begin another one. If a torque has states of its own
      (`rigidjax.torques.AbstractTorque`), they are in `own` of the solution. For a `Point` the
      torque is a scene of `rigidjax.scenes`, a `MovingFrame`, or a force per mass
      `(t, state, None) → (3,)`, m/s². For a `Turn` it is a suspension of `rigidjax.suspensions`,
      which holds the other torques.
    - `solver`: any `diffrax.AbstractSolver`; a wrapper keeps attitudes unit quaternions, at every
      step and every saved time. `None` is the cheapest accurate choice, for any number of saved
      times: the closed form for a free body (`rigidjax.exact`) and for a free `Axle` or
      `TorsionBar`, else
      `rigidjax.solvers.DormandPrince8` (order 8). With `max_steps=None` or
      `adjoint=diffrax.ForwardMode()` this choice is `diffrax.Dopri8` instead. Between the steps the
      error of `DormandPrince8` is up to ten times `rtol`; that of `Dopri8` is up to 26 times `rtol`
      if `rtol` is below 1e-10.
    - `rtol`, `atol`: the relative and the absolute tolerance of the adaptive steps. The defaults
      are 1e-9 and 1e-12 in float64, 2e-5 and 1e-7 in float32. Traced tolerances are not checked. A
      run with other tolerances does not compile again. Scale `atol` to the smallest number that
      matters. The closed form uses neither.
    - `accuracy`: how far the states may be from the exact motion, given in the place of tolerances.
      For a rotation it is an angle, rad; for any other array of the state it is relative to the
      largest length of this array in the run. Two or more cheap runs find the tolerance. The
      `error` of the solution is then known without more runs. If it exceeds the accuracy (chaos,
      round-off), a `UserWarning` says from which time on; under `jit` look at `error.relative`.
    - `dt0`: the length of the first step, s. With `None` it is chosen by the tolerances.
    - `stepsize_controller`: a step controller of diffrax in the place of tolerances. Fixed steps of
      0.01 s, for example, are `dt0=0.01, stepsize_controller=diffrax.ConstantStepSize()`; such a
      step also ends where the torque jumps in time, and steps of full length follow.
    - `max_step`: the longest step, s. Steps could pass over a short change in a torque, such as a
      smooth bump or a switch by the state: give half of the length of the shortest one. The closed
      form takes no steps; a `stepsize_controller` has its own limit.
    - `adjoint`: how derivatives are taken, as in diffrax. For the explicit methods of
      `rigidjax.solvers` the default `None` is `rigidjax.solvers.ReplayAdjoint()`: `jax.grad`,
      `jax.jacfwd`, `jax.jacrev` and `jax.hessian` (forward over reverse) work, as in closed form,
      and `jax.grad` of a `jax.grad` is refused. For other solvers `None` is
      `diffrax.RecursiveCheckpointAdjoint()`, for `jax.grad`; it has 4096 checkpoints if `rtol` is
      known to be below 1e-10. With these solvers give `diffrax.ForwardMode()` for `jax.jacfwd`. If
      you need only `jax.jacfwd` of a body, `diffrax.ForwardMode()` is faster than the default; it
      is not faster for a particle with few saved times.
    - `event`: a condition `(t, state, body) → scalar`, or an `Event` with such a condition. The run
      ends at the first zero of the condition. `event_time` and `event_state` of the solution are
      accurate to the tolerances, and have first and second derivatives with respect to all numbers,
      also the numbers in the condition. The states `ys` at times after the event are NaN, and
      `result` is `event_occurred`. If the condition has no zero, `event_time` and `event_state` are
      NaN, and the run goes to its end. Events are for the closed form and the explicit methods of
      `rigidjax.solvers`; with a solver of diffrax, call `diffrax.diffeqsolve` with a
      `diffrax.Event`.
    - `max_steps`, `progress_meter`: as in `diffrax.diffeqsolve`.
    - `throw`: whether a run that fails raises an error. With `False` neither a failed run nor a bad
      start in a batch raises an error, and `result` gives the reason. The states that the run did
      not reach are NaN, as are their derivatives. The other bodies of a batch get the same bits as
      without the body that failed. The motion of an invalid traced body (with a mass that is not
      positive, or moments of no real body) is NaN, and its `result` is `nonfinite_input`. Wrong
      numbers that are not traced raise an error in any case.

    **Returns** a `Solution`. A second call with other numbers of the same shapes does not compile
    again. Source: the equations of Newton and Euler (notes, eqs 50, 79, 84).

    **Raises:** `TypeError` if body, state and torque do not fit together; `ValueError` for times
    that neither increase nor decrease, NaN, or a quaternion that is not unit (`EquinoxRuntimeError`
    under `jit`).

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> bool(abs(rj.simulate(body, start, jnp.linspace(0.0, 9.43, 3)).ys.omega[-1, 1]) < 0.01)
    True
    """
    max_steps = None if max_steps is None else _checks.integer(max_steps, "max_steps", 1)
    body, state0, times = validation.checked_run(body, state0, ts, torque, throw)
    given = rtol is not None or atol is not None
    if stepsize_controller is not None and (given or accuracy is not None):
        raise ValueError("simulate: give either rtol and atol or a stepsize_controller, not both")
    if accuracy is not None and given:
        raise ValueError("simulate: give either an accuracy or rtol and atol, not both")
    if accuracy is not None and _checks.is_known(accuracy):
        _checks.positive_float(accuracy, "accuracy")
    if max_step is not None:
        if stepsize_controller is not None:
            raise ValueError(
                "simulate: give max_step without a stepsize_controller, which has its own limit "
                "(dtmax of diffrax.PIDController)"
            )
        if _checks.is_known(max_step):
            _checks.positive_float(max_step, "max_step")
        max_step = jnp.asarray(max_step, times.dtype)
    way = time_direction(times)
    if stepsize_controller is None:
        rtol, atol = validation.checked_tolerances(rtol, atol, times.dtype)
        if solver is None and has_closed_form(body, torque):
            found = _solve_run(ClosedFormRun(body, way, throw, torque), event, state0, times)
            return found if accuracy is None else with_error(found, found.error, accuracy)
        # The tolerances are arrays, so that another tolerance does not compile again.
        rtol, atol = (jnp.asarray(a, times.dtype) for a in (rtol, atol))
    else:
        rtol = getattr(stepsize_controller, "rtol", None)
    chosen = solver
    if solver is None:
        # If the user asks for forward mode alone, diffrax computes the tangents together with the
        # run.
        forward = isinstance(adjoint, dfx.ForwardMode) and event is None
        chosen = SOLVER if forward or max_steps is None else DormandPrince8()
    elif not isinstance(solver, AbstractExplicit | AbstractSplitting | Projected):
        # The explicit methods and the splittings of this package scale the quaternion inside the
        # kernel of a step. They are not wrapped, because a second scaling outside would split this
        # kernel.
        chosen = Projected(solver)
    if isinstance(chosen, AbstractExplicit) and max_steps and isinstance(adjoint, _EITHER_MODE):
        adjoint = REPLAY
    elif adjoint is None:
        tight = rtol is not None and _checks.is_known(rtol) and float(rtol) < _TIGHT  # pyright: ignore[reportArgumentType]
        adjoint = _EVERY_STEP if tight else ADJOINT
    setup = DiffraxRun(
        body, torque, chosen, rtol, atol, stepsize_controller,
        None if dt0 is None else validation.checked_first_step(dt0, times), max_step, adjoint,
        progress_meter or NO_METER, way, max_steps, throw,
    )  # fmt: skip
    sought = setup.replays and progress_meter is None
    for name, asked in (("accuracy", accuracy), ("event", event)):
        if asked is not None and not sought:
            raise ValueError(_message_of_conflict(name, setup, solver, progress_meter))
    if accuracy is not None:
        return _solve_to_accuracy(setup, event, state0, times, accuracy)
    return _solve_run(setup, event, state0, times)


def _message_of_conflict(
    name: str,
    setup: DiffraxRun,
    solver: dfx.AbstractSolver | None,
    meter: dfx.AbstractProgressMeter | None,
) -> str:
    """Return the message that the argument `name`, an accuracy or an event, does not go with those
    arguments that need diffrax' own loop.
    """
    ours = solver is None or isinstance(solver, AbstractExplicit)
    needs_diffrax = {
        f"solver={type(solver).__name__}": not ours,
        "max_steps=None": setup.max_steps is None,
        f"stepsize_controller={type(setup.controller).__name__}": setup.controller is not None,
        f"adjoint={type(setup.adjoint).__name__}": ours
        and setup.max_steps is not None
        and not isinstance(setup.adjoint, ReplayAdjoint),
        f"progress_meter={type(meter).__name__}": meter is not None,
    }
    given = [argument for argument, needs in needs_diffrax.items() if needs]
    advice = ["leave it out" if len(given) == 1 else "leave them out"]
    advice += [] if ours else ["take an explicit solver of rigidjax.solvers"]
    advice += ["give diffrax.Event to diffrax.diffeqsolve"] if name == "event" else []
    return (
        f"simulate: {name} does not go with {' and '.join(given)}, a run in the loop of diffrax: "
        f"{', or '.join(advice)}"
    )


def _solve_to_accuracy(
    setup: DiffraxRun,
    event: Event | Callable[..., Any] | None,
    state0: Any,
    times: Array,
    accuracy: ScalarLike,
) -> Solution:
    """Find a tolerance that gives the wanted accuracy, and return the solution with its error.

    The `accuracy` is the largest error that is allowed at the saved times: for a rotation an angle,
    rad; for any other array of the state a fraction of its largest length in the run.
    """
    # The derivative of the search is a rule of our own, which does not see traced numbers that a
    # function holds. They become arrays of the set-up, which the rule does see.
    torque = hoist(setup.torque, times[0], state0, setup.body)
    setup = dataclasses.replace(setup, torque=torque)
    found, run, search = solve_to_accuracy(setup, state0, times, jnp.asarray(accuracy, times.dtype))
    found = dataclasses.replace(found, throw=setup.throw)
    if setup.throw and _checks.is_known((run[2], state0, times)) and not dfx.is_successful(run[2]):
        _solve_run(setup, event, state0, times)  # fails with the words of a run without accuracy
    sol = _solve_run(found, event, state0, times, None if event is not None else run)
    error = estimate_error_of_run(found, times, sol._states, sol.stats["num_steps"], search)
    return with_error(sol, error, accuracy)


def _solve_run(
    setup: AnyRun,
    event: Event | Callable[..., Any] | None,
    state0: Any,
    times: Array,
    solved_run: tuple[Any, dict[str, Any], dfx.RESULTS] | None = None,
) -> Solution:
    """Solve a run, and return it as a `Solution`.

    `solved_run` is what `solve` returned for this run, if it is already known.
    """
    event_time = event_state = None
    try:
        if event is None:
            # An error that the compiled program raises would need a callback, which takes a fifth
            # of the time of its compilation, and keeps the program out of the cache of JAX 0.10.
            known = solved_run is not None or _checks.is_known((setup, state0, times))
            quiet = dataclasses.replace(setup, throw=setup.throw and not known)
            ys, stats, result = solved_run or solve(quiet, state0, times)
            if setup.throw and not quiet.throw:
                ys = require_complete(setup, ys, result)
        else:
            event = event if isinstance(event, Event) else Event(event)
            state0 = checked_state(event, setup.body, state0, setup.torque, times[0])
            ys, stats, result, event_time, event_state = solve_until_event(
                setup, event, state0, times
            )
    except RuntimeError as error:
        raise explain_max_steps(setup, state0, times, _checks.plain_error(error)) from None
    if "switches_missed" in stats:
        warn_of_missed(setup, state0, times, stats["switches_missed"])
    if setup.throw and "ended" in stats:
        ys = raise_if_ended(setup.torque, ys, stats, times)
    motion, own = (ys.motion, ys.own) if isinstance(ys, Coupled) else (ys, None)
    # The solution keeps the set-up of the run, split into its arrays and the rest, so that
    # `jax.jit` and `jax.vmap` can return it.
    arrays, rest = eqx.partition(setup, eqx.is_array)
    return Solution(times, motion, stats, result, arrays, rest, event_time, event_state, own)
