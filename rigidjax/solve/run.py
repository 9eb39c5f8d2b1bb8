"""A run in one compiled piece: by the closed form, by diffrax, or by our own loop."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.exact.free_body import FreeMotion
from rigidjax.frames import Point
from rigidjax.frames.frame_dynamics import scene_of
from rigidjax.motion import on_the_group
from rigidjax.motion.coupled import started
from rigidjax.motion.torques.base import jumps_of
from rigidjax.solve import ending
from rigidjax.solve.adaptive import adaptive
from rigidjax.solve.direction import ahead
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.projection import Projected
from rigidjax.solve.step_control import NONFINITE, finite, of_body
from rigidjax.solve.vector_field import equations_of_motion

# Made once: building a Module costs as much as ten steps, and `jit` compares it leaf by leaf.
SOLVER = Projected(dfx.Dopri8())
ADJOINT = dfx.RecursiveCheckpointAdjoint()
NO_METER = dfx.NoProgressMeter()


class Free(eqx.Module):
    """A free body: the closed form, any time at the cost of one."""

    body: Inertia | MassProperties
    throw: bool = eqx.field(static=True)


class Setup(eqx.Module):
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


class Loop(eqx.Module):
    """A solve of which nothing is asked but states and derivatives: our own loop.

    `sign` of the direction of time; `None` where it is known to go forwards.
    """

    body: Inertia | MassProperties | None
    torque: Any
    solver: AbstractExplicit
    controller: dfx.AbstractStepSizeController
    dt0: Any
    sign: Array | None
    max_steps: int = eqx.field(static=True)
    throw: bool = eqx.field(static=True)


@eqx.filter_jit
def solve(
    setup: Free | Loop | Setup, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    ys, stats, result = _solved(setup, state0, ts)
    inputs = (setup.body, getattr(setup, "torque", None), state0, ts)
    return nan_derivatives(ys, inputs), stats, of_body(result, setup.body)


def _solved(
    setup: Free | Loop | Setup, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    # One jit around everything: an operation outside of it costs as much as a hundred steps.
    state0 = on_the_group(state0)
    if isinstance(setup, Free):
        return _free(setup, state0, ts)
    # With the states of the torque, where it has some.
    state0 = started(setup.body, state0, setup.torque, ts[0])
    if isinstance(setup, Loop):
        return _loop(setup, state0, ts)
    field = equations_of_motion(setup.body, state0, setup.torque)
    scene: Any = scene_of(setup.torque) if isinstance(state0, Point) else None
    watch = ending.condition(scene)
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
        event=None if watch is None else dfx.Event(watch),
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
            stats |= _ended(out.result, end_time, end)
        stats["drift"] = scene.drift(ts, ys)
    return ys, stats, result


def _loop(setup: Loop, state0: Any, ts: Array) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    controller: Any = setup.controller
    scene: Any = scene_of(setup.torque) if isinstance(state0, Point) else None
    watch = ending.condition(scene)
    field, jumps = equations_of_motion(setup.body, state0, setup.torque), jumps_of(setup.torque)
    sign = setup.sign
    field, watch, along, jumps = ahead(sign, field, watch, ts, jumps)
    out = adaptive(
        setup.solver,
        field,
        along,
        state0,
        rtol=controller.rtol,
        atol=controller.atol,
        dt0=setup.dt0,
        max_steps=setup.max_steps,
        jumps=jumps,
        halt=watch,
    )
    if sign is not None:
        out = out._replace(last_time=sign.astype(ts.dtype) * out.last_time)
    ys = _raise(out.ys, out.result) if setup.throw else out.ys
    stats: dict[str, Any] = {
        "num_steps": out.num_steps,
        "num_accepted_steps": out.num_steps - out.num_rejected,
        "num_rejected_steps": out.num_rejected,
    }
    if scene is not None:
        if watch is not None:
            stats |= _ended(out.result, out.last_time, out.last)
        stats["drift"] = scene.drift(ts, ys)
    return ys, stats, out.result


def _ended(result: dfx.RESULTS, time: Array, state: Any) -> dict[str, Any]:
    return {
        "ended": result == dfx.RESULTS.event_occurred,
        "end_time": time,
        "end_state": state,
    }


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
        "of the run? With equal steps: are they short enough for this spin? throw=False keeps "
        "what came before",
    )
    ys = eqx.error_if(
        ys,
        result == dfx.RESULTS.dt_min_reached,
        "simulate: no step is short enough: the minimum step size, some units of round-off of the "
        "time, was reached. Does the torque jump or grow without bound? In float32 the times near "
        "1e9 s are 100 s apart: count time from a later origin, or use float64",
    )
    ill = (result != dfx.RESULTS.successful) & (result != dfx.RESULTS.event_occurred)
    ill = ill & (result != NONFINITE) & (result != dfx.RESULTS.dt_min_reached)
    return result.error_if(ys, ill)


def _free(setup: Free, state0: Any, ts: Array) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    ys = FreeMotion(setup.body, state0)(ts - ts[0])
    none = jnp.zeros((), int)
    stats = {"num_steps": none, "num_accepted_steps": none, "num_rejected_steps": none}
    if setup.throw:
        ys = eqx.error_if(
            ys,
            ~finite(ys),
            "simulate: a state in closed form is NaN or infinite: after more turns than the dtype "
            "can count, or from numbers beyond its range; throw=False keeps the others",
        )
        return ys, stats, dfx.RESULTS.successful
    return ys, stats, dfx.RESULTS.where(finite(ys), dfx.RESULTS.successful, NONFINITE)


class Flow(eqx.Module):
    """The same run from another start, as a function that forward mode goes through."""

    setup: Free | Loop | Setup

    def __init__(self, setup: "Free | Loop | Setup"):
        setup = dataclasses.replace(setup, throw=False)
        if isinstance(setup, Setup):
            setup = dataclasses.replace(setup, adjoint=dfx.ForwardMode())
        self.setup = setup

    def __call__(self, state0: Any, ts: Array) -> Any:
        return solve(self.setup, state0, ts)[0]
