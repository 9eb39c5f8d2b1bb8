"""Time to an attitude error: these solvers against plain diffrax and SciPy, in one process.

Run `python tests/solve/bench_solvers.py`. For each scene and method a ladder of tolerances (or
steps) is run; the time at an error is interpolated in log–log. Compilation is apart. The methods are
timed in turn, round after round, and only ratios mean anything.
"""

import itertools
import sys
import time

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax.solve import lean, travel

ERRORS = (1e-4, 1e-8, 1e-10)
ROUNDS = 7


class Gradient(eqx.Module):
    """Gravity gradient on a circular orbit: 3 n² r × I r, r turning in the plane x, y."""

    rate: jax.Array

    def __call__(self, t, state, body):
        a = self.rate * t
        r = rj.quaternion.rotate_inverse(
            state.q, jnp.stack([jnp.cos(a), jnp.sin(a), jnp.zeros_like(a)])
        )
        return 3 * self.rate**2 * jnp.cross(r, (body.tensor * r[None, :]).sum(axis=1))


class Gyrostat(eqx.Module):
    """A wheel of constant momentum inside, and linear damping."""

    wheel: jax.Array
    damping: jax.Array

    def __call__(self, t, state, body):
        return jnp.cross(self.wheel, state.omega) - self.damping * state.omega


def scenes():
    body = rj.Inertia.from_principal(1.0, 1.3, 0.7)
    tilt = jnp.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0])
    top = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    yield "heavy top", body, top, rj.Attitude(tilt, [0.3, 0.2, 5.0]), 50.0
    yield (
        "gravity gradient",
        body,
        Gradient(jnp.asarray(0.5)),
        rj.Attitude(tilt, [0.1, 0.2, 0.7]),
        100.0,
    )
    wheel = Gyrostat(jnp.array([0.0, 0.3, 0.1]), jnp.array([0.01, 0.02, 0.01]))
    yield "damped gyrostat", body, wheel, rj.Attitude(tilt, [1.0, 0.5, 2.0]), 50.0


def plain(solver):
    def make(field, y0, ts):
        def run(field, y0, tol):
            return dfx.diffeqsolve(
                dfx.ODETerm(field), solver, ts[0], ts[-1], None, y0, max_steps=100_000,
                stepsize_controller=dfx.PIDController(rtol=tol, atol=tol),
            ).ys.q[-1]  # fmt: skip

        return run, [10.0**-k for k in range(4, 14)]

    return make


def adaptive(solver):
    def make(field, y0, ts):
        def run(field, y0, tol):
            return lean.adaptive(solver, field, ts, y0, rtol=tol, atol=tol).ys.q[-1]

        return run, [10.0**-k for k in range(4, 14)]

    return make


def fixed(solver, steps):
    def make(field, y0, ts):
        def run(field, y0, n):
            return lean.fixed(solver, field, ts, y0, n.astype(jnp.int64)).q[-1]

        return run, steps

    return make


METHODS = {
    "diffrax Tsit5": plain(dfx.Tsit5()),
    "diffrax Dopri8": plain(dfx.Dopri8()),
    "ours in diffeqsolve": plain(rj.solvers.DormandPrince8()),
    "lean adaptive 8": adaptive(rj.solvers.DormandPrince8()),
    "lean adaptive 5": adaptive(rj.solvers.Tsitouras5()),
    "lean fixed 8": fixed(rj.solvers.DormandPrince8(), [100, 150, 200, 300, 450, 700, 1000, 1500]),
}


def clock(run, *arguments):
    start = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - start


def ladder(name, field, y0, ts, right):
    run, rungs = METHODS[name](field, y0, ts)
    start = time.perf_counter()
    compiled = jax.jit(run).lower(field, y0, jnp.asarray(float(rungs[0]))).compile()
    compiling = time.perf_counter() - start
    kernels = compiled.as_text().count("xla_cpu_small_call")
    points = []
    for rung in rungs:
        q = np.asarray(compiled(field, y0, jnp.asarray(float(rung))))
        points.append(min(np.linalg.norm(q - right), np.linalg.norm(q + right)))
    return compiled, rungs, points, compiling, kernels


def at(error, points, times):
    """log–log interpolation of time against error, along the ladder until it stops improving."""
    rungs = list(zip(points, times, strict=True))
    for (e0, t0), (e1, t1) in itertools.pairwise(rungs):
        if e0 > error >= e1:
            s = np.log(e0 / error) / np.log(e0 / e1)
            return float(np.exp((1 - s) * np.log(t0) + s * np.log(t1)))
    return float(times[0]) if points[0] <= error else float("nan")


def scipy_time(field, y0, ts, right, error):
    f = jax.jit(
        lambda t, y: jnp.concatenate(jax.tree.leaves(field(t, rj.Attitude(y[:4], y[4:]), None)))
    )
    start = np.concatenate([y0.q, y0.omega])
    for tol in [10.0**-k for k in range(5, 14)]:
        begin = time.perf_counter()
        out = solve_ivp(
            lambda t, y: np.asarray(f(t, y)),
            (0.0, float(ts[-1])),
            start,
            "DOP853",
            rtol=tol,
            atol=tol,
        )
        spent = time.perf_counter() - begin
        q = out.y[:4, -1] / np.linalg.norm(out.y[:4, -1])
        if min(np.linalg.norm(q - right), np.linalg.norm(q + right)) < error:
            return spent
    return float("nan")


def gradients(body, torque, y0, ts, tol=1e-9):
    """d(one number of q)/d(inertia 6, Ω0, q0): diffrax with its adjoints, and the lean loop."""
    rows, columns = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])

    def pieces(p):
        upper = jnp.zeros((3, 3)).at[rows, columns].set(p[:6])
        tensor = upper + upper.T - jnp.diag(jnp.diag(upper))
        return rj.AttitudeEquations(rj.Inertia(tensor), torque), rj.Attitude(
            rj.quaternion.normalise(p[9:]), p[6:9]
        )

    def theirs(adjoint, solver):
        def loss(p):
            field, start = pieces(p)
            return dfx.diffeqsolve(
                dfx.ODETerm(field), solver, ts[0], ts[-1], None, start, max_steps=100_000,
                stepsize_controller=dfx.PIDController(rtol=tol, atol=tol), adjoint=adjoint,
            ).ys.q[-1, 0]  # fmt: skip

        return loss

    def ours(way):
        def loss(p):
            field, start = pieces(p)
            solver = rj.solvers.DormandPrince8()
            return lean.adaptive(solver, field, ts, start, rtol=tol, atol=tol, way=way).ys.q[-1, 0]

        return loss

    p = jnp.concatenate([body.tensor[rows, columns], y0.omega, y0.q])
    ways = {
        "diffrax Dopri8 forward": jax.jacfwd(theirs(dfx.ForwardMode(), dfx.Dopri8())),
        "diffrax Dopri8 checkpointed": jax.grad(theirs(dfx.RecursiveCheckpointAdjoint(), dfx.Dopri8())),
        "diffrax Dopri8 backsolve": jax.grad(theirs(dfx.BacksolveAdjoint(), dfx.Dopri8())),
        "lean adaptive 8 forward": jax.jacfwd(ours(travel.forward)),
        "lean adaptive 8 reverse": jax.grad(ours(travel.reverse)),
    }  # fmt: skip
    compiled, compiling = {}, {}
    for name, way in ways.items():
        start = time.perf_counter()
        compiled[name] = jax.jit(way).lower(p).compile()
        compiling[name] = time.perf_counter() - start
    values = {name: np.asarray(way(p)) for name, way in compiled.items()}
    times = {name: [] for name in compiled}
    for _ in range(ROUNDS):
        for name, way in compiled.items():
            times[name].append(clock(way, p))
    best = min(np.median(v) for n, v in times.items() if n.startswith("diffrax"))
    for name, spent in times.items():
        gap = np.abs(values[name] - values["diffrax Dopri8 forward"]).max()
        print(
            f"  gradient {name:30s} {np.median(spent) / best:8.3f} of diffrax's best; differs "
            f"{gap:.1e}; compiled in {compiling[name]:.1f} s"
        )


def main(which=None):
    for title, body, torque, y0, late in scenes():
        if which and which not in title:
            continue
        print(f"{title}, T = {late}", flush=True)
        field, ts = rj.AttitudeEquations(body, torque), jnp.array([0.0, late])
        right = np.asarray(lean.fixed(rj.solvers.DormandPrince8(), field, ts, y0, 6000).q[-1])
        ladders = {name: ladder(name, field, y0, ts, right) for name in METHODS}
        times = {name: [[] for _ in rungs] for name, (_, rungs, *_) in ladders.items()}
        for _ in range(ROUNDS):
            for name, (compiled, rungs, *_) in ladders.items():
                for i, rung in enumerate(rungs):
                    times[name][i].append(clock(compiled, field, y0, jnp.asarray(float(rung))))
        medians = {name: [np.median(spent) for spent in rows] for name, rows in times.items()}
        for error in ERRORS:
            spent = {n: at(error, ladders[n][2], medians[n]) for n in METHODS}
            best = np.nanmin([spent["diffrax Tsit5"], spent["diffrax Dopri8"]])
            row = ", ".join(f"{n} {t / best:.3f}" for n, t in spent.items())
            scipy = scipy_time(field, y0, ts, right, error)
            print(f"  at {error:.0e}, over diffrax's best: {row}, scipy DOP853 {scipy / best:.0f}")
        for name, (*_, compiling, kernels) in ladders.items():
            print(f"  {name}: compiled in {compiling:.1f} s, loops in one kernel: {kernels}")
        gradients(body, torque, y0, ts)


if __name__ == "__main__":
    main(*sys.argv[1:])
