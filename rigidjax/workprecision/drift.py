"""A million steps of a heavy top: how energy and momentum stray, and what that costs."""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude, AttitudeEquations, drift
from rigidjax.motion.torques import HeavyTop
from rigidjax.solve import fixed, solvers
from rigidjax.workprecision.record import Record

STEPS = 1_000_000
BODY = (0.7, 1.2, 1.6)
LOOKS = 101
# Length of a step, s.
RUNS = {
    "Splitting2": (0.1, solvers.Splitting2),
    "Splitting4": (0.1, solvers.Splitting4),
    "Splitting6": (0.2, solvers.Splitting6),
    "DormandPrince8": (0.1, solvers.DormandPrince8),
    "RungeKutta4": (0.02, solvers.RungeKutta4),
}


def long_drift(
    steps: int = STEPS,
    only: Sequence[str] | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> list[Record]:
    """Largest drift of energy and momentum over `steps` equal steps of an asymmetric heavy top.

    Two records for each method, of the first hundredth of the run and of all of it: where they
    agree the drift is bounded, where the second is a hundred times the first it grows with time.
    `setting` is the length of a step, s; there is no error of the attitude (the motion forgets its
    start long before), `error` is the energy's. Timed once: it is a run of seconds.

    **Arguments:** `steps` how many; `only` names of methods, all by default; `progress` is told a
    line now and then.

    **Raises:** `ValueError` for a method that is not among them, or too few steps to look at.

    >>> [record.steps for record in long_drift(10_000, ["RungeKutta4"])]
    [100.0, 10000.0]
    """
    body = Inertia.from_principal(*BODY)
    start = Attitude([0.955336489125606, 0.29552020666133955, 0.0, 0.0], [0.4, 0.3, 1.2])
    law = HeavyTop(1.0, [0.05, 0.1, 0.3], [0.0, 0.0, -1.0])
    field = AttitudeEquations(body, law)
    unknown = sorted(set(only or ()) - set(RUNS))
    if unknown:
        raise ValueError(f"long_drift: no method {unknown[0]!r}; there are {', '.join(RUNS)}")
    if steps < 100 * (LOOKS - 1):
        raise ValueError(f"long_drift: wanted {100 * (LOOKS - 1)} steps or more, got {steps}")
    found = []
    for name in RUNS if only is None else [name for name in RUNS if name in only]:
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
                raise FloatingPointError(f"long_drift: {name} gave no numbers: {away}")
            found.append(
                Record(
                    scene, f"{name}, equal steps", "ours", "value", "", h, error=away["energy"],
                    energy=away["energy"], momentum=away["momentum_along_axis"],
                    steps=float(count), time=spent, time_low=spent, time_high=spent,
                    compile=compiling,
                )
            )  # fmt: skip
    return found
