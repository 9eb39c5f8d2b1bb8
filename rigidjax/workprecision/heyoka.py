"""heyoka's Taylor method as a peer, and its variational equations for the gradient."""

import importlib
import time
from typing import Any

import numpy as np

from rigidjax.workprecision.method import Method, Ready, Run
from rigidjax.workprecision.scene import Scene

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)


def _system(scene: Scene, hy: Any, numbers: Any) -> Any:
    names = "abcdxyz" if scene.body is not None else ("px", "py", "pz", "vx", "vy", "vz")
    variables = hy.make_vars(*names)
    plain: Any = scene.plain
    rates = plain(numbers, hy.sin, hy.cos, hy.sqrt)(hy.time, variables)
    return list(zip(variables, rates, strict=True))


def _value(scene: Scene) -> Ready | None:
    if scene.plain is None:
        return None
    hy: Any = importlib.import_module("heyoka")

    system = _system(scene, hy, [float(x) for x in scene.numbers])
    start = np.asarray(scene.flat(scene.state0), float)
    made: dict[float, Any] = {}
    begin = time.perf_counter()
    made[TOLERANCES[0]] = hy.taylor_adaptive(system, start, tol=TOLERANCES[0])
    spent = time.perf_counter() - begin

    def run(setting: float) -> Run:
        # The order follows from the tolerance, and so does the code: one compilation each.
        if setting not in made:
            made[setting] = hy.taylor_adaptive(system, start, tol=setting)
        stepper = made[setting]
        stepper.state[:], stepper.time = start, 0.0
        out = stepper.propagate_until(scene.end)
        return Run(stepper.state.copy(), out[3])

    return Ready(run, spent)


def _gradient(scene: Scene) -> Ready | None:
    """Variational equations by the first state and the inertia, contracted with the scalar's."""
    if scene.plain is None:
        return None
    import jax

    hy: Any = importlib.import_module("heyoka")

    numbers = np.asarray(scene.numbers)
    size = 6 if scene.body is not None else 0
    symbols = [hy.par[i] for i in range(size)] or list(numbers)
    system = _system(scene, hy, [*symbols, *numbers[size:]] if size else symbols)
    flavour = hy.var_args.vars | hy.var_args.params if size else hy.var_args.vars
    begin = time.perf_counter()
    varied = hy.var_ode_sys(system, flavour, order=1)
    start = np.asarray(scene.flat(scene.state0), float)
    made: dict[float, Any] = {}

    def stepper_of(setting: float) -> Any:
        if setting not in made:
            made[setting] = hy.taylor_adaptive(
                varied, start, pars=numbers[:size], tol=setting, compact_mode=True
            )
        return made[setting]

    first = stepper_of(TOLERANCES[2]).state.copy()
    spent = time.perf_counter() - begin
    n = len(start)
    chain = np.asarray(jax.jacfwd(lambda p: scene.flat(scene.assembled(p)[1]))(scene.numbers))
    pull = jax.jit(jax.grad(scene.loss))

    def run(setting: float) -> Run:
        stepper = stepper_of(setting)
        stepper.state[:], stepper.time = first, 0.0
        out = stepper.propagate_until(scene.end)
        end = stepper.state[:n]
        table = stepper.state[n:].reshape(n, -1)
        slope = np.asarray(pull(end)) @ table
        # By the first state, carried on to the numbers of the scene; then by the parameters.
        found = slope[:n] @ chain
        found[:size] += slope[n : n + size]
        return Run(found, out[3])

    return Ready(run, spent)


def heyoka_method() -> Method:
    """heyoka.py's adaptive Taylor method (Biscani and Izzo 2021, doi:10.1093/mnras/stab1032).

    >>> heyoka_method().group
    'peer'
    """
    return Method("heyoka Taylor", "peer", TOLERANCES, _value, {"variational": _gradient})
