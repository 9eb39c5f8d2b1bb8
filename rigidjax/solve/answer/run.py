"""Solve a run in one compiled function, by the closed form or by one `diffrax.diffeqsolve`."""

import dataclasses
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.exact.diffrax_solver import FreeSolver
from rigidjax.exact.free_body import FreeMotion
from rigidjax.frames import AbstractScene, MovingFrame, Point
from rigidjax.frames.frame_dynamics import scene_of_force
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.coupled import Coupled, motion_of, with_own_states
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.suspension import AbstractSuspension
from rigidjax.motion.torques.base import Torque, in_precision
from rigidjax.motion.torques.composite import Sum
from rigidjax.solve.answer import validation
from rigidjax.solve.engine.adaptive import integrate
from rigidjax.solve.engine.control import StandardController, Watched
from rigidjax.solve.engine.loop import NONFINITE, is_finite, result_of_body
from rigidjax.solve.engine.momentum import changing_inertia, equations_of, integrated_form
from rigidjax.solve.engine.projection import Projected
from rigidjax.solve.engine.replay import ReplayAdjoint
from rigidjax.solve.programs.linear_map import nan_derivatives
from rigidjax.solve.programs.traced import trace_program
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.magnus import Magnus4
from rigidjax.solve.steps.splitting import AbstractSplitting
from rigidjax.solve.times.sides import declared_jumps, evaluate_on_correct_sides
from rigidjax.solve.times.switching import MOST, find_switches

_COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")


class ClosedFormRun(eqx.Module):
    """Hold the set-up of a run in closed form, without start and saved times."""

    body: Any
    sign: Array | None  # as in `DiffraxRun`
    throw: bool = eqx.field(static=True)  # whether a run that fails raises an error
    torque: Any = None  # a suspension, or `None`
    # What follows is as in `DiffraxRun`: there are no steps.
    solver: ClassVar[None] = None
    rtol: ClassVar[None] = None
    max_step: ClassVar[None] = None
    max_steps: ClassVar[None] = None
    replays: ClassVar[bool] = False

    def moving(self, state0: Any) -> Any:
        """Return the motion from `state0`, a Module that maps times since the start to states."""
        if self.torque is None:
            return FreeMotion(self.body, state0)
        body, law = in_precision((self.body, self.torque), state0.angle.dtype)
        return law.swing(body, state0)

    def motion(self, state0: Any, ts: Array) -> "Trajectory":
        """Return the motion at the times `ts` (T,), s."""
        ys: Any = self.moving(state0)(ts - ts[0])
        stats: dict[str, Any] = dict.fromkeys(_COUNTS, jnp.zeros((), int))
        result = dfx.RESULTS.where(is_finite(ys), dfx.RESULTS.successful, NONFINITE)
        return Trajectory(Solved(ys, stats, result), None)

    def raise_reason(self, ys: Any, result: dfx.RESULTS) -> Any:
        """Return the states `ys`; raise an error with the reason if the run ended early."""
        return eqx.error_if(ys, result != dfx.RESULTS.successful, _CLOSED_FORM)

    def forward(self) -> "ClosedFormRun":
        """Return the same run, which raises no error, for derivatives in forward mode."""
        return dataclasses.replace(self, throw=False)


def has_closed_form(body: Any, torque: Any) -> bool:
    """Return whether the motion of a body is known in closed form."""
    if isinstance(torque, AbstractSuspension):
        return torque.closed_form
    return torque is None and body is not None


class DiffraxRun(eqx.Module):
    """Hold the set-up of a run by diffrax, without start and saved times.

    The fields without a comment are the arguments of `simulate` with the same names.
    """

    body: Inertia | MassProperties | None
    torque: Any
    solver: Any
    rtol: Any  # that of the user's step controller if there is one; `None` if that has none
    atol: Any
    controller: Any  # the user's step controller in the place of tolerances, or `None`
    dt0: Any
    max_step: Any
    adjoint: Any
    progress_meter: dfx.AbstractProgressMeter
    sign: Array | None  # σ, 1 or −1, the direction of time; `None`: known to be 1
    max_steps: int | None = eqx.field(static=True)
    throw: bool = eqx.field(static=True)
    cuts: Array | None = None  # more times at which a step ends, besides the jumps of the torque

    @property
    def replays(self) -> bool:
        """Return whether the run records its steps, which derivatives then repeat."""
        explicit = isinstance(self.solver, AbstractExplicit) and self.max_steps is not None
        return explicit and self.controller is None and isinstance(self.adjoint, ReplayAdjoint)

    def motion(self, state0: Any, ts: Array) -> "Trajectory":
        """Return the motion at the times `ts` (T,), s, integrated step by step."""
        # If the torque has states of its own, they are integrated together with the state of the
        # body.
        state0 = with_own_states(self.body, state0, self.torque, ts[0])
        scene: Any = scene_of_force(self.torque) if isinstance(state0, Point) else None
        law = self.torque if isinstance(state0, Turn) else scene
        watch = halt = Ends(law, self.body) if hasattr(law, "ends") else None
        form = integrated_form(self.body, state0, self.torque)
        field, y0 = form.field, form.from_state(ts[0], state0)
        control: Any = self.controller
        if control is None:
            control = StandardController(self.rtol, self.atol, self.max_step)
        # Where steps end at jumps, the vector field is replaced by a traced program, and the run
        # uses the time s = σt. `Magnus4`, `FreeSolver` and the splittings read attributes of the
        # field, which a traced program does not have.
        solver = self.solver.solver if isinstance(self.solver, Projected) else self.solver
        stops = self.controller is None or isinstance(control, dfx.ConstantStepSize)
        stops = stops and not isinstance(solver, AbstractSplitting | Magnus4 | FreeSolver)
        if isinstance(control, dfx.AbstractAdaptiveStepSizeController):
            control = Watched(control)
        along, jumps, dt0, sign = ts, None, self.dt0, None
        if stops:
            sign = self.sign
            field, halt, along, jumps = forward_time(sign, field, watch, ts)
            if self.cuts is not None:
                jumps = [*jumps, _signed(sign, self.cuts)]
        else:
            dt0 = None if dt0 is None else dt0 * jnp.sign(ts[-1] - ts[0])
            if self.cuts is not None:
                cuts = jnp.sort(self.cuts)
                control = dfx.ClipStepSizeController(control, step_ts=cuts)  # pyright: ignore
        out = integrate(
            self.solver, field, along, y0, control, jumps=jumps, halt=halt, dt0=dt0,
            max_steps=self.max_steps, adjoint=self.adjoint, progress_meter=self.progress_meter,
        )  # fmt: skip
        taken = (out.num_steps, out.num_steps - out.num_rejected, out.num_rejected)
        stats: dict[str, Any] = dict(zip(_COUNTS, taken, strict=True))
        ys, t = jax.vmap(form.to_state)(ts, out.ys), _signed(sign, out.last_time)
        end = End(t, form.to_state(t, out.last), out.next_step)
        if out.missed is not None:
            stats["switches_missed"] = out.missed
        if watch is not None:
            ended = out.result == dfx.RESULTS.event_occurred
            stats |= {"ended": ended, "end_time": end.time, "end_state": end.state}
        if scene is not None:
            stats["drift"] = scene.drift(ts, ys)
        return Trajectory(Solved(ys, stats, out.result), end)

    def raise_reason(self, ys: Any, result: dfx.RESULTS) -> Any:
        """Return the states; raise the reason if the run ended early, but not by an event."""
        if changing_inertia(self.torque) is not None:
            ys = eqx.error_if(ys, result == NONFINITE, _INERTIA)
        ill = (result != dfx.RESULTS.successful) & (result != dfx.RESULTS.event_occurred)
        dtype = jax.tree.leaves(ys)[0].dtype
        gap = np.spacing(np.asarray(1e9, dtype))
        shortest = (
            "simulate: no step is short enough: the minimum step size, some units of round-off of "
            "the time, was reached. Does the torque jump or grow without bound? In "
            f"{np.dtype(dtype)} the times near 1e9 s are {gap:.2g} s apart: "
            f"{_checks.advice_on_times(dtype)}"
        )
        for why, words in (
            (dfx.RESULTS.max_steps_reached, _MANY_STEPS),
            (NONFINITE, _NONFINITE_WORDS),
            (dfx.RESULTS.dt_min_reached, shortest),
        ):
            ys = eqx.error_if(ys, result == why, words)
            ill = ill & (result != why)
        return result.error_if(ys, ill)

    def forward(self) -> "DiffraxRun":
        """Return the same run, which raises no error, with derivatives in forward mode."""
        # A run that does not record its steps needs `ForwardMode` for this.
        adjoint = self.adjoint if self.replays else dfx.ForwardMode()
        return dataclasses.replace(self, throw=False, adjoint=adjoint)


AnyRun = ClosedFormRun | DiffraxRun


class ForwardRun(NamedTuple):
    """Hold a run in the time s = σt, which increases along it."""

    # field(s, y, sides): `sides` has one array for each part that jumps, the s at which steps end
    # because of it. They may differ from the jumps by some units of round-off; `None`: they do not.
    field: Callable[..., Any]
    condition: Any  # condition(s, y), or `None`
    ts: Array  # (T,) the saved times
    jumps: list[Array]  # the jump times of each part of the field


class Ends(eqx.Module):
    """Evaluate whether a run ends early: a particle's by its scene, such as a collision, and that
    of a hanging body by its suspension.
    """

    scene: Any  # has ends(t, state) → bool, of a suspension (t, state, body), and end_words
    body: Any = None

    def __call__(self, t: ScalarLike, y: Any, args: object = None, **_: object) -> Bool[Array, ""]:
        return self.scene.ends(t, y, *(() if self.body is None else (self.body,)))


def equations_of_motion(
    body: Inertia | MassProperties | None,
    state0: Spin | Attitude | Rigid | Turn | Point | Coupled,
    torque: Torque | AbstractScene | MovingFrame | AbstractSuspension | None = None,
) -> Callable[..., Any]:
    """Return the vector field of a body as a function `f(t, y, args)`, for `diffrax.ODETerm`.

    The states y have the type of `state0`.

    **Arguments:** `body`, `state0` and `torque` are those of `simulate`. If the torque has states
    of its own, `state0` is a `rigidjax.motion.coupled.Coupled`, which joins them with the state of
    the body.

    **Raises:** `TypeError` if body, state and torque do not fit together.

    >>> type(equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 0, 0])))
    <class 'rigidjax.motion.equations.EulerEquations'>
    """
    validation.require_compatible(body, motion_of(state0), torque)
    return equations_of(body, state0, torque)


def hoist(function: Any, *args: Any) -> Any:
    """Return an equal function of `args` whose arrays include the traced numbers that it holds.

    A derivative rule of our own sees no traced number in the closure of a function of Python.
    """
    if isinstance(function, Sum):
        return Sum(*(hoist(part, *args) for part in function.parts))
    if function is None or isinstance(function, eqx.Module):
        return function
    converted = eqx.filter_closure_convert(function, *args)
    return function if _checks.is_known(converted) else converted


def time_direction(times: Array) -> Int[Array, ""] | None:
    """Return 1 or −1 for times that increase or decrease; `None` if they are known to increase."""
    ends = _checks.array_module(times).asarray(times)
    change = ends[-1] - ends[0]
    if _checks.is_known(times) and change > 0:
        return None
    # The sign is an integer, so that derivatives do not carry it along.
    return jnp.asarray(jnp.sign(change), jnp.int32)


def forward_time(
    sign: Array | None, field: Callable[..., Any], condition: Callable[..., Any] | None, ts: Array
) -> ForwardRun:
    """Convert a run to one forwards in the time s = σt.

    `sign` is σ, 1 or −1; `None` stands for 1. `condition(t, y)` ends the run, or is `None`.
    """
    time = partial(_signed, sign)

    def directed(s: Array, y: Any, sides: Any = None) -> Any:
        sided = evaluate_on_correct_sides(
            field, sign, None if sides is None else [time(side) for side in sides], ts[-1]
        )
        return jax.tree.map(time, sided(time(s), y, None))

    asked = None if condition is None else lambda s, y: condition(time(s), y)
    return ForwardRun(directed, asked, time(ts), [time(jumps) for jumps in declared_jumps(field)])


class Solved(NamedTuple):
    """Hold the motion of one body at the saved times."""

    ys: Any  # the states, with a leading time axis; NaN at times that the run did not reach
    stats: dict[str, Any]  # as in `Solution.stats`
    result: dfx.RESULTS


class End(NamedTuple):
    """Hold the end of a run."""

    time: Array  # s
    state: Any
    step: Array  # the length of the step that would follow, s


class Trajectory(NamedTuple):
    """Hold the motion and the end of a run; a closed form has no `end`."""

    solved: Solved
    end: End | None


@eqx.filter_jit
def solve(setup: AnyRun, state0: Any, ts: Array) -> Solved:
    """Compute the motion of one body from `state0`, at the times `ts` (T,), s."""
    # The whole function is under one `jit`, because a single operation outside of `jit` takes as
    # long as a hundred steps.
    state0 = project_to_group(state0)
    ys, stats, result = setup.motion(state0, ts).solved
    if setup.throw:
        ys = require_complete(setup, ys, result)
    ys = nan_derivatives(ys, (setup.body, setup.torque, state0, ts))
    return Solved(ys, stats, result_of_body(result, setup.body))


def _signed(sign: Array | None, t: Array) -> Array:
    """Convert times `t` to s = σt, or back; `None` stands for σ = 1."""
    return t if sign is None else sign.astype(t.dtype) * t


_INERTIA = (
    "simulate: the motion under ChangingInertia became NaN or infinite. Is inertia(t) the tensor "
    "of a body at every time of the run: symmetric, with positive moments of which none exceeds "
    "the sum of the other two? throw=False keeps what came before"
)
_MANY_STEPS = (
    "simulate: the maximum number of solver steps, max_steps, did not reach the last time. Has the "
    "motion many turns? then give a larger one. Does a law switch by the state (sign, where) and "
    "hold it there? then no number of steps is enough: smooth the switch, or end the run there by "
    "an Event"
)
_NONFINITE_WORDS = (
    "simulate: the motion became NaN or infinite. Is the torque finite at every time and state of "
    "the run? With fixed steps: are they short enough for this spin? throw=False keeps what came "
    "before"
)


_CLOSED_FORM = (
    "simulate: a state in closed form is NaN or infinite: after more turns than the dtype can "
    "count, or from numbers beyond its range; throw=False keeps the others"
)


def require_complete(setup: AnyRun, ys: Any, result: dfx.RESULTS) -> Any:
    """Return the states of a run; raise a readable error if it ended early, but for an event."""
    # Known results are compared as whole numbers: an operation of JAX outside of `jit` takes 50 µs.
    number, successful = jax.tree.leaves((result, dfx.RESULTS.successful))
    if _checks.is_known(number) and int(number) == int(successful):
        return ys
    return setup.raise_reason(ys, result)


def warn_of_missed(setup: AnyRun, state0: Any, ts: Array, missed: Array) -> None:
    """Warn if a torque switches in time so often that steps do not end at all of its switches."""
    if not _checks.is_known((missed, state0, ts)) or not np.any(np.asarray(missed)):
        return
    state0 = with_own_states(setup.body, state0, setup.torque, ts[0])
    field = integrated_form(setup.body, state0, setup.torque).field
    program = trace_program(lambda t, y: ravel_pytree(field(t, y, None))[0], ts[0], state0)
    lines = dict.fromkeys(s.line for s in find_switches(program.closed).switches)
    warnings.warn(
        f"simulate: a law switches by the time more than {MOST} times ({'; '.join(lines)}): steps "
        "end at the first of these times, and the derivative with respect to the other times is "
        "lost. Give the law `jump_times`, all its jumps in s, or take torques.Held or Pulses for a "
        "table",
        stacklevel=5,
    )


_motion: Any = eqx.filter_jit(lambda run, y, ts: run.motion(project_to_group(y), ts))
# If the next step is shorter than this fraction of the mean step, the run makes no more progress.
_STUCK = 1e-2


def explain_max_steps(setup: AnyRun, state0: Any, ts: Array, error: RuntimeError) -> RuntimeError:
    """Return the error of a run; if it used up all steps, say which time it reached, and why."""
    if _MANY_STEPS not in str(error) or not isinstance(setup, DiffraxRun) or not setup.replays:
        return error
    if not _checks.is_known((setup, state0, ts)):
        return error
    (_, stats, _), end = _motion(setup, state0, ts)
    (t, state, step), count = end, stats["num_steps"]
    # A torque that is a function may hold traced numbers, which are then in the result alone.
    if not _checks.is_known((t, state, step, count)):
        return error
    begun, end, t = float(ts[0]), float(ts[-1]), float(t)
    gone, step = abs(t - begun), float(step)
    words = f"simulate: the maximum number of solver steps, {int(count)}, "
    words += f"led to t = {t:.9g} s, and not to {end:.9g} s"
    if step * int(count) < _STUCK * gone:
        return type(error)(
            f"{words}; the last are {step:.1e} s long, all at one place: does a law switch there "
            "by the state (sign, where) and hold it at the switch, as Coulomb friction does at "
            "rest? No number of steps is enough: smooth the switch (tanh(x / width) for sign(x)), "
            "or end the run there by an Event and go on with the law that holds then"
        )
    if hasattr(motion_of(state), "omega"):
        rates = (motion_of(y).omega for y in (state0, state))
        rate = max(float(np.linalg.norm(np.asarray(w))) for w in rates)
        turns, share = rate * gone / (2 * np.pi), abs(end - begun) / max(gone, 1e-300)
        if turns > 1:
            words += f": {int(count) / turns:.3g} steps a turn for {turns * share:.3g} turns"
    needed = 1.2 * int(count) * abs(end - begun) / max(gone, 1e-300)
    return type(error)(f"{words}; give max_steps={int(float(f'{needed:.1g}')):_} or more")


def raise_if_ended(scene: Any, ys: Any, stats: dict[str, Any], ts: Array) -> Any:
    """Return the states of a particle's run; raise an error if its scene ended the run early."""
    ended, advice = stats["ended"], "; give throw=False to keep what came before it"
    if _checks.is_known(ended) and not np.any(np.asarray(ended)):
        return ys
    words = "simulate: " + scene.end_words(stats["end_time"], stats["end_state"])
    if not _checks.is_known(ended):
        return eqx.error_if(ys, ended, words + advice)
    before = np.asarray(ts)[np.asarray(ts) < float(stats["end_time"])]
    last = f"the last of ts before it is {before[-1]:.9g}{advice}" if len(before) else "the start"
    raise ValueError(f"{words}; {last}")
