"""The one front door: a body, where it starts, when to look, and what turns it."""

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, motion
from rigidjax._types import HasAttitude, ScalarLike
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
from rigidjax.motion.torques import Torque, jumps_of, require_rung
from rigidjax.solve.projected import Projected

State = Spin | Attitude | Rigid | Point

# Made once: building a Module costs as much as ten steps, and `jit` compares it leaf by leaf.
_SOLVER = Projected(dfx.Dopri8())
_ADJOINT = dfx.RecursiveCheckpointAdjoint()
_NO_METER = dfx.NoProgressMeter()


class Solution(eqx.Module):
    """What `simulate` returns.

    **Fields:** `ts` (T,) the times asked for, s; `ys` the states there, of the type of `state0`,
    with a leading time axis; `stats` a dict with `num_steps`, `num_accepted_steps`,
    `num_rejected_steps`, for a `Point` also `drift` of what its scene conserves; `result` a
    `diffrax.RESULTS`, successful or the reason why not.
    """

    ts: Float[Array, " times"]
    ys: Any
    stats: dict[str, Any]
    result: dfx.RESULTS
    _setup: "_Free | _Setup"

    @property
    def drift(self) -> dict[str, Array]:
        """How far each quantity that the scene conserves moved, relative to its size.

        See `rigidjax.drift`: energy, angular momentum in the world, its component along gravity…,
        whichever this scene keeps; for a `Point` what its scene says. Zero is perfect.
        """
        if "drift" in self.stats:
            return self.stats["drift"]
        return _drift(self._setup, self.ts, self.ys)

    def evaluate(self, t: ScalarLike) -> Any:
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
def _drift(setup: "_Free | _Setup", ts: Array, ys: Any) -> dict[str, Array]:
    torque = None if isinstance(setup, _Free) else setup.torque
    return motion.drift(ts, ys, setup.body, torque)  # pyright: ignore[reportArgumentType]


class _Free(eqx.Module):
    """A free body: the closed form, any time at the cost of one."""

    body: Inertia | MassProperties


class _Setup(eqx.Module):
    """Everything about a solve but the start and the times."""

    body: Inertia | MassProperties | None
    torque: Torque | AbstractScene | MovingFrame | None
    solver: dfx.AbstractSolver
    controller: dfx.AbstractStepSizeController
    dt0: Any
    adjoint: dfx.AbstractAdjoint
    progress_meter: dfx.AbstractProgressMeter
    max_steps: int | None = eqx.field(static=True)
    throw: bool = eqx.field(static=True)


@eqx.filter_jit
def _solve(
    setup: _Free | _Setup, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    # One jit around everything: an operation outside of it costs as much as a hundred steps.
    state0 = on_the_group(state0)
    if isinstance(setup, _Free):
        return _free(setup.body, state0, ts)
    field = equations_of_motion(setup.body, state0, setup.torque)
    scene: Any = scene_of(setup.torque) if isinstance(state0, Point) else None
    watch = collision.event(scene)
    saveat = dfx.SaveAt(ts=ts)
    if watch is not None:
        saveat = dfx.SaveAt(subs=(dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t1=True)))
    out = dfx.diffeqsolve(
        dfx.ODETerm(field),
        setup.solver,
        ts[0],
        ts[-1],
        setup.dt0,
        state0,
        saveat=saveat,
        stepsize_controller=setup.controller,
        adjoint=setup.adjoint,
        max_steps=setup.max_steps,
        throw=setup.throw,
        progress_meter=setup.progress_meter,
        event=watch,
    )
    stats: dict[str, Any] = {k: value for k, value in out.stats.items() if k != "max_steps"}
    ys: Any = out.ys
    if scene is not None:
        if watch is not None:
            times: Any = out.ts
            (ys, ends), (_, end_times) = ys, times
            end = jax.tree.map(lambda leaf: leaf[0], ends)
            stats["collided"] = out.result == dfx.RESULTS.event_occurred
            stats["end_time"] = end_times[0]
            stats["end_distances"] = scene.approach(end_times[0], end)[0]
        stats["drift"] = scene.drift(ts, ys)
    return ys, stats, out.result


def _free(
    body: Inertia | MassProperties, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS]:
    since = ts - ts[0]
    inertia = body if isinstance(body, Inertia) else body.inertia
    turning = Attitude(state0.q, state0.omega) if isinstance(state0, Rigid) else state0
    ys: Any = jax.vmap(FreeBody(inertia, turning))(since)
    if isinstance(state0, Rigid):
        x = state0.x[None] + since[:, None] * state0.v[None]
        ys = Rigid(x, jnp.broadcast_to(state0.v, x.shape), ys.q, ys.omega)
    none = jnp.zeros((), int)
    stats = {"num_steps": none, "num_accepted_steps": none, "num_rejected_steps": none}
    return ys, stats, dfx.RESULTS.successful


def simulate(
    body: Inertia | MassProperties | None,
    state0: State,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Torque | AbstractScene | MovingFrame | None = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt0: float | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    max_steps: int | None = 100_000,
    throw: bool = True,
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> Solution:
    """The motion of a rigid body from `state0`, saved at `ts`.

    **Arguments:**

    - `body`: `Inertia` for `Spin` and `Attitude`, about the point that the body turns about;
      `MassProperties` for `Rigid`; `None` for a `Point`.
    - `state0`: `Spin(omega)`, `Attitude(q, omega)` or `Rigid(x, v, q, omega)` at `ts[0]`. The rung
      says what is solved for: take the lowest that the question needs. One body; for many,
      `jax.vmap(lambda body, state: rj.simulate(body, state, ts).ys)`.
    - `ts`: (T,) increasing times, s. The first is the start.
    - `torque`: a law of `rigidjax.torques` (the jumps of a schedule are given to the stepper), or
      any callable Module `(t, state, body) → (3,)`, N m, body frame; `None` for a free body. For a
      `Point` a scene of `rigidjax.scenes`, a `MovingFrame` to see it from, or a force per mass
      `(t, state, None) → (3,)`, m/s².
    - `solver`: `None` is the cheapest that is right: the closed form (`rigidjax.exact`) for a free
      body, else `diffrax.Dopri8`. Any `diffrax.AbstractSolver` may be given; it is wrapped so that
      attitudes stay unit quaternions, at every step and every saved time.
    - `rtol`, `atol`: tolerances of the adaptive steps; 1e-9 and 1e-12 in float64, 2e-5 and 1e-7 in
      float32. The closed form has no use for them.
    - `dt0`, `stepsize_controller`: first step and controller where the tolerances are not enough,
      such as `dt0=0.01, stepsize_controller=diffrax.ConstantStepSize()`.
    - `adjoint`: how gradients through a solver are taken. `None` is
      `diffrax.RecursiveCheckpointAdjoint()`, for `jax.grad`; pass `diffrax.ForwardMode()` for
      `jax.jacfwd` and least squares. The closed form takes both.
    - `max_steps`, `throw`, `progress_meter`: as in `diffrax.diffeqsolve`.

    **Returns** a `Solution`. A second call with other numbers of the same shapes compiles nothing.

    Source: `AttitudeEquations`, `EulerEquations`, `NewtonEuler` (notes, eqs 50, 79, 84).

    **Raises:** `TypeError` where body, state and torque do not fit; `ValueError` for times that do
    not increase, NaN, or a quaternion that is not unit (`EquinoxRuntimeError` under `jit`).

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> bool(abs(rj.simulate(body, start, jnp.linspace(0.0, 9.43, 3)).ys.omega[-1, 1]) < 0.01)
    True
    """
    times = _check_times(ts)
    state0 = _check_start(state0)
    dtype = times.dtype
    for leaf in jax.tree.leaves(state0):
        dtype = jnp.promote_types(dtype, leaf.dtype)
    times, state0 = jax.tree.map(lambda leaf: _as(leaf, dtype), (times, state0))
    require_fit(body, state0, torque)
    if body is not None:
        body = body.invertible()
    controller = stepsize_controller
    if controller is None:
        rtol, atol = _tolerances(rtol, atol, dtype)
        controller = _controller(rtol, atol)
        if hasattr(torque, "jump_times") and jumps_of(torque).size:
            # An adaptive step passes over a short pulse without seeing it.
            jump_ts = jnp.sort(jumps_of(torque).astype(dtype))
            controller = dfx.ClipStepSizeController(controller, jump_ts=jump_ts)
    elif rtol is not None or atol is not None:
        raise ValueError("simulate: give either rtol and atol or a stepsize_controller, not both")
    if torque is None and solver is None and stepsize_controller is None and body is not None:
        free = _Free(body)
        return Solution(times, *_solve(free, state0, times), free)
    setup = _Setup(
        body=body,
        torque=torque,
        solver=_SOLVER if solver is None else Projected(solver),
        controller=controller,
        dt0=None if dt0 is None else jnp.asarray(dt0, dtype),
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
    state0: State,
    torque: Torque | AbstractScene | MovingFrame | None = None,
) -> Callable[..., Any]:
    """The vector field for this body on the rung of `state0`, for plain `diffrax.ODETerm`.

    **Arguments** as for `simulate`. **Raises** `TypeError` where they do not fit.

    >>> import rigidjax as rj
    >>> type(equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 0, 0])))
    <class 'rigidjax.motion.spin.EulerEquations'>
    """
    require_fit(body, state0, torque)
    if isinstance(state0, Point):
        return scene_of(torque).field
    matter: Any = body
    turning: Any = torque
    if isinstance(body, MassProperties):
        return NewtonEuler(body, turning)
    if isinstance(state0, Attitude):
        return AttitudeEquations(matter, turning)
    return EulerEquations(matter, turning)


def require_fit(body: Any, state0: Any, torque: Any) -> None:
    """Raise `TypeError` unless body, state and torque belong on one rung."""
    if isinstance(state0, Point) and body is not None:
        raise TypeError(f"Point is no body: wanted None in its place, got {type(body).__name__}")
    if isinstance(torque, AbstractScene | MovingFrame) and not isinstance(state0, Point):
        raise TypeError(
            f"{type(torque).__name__} moves a Point: wanted Point(x, v), got "
            f"{type(state0).__name__}; frames.BodyInFrame is for a body in a moving frame"
        )
    if isinstance(state0, Point):
        scene_of(torque)
    if torque is not None and not isinstance(torque, AbstractScene | MovingFrame):
        require_rung(torque, state0)
    if isinstance(state0, Rigid) and not isinstance(body, MassProperties):
        raise TypeError(
            f"Rigid moves as well as turns: wanted MassProperties, got {type(body).__name__}"
        )
    if not isinstance(state0, Rigid | Point) and not isinstance(body, Inertia):
        raise TypeError(
            f"{type(state0).__name__} only turns: wanted Inertia, got {type(body).__name__}"
            + ("; pass body.inertia" if isinstance(body, MassProperties) else "")
        )
    tensor = (
        body.inertia.tensor if isinstance(body, MassProperties) else getattr(body, "tensor", None)
    )
    if tensor is not None and tensor.ndim != 2:
        raise ValueError(
            f"body: wanted one body, a tensor of shape (3, 3), got {tensor.shape}; batch with "
            "jax.vmap"
        )


def _tolerances(rtol: float | None, atol: float | None, dtype: Any) -> tuple[float, float]:
    double = dtype == jnp.float64
    rtol = (1e-9 if double else 2e-5) if rtol is None else rtol
    atol = (1e-12 if double else 1e-7) if atol is None else atol
    if not rtol > 0 or not atol >= 0:
        raise ValueError(f"simulate: wanted rtol > 0 and atol >= 0, got rtol={rtol}, atol={atol}")
    floor = 100 * float(jnp.finfo(dtype).eps)
    # A relative tolerance below this cannot be met: steps shrink until max_steps ends the run.
    if rtol < floor:
        advice = "" if double else "; set jax.config.update('jax_enable_x64', True) for float64"
        warnings.warn(
            f"simulate: {np.dtype(dtype).name} cannot reach rtol={rtol:g}; "
            f"using {floor:.1g}{advice}",
            stacklevel=3,
        )
        rtol = floor
    return rtol, atol


@functools.cache
def _controller(rtol: float, atol: float) -> dfx.PIDController:
    return dfx.PIDController(rtol=rtol, atol=atol)


def _as(leaf: Array, dtype: Any) -> Array:
    # Outside of `jit` even a conversion to the same dtype costs as much as a step.
    return leaf if leaf.dtype == dtype else leaf.astype(dtype)


def _check_times(ts: Any) -> Array:
    try:
        length = np.shape(ts)
    except ValueError:
        length = ()
    if len(length) != 1 or length[0] < 2:
        raise ValueError(f"ts: wanted at least two times, shape (T,), got shape {length}")
    times = _checks.finite(_checks.floating(ts, length, "ts"), "ts")
    xp = _checks.namespace(times)
    found = xp.asarray(times)
    falling = found[1:] <= found[:-1]
    where = ""
    if xp is np and falling.any():
        where = f"; ts[{int(np.argmax(falling)) + 1}] is not above the one before"
    return _checks.refuse(times, falling.any(), f"ts: wanted increasing times{where}")


def _check_start(state0: State) -> State:
    if not isinstance(state0, Spin | Attitude | Rigid | Point):
        raise TypeError(
            "state0: wanted Spin, Attitude or Rigid, or Point without a body, got "
            f"{type(state0).__name__}"
        )
    name, first = ("v", state0.v) if isinstance(state0, Point) else ("omega", state0.omega)
    if first.ndim != 1:
        raise ValueError(
            f"state0: wanted one body, {name} of shape (3,), got {first.shape}; batch with jax.vmap"
        )
    names = [str(path[-1]).lstrip(".") for path, _ in jax.tree.leaves_with_path(state0)]
    leaves, tree = jax.tree.flatten(state0)
    leaves = [_checks.finite(leaf, name) for leaf, name in zip(leaves, names, strict=True)]
    state0 = jax.tree.unflatten(tree, leaves)
    if isinstance(state0, HasAttitude):
        xp = _checks.namespace(state0.q)
        far = xp.abs(xp.sqrt(xp.sum(xp.square(state0.q))) - 1) > (
            1e-6 if state0.q.dtype == jnp.float64 else 1e-3
        )
        q = _checks.refuse(
            state0.q,
            far,
            "q: wanted a unit quaternion (w, x, y, z), got one whose length is not 1; normalise it "
            "with rigidjax.quaternion.normalise, and mind that the scalar comes first",
        )
        state0 = eqx.tree_at(lambda s: s.q, state0, q)
    return state0
