"""`simulate`: the motion of a body or a particle, saved at given times."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import AbstractScene, MovingFrame
from rigidjax.motion.coupled import Coupled
from rigidjax.solve import validation
from rigidjax.solve.adaptive import NO_METER, REPLAY
from rigidjax.solve.crossings import Event, checked_start, solve_until
from rigidjax.solve.error import error_of_run, solve_to
from rigidjax.solve.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.projection import Projected
from rigidjax.solve.run import (
    ClosedFormRun,
    DiffraxRun,
    direction,
    refuse,
    refuse_ended,
    solve,
    warn_of_missed,
    words_of_steps,
)
from rigidjax.solve.solution import Solution, State, with_error
from rigidjax.solve.splitting import AbstractSplitting

# A torque must accept the given state: gravity on a `Spin` is an error that type checkers see.
Law = Callable[[Any, State, Any], Any] | AbstractScene | MovingFrame | None

# Made once: building a Module costs as much as ten steps.
SOLVER = Projected(dfx.Dopri8())
ADJOINT = dfx.RecursiveCheckpointAdjoint()
# All that these adjoints of diffrax ask, `ReplayAdjoint` has.
_EITHER_MODE = (type(None), dfx.ForwardMode, dfx.RecursiveCheckpointAdjoint)
# A step that reverse mode runs again rounds differently. So near to round-off its length then
# differs, too (2e-4 of a gradient at 1e-13): keep the start of every step of all but long runs.
_TIGHT, _EVERY_STEP = 1e-10, dfx.RecursiveCheckpointAdjoint(checkpoints=4096)


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
    """The motion of a rigid body from `state0`, saved at `ts`.

    **Arguments:**

    - `body`: `Inertia` for `Spin` and `Attitude`, about the point that the body turns about;
      `MassProperties` for `Rigid`; `None` for a `Point`.
    - `state0`: `Spin(omega)`, `Attitude(q, omega)` or `Rigid(x, v, q, omega)` at `ts[0]`, of one
      body. For many, `jax.vmap(lambda body, state: rj.simulate(body, state, ts).ys)`; with
      `throw=False` return `.result`, too: one for each body.
    - `ts`: (T,) increasing times, s, or decreasing ones, backwards in time. The first is the start.
    - `torque`: a torque of `rigidjax.torques`, or any callable Module `(t, state, body) → (3,)`,
      N m, body frame; `None` for a free body. Steps end where it declares jumps (`jump_times`), and
      where it compares the time with what no state changes (`jnp.where(t < te, …)`): such times are
      found before the run, and have derivatives. Steps do not end at switches by the state, and
      their derivatives are lost: end a run there by an `event`, and begin another. A torque's
      own states (`rigidjax.torques.AbstractTorque`) are in `own`. For a `Point` it is a scene of
      `rigidjax.scenes`, a `MovingFrame`, or a force per mass `(t, state, None) → (3,)`, m/s².
    - `solver`: `None` is the cheapest accurate choice: the closed form (`rigidjax.exact`) for a
      free body, else `rigidjax.solvers.DormandPrince8` (order 8), for any number of saved times;
      with `max_steps=None` or `adjoint=diffrax.ForwardMode()` it is `diffrax.Dopri8`. It may be any
      `diffrax.AbstractSolver`; a wrapper keeps attitudes unit quaternions, at every step and every
      saved time. Between its steps the error of `DormandPrince8` is up to ten times `rtol`, that of
      Dopri8 up to 26 times below `rtol=1e-10`.
    - `rtol`, `atol`: tolerances of the adaptive steps; 1e-9 and 1e-12 in float64, 2e-5 and 1e-7 in
      float32. Traced ones are not checked, and other values do not compile again. Scale `atol` to
      the smallest number that matters. The closed form uses neither.
    - `accuracy`: in the place of tolerances, how far the states may be from the exact motion: rad,
      and relative to the largest value in the run. Two or more cheap runs find the tolerance.
      `sol.error` is then known without more runs. Where it exceeds the accuracy (chaos, round-off),
      a `UserWarning` says from which time on; under `jit` look at `sol.error.relative`.
    - `dt0`, `stepsize_controller`: first step and controller where the tolerances are not enough,
      such as `dt0=0.01, stepsize_controller=diffrax.ConstantStepSize()`.
    - `max_step`: the longest step, s, such as half of the shortest event in a law that steps could
      pass over (a smooth bump, a switch by the state). The closed form takes no steps; a
      `stepsize_controller` has its own limit.
    - `adjoint`: how derivatives are taken, as in diffrax. `None` is `rigidjax.solvers.
      ReplayAdjoint()` for the explicit methods of `rigidjax.solvers`: `jax.grad`, `jax.jacfwd`,
      `jax.jacrev` and `jax.hessian` (forward over reverse) work, as in closed form, and `jax.grad`
      of a `jax.grad` is refused. For other solvers it is `diffrax.RecursiveCheckpointAdjoint()` for
      `jax.grad`, with 4096 checkpoints where `rtol` is known to be below 1e-10, and
      `diffrax.ForwardMode()` is for `jax.jacfwd`. If you need only `jax.jacfwd` of a body,
      `diffrax.ForwardMode()` is faster; it is not for a particle with few saved times.
    - `event`: `(t, state, body) → scalar`, or an `Event` of it: the run ends at its first zero.
      `event_time` and `event_state` of the solution are exact to the tolerances, with first and
      second derivatives with respect to all numbers, also the condition's own; later `ys` are NaN,
      and `result` is `event_occurred`. Without a zero they are NaN and the run goes to its end.
      Events are for the closed form and the explicit methods of `rigidjax.solvers`; for a solver of
      diffrax give `diffrax.Event` there.
    - `max_steps`, `progress_meter`: as in `diffrax.diffeqsolve`.
    - `throw`: with `False` nothing in a run, and no bad start in a batch, raises an error: `result`
      gives the reason, states not reached are NaN, as are their derivatives, and other bodies of
      the batch get the same bits as without the bad one. The motion of an invalid traced body (a
      mass that is not positive, moments of no real body) is NaN, its `result` `nonfinite_input`.
      Known wrong numbers are refused in any case.

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
    body, state0, times = validation.scene(body, state0, ts, torque, throw)
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
    if stepsize_controller is None:
        rtol, atol = validation.tolerances(rtol, atol, times.dtype)
    if torque is None and solver is None and stepsize_controller is None and body is not None:
        found = _solution(ClosedFormRun(body, throw), event, state0, times)
        return found if accuracy is None else with_error(found, found.error, accuracy)
    # As arrays: another tolerance does not compile again.
    if stepsize_controller is None:
        rtol, atol = (jnp.asarray(a, times.dtype) for a in (rtol, atol))
    setup = DiffraxRun(
        body, torque, _solver(solver, adjoint, event, max_steps), rtol, atol, stepsize_controller,
        None if dt0 is None else validation.first_step(dt0, times), max_step, adjoint,
        progress_meter or NO_METER, direction(times), max_steps, throw,
    )  # fmt: skip
    setup = dataclasses.replace(setup, adjoint=_adjoint(setup))
    sought = setup.is_replayed and progress_meter is None
    if accuracy is not None and not sought:
        raise ValueError(
            "simulate: an accuracy is for the closed form and the explicit methods of "
            "rigidjax.solvers under ReplayAdjoint: leave solver, adjoint, progress_meter and "
            "max_steps to their defaults, or take a solver of rigidjax.solvers"
        )
    if event is not None and not sought:
        raise ValueError(
            "simulate: an event is for the closed form and the explicit methods of "
            "rigidjax.solvers under ReplayAdjoint: leave solver, stepsize_controller, adjoint and "
            "progress_meter to their defaults (or take a solver of rigidjax.solvers), or give "
            "diffrax.Event to diffrax.diffeqsolve"
        )
    if accuracy is not None:
        return _accurate(setup, event, state0, times, accuracy)
    return _solution(setup, event, state0, times)


def _solver(solver: Any, adjoint: Any, event: Any, max_steps: int | None) -> Any:
    """Return the solver of a run, on the group; `None` is the quickest one under this adjoint."""
    if solver is None:
        # Where forward mode is all that is asked, tangents go along with the run of diffrax.
        forward = isinstance(adjoint, dfx.ForwardMode) and event is None
        return SOLVER if forward or max_steps is None else DormandPrince8()
    # Ours project inside their one kernel; a second time outside of it breaks the kernel up.
    ours = isinstance(solver, AbstractExplicit | AbstractSplitting | Projected)
    return solver if ours else Projected(solver)


def _adjoint(setup: DiffraxRun) -> dfx.AbstractAdjoint:
    """Return the adjoint of a run; `ReplayAdjoint` where it takes the run, in either mode."""
    explicit = isinstance(setup.solver, AbstractExplicit) and setup.max_steps is not None
    if explicit and isinstance(setup.adjoint, _EITHER_MODE):
        return REPLAY
    if setup.adjoint is not None:
        return setup.adjoint
    rtol = getattr(setup.step_controller(), "rtol", None)
    tight = rtol is not None and _checks.is_known(rtol) and float(rtol) < _TIGHT
    return _EVERY_STEP if tight else ADJOINT


def _accurate(setup: DiffraxRun, event: Any, state0: Any, times: Array, accuracy: Any) -> Solution:
    found, run, tried = solve_to(setup, state0, times, jnp.asarray(accuracy, times.dtype))
    found = dataclasses.replace(found, throw=setup.throw)
    sol = _solution(found, event, state0, times, None if event is not None else run)
    error = error_of_run(found, times, sol._states, sol.stats["num_steps"], tried)
    return with_error(sol, error, accuracy)


def _solution(setup: Any, event: Any, state0: Any, times: Array, run: Any = None) -> Solution:
    event_time = event_state = None
    try:
        if run is not None:
            ys, stats, result = run
            ys = refuse(ys, result, setup.torque) if setup.throw else ys
        elif event is None:
            ys, stats, result = solve(setup, state0, times)
        else:
            event = event if isinstance(event, Event) else Event(event)
            state0 = checked_start(event, setup.body, state0, setup.torque, times[0])
            ys, stats, result, event_time, event_state = solve_until(setup, event, state0, times)
    except RuntimeError as error:
        raise words_of_steps(setup, state0, times, _checks.own_sentence(error)) from None
    warn_of_missed(setup, state0, times, stats)
    if setup.throw and "ended" in stats:
        ys = refuse_ended(setup.torque, ys, stats, times)
    motion, own = (ys.motion, ys.own) if isinstance(ys, Coupled) else (ys, None)
    # The set-up as arrays and the rest, so that `jax.jit` and `jax.vmap` can return it.
    arrays, rest = eqx.partition(setup, eqx.is_array)
    return Solution(times, motion, stats, result, arrays, rest, event_time, event_state, own)
