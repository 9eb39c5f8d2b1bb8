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
from rigidjax.solve.crossings import Event, ready, solve_until
from rigidjax.solve.error import error_of_run, solve_to
from rigidjax.solve.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.projection import Projected, Watched
from rigidjax.solve.run import (
    Free,
    Loop,
    Setup,
    direction,
    refuse,
    refuse_ended,
    solve,
    warn_of_missed,
    words_of_steps,
)
from rigidjax.solve.solution import Solution, State, told
from rigidjax.solve.splitting import AbstractSplitting

# A torque must accept the given state: gravity on a `Spin` is an error that type checkers see.
Law = Callable[[Any, State, Any], Any] | AbstractScene | MovingFrame | None

# Made once: building a Module costs as much as ten steps.
SOLVER = Projected(dfx.Dopri8())
ADJOINT = dfx.RecursiveCheckpointAdjoint()
NO_METER = dfx.NoProgressMeter()
# Our loop has both modes of differentiation, all that these adjoints of diffrax ask.
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
      free body, else `rigidjax.solvers.DormandPrince8` (order 8), for any number of saved times.
      The explicit methods of `rigidjax.solvers` run in our own loop; so does the default, unless a
      controller, a progress meter, `max_steps=None` or `adjoint=diffrax.ForwardMode()` is given:
      then diffrax runs its Dopri8. It may be any `diffrax.AbstractSolver`; a wrapper keeps
      attitudes unit quaternions, at every step and every saved time. Between its steps the error of
      `DormandPrince8` is up to ten times `rtol`, that of Dopri8 up to 26 times below `rtol=1e-10`.
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
    - `adjoint`: how derivatives through a solver of diffrax are taken, as there. `None` is
      `diffrax.RecursiveCheckpointAdjoint()` for `jax.grad`, with 4096 checkpoints where `rtol` is
      known to be below 1e-10; `diffrax.ForwardMode()` is for `jax.jacfwd`. Our loop and the closed
      form need none: `jax.grad`, `jax.jacfwd`, `jax.jacrev` and `jax.hessian` (forward over
      reverse) work, and `jax.grad` of a `jax.grad` is refused. If you need only `jax.jacfwd` of a
      body, `diffrax.ForwardMode()` is faster; it is not for a particle with few saved times.
    - `event`: `(t, state, body) → scalar`, or an `Event` of it: the run ends at its first zero.
      `event_time` and `event_state` of the solution are exact to the tolerances, with first and
      second derivatives with respect to all numbers, also the condition's own; later `ys` are NaN,
      and `result` is `event_occurred`. Without a zero they are NaN and the run goes to its end.
      Events work in our own loop and the closed form; for a solver of diffrax give `diffrax.Event`
      there.
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
        found = _solution(Free(body, throw), event, state0, times)
        return found if accuracy is None else told(found, found.error, accuracy)
    method = DormandPrince8() if solver is None else solver
    plain = isinstance(method, AbstractExplicit) and max_steps is not None
    plain = plain and stepsize_controller is None and progress_meter is None
    # Where forward mode is all that is asked, diffrax is quicker: tangents go along with the run.
    forward = isinstance(adjoint, dfx.ForwardMode) and solver is None and event is None
    first = None if dt0 is None else validation.first_step(dt0, times)
    if plain and isinstance(adjoint, _EITHER_MODE) and not forward:
        way = direction(times)
        # As arrays: another tolerance does not compile again.
        rtol, atol = (jnp.asarray(a, times.dtype) for a in (rtol, atol))
        loop = Loop(body, torque, method, rtol, atol, first, way, max_steps, throw, None, max_step)  # pyright: ignore
        if accuracy is None:
            return _solution(loop, event, state0, times)
        return _accurate(loop, event, state0, times, accuracy)
    if accuracy is not None:
        raise ValueError(
            "simulate: an accuracy is for the closed form and our own loop: leave solver, adjoint, "
            "progress_meter and max_steps to their defaults, or take a solver of rigidjax.solvers"
        )
    if event is not None:
        raise ValueError(
            "simulate: an event is looked for in our own loop and in closed form: leave solver, "
            "stepsize_controller, adjoint and progress_meter to their defaults (or take a solver "
            "of rigidjax.solvers), or give diffrax.Event to diffrax.diffeqsolve"
        )
    meter, control = progress_meter or NO_METER, stepsize_controller
    setup = Setup(body, torque, solver, control, first, adjoint, meter, max_steps, throw)
    return _solution(_completed(setup, rtol, atol, times, max_step), None, state0, times)


def _completed(setup: Setup, rtol: Any, atol: Any, times: Array, max_step: Any) -> Setup:
    """A run by diffrax with what was left to its defaults."""
    solver, control, adjoint, dt0 = setup.solver, setup.controller, setup.adjoint, setup.dt0
    if control is None:
        control = Watched(dfx.PIDController(rtol=rtol, atol=atol, dtmax=max_step))
        # A splitting looks into the field, of a known class.
        stops = not isinstance(solver, AbstractSplitting)
        setup = dataclasses.replace(setup, stops=stops, sign=direction(times))
    elif isinstance(control, dfx.AbstractAdaptiveStepSizeController):
        control = Watched(control)
    # Ours project inside their one kernel; a second time outside of it breaks the kernel up.
    if not isinstance(solver, AbstractExplicit | AbstractSplitting | Projected):
        solver = SOLVER if solver is None else Projected(solver)
    if adjoint is None:
        rtol = getattr(control, "rtol", None)
        tight = rtol is not None and _checks.is_known(rtol) and float(rtol) < _TIGHT
        adjoint = _EVERY_STEP if tight else ADJOINT
    if dt0 is not None and not setup.stops:
        dt0 = dt0 * jnp.sign(times[-1] - times[0])
    new = dict(solver=solver, controller=control, adjoint=adjoint, dt0=dt0)
    return dataclasses.replace(setup, **new)


def _accurate(loop: Loop, event: Any, state0: Any, times: Array, accuracy: Any) -> Solution:
    found, run, tried = solve_to(loop, state0, times, jnp.asarray(accuracy, times.dtype))
    found = dataclasses.replace(found, throw=loop.throw)
    sol = _solution(found, event, state0, times, None if event is not None else run)
    error = error_of_run(found, times, sol._states, sol.stats["num_steps"], tried)
    return told(sol, error, accuracy)


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
            state0 = ready(event, setup.body, state0, setup.torque, times[0])
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
