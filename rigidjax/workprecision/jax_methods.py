"""Prepare the methods in JAX, our methods and diffrax's solvers, each compiled once."""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax.body.inertia import Inertia
from rigidjax.exact import FreeBody
from rigidjax.solve import adaptive, equations_of_motion, fixed, simulate, solvers
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.splitting import AbstractSplitting
from rigidjax.workprecision.scene import BenchmarkScene, PreparedMethod, TimedMethod

# TOLERANCES are the settings of methods with adaptive steps. EIGHT and FOUR are the settings of
# methods with equal steps: numbers of steps, for a motion in which the body turns by 50 rad. FOUR
# is for the Runge–Kutta method of order 4, which needs more steps; EIGHT is for all others. MOST is
# the largest number of steps of a run with adaptive steps. MODES has the two ways to take a
# gradient.
TOLERANCES = tuple(10.0**-k for k in range(3, 14))
EIGHT = (40, 60, 80, 120, 170, 240, 340, 480, 680, 1000)
FOUR = (200, 500, 1200, 3000, 8000, 20000, 60000)
MOST = 400_000
MODES = {"forward": jax.jacfwd, "reverse": jax.grad}

# A flow is a function of the scene's numbers and of the setting; it returns the last state as a
# vector, and the number of steps.
Flow = Callable[[Array, Array], tuple[Array, Array]]
MakeFlow = Callable[[BenchmarkScene], Flow | None]


def compile_flow(scene: BenchmarkScene, flow: Flow) -> PreparedMethod:
    """Return a flow (of the last state or of a gradient) compiled for a scene, once for all
    settings: both arguments are traced, as if a user gave new numbers at each call.
    """
    numbers = scene.numbers
    start = time.perf_counter()
    ready = jax.jit(flow).lower(numbers, jnp.asarray(1.0, numbers.dtype)).compile()
    spent = time.perf_counter() - start
    memory = ready.memory_analysis()
    held = float(memory.temp_size_in_bytes) if memory is not None else float("nan")

    # The settings are kept on the device: moving a number to the device takes as long as some runs.
    there: dict[float, Any] = {}

    def run(setting: float) -> tuple[Any, Any]:
        if setting not in there:
            there[setting] = jnp.asarray(float(setting), numbers.dtype)
        return jax.block_until_ready(ready(numbers, there[setting]))

    return PreparedMethod(run, spent, held)


def flow_from_run(
    scene: BenchmarkScene, run: Callable[[Any, PyTree, Array, Array], tuple[PyTree, Any]]
) -> Flow:
    """Return the flow of a scene that calls `run(body, state0, ts, setting)`, which returns the
    states at `ts`, the first and the last time, and the number of steps.
    """

    def flow(numbers: Array, setting: Array) -> tuple[Any, Any]:
        body, start = scene.assemble(numbers)
        ys, steps = run(body, start, jnp.array([0.0, scene.end], numbers.dtype), setting)
        return scene.flatten(jax.tree.map(lambda leaf: leaf[-1], ys)), steps

    return flow


def _closed_flow(scene: BenchmarkScene) -> Flow | None:
    """Return the flow of the closed form of the free body, which needs no setting and takes no
    steps, or `None` for any other scene.
    """

    def run(body: Inertia, start: PyTree, ts: Array, setting: Array) -> tuple[Any, Any]:
        end: Any = FreeBody(body, start)(ts[1])
        return jax.tree.map(lambda leaf: leaf[None], end), jnp.zeros(())

    return flow_from_run(scene, run) if scene.torque is None and scene.body is not None else None


def _simulate_flow(scene: BenchmarkScene, setting_is_accuracy: bool = False) -> Flow | None:
    """Return the flow of `simulate`, with the setting as tolerance, or as `accuracy`, in place of
    the defaults, and with more steps allowed; or `None` for a scene without a torque: its closed
    form is measured by itself.
    """

    def run(body: Inertia, start: PyTree, ts: Array, setting: Array) -> tuple[Any, Any]:
        how: dict[str, Any] = dict(rtol=setting, atol=1e-3 * setting)
        how = dict(accuracy=setting) if setting_is_accuracy else how
        out = simulate(body, start, ts, scene.torque, throw=False, max_steps=MOST, **how)
        return out.ys, out.stats["num_steps"]

    return None if scene.torque is None else flow_from_run(scene, run)


def _adaptive_flow(scene: BenchmarkScene, solver: AbstractExplicit) -> Flow:
    """Return the `Flow` of a Runge–Kutta method in the loop of `simulate`, differentiable in
    forward and reverse mode; the setting of this `Flow` is the relative tolerance.
    """

    def run(body: Inertia, start: PyTree, ts: Array, setting: Array) -> tuple[Any, Any]:
        field = equations_of_motion(body, start, scene.torque)
        out = adaptive(solver, field, ts, start, rtol=setting, atol=1e-3 * setting, max_steps=MOST)
        return out.ys, out.num_steps

    return flow_from_run(scene, run)


def equal_flow(scene: BenchmarkScene, solver: AbstractExplicit | AbstractSplitting) -> Flow:
    """Return the flow of `solver` with equal steps, whose number is the setting."""

    def run(body: Inertia, start: PyTree, ts: Array, setting: Array) -> tuple[Any, Any]:
        field, count = equations_of_motion(body, start, scene.torque), setting.astype(int)
        return fixed(solver, field, ts, start, count), count

    return flow_from_run(scene, run)


def _diffrax_flow(
    scene: BenchmarkScene, solver: dfx.AbstractSolver, adjoint: dfx.AbstractAdjoint | None = None
) -> Flow:
    """Return the flow of our equations in diffrax's own loop, with the setting as relative
    tolerance.
    """

    def run(body: Inertia, start: PyTree, ts: Array, setting: Array) -> tuple[Any, Any]:
        field = equations_of_motion(body, start, scene.torque)
        return _diffeqsolve(field, None, start, solver, adjoint, setting, scene.end)

    return flow_from_run(scene, run)


def _plain_flow(
    scene: BenchmarkScene, solver: dfx.AbstractSolver, adjoint: dfx.AbstractAdjoint | None = None
) -> Flow:
    """Return the flow in diffrax of the equations that a user would write by hand (of ours, if the
    scene has none): the state is one array, and the constants are computed before the run.
    """
    plain = scene.plain
    if plain is None:
        return _diffrax_flow(scene, solver, adjoint)

    def flow(numbers: Array, setting: Array) -> tuple[Any, Any]:
        start = scene.flatten(scene.assemble(numbers)[1])
        rates = plain(tuple(numbers), jnp.sin, jnp.cos, jnp.sqrt)
        zero = jnp.zeros((), start.dtype)
        by_hand, constants = jax.closure_convert(lambda t, y: jnp.stack(rates(t, y)), zero, start)

        def field(t: Array, y: PyTree, constants: Sequence[Array]) -> Any:
            return by_hand(t, y, *constants)

        ys, steps = _diffeqsolve(field, constants, start, solver, adjoint, setting, scene.end)
        return ys[-1], steps

    return flow


def _diffeqsolve(
    field: Callable[..., PyTree],
    args: PyTree,
    start: PyTree,
    solver: dfx.AbstractSolver,
    adjoint: dfx.AbstractAdjoint | None,
    setting: Array,
    end: float,
) -> tuple[PyTree, Any]:
    """Solve an equation of motion by diffrax, with the setting as relative tolerance; return the
    last state, with a leading axis, and the number of steps.
    """
    # The adjoint equation of diffrax takes times of the precision of the state only.
    first, last = jnp.zeros_like(setting), jnp.asarray(end, setting.dtype)
    out = dfx.diffeqsolve(
        dfx.ODETerm(field), solver, first, last, None, start, args,
        stepsize_controller=dfx.PIDController(rtol=setting, atol=1e-3 * setting),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=MOST, throw=False,
    )  # fmt: skip
    return out.ys, out.stats["num_steps"]


def _compiled(
    make_flow: MakeFlow, differentiate: Callable[..., Any] | None, scene: BenchmarkScene
) -> PreparedMethod | None:
    """Return a method compiled for a scene, for its value, or for the gradient of `scene.loss` by
    `differentiate`; `None` if the method cannot do the scene.
    """
    flow = make_flow(scene)
    if flow is None:
        return None

    def slopes(numbers: Array, setting: Array) -> tuple[Any, Any]:
        def loss(numbers: Array) -> Any:
            end, steps = flow(numbers, setting)
            return scene.loss(end), steps

        assert differentiate is not None
        return differentiate(loss, has_aux=True)(numbers)

    try:
        return compile_flow(scene, flow if differentiate is None else slopes)
    except TypeError as refused:
        # A splitting method refuses a torque that depends on the rate, and the adjoint equation of
        # diffrax refuses some fields that hold a function of time: the method is left out for such
        # a scene.
        if "Splitting" in str(refused) or "_DistinctTuple" in str(refused):
            return None
        raise


def diffrax_method(solver: dfx.AbstractSolver, *, gradients: bool = False) -> TimedMethod:
    """Return a method for `measure` from any `diffrax` solver, with adaptive steps.

    For each scene (a motion to run) the solver runs on the equations that the scene has in plain
    arithmetic (`BenchmarkScene.plain`), or on our vector field if it has none.

    **Arguments:** `solver` a solver with an error estimate; `gradients` whether gradients are
    measured, too, by three of diffrax's ways to differentiate a solution: forward mode (`forward`),
    reverse mode with checkpoints (`checkpointed`) and the adjoint equation (`backsolve`).

    >>> diffrax_method(dfx.Heun()).name
    'diffrax Heun'
    """
    _checks.require_instance(
        solver, dfx.AbstractSolver, "solver", requirement="a solver of diffrax"
    )
    ways = {
        "forward": (dfx.ForwardMode(), jax.jacfwd),
        "checkpointed": (dfx.RecursiveCheckpointAdjoint(), jax.grad),
        "backsolve": (dfx.BacksolveAdjoint(), jax.grad),
    }
    slopes = {
        name: partial(
            _compiled,
            partial(_plain_flow, solver=solver, adjoint=adjoint),
            take,
        )
        for name, (adjoint, take) in ways.items()
    }
    value = partial(_compiled, partial(_plain_flow, solver=solver), None)
    name = f"diffrax {type(solver).__name__}"
    return TimedMethod(name, "jax", TOLERANCES, value, slopes if gradients else {})


def _own(
    name: str,
    settings: Sequence[float | int],
    make_flow: MakeFlow,
    differentiation_modes: Iterable[str] = (),
    settings_are_step_counts: bool = False,
) -> TimedMethod:
    """Return a method of this library, with the modes of differentiation that are measured."""
    slopes = {mode: partial(_compiled, make_flow, MODES[mode]) for mode in differentiation_modes}
    value = partial(_compiled, make_flow, None)
    return TimedMethod(name, "ours", settings, value, slopes, settings_are_step_counts)


def methods_in_jax() -> list[TimedMethod]:
    """Return the methods of this library and those of diffrax, in the order of the charts."""
    eight = solvers.DormandPrince8()
    equal = ((EIGHT, eight), (FOUR, solvers.RungeKutta4()))
    equal += ((EIGHT, solvers.Splitting4()), (EIGHT, solvers.Splitting6()))
    five, there = solvers.Tsitouras5(), partial(_diffrax_flow, solver=eight)
    return [
        _own("closed form", (0.0,), _closed_flow, MODES),
        _own("simulate", TOLERANCES, _simulate_flow, MODES),
        _own(
            "simulate, accuracy", TOLERANCES, partial(_simulate_flow, setting_is_accuracy=True)
        ),
        _own(
            "DormandPrince8", TOLERANCES, partial(_adaptive_flow, solver=eight), MODES
        ),
        _own(
            "Tsitouras5", TOLERANCES, partial(_adaptive_flow, solver=five)
        ),
        *(
            _own(
                f"{type(solver).__name__}, equal steps", counts,
                partial(equal_flow, solver=solver), settings_are_step_counts=True,
            )
            for counts, solver in equal
        ),
        _own("DormandPrince8 in diffeqsolve", TOLERANCES, there),
        diffrax_method(dfx.Tsit5()),
        diffrax_method(dfx.Dopri8(), gradients=True),
    ]  # fmt: skip
