"""What runs in JAX: ours and diffrax's solvers, on the same field, each compiled once."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

from rigidjax import _checks
from rigidjax.exact import FreeBody
from rigidjax.solve import adaptive, equations_of_motion, fixed, simulate, solvers
from rigidjax.workprecision.method import Method, Ready, Run
from rigidjax.workprecision.scene import Scene

TOLERANCES = tuple(10.0**-k for k in range(3, 14))
EIGHT = (40, 60, 80, 120, 170, 240, 340, 480, 680, 1000)
FOUR = (200, 500, 1200, 3000, 8000, 20000, 60000)
MOST = 400_000

# numbers, setting → the last state as a vector, steps
Flow = Callable[[Any, Any], tuple[Any, Any]]


def compiled(scene: Scene, flow: Flow) -> Ready:
    """One compiled call for all settings, timed as a user would call it: nothing but numbers in."""
    numbers = scene.numbers
    start = time.perf_counter()
    ready = jax.jit(flow).lower(numbers, jnp.asarray(1.0)).compile()
    spent = time.perf_counter() - start
    memory = ready.memory_analysis()
    held = float(memory.temp_size_in_bytes) if memory is not None else float("nan")

    # Moving a number to the device takes as long as some runs.
    there: dict[float, Any] = {}

    def run(setting: float) -> Run:
        if setting not in there:
            there[setting] = jnp.asarray(float(setting))
        return Run(*jax.block_until_ready(ready(numbers, there[setting])))

    return Ready(run, spent, held)


def slopes(scene: Scene, flow: Flow, take: Callable[..., Any]) -> Ready:
    """The gradient of the scene's scalar by `take`, `jax.grad` or `jax.jacfwd`."""

    def both(numbers: Any, setting: Any) -> tuple[Any, Any]:
        def loss(numbers: Any) -> Any:
            end, steps = flow(numbers, setting)
            return scene.loss(end), steps

        return take(loss, has_aux=True)(numbers)

    return compiled(scene, both)


def _closed(scene: Scene) -> Flow | None:
    if scene.torque is not None or scene.body is None:
        return None

    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        body, start = scene.assembled(numbers)
        end: Any = FreeBody(body, start)(jnp.asarray(scene.end, numbers.dtype))
        return scene.flat(end), jnp.zeros(())

    return flow


def _simulate(scene: Scene, adjoint: Any = None) -> Flow | None:
    """`simulate` with its defaults, but for the tolerance: traced, so that one program does."""
    if scene.torque is None:
        return None

    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        body, start = scene.assembled(numbers)
        out = simulate(
            body, start, jnp.array([0.0, scene.end], numbers.dtype), scene.torque,
            rtol=setting, atol=1e-3 * setting, adjoint=adjoint, throw=False, max_steps=MOST,
        )  # fmt: skip
        end: Any = jax.tree.map(lambda leaf: leaf[-1], out.ys)
        return scene.flat(end), out.stats["num_steps"]

    return flow


def _field(scene: Scene, body: Any, start: Any) -> Any:
    return equations_of_motion(body, start, scene.torque)


def _adaptive(scene: Scene, solver: Any) -> Flow:
    """The loop that `simulate` runs in under a torque, in both modes."""

    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        body, start = scene.assembled(numbers)
        ts = jnp.array([0.0, scene.end], numbers.dtype)
        out = adaptive(
            solver, _field(scene, body, start), ts, start, rtol=setting, atol=1e-3 * setting,
            max_steps=MOST,
        )  # fmt: skip
        end: Any = jax.tree.map(lambda leaf: leaf[-1], out.ys)
        return scene.flat(end), out.num_steps

    return flow


def _equal(scene: Scene, solver: Any) -> Flow:
    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        body, start = scene.assembled(numbers)
        ts, count = jnp.array([0.0, scene.end], numbers.dtype), setting.astype(int)
        ys = fixed(solver, _field(scene, body, start), ts, start, count)
        return scene.flat(jax.tree.map(lambda leaf: leaf[-1], ys)), count

    return flow


def _split(scene: Scene, solver: Any) -> Flow | None:
    return None if scene.body is None else _equal(scene, solver)


def _in_diffrax(scene: Scene, solver: Any, adjoint: Any = None) -> Flow:
    """Our field and state in diffrax's loop."""

    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        body, start = scene.assembled(numbers)
        out = _solved(_field(scene, body, start), None, start, solver, adjoint, setting, scene.end)
        end: Any = jax.tree.map(lambda leaf: leaf[-1], out.ys)
        return scene.flat(end), out.stats["num_steps"]

    return flow


def _diffrax(scene: Scene, solver: Any, adjoint: Any = None) -> Flow:
    """What a user would have without us: equations written by hand, one array, constants once."""
    plain = scene.plain
    if plain is None:
        return _in_diffrax(scene, solver, adjoint)

    def flow(numbers: Any, setting: Any) -> tuple[Any, Any]:
        start = scene.flat(scene.assembled(numbers)[1])
        rates = plain(tuple(numbers), jnp.sin, jnp.cos, jnp.sqrt)
        zero = jnp.zeros((), start.dtype)
        by_hand, constants = jax.closure_convert(lambda t, y: jnp.stack(rates(t, y)), zero, start)

        def field(t: Any, y: Any, constants: Any) -> Any:
            return by_hand(t, y, *constants)

        out = _solved(field, constants, start, solver, adjoint, setting, scene.end)
        ys: Any = out.ys
        return ys[-1], out.stats["num_steps"]

    return flow


def _solved(
    field: Any, args: Any, start: Any, solver: Any, adjoint: Any, setting: Any, end: float
) -> dfx.Solution:
    return dfx.diffeqsolve(
        dfx.ODETerm(field), solver, 0.0, end, None, start, args,
        stepsize_controller=dfx.PIDController(rtol=setting, atol=1e-3 * setting),
        adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=MOST, throw=False,
    )  # fmt: skip


def _value(make: Callable[[Scene], Flow | None], scene: Scene) -> Ready | None:
    flow = make(scene)
    try:
        return None if flow is None else compiled(scene, flow)
    except TypeError as refused:
        # A splitting says so where a torque feels the rate.
        if "Splitting" in str(refused):
            return None
        raise


def _slope(make: Callable[[Scene], Flow | None], take: Any, scene: Scene) -> Ready | None:
    flow = make(scene)
    return None if flow is None else slopes(scene, flow, take)


def diffrax_method(solver: dfx.AbstractSolver, *, gradients: bool = False) -> Method:
    """Any `diffrax` solver as a method, with a step controller, on equations written by hand.

    Where a scene has none (`plain`), on our vector field.

    **Arguments:** `solver` with an error estimate; `gradients` whether its adjoints are measured,
    too: `forward`, `checkpointed`, `backsolve`.

    >>> diffrax_method(dfx.Heun()).name
    'diffrax Heun'
    """
    _checks.instance(solver, dfx.AbstractSolver, "solver", wanted="a solver of diffrax")
    ways = {
        "forward": (dfx.ForwardMode(), jax.jacfwd),
        "checkpointed": (dfx.RecursiveCheckpointAdjoint(), jax.grad),
        "backsolve": (dfx.BacksolveAdjoint(), jax.grad),
    }
    return Method(
        f"diffrax {type(solver).__name__}",
        "jax",
        TOLERANCES,
        partial(_value, partial(_diffrax, solver=solver)),
        {
            name: partial(_slope, partial(_diffrax, solver=solver, adjoint=adjoint), take)
            for name, (adjoint, take) in ways.items()
        }
        if gradients
        else {},
    )


def methods_in_jax() -> list[Method]:
    """Ours, and diffrax's, in the order of the charts."""
    eight, five, four = solvers.DormandPrince8(), solvers.Tsitouras5(), solvers.RungeKutta4()
    return [
        Method(
            "closed form",
            "ours",
            (0.0,),
            partial(_value, _closed),
            {
                "forward": partial(_slope, _closed, jax.jacfwd),
                "reverse": partial(_slope, _closed, jax.grad),
            },
        ),
        Method(
            "simulate",
            "ours",
            TOLERANCES,
            partial(_value, _simulate),
            {
                "forward": partial(_slope, _simulate, jax.jacfwd),
                "reverse": partial(_slope, _simulate, jax.grad),
            },
        ),
        Method(
            "DormandPrince8",
            "ours",
            TOLERANCES,
            partial(_value, partial(_adaptive, solver=eight)),
            {
                "forward": partial(_slope, partial(_adaptive, solver=eight), jax.jacfwd),
                "reverse": partial(_slope, partial(_adaptive, solver=eight), jax.grad),
            },
        ),
        Method("Tsitouras5", "ours", TOLERANCES, partial(_value, partial(_adaptive, solver=five))),
        Method(
            "DormandPrince8, equal steps", "ours", EIGHT,
            partial(_value, partial(_equal, solver=eight)), equal=True,
        ),
        Method(
            "RungeKutta4, equal steps", "ours", FOUR,
            partial(_value, partial(_equal, solver=four)), equal=True,
        ),
        Method(
            "Splitting4, equal steps", "ours", EIGHT,
            partial(_value, partial(_split, solver=solvers.Splitting4())), equal=True,
        ),
        Method(
            "Splitting6, equal steps", "ours", EIGHT,
            partial(_value, partial(_split, solver=solvers.Splitting6())), equal=True,
        ),
        Method(
            "DormandPrince8 in diffeqsolve", "ours", TOLERANCES,
            partial(_value, partial(_in_diffrax, solver=eight)),
        ),
        diffrax_method(dfx.Tsit5()),
        diffrax_method(dfx.Dopri8(), gradients=True),
    ]  # fmt: skip
