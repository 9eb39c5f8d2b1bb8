"""Prepare methods of other packages, as far as these packages are installed, for a comparison."""

import importlib
import importlib.util
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.body.symmetric3 import PAIRS
from rigidjax.workprecision.jax_methods import methods_in_jax
from rigidjax.workprecision.scene import BenchmarkScene, PreparedMethod, TimedMethod

# The settings of the packages: TAYLOR has the tolerances of heyoka, STEPS the lengths of MuJoCo's
# steps, s, and TOLERANCES the tolerances of all others.
TOLERANCES = (1e-4, 1e-7, 1e-10, 1e-13)
TAYLOR = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)
STEPS = (5e-2, 2e-2, 5e-3)

# A run is a function of a setting (a tolerance or the length of a step) that returns the last
# state, or the gradient, as one vector, and the number of steps.
RunAtSetting = Callable[[float], tuple[Any, Any]]
# A function of a scene, of its numbers, of its initial state and of an imported package that
# returns a run.
MakeRun = Callable[[BenchmarkScene, np.ndarray, np.ndarray, Any], RunAtSetting]
# A function of a scene that returns a method compiled for the scene, or `None` if the method cannot
# do the scene.
PrepareMethod = Callable[[BenchmarkScene], PreparedMethod | None]


def _python_vector_field(
    scene: BenchmarkScene, numbers: np.ndarray, **options: Any
) -> Callable[..., Any]:
    """Return the vector field of the handwritten equations, a function (t, y) of Python's floats;
    `options` such as `wrap`, which compiles a function, are for `plain`.
    """
    plain: Any = scene.plain
    return plain(tuple(map(float, numbers)), math.sin, math.cos, math.sqrt, **options)


def _in_double(scene: BenchmarkScene) -> bool:
    """Return whether gradsolve can run a scene: importing it sets JAX to float64, and so it is not
    used for another precision.
    """
    return scene.plain is not None and scene.numbers.dtype == jnp.float64


def _of_package(
    package: str, can_run: Callable[[BenchmarkScene], bool] = lambda scene: scene.plain is not None
) -> Callable[[MakeRun], PrepareMethod]:
    """Return a decorator that turns a `MakeRun` into the `value` of a `TimedMethod`.

    The time that it takes is recorded as compile time; the time to import the package is not.
    """

    def decorate(make: MakeRun) -> PrepareMethod:
        def prepare(scene: BenchmarkScene) -> PreparedMethod | None:
            if not can_run(scene):
                return None
            numbers, start = (np.asarray(v) for v in (scene.numbers, scene.flatten(scene.state0)))
            loaded = importlib.import_module(package)
            begin = time.perf_counter()
            run = make(scene, numbers, start.astype(float), loaded)
            return PreparedMethod(run, time.perf_counter() - begin)

        return prepare

    return decorate


def _make_scipy_run(
    end: float, start: np.ndarray, vector_field: Callable[[float, np.ndarray], np.ndarray]
) -> RunAtSetting:
    """Return a run of SciPy's DOP853 from time 0 to `end`, by tolerance."""
    from scipy.integrate import DOP853

    def run(setting: float) -> tuple[Any, Any]:
        # The stepper is called directly: solve_ivp would store every step.
        stepper = DOP853(vector_field, 0.0, start, end, rtol=setting, atol=1e-3 * setting)
        steps = 0
        while stepper.status == "running":
            stepper.step()
            steps += 1
        return stepper.y, steps

    return run


@_of_package("scipy.integrate")
def _prepare_scipy(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, _: ModuleType
) -> RunAtSetting:
    """Return a run of SciPy's DOP853 on Python's floats, by tolerance."""
    rates = _python_vector_field(scene, numbers)
    return _make_scipy_run(scene.end, start, lambda t, y: np.array(rates(t, y)))


@_of_package("numba")
def _prepare_numba(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, numba: ModuleType
) -> RunAtSetting:
    """Return a run of SciPy's DOP853 with a vector field compiled by numba, by tolerance."""
    rates = _python_vector_field(scene, numbers, wrap=numba.njit)

    @numba.njit
    def f(t: Any, y: Any) -> Any:
        return np.array(rates(t, y))

    f(0.0, start)
    return _make_scipy_run(scene.end, start, f)


@_of_package("mujoco", lambda scene: "com" in (scene.notes or {}) and scene.body is not None)
def _prepare_mujoco(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, mujoco: ModuleType
) -> RunAtSetting:
    """Return a run of a body on a ball joint by MuJoCo's own Runge–Kutta method of order 4, by the
    length of a step, s.

    The scene needs `notes` of mass, centre of mass and gravity, which only heavy tops and free
    bodies have.
    """
    notes, body = scene.notes, scene.body
    assert notes is not None and body is not None
    mass, com = notes["mass"], np.asarray(notes["com"])
    about = np.asarray(body.tensor) - mass * (com @ com * np.eye(3) - np.outer(com, com))

    def words(values: Iterable[float]) -> str:
        return " ".join(repr(float(v)) for v in values)

    model: Any = mujoco.MjModel.from_xml_string(
        f'<mujoco><option integrator="RK4" gravity="{words(notes["gravity"])}"/><worldbody>'
        f'<body><joint type="ball" damping="0"/><inertial pos="{words(com)}" mass="{mass}" '
        f'fullinertia="{words(about[at] for at in PAIRS)}"/></body></worldbody></mujoco>'
    )
    data: Any = mujoco.MjData(model)
    # Without this function for warnings MuJoCo writes a file into the working folder when a step
    # is too long.
    mujoco.set_mju_user_warning(lambda message: None)

    def run(setting: float) -> tuple[Any, Any]:
        mujoco.mj_resetData(model, data)
        count = round(scene.end / setting)
        model.opt.timestep = scene.end / count
        data.qpos[:], data.qvel[:] = start[:4], start[4:]
        mujoco.mj_step(model, data, nstep=count)
        return np.concatenate([data.qpos, data.qvel]), count

    return run


def _heyoka_equations(
    scene: BenchmarkScene, heyoka: ModuleType, numbers: Sequence[Any]
) -> list[tuple[Any, Any]]:
    """Return pairs of a variable and its time derivative for heyoka; the numbers are floats or
    parameters of heyoka.
    """
    names = "abcdxyz" if scene.body is not None else ("px", "py", "pz", "vx", "vy", "vz")
    variables = heyoka.make_vars(*names)
    plain: Any = scene.plain
    rates = plain(numbers, heyoka.sin, heyoka.cos, heyoka.sqrt)(heyoka.time, variables)
    return list(zip(variables, rates, strict=True))


def _make_heyoka_run(
    heyoka: ModuleType, end: float, start: np.ndarray, equations: Any, **options: Any
) -> RunAtSetting:
    """Return a run of heyoka's Taylor method, by tolerance; its order and code depend on the
    tolerance, and each tolerance is compiled once, when it is first used.
    """
    made: dict[float, Any] = {}

    def run(setting: float) -> tuple[Any, Any]:
        if setting not in made:
            stepper = heyoka.taylor_adaptive(equations, start, tol=setting, **options)
            made[setting] = stepper, stepper.state.copy()
        stepper, first = made[setting]
        stepper.state[:], stepper.time = first, 0.0
        steps = stepper.propagate_until(end)[3]
        return stepper.state.copy(), steps

    run(TAYLOR[2])
    return run


@_of_package("heyoka")
def _prepare_heyoka(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, heyoka: ModuleType
) -> RunAtSetting:
    """Return a run of heyoka's Taylor method, by tolerance."""
    system = _heyoka_equations(scene, heyoka, list(map(float, numbers)))
    return _make_heyoka_run(heyoka, scene.end, start, system)


@_of_package("heyoka")
def _prepare_heyoka_gradient(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, heyoka: ModuleType
) -> RunAtSetting:
    """Return a run that computes the gradient of `scene.loss` by heyoka's variational equations, by
    tolerance.

    The variational equations give the derivatives of the last state with respect to the initial
    state and the inertia; these derivatives are multiplied by the gradient of the scalar with
    respect to the last state.
    """
    size = 6 if scene.body is not None else 0
    symbols = [heyoka.par[i] for i in range(size)] or list(numbers)
    system = _heyoka_equations(scene, heyoka, [*symbols, *numbers[size:]] if size else symbols)
    flavour = heyoka.var_args.vars | heyoka.var_args.params if size else heyoka.var_args.vars
    varied = heyoka.var_ode_sys(system, flavour, order=1)
    end_of = _make_heyoka_run(
        heyoka, scene.end, start, varied, pars=numbers[:size], compact_mode=True
    )
    n = len(start)
    chain = np.asarray(jax.jacfwd(lambda p: scene.flatten(scene.assemble(p)[1]))(scene.numbers))
    pull = jax.jit(jax.grad(scene.loss))

    def run(setting: float) -> tuple[Any, Any]:
        state, steps = end_of(setting)
        slope = np.asarray(pull(state[:n])) @ state[n:].reshape(n, -1)
        # The derivative with respect to the initial state is converted to one with respect to the
        # numbers of the scene; then the derivative with respect to the inertia is added.
        gradient = slope[:n] @ chain
        gradient[:size] += slope[n : n + size]
        return gradient, steps

    return run


class _GradsolveEnsemble:
    """Present a scene as an ensemble of one member, with its numbers as parameters, because
    gradsolve solves ensembles of equations.
    """

    is_stiff, t0 = False, 0.0

    def __init__(
        self, scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, module: ModuleType
    ):
        # Without this setting gradsolve uses NumPy to record the steps of the solution of a single
        # scene, which takes a thousand times as long.
        os.environ.setdefault("GRADSOLVE_RECORDER", "jax")
        self.module, self.plain = module, scene.plain
        self.name, self.t1 = scene.name, scene.end
        self.start, self.numbers = start[None], numbers[None]
        self.dim = self.start.shape[1]

    def f_jax(self, t: Array, y: Array, p: Array) -> Any:
        assert self.plain is not None
        return jnp.stack(self.plain(tuple(p), jnp.sin, jnp.cos, jnp.sqrt)(t, y))

    def call(self, name: str, setting: float, **options: Any) -> Any:
        options |= dict(engine="vern7_replay", fused=False, rtol=setting, atol=1e-3 * setting)
        return getattr(self.module, name)(self, self.start, self.numbers, **options)


@_of_package("gradsolve", _in_double)
def _prepare_gradsolve(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, gradsolve: ModuleType
) -> RunAtSetting:
    """Return a run of gradsolve's method of order 7, by tolerance."""
    ensemble = _GradsolveEnsemble(scene, numbers, start, gradsolve)

    def run(setting: float) -> tuple[Any, Any]:
        try:
            solution = ensemble.call("solve", setting)
        except RuntimeError:
            # gradsolve raises a `RuntimeError` if its 50 000 steps do not reach the end of the
            # motion, as with a fast top. Return NaN as the last state: `measure` then leaves this
            # run out and goes on with the other methods.
            return np.full_like(start, np.nan), 0
        return solution.y_final[0], int(solution.accepted_steps[0])

    run(TOLERANCES[0])
    return run


@_of_package("gradsolve", _in_double)
def _prepare_gradsolve_gradient(
    scene: BenchmarkScene, numbers: np.ndarray, start: np.ndarray, gradsolve: ModuleType
) -> RunAtSetting:
    """Return a run that computes the gradient of `scene.loss` by gradsolve, which differentiates a
    solution whose steps it has recorded once for each tolerance (which is not timed).
    """
    ensemble = _GradsolveEnsemble(scene, numbers, start, gradsolve)
    made: dict[float, Any] = {}

    def gradient_of(setting: float) -> Any:
        end = ensemble.call("grad_closure", setting, wrt=("y0", "params"))
        count = int(ensemble.call("solve", setting).accepted_steps[0])

        def loss(numbers: Array) -> Any:
            first = scene.flatten(scene.assemble(numbers)[1])
            return scene.loss(end(first[None], numbers[None])[0])

        return jax.jit(jax.grad(loss)).lower(scene.numbers).compile(), count

    def run(setting: float) -> tuple[Any, Any]:
        if setting not in made:
            made[setting] = gradient_of(setting)
        gradient, count = made[setting]
        return jax.block_until_ready(gradient(scene.numbers)), count

    run(TOLERANCES[0])
    return run


def other_methods() -> list[TimedMethod]:
    """Return the methods of SciPy, numba, MuJoCo, heyoka and gradsolve that are installed.

    Sources: for the adaptive Taylor method of heyoka, Biscani and Izzo 2021,
    doi:10.1093/mnras/stab1032; for gradsolve, which takes gradients of recorded steps of Verner's
    method of order 7, arXiv:2609.02876.
    """
    peers = {
        "scipy": TimedMethod("scipy DOP853", "peer", TOLERANCES, _prepare_scipy),
        "numba": TimedMethod("scipy DOP853, numba", "peer", TOLERANCES, _prepare_numba),
        "mujoco": TimedMethod("MuJoCo RK4", "peer", STEPS, _prepare_mujoco),
        "heyoka": TimedMethod(
            "heyoka Taylor", "peer", TAYLOR, _prepare_heyoka,
            {"variational": _prepare_heyoka_gradient},
        ),
        "gradsolve": TimedMethod(
            "gradsolve Vern7", "peer", TOLERANCES, _prepare_gradsolve,
            {"replay": _prepare_gradsolve_gradient},
        ),
    }  # fmt: skip
    return [method for name, method in peers.items() if importlib.util.find_spec(name)]


def methods(group: str | None = None) -> list[TimedMethod]:
    """Return the methods to compare: our methods, those of diffrax, and those of the other packages
    (SciPy, numba, MuJoCo, heyoka, gradsolve) that are installed.

    **Arguments:** `group` `ours`, `jax` or `peer`, to return the methods of one group only.

    >>> [method.name for method in methods("ours")][:2]
    ['closed form', 'simulate']
    """
    if group is not None:
        _checks.require_option(group, ("ours", "jax", "peer"), "group")
    available = [*methods_in_jax(), *other_methods()]
    return [method for method in available if group in (None, method.group)]
