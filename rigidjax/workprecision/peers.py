"""Peers that are no JAX: SciPy, SciPy with numba, MuJoCo. Left out where not installed."""

import importlib
import importlib.util
import math
import time
from typing import Any

import numpy as np

from rigidjax.workprecision.method import Method, Ready, Run
from rigidjax.workprecision.scene import Scene

TOLERANCES = (1e-4, 1e-7, 1e-10, 1e-13)
STEPS = (5e-2, 2e-2, 5e-3)


def _rates(scene: Scene, wrap: Any = None) -> Any:
    """The plain equations on floats."""
    if scene.plain is None:
        return None
    numbers = tuple(float(x) for x in scene.numbers)
    how = {} if wrap is None else {"wrap": wrap}
    return scene.plain(numbers, math.sin, math.cos, math.sqrt, **how)


def _solver(scene: Scene, f: Any, warm: float) -> Ready:
    from scipy.integrate import DOP853

    start = np.asarray(scene.flat(scene.state0), float)

    def run(setting: float) -> Run:
        # The stepper itself: solve_ivp would keep every step.
        stepper = DOP853(f, 0.0, start, scene.end, rtol=setting, atol=1e-3 * setting)
        steps = 0
        while stepper.status == "running":
            stepper.step()
            steps += 1
        return Run(stepper.y, steps)

    return Ready(run, warm)


def _scipy(scene: Scene) -> Ready | None:
    rates = _rates(scene)
    return None if rates is None else _solver(scene, lambda t, y: np.array(rates(t, y)), 0.0)


def _numba(scene: Scene) -> Ready | None:
    numba: Any = importlib.import_module("numba")

    begin = time.perf_counter()
    rates = _rates(scene, numba.njit)
    if rates is None:
        return None
    start = np.asarray(scene.flat(scene.state0), float)

    @numba.njit
    def f(t: Any, y: Any) -> Any:
        return np.array(rates(t, y))

    f(0.0, start)
    return _solver(scene, f, time.perf_counter() - begin)


def _mujoco(scene: Scene) -> Ready | None:
    """A body on a ball joint, MuJoCo's own Runge–Kutta 4; tops and free bodies only."""
    if scene.notes is None or "com" not in scene.notes or scene.body is None:
        return None
    mujoco: Any = importlib.import_module("mujoco")

    mass, com = scene.notes["mass"], np.asarray(scene.notes["com"])
    about = np.asarray(scene.body.tensor) - mass * (com @ com * np.eye(3) - np.outer(com, com))
    full = [about[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]

    def words(values: Any) -> str:
        return " ".join(repr(float(v)) for v in values)

    begin = time.perf_counter()
    model: Any = mujoco.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" gravity="{words(scene.notes["gravity"])}"/><worldbody>'
        f'<body><joint type="ball" damping="0"/><inertial pos="{words(com)}" mass="{mass}" '
        f'fullinertia="{words(full)}"/></body></worldbody></mujoco>'
    )
    data: Any = mujoco.MjData(model)
    # It would write a file into the folder one works in where a step is too long.
    mujoco.set_mju_user_warning(lambda message: None)
    spent = time.perf_counter() - begin
    start: Any = scene.state0
    q0, omega0 = np.asarray(start.q), np.asarray(start.omega)

    def run(setting: float) -> Run:
        mujoco.mj_resetData(model, data)
        count = round(scene.end / setting)
        model.opt.timestep = scene.end / count
        data.qpos[:], data.qvel[:] = q0, omega0
        mujoco.mj_step(model, data, nstep=count)
        return Run(np.concatenate([data.qpos, data.qvel]), count)

    return Ready(run, spent)


def methods_outside() -> list[Method]:
    """Those of SciPy, numba, MuJoCo and heyoka that can be imported here.

    >>> methods_outside()[0].name
    'scipy DOP853'
    """
    from rigidjax.workprecision.heyoka import heyoka_method

    found = [Method("scipy DOP853", "peer", TOLERANCES, _scipy)]
    if _there("numba"):
        found.append(Method("scipy DOP853, numba", "peer", TOLERANCES, _numba))
    if _there("mujoco"):
        found.append(Method("MuJoCo RK4", "peer", STEPS, _mujoco))
    if _there("heyoka"):
        found.append(heyoka_method())
    return found


def _there(name: str) -> bool:
    return importlib.util.find_spec(name) is not None
