"""Measure the error and time of methods on a scene, and the drift of a very long run."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.body.inertia import Inertia
from rigidjax.frames.frame_dynamics import scene_of_force
from rigidjax.motion import Attitude
from rigidjax.motion.conserved import drift
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques import HeavyTop
from rigidjax.solve import fixed, solvers
from rigidjax.workprecision import peers as known
from rigidjax.workprecision.jax_methods import equal_flow
from rigidjax.workprecision.record import Measurement
from rigidjax.workprecision.scene import (
    BenchmarkScene,
    PreparedMethod,
    Reference,
    TimedMethod,
    state_errors,
)

# Runs that take more than LONG seconds are timed three times. Runs that take less than SHORT
# seconds are timed three times as often as runs between SHORT and LONG.
LONG, SHORT = 0.5, 0.02
# One timing of a short run repeats the run for about BURST seconds, and takes the mean.
BURST = 3e-3
# Runs with an error of WRONG or more, rad or relative, are left out.
WRONG = 0.5
# The run of `long_drift`: STEPS is the number of steps, BODY the principal moments, LOOKS the
# number of states that are saved, and RUNS has, by the name of a method, the length of a step in
# seconds and the solver.
STEPS = 1_000_000
BODY = (0.7, 1.2, 1.6)
LOOKS = 101
RUNS = {
    "Splitting2": (0.1, solvers.Splitting2),
    "Splitting4": (0.1, solvers.Splitting4),
    "Splitting6": (0.2, solvers.Splitting6),
    "DormandPrince8": (0.1, solvers.DormandPrince8),
    "RungeKutta4": (0.02, solvers.RungeKutta4),
}
_PARTS = ("body", "state0", "torque")


class _TimedRun(NamedTuple):
    """Hold a run that is timed: one method at one setting on one scene."""

    record: Measurement  # without its times
    ready: PreparedMethod
    times: list[float]  # s; the first tells how often the run is repeated, and is not in the median


def measure(
    scene: BenchmarkScene,
    methods: Iterable[TimedMethod] | None = None,
    *,
    peers: Iterable[TimedMethod] = (),
    gradients: bool = True,
    thin: int = 1,
    rounds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> list[Measurement]:
    """Return the error and the cost of each method at each of its settings (tolerances or numbers
    of steps), for the value (the last state of a motion) and for gradients.

    All runs are in this process. Each round times all runs, one after another; compilation is timed
    separately. The records omit methods that cannot do the scene, and runs with an error of 0.5 or
    more (rad, or relative).

    **Arguments:** `scene` the motion to run; `methods` the methods to compare (all of `methods()`
    by default); `peers` more methods; `gradients` whether gradients are measured, too; `thin` a
    number k to use every k-th setting (for gradients every 2k-th); `rounds` how often each run is
    timed (three times as often if it takes less than 0.02 s, and three times in all if it takes
    more than 0.5 s); `progress` a function that is called with a line of text for each method.

    **Raises:** `TypeError` for a `scene` that is no `BenchmarkScene`, or a method that is no
    `TimedMethod`.
    """
    made = 'standard ones are made by rj.workprecision.scenes()["heavy-top"]()'
    _checks.require_instance(
        scene, BenchmarkScene, "scene", requirement="a BenchmarkScene", hint=made
    )
    chosen = [*(known.methods() if methods is None else methods), *peers]
    for method in chosen:
        _checks.require_instance(
            method, TimedMethod, "methods", requirement="methods of workprecision.methods()"
        )
    right = scene.reference if scene.reference is not None else compute_reference(scene, gradients)
    jobs: list[_TimedRun] = []
    for method in chosen:
        for adjoint, make in {"": method.value, **(method.gradients if gradients else {})}.items():
            if adjoint and not right.gradient:
                continue
            ready = make(scene)
            if ready is None:
                continue
            if progress is not None:
                progress(f"{scene.name}: {method.name} {adjoint or 'value'}")
            for setting in _settings(scene, method, thin * (2 if adjoint else 1)):
                jobs += _tried(scene, method, adjoint, setting, ready, right)
    _time_all(jobs, rounds)
    records = []
    for job in jobs:
        low, middle, high = (float(p) for p in np.percentile(job.times[1:], [25, 50, 75]))
        times = dict(time=middle, time_low=low, time_high=high)
        records.append(dataclasses.replace(job.record, **times))
    return records


def compute_reference(scene: BenchmarkScene, gradients: bool = True) -> Reference:
    """Return a reference for a scene that has none, from our method of order 8 with equal steps.

    The error that the reference states for itself is its difference from a run with half as many
    steps, but at least 100 times the machine epsilon.
    """
    counts = (4000, 2000)
    numbers, scale = scene.numbers, max(1.0, _turning(scene) / 50)
    flow = equal_flow(scene, solvers.DormandPrince8())
    run = jax.jit(flow)
    take = jax.jit(jax.jacfwd(lambda p, count: scene.loss(flow(p, count)[0])))
    ends, slopes = [], []
    for count in (jnp.asarray(round(c * scale)) for c in counts):
        ends.append(np.asarray(run(numbers, count)[0]))
        if gradients:
            slopes.append(np.asarray(take(numbers, count)))
    floor = 100 * float(np.finfo(ends[0].dtype).eps)
    error = max(float(np.abs(ends[0] - ends[1]).max()), floor)
    slope = tuple(map(float, slopes[0])) if gradients else ()
    off = max(float(np.abs(slopes[0] - slopes[1]).max()), floor) if gradients else float("nan")
    source = f"order 8 at {round(counts[0] * scale)} equal steps"
    return Reference(tuple(map(float, ends[0])), error, slope, off, source)


def to_float32(scene: BenchmarkScene, gradients: bool = True) -> BenchmarkScene:
    """Return a scene in single precision, without `plain`, and with a reference that is computed in
    double precision from the numbers rounded to single precision.
    """

    def cast(scene: BenchmarkScene, dtype: DTypeLike) -> BenchmarkScene:
        numbers, rest = eqx.partition({n: getattr(scene, n) for n in _PARTS}, eqx.is_inexact_array)
        numbers = jax.tree.map(lambda a: jnp.asarray(a, dtype), numbers)
        return dataclasses.replace(scene, **eqx.combine(numbers, rest))

    low = cast(scene, jnp.float32)
    right = compute_reference(
        dataclasses.replace(cast(low, jnp.float64), reference=None), gradients
    )
    # Leave out `plain`, the handwritten equations: they have constants in double precision.
    return dataclasses.replace(low, name=f"{scene.name}, float32", reference=right, plain=None)


def _turning(scene: BenchmarkScene) -> float:
    """Return a rough estimate of the angle, rad, by which the body turns, at least 50, for which
    methods state their numbers of equal steps; for a point 50.
    """
    return 50.0 if scene.body is None else max(50.0, scene.size[1] * scene.end)


def _settings(scene: BenchmarkScene, method: TimedMethod, stride: int) -> list[float]:
    """Return the settings at which a method is measured on a scene: every `stride`-th, counted from
    the finest.

    Numbers of equal steps, which are stated for a turn of 50 rad, are scaled to the angle by which
    the body turns; tolerances that the precision cannot reach are left out.
    """
    settings = list(method.settings)[::-1][::stride][::-1]
    if method.equal:
        return [float(round(s * _turning(scene) / 50)) for s in settings]
    # With a tolerance below about ten times the machine epsilon every step is rejected.
    least = 10 * float(jnp.finfo(scene.numbers.dtype).eps)
    return [float(s) for s in settings if s == 0 or s > least]


def _tried(
    scene: BenchmarkScene,
    method: TimedMethod,
    adjoint: str,
    setting: float,
    prepared: PreparedMethod,
    reference: Reference,
) -> list[_TimedRun]:
    """Run a prepared method to find its errors; return the run, to be timed later, in a list that
    is empty if the error is NaN or at least `WRONG`. `adjoint` names the way of a gradient, or is
    empty.
    """
    prepared.run(setting)
    begin = time.perf_counter()
    end, steps = prepared.run(setting)
    first = time.perf_counter() - begin
    if adjoint:
        gradient, wanted = np.asarray(end, float), np.asarray(reference.gradient)
        errors = {}
        # The relative errors of the gradient and of its parts.
        for key, part in {"error": slice(None), **scene.blocks}.items():
            size = max(np.linalg.norm(wanted[part]), 1e-300)
            errors[key] = float(np.linalg.norm(gradient[part] - wanted[part]) / size)
    else:
        error, rate = state_errors(scene, end, reference.end)
        energy, momentum = drifts(scene, np.asarray(end))
        errors = {"error": error, "error_rate": rate, "energy": energy, "momentum": momentum}
    if not errors["error"] < WRONG:
        return []
    record = Measurement(
        scene.name, method.name, method.group, "gradient" if adjoint else "value", adjoint,
        setting, steps=float(steps), compile=prepared.compile, memory=prepared.memory, **errors,
    )  # fmt: skip
    return [_TimedRun(record, prepared, [first])]


def drifts(scene: BenchmarkScene, final_state: np.ndarray | Array) -> tuple[float, float]:
    """Return the relative drift of the energy (of a point: of its first conserved quantity) up to
    the last state, and the largest drift of a conserved momentum; NaN if there is none.
    """
    if scene.body is None:
        law: Any = scene_of_force(scene.torque)
        state: Any = scene.state0
        last = type(state)(final_state[:3], final_state[3:])
        kept = law.conserved(0.0, state), law.conserved(scene.end, last)
        name = next(iter(kept[0]), None)
        if name is None:
            return float("nan"), float("nan")
        a, b = (float(values[name]) for values in kept)
        return abs(b - a) / max(abs(a), 0.5 * scene.size[1] ** 2), float("nan")
    first: Any = scene.state0
    last = Attitude(final_state[:4] / np.linalg.norm(final_state[:4]), final_state[4:])
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, last)
    away = drift(jnp.array([0.0, scene.end]), states, scene.body, scene.torque)
    momenta = [float(away[n]) for n in ("momentum", "momentum_along_axis") if n in away]
    return float(away.get("energy", jnp.nan)), max(momenta, default=float("nan"))


def _time_all(runs: list[_TimedRun], rounds: int) -> None:
    """Measure the times of the runs in turn, of those of less than `SHORT` seconds in three times
    as many rounds, and of those of more than `LONG` seconds in three.
    """
    for turn in range(3 * rounds):
        for job in runs:
            first = job.times[0]
            if turn >= (3 if first > LONG else rounds if first > SHORT else 3 * rounds):
                continue
            # Do not time the first call after a call of another method, which has filled the caches
            # of the processor: a long program such as that of the closed form then takes fifteen
            # times as long.
            job.ready.run(job.record.setting)
            many = max(1, int(BURST / first))
            begin = time.perf_counter()
            for _ in range(many):
                job.ready.run(job.record.setting)
            job.times.append((time.perf_counter() - begin) / many)


def long_drift(
    steps: int = STEPS,
    names: Sequence[str] | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> list[Measurement]:
    """Measure how far the energy, and the momentum along gravity, of an asymmetric heavy top drift
    over `steps` equal steps by each method of `RUNS`, or by those in `names`.

    Each method has two records: one for the first hundredth of the run, one for the whole run. The
    drift is bounded if both drifts are about equal, and grows with time if the drift of the whole
    run is a hundred times that of the first hundredth. In a record `setting` is the length of a
    step in seconds. The field `error` is the drift of the energy, because there is no reference for
    the last state: small errors grow so much in this long run that the last state cannot be
    predicted.
    """
    body = Inertia.from_principal(*BODY)
    start = Attitude([0.955336489125606, 0.29552020666133955, 0.0, 0.0], [0.4, 0.3, 1.2])
    law = HeavyTop(1.0, [0.05, 0.1, 0.3], [0.0, 0.0, -1.0])
    field = AttitudeEquations(body, law)
    unknown = sorted(set(names or ()) - set(RUNS))
    if unknown:
        raise ValueError(f"long_drift: no method {unknown[0]!r}; there are {', '.join(RUNS)}")
    if steps < 100 * (LOOKS - 1):
        raise ValueError(f"long_drift: wanted {100 * (LOOKS - 1)} steps or more, got {steps}")
    drifts_by_method = []
    for name in RUNS if names is None else [name for name in RUNS if name in names]:
        h, solver = RUNS[name]
        if progress is not None:
            progress(f"long-drift: {name}")
        run = jax.jit(lambda ts, n, s=solver: fixed(s(), field, ts, start, n))
        ts = jnp.linspace(0.0, h * steps, LOOKS)
        begin = time.perf_counter()
        ready = run.lower(ts, jnp.asarray(1)).compile()
        compiling = time.perf_counter() - begin
        for scene, part in (("long-drift, first hundredth", 100), ("long-drift", 1)):
            count = steps // part
            begin = time.perf_counter()
            ys = jax.block_until_ready(ready(ts / part, jnp.asarray(count // (LOOKS - 1))))
            spent = time.perf_counter() - begin
            away = {k: float(v) for k, v in drift(ts / part, ys, body, law).items()}
            if not np.isfinite(list(away.values())).all():
                raise FloatingPointError(
                    f"long_drift: the states of {name} became NaN or infinite, with the drifts "
                    f"{away}; likely the step is too long"
                )
            drifts_by_method.append(
                Measurement(
                    scene, f"{name}, equal steps", "ours", "value", "", h, error=away["energy"],
                    energy=away["energy"], momentum=away["momentum_along_axis"],
                    steps=float(count), time=spent, time_low=spent, time_high=spent,
                    compile=compiling,
                )
            )  # fmt: skip
    return drifts_by_method
