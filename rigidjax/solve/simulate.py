"""The one front door: a body, where it starts, when to look, and what turns it."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, motion
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.exact import FreeBody
from rigidjax.frames import AbstractScene, MovingFrame, Point, collision, scene_of
from rigidjax.motion import (
    Attitude,
    AttitudeEquations,
    EulerEquations,
    NewtonEuler,
    Rigid,
    Spin,
    on_the_group,
)
from rigidjax.motion.torques import Torque, jumps_of
from rigidjax.solve import inputs, lean, travel
from rigidjax.solve.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.growth import growth
from rigidjax.solve.projected import Projected
from rigidjax.solve.splitting import AbstractSplitting
from rigidjax.solve.watched import NONFINITE, Watched, finite

State = TypeVar("State", Spin, Attitude, Rigid, Point)
# A law must take the state that there is: gravity on a `Spin` is an error that type checkers see.
Law = Callable[[Any, State, Any], Any] | AbstractScene | MovingFrame | None

# Made once: building a Module costs as much as ten steps, and `jit` compares it leaf by leaf.
_SOLVER = Projected(dfx.Dopri8())
_ADJOINT = dfx.RecursiveCheckpointAdjoint()
_NO_METER = dfx.NoProgressMeter()
# Our loop takes a short step to each saved time, where diffrax has a polynomial to evaluate.
_FEW_TIMES = 32


class Solution(eqx.Module, Generic[State]):
    """What `simulate` returns.

    **Fields:** `ts` (T,) the times asked for, s; `ys` the states there, of the type of `state0`,
    with a leading time axis, NaN where the run did not get to; `stats` a dict with `num_steps`,
    `num_accepted_steps`, `num_rejected_steps`, for a `Point` also `drift` of what its scene
    conserves; `result` a `diffrax.RESULTS`: `successful`, or why the run ended early, such as
    `max_steps_reached`, `nonfinite`, `dt_min_reached`.
    """

    ts: Float[Array, " times"]
    ys: State
    stats: dict[str, Any]
    result: dfx.RESULTS
    _setup: "_Free | _Lean | _Setup"

    @property
    def drift(self) -> dict[str, Array]:
        """How far each quantity that the scene conserves moved, relative to its size.

        See `rigidjax.drift`: energy, angular momentum in the world, its component along gravity…,
        whichever this scene keeps; for a `Point` what its scene says. Zero is perfect.
        """
        if "drift" in self.stats:
            return self.stats["drift"]
        return _drift(self._setup, self.ts, self.ys)

    @property
    def growth(self) -> Float[Array, " times"]:
        """‖∂y(t)/∂y(t₀)‖ at each of `ts`: by how much a small error at the start has grown.

        Computed when asked for, by forward mode: about as many runs as the state has numbers. It
        has no unit: each of q, Ω, x, v counts relative to its largest size in the run, and the norm
        is the largest singular value.

        A solver's own errors grow as much. Where `growth * rtol` exceeds 1, the states there are
        not known to a single digit and every gradient through them means nothing, however finite it
        looks, whatever the adjoint: a `UserWarning` names the first such time. So look at it once
        before differentiating through a long run; then end the run earlier, or fit it in pieces
        (multiple shooting).

        Source: the largest finite-time Lyapunov exponent is its logarithm over t (Eckmann and
        Ruelle 1985, doi:10.1103/RevModPhys.57.617).
        """
        found = growth(_Flow(self._setup), self.ts, self.ys)
        rtol = getattr(getattr(self._setup, "controller", None), "rtol", None)
        if rtol is None:
            rtol = 100 * float(jnp.finfo(self.ts.dtype).eps)
        if _checks.known((found, rtol, self.ts)):
            lost = np.flatnonzero(np.asarray(found) * float(rtol) > 1)
            if lost.size:
                i = lost[0]
                warnings.warn(
                    f"growth: errors at the start have grown {float(found[i]):.1e} times at t = "
                    f"{float(self.ts[i]):g} s; at a tolerance of {float(rtol):.0e} the states from "
                    "there on are not known, and gradients through them mean nothing",
                    stacklevel=2,
                )
        return found

    def evaluate(self, t: ScalarLike) -> State:
        """The state at any `t` between the first and the last of `ts`, s.

        The motion is worked out again from the last saved state before `t`, so the error is that of
        the method, not of an interpolation, and the attitude is on the group.

        **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) where `t` is outside.
        """
        t = _checks.floating(t, (), "t").astype(self.ts.dtype)
        outside = (t < self.ts[0]) | (t > self.ts[-1])
        t = _checks.refuse(t, outside, "evaluate: t lies outside the times that were simulated")
        index = jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, self.ts.shape[0] - 1)
        start = jax.tree.map(lambda leaf: leaf[index], self.ys)
        ys, _, _ = _solve(self._setup, start, jnp.stack([self.ts[index], t]))
        return jax.tree.map(lambda leaf: leaf[-1], ys)


@eqx.filter_jit
def _drift(setup: "_Free | _Lean | _Setup", ts: Array, ys: Any) -> dict[str, Array]:
    torque = None if isinstance(setup, _Free) else setup.torque
    return motion.drift(ts, ys, setup.body, torque)  # pyright: ignore[reportArgumentType]


class _Free(eqx.Module):
    """A free body: the closed form, any time at the cost of one."""

    body: Inertia | MassProperties
    throw: bool = eqx.field(static=True)


class _Setup(eqx.Module):
    """Everything about a solve but the start and the times."""

    body: Inertia | MassProperties | None
    torque: Any
    solver: dfx.AbstractSolver
    controller: dfx.AbstractStepSizeController
    dt0: Any
    adjoint: dfx.AbstractAdjoint
    progress_meter: dfx.AbstractProgressMeter
    max_steps: int | None = eqx.field(static=True)
    throw: bool = eqx.field(static=True)


class _Lean(eqx.Module):
    """A solve of which nothing is asked but states and `jax.grad`: our own loop."""

    body: Inertia | MassProperties | None
    torque: Any
    controller: dfx.AbstractStepSizeController
    dt0: Any
    max_steps: int = eqx.field(static=True)
    throw: bool = eqx.field(static=True)


@eqx.filter_jit
def _solve(
    setup: _Free | _Lean | _Setup, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    # One jit around everything: an operation outside of it costs as much as a hundred steps.
    state0 = on_the_group(state0)
    if isinstance(setup, _Free):
        return _free(setup, state0, ts)
    if isinstance(setup, _Lean):
        return _lean(setup, state0, ts)
    field = equations_of_motion(setup.body, state0, setup.torque)
    scene: Any = scene_of(setup.torque) if isinstance(state0, Point) else None
    watch = collision.event(scene)
    subs = (
        (dfx.SubSaveAt(ts=ts),) if watch is None else (dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t1=True))
    )
    out = dfx.diffeqsolve(
        dfx.ODETerm(field),
        setup.solver,
        ts[0],
        ts[-1],
        setup.dt0,
        state0,
        saveat=dfx.SaveAt(subs=subs),
        stepsize_controller=setup.controller,
        adjoint=setup.adjoint,
        max_steps=setup.max_steps,
        throw=False,
        progress_meter=setup.progress_meter,
        event=watch,
    )
    stats: dict[str, Any] = {k: value for k, value in out.stats.items() if k != "max_steps"}
    times: Any = out.ts
    saved: Any = out.ys
    ys, result = _reached(saved[0], times[0]), out.result
    if not isinstance(setup.controller, dfx.AbstractAdaptiveStepSizeController):
        # Equal steps look at no error, and would go on with NaN.
        ill = (result == dfx.RESULTS.successful) & ~finite(ys)
        result = dfx.RESULTS.where(ill, NONFINITE, result)
    if setup.throw:
        ys = _raise(ys, result)
    if scene is not None:
        if watch is not None:
            end, end_time = jax.tree.map(lambda leaf: leaf[0], (saved[1], times[1]))
            stats["collided"] = out.result == dfx.RESULTS.event_occurred
            stats["end_time"] = end_time
            stats["end_distances"] = scene.approach(end_time, end)[0]
        stats["drift"] = scene.drift(ts, ys)
    return ys, stats, result


def _lean(setup: _Lean, state0: Any, ts: Array) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    controller: Any = setup.controller
    out = lean.adaptive(
        DormandPrince8(),
        equations_of_motion(setup.body, state0, setup.torque),
        ts,
        state0,
        rtol=controller.rtol,
        atol=controller.atol,
        dt0=setup.dt0,
        max_steps=setup.max_steps,
        jumps=jumps_of(setup.torque),
        way=travel.reverse,
    )
    ys = _raise(out.ys, out.result) if setup.throw else out.ys
    stats: dict[str, Any] = {
        "num_steps": out.num_steps,
        "num_accepted_steps": out.num_steps - out.num_rejected,
        "num_rejected_steps": out.num_rejected,
    }
    if isinstance(state0, Point):
        stats["drift"] = scene_of(setup.torque).drift(ts, ys)
    return ys, stats, out.result


def _reached(ys: Any, times: Array) -> Any:
    """NaN where nothing was saved, there diffrax says t = inf: not to be taken for a state."""

    def mark(leaf: Array) -> Array:
        there = jnp.isfinite(times).reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(there, leaf, jnp.full_like(leaf, jnp.nan))

    return jax.tree.map(mark, ys)


def _raise(ys: Any, result: dfx.RESULTS) -> Any:
    ys = eqx.error_if(
        ys,
        result == NONFINITE,
        "simulate: the motion became NaN or infinite. Is the torque finite at every time and state "
        "that it meets? With equal steps: are they short enough for this spin? throw=False keeps "
        "what came before",
    )
    ill = (result != dfx.RESULTS.successful) & (result != dfx.RESULTS.event_occurred)
    return result.error_if(ys, ill & (result != NONFINITE))


def _free(setup: _Free, state0: Any, ts: Array) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    since, body = ts - ts[0], setup.body
    inertia = body if isinstance(body, Inertia) else body.inertia
    turning = Attitude(state0.q, state0.omega) if isinstance(state0, Rigid) else state0
    ys: Any = jax.vmap(FreeBody(inertia, turning))(since)
    if isinstance(state0, Rigid):
        x = state0.x[None] + since[:, None] * state0.v[None]
        ys = Rigid(x, jnp.broadcast_to(state0.v, x.shape), ys.q, ys.omega)
    none = jnp.zeros((), int)
    stats = {"num_steps": none, "num_accepted_steps": none, "num_rejected_steps": none}
    result = dfx.RESULTS.successful
    if not setup.throw:
        result = dfx.RESULTS.where(finite(ys), result, NONFINITE)
    return ys, stats, result


class _Flow(eqx.Module):
    """The same run from another start, as a function that forward mode goes through."""

    setup: _Free | _Lean | _Setup

    def __init__(self, setup: "_Free | _Lean | _Setup"):
        if isinstance(setup, _Lean):
            setup = _Setup(
                body=setup.body,
                torque=setup.torque,
                solver=_SOLVER,
                controller=setup.controller,
                dt0=setup.dt0,
                adjoint=_ADJOINT,
                progress_meter=_NO_METER,
                max_steps=setup.max_steps,
                throw=False,
            )
        setup = dataclasses.replace(setup, throw=False)
        if isinstance(setup, _Setup):
            setup = dataclasses.replace(setup, adjoint=dfx.ForwardMode())
        self.setup = setup

    def __call__(self, state0: Any, ts: Array) -> Any:
        return _solve(self.setup, state0, ts)[0]


def simulate(
    body: Inertia | MassProperties | None,
    state0: State,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Law[State] = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt0: ScalarLike | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int | None = 100_000,
    throw: bool = True,
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> Solution[State]:
    """The motion of a rigid body from `state0`, saved at `ts`.

    **Arguments:**

    - `body`: `Inertia` for `Spin` and `Attitude`, about the point that the body turns about;
      `MassProperties` for `Rigid`; `None` for a `Point`.
    - `state0`: `Spin(omega)`, `Attitude(q, omega)` or `Rigid(x, v, q, omega)` at `ts[0]`. The rung
      says what is solved for: take the lowest that the question needs. One body; for many,
      `jax.vmap(lambda body, state: rj.simulate(body, state, ts).ys)`, and with `throw=False` take
      `.result` along: one for each body.
    - `ts`: (T,) increasing times, s. The first is the start.
    - `torque`: a law of `rigidjax.torques` (the jumps of a schedule are given to the stepper), or
      any callable Module `(t, state, body) → (3,)`, N m, body frame; `None` for a free body. For a
      `Point` a scene of `rigidjax.scenes`, a `MovingFrame` to see it from, or a force per mass
      `(t, state, None) → (3,)`, m/s².
    - `solver`: `None` is the cheapest that is right: the closed form (`rigidjax.exact`) for a free
      body, else `diffrax.Dopri8`. Any `diffrax.AbstractSolver` may be given; it is wrapped so that
      attitudes stay unit quaternions, at every step and every saved time.
      `rigidjax.solvers.DormandPrince8()` with nothing more asked (at most 32 times, no controller,
      forward mode or meter, no `Point` that may collide) runs in a loop of our own: a half to a
      third of the time, and some seconds more to compile. Below `rtol=1e-10` mind that Dopri8 is up
      to 26 times `rtol` off between its steps (five times at most with `DormandPrince8`).
    - `rtol`, `atol`: tolerances of the adaptive steps; 1e-9 and 1e-12 in float64, 2e-5 and 1e-7 in
      float32. Scale `atol` to the smallest number that matters: a flip about the middle axis grows
      out of how far off the axis it starts, and where that is below `atol` its time is made up. The
      closed form has no use for either.
    - `dt0`, `stepsize_controller`: first step and controller where the tolerances are not enough,
      such as `dt0=0.01, stepsize_controller=diffrax.ConstantStepSize()`.
    - `adjoint`: how gradients through a solver are taken. `None` is
      `diffrax.RecursiveCheckpointAdjoint()`, for `jax.grad`; pass `diffrax.ForwardMode()` for
      `jax.jacfwd` and least squares. The closed form takes both.
    - `max_steps`, `progress_meter`: as in `diffrax.diffeqsolve`.
    - `throw`: `False` never raises for numbers met on the way, or for a bad start inside a batch:
      `result` says what happened, states not reached are NaN, and other bodies of the batch get
      what they would get alone. Known numbers that are wrong are refused in any case.

    **Returns** a `Solution`. A second call with other numbers of the same shapes compiles nothing.

    Source: `AttitudeEquations`, `EulerEquations`, `NewtonEuler` (notes, eqs 50, 79, 84).

    **Raises:** `TypeError` where body, state and torque do not fit; `ValueError` for times that do
    not increase, NaN, or a quaternion that is not unit (`EquinoxRuntimeError` under `jit`).

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> bool(abs(rj.simulate(body, start, jnp.linspace(0.0, 9.43, 3)).ys.omega[-1, 1]) < 0.01)
    True
    """
    times = inputs.times(ts, throw)
    state0 = inputs.start(state0, throw)
    dtype = times.dtype
    for leaf in jax.tree.leaves(state0):
        dtype = jnp.promote_types(dtype, leaf.dtype)
    times, state0 = jax.tree.map(lambda leaf: _as(leaf, dtype), (times, state0))
    inputs.require_fit(body, state0, torque)
    if body is not None and (throw or _checks.known(body)):
        body = body.invertible()
    controller = stepsize_controller
    if controller is None:
        rtol, atol = inputs.tolerances(rtol, atol, dtype)
        controller = _controller(rtol, atol)
        if hasattr(torque, "jump_times") and jumps_of(torque).size:
            # An adaptive step passes over a short pulse without seeing it.
            jump_ts = jnp.sort(jumps_of(torque).astype(dtype))
            controller = dfx.ClipStepSizeController(controller, jump_ts=jump_ts)
    elif rtol is not None or atol is not None:
        raise ValueError("simulate: give either rtol and atol or a stepsize_controller, not both")
    elif isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        controller = Watched(controller)
    if torque is None and solver is None and stepsize_controller is None and body is not None:
        free = _Free(body, throw)
        return Solution(times, *_solve(free, state0, times), free)
    ours = isinstance(solver, DormandPrince8)
    plain = ours and stepsize_controller is None and progress_meter is None
    # Forward mode stays with diffrax: there our loop is faster, but takes far longer to compile.
    plain = plain and (adjoint is None or adjoint == _ADJOINT) and max_steps is not None
    plain = plain and times.shape[0] <= _FEW_TIMES
    if plain and not _can_collide(state0, torque):
        first = inputs.first_step(dt0, times)
        quick = _Lean(body, torque, controller, first, max_steps, throw)  # pyright: ignore
        return Solution(times, *_solve(quick, state0, times), quick)
    setup = _Setup(
        body=body,
        torque=torque,
        solver=_on_the_group(solver),
        controller=controller,
        dt0=inputs.first_step(dt0, times),
        adjoint=_ADJOINT if adjoint is None else adjoint,
        progress_meter=_NO_METER if progress_meter is None else progress_meter,
        max_steps=max_steps,
        throw=throw,
    )
    ys, stats, result = _solve(setup, state0, times)
    if throw and "collided" in stats:
        ys = collision.refuse(ys, stats, times)
    return Solution(times, ys, stats, result, setup)


def equations_of_motion(
    body: Inertia | MassProperties | None,
    state0: Spin | Attitude | Rigid | Point,
    torque: Torque | AbstractScene | MovingFrame | None = None,
) -> Callable[..., Any]:
    """The vector field for this body on the rung of `state0`, for plain `diffrax.ODETerm`.

    **Arguments** as for `simulate`. **Raises** `TypeError` where they do not fit.

    >>> import rigidjax as rj
    >>> type(equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 0, 0])))
    <class 'rigidjax.motion.spin.EulerEquations'>
    """
    inputs.require_fit(body, state0, torque)
    if isinstance(state0, Point):
        return scene_of(torque).field
    matter: Any = body
    turning: Any = torque
    if isinstance(body, MassProperties):
        return NewtonEuler(body, turning)
    if isinstance(state0, Attitude):
        return AttitudeEquations(matter, turning)
    return EulerEquations(matter, turning)


def _can_collide(state0: Any, torque: Any) -> bool:
    return isinstance(state0, Point) and collision.event(scene_of(torque)) is not None


@functools.cache
def _controller(rtol: float, atol: float) -> Watched:
    return Watched(dfx.PIDController(rtol=rtol, atol=atol))


def _on_the_group(solver: dfx.AbstractSolver | None) -> dfx.AbstractSolver:
    # Ours project inside their one kernel; a second time outside of it breaks the kernel up.
    if isinstance(solver, AbstractExplicit | AbstractSplitting):
        return solver
    return _SOLVER if solver is None else Projected(solver)


def _as(leaf: Array, dtype: Any) -> Array:
    # Outside of `jit` even a conversion to the same dtype costs as much as a step.
    return leaf if leaf.dtype == dtype else leaf.astype(dtype)
