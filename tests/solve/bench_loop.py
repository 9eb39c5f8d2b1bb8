"""What the first answer costs, and the next ones: `simulate` beside plain diffrax, in one process.

`python tests/solve/bench_loop.py [--quick]` prints, for the asymmetric heavy top at 1e-9 with 2 and
with 30 saved times, CPU seconds to trace and compile and CPU time to run, each over that of a
vector field written by hand under `diffrax.Dopri8`; then our solver inside `diffeqsolve`, the closed
form, and a particle (Foucault, Arenstorf). Medians of interleaved repeats.
"""

import sys
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj

jax.config.update("jax_enable_x64", True)

Q = np.array([0.9, 0.1, 0.3, 0.2]) / np.linalg.norm([0.9, 0.1, 0.3, 0.2])
MOMENTS, OMEGA = np.array([1.6, 2.0, 3.0]), np.array([0.5, 1.0, 6.0])
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])
END, RTOL, ATOL, MANY = 10.0, 1e-9, 1e-12, 256
WEIGHTS = np.arange(1.0, 4.0)


def by_hand(t, y, p):
    """What a user would write: principal moments, constants outside."""
    q, w, c = y[:4], y[4:], (0.1, 0.2, 0.9)
    g = tuple(
        -9.81 * r
        for r in (
            2 * (q[1] * q[3] - q[0] * q[2]),
            2 * (q[2] * q[3] + q[0] * q[1]),
            q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2,
        )
    )
    torque = (c[1] * g[2] - c[2] * g[1], c[2] * g[0] - c[0] * g[2], c[0] * g[1] - c[1] * g[0])
    dw = [
        (torque[i] + (p[j] - p[k]) * w[j] * w[k]) / p[i]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    ]
    dq = [
        0.5 * v
        for v in (
            -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
            q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
            q[0] * w[1] + q[3] * w[0] - q[1] * w[2],
            q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
        )
    ]
    return jnp.stack([*dq, *dw])


def plain(ts, adjoint):
    def run(p, omega):
        out = dfx.diffeqsolve(
            dfx.ODETerm(by_hand), dfx.Dopri8(), ts[0], ts[-1], None, jnp.concatenate([Q, omega]), p,
            saveat=dfx.SaveAt(ts=ts), stepsize_controller=dfx.PIDController(rtol=RTOL, atol=ATOL),
            adjoint=adjoint, max_steps=100_000,
        )  # fmt: skip
        return out.ys[:, 4:]

    return run


def ours(ts):
    def run(p, omega):
        body = rj.Inertia.from_principal(p[0], p[1], p[2])
        return rj.simulate(body, rj.Attitude(Q, omega), ts, TOP, rtol=RTOL, atol=ATOL).ys.omega

    return run


def inside_diffrax(ts):
    def run(p, omega):
        body = rj.Inertia.from_principal(p[0], p[1], p[2])
        out = dfx.diffeqsolve(
            dfx.ODETerm(rj.AttitudeEquations(body, TOP)), rj.solvers.DormandPrince8(), ts[0],
            ts[-1], None, rj.Attitude(Q, omega), saveat=dfx.SaveAt(ts=ts), max_steps=100_000,
            stepsize_controller=dfx.PIDController(rtol=RTOL, atol=ATOL),
        )  # fmt: skip
        return out.ys.omega

    return run


def closed_form(ts):
    def run(p, omega):
        body = rj.Inertia.from_principal(p[0], p[1], p[2])
        return rj.simulate(body, rj.Attitude(Q, omega), ts).ys.omega

    return run


def number(f):
    return lambda p, omega: jnp.sum(f(p, omega) ** 2 * WEIGHTS)


def numbers(f):
    return lambda p, omega: jnp.sum(jax.vmap(f)(p, omega) ** 2 * WEIGHTS)


def cases(ts):
    """Name of the row → name of the method → function and arguments."""
    rng = np.random.default_rng(0)
    one = (jnp.asarray(MOMENTS), jnp.asarray(OMEGA))
    moments = jnp.asarray(MOMENTS * (1 + 0.1 * rng.uniform(size=(MANY, 3))))
    many = (moments, jnp.asarray(OMEGA + rng.normal(size=(MANY, 3))))
    hand, ahead = plain(ts, dfx.RecursiveCheckpointAdjoint()), plain(ts, dfx.ForwardMode())
    mine, both = ours(ts), (0, 1)
    return {
        "value": {"diffrax": (hand, one), "ours": (mine, one)},
        "gradient": {
            "diffrax": (jax.grad(number(hand), both), one),
            "ours": (jax.grad(number(mine), both), one),
            "inside diffeqsolve": (jax.grad(number(inside_diffrax(ts)), both), one),
            "closed form": (jax.grad(number(closed_form(ts)), both), one),
        },
        "Jacobian by 6": {
            "diffrax": (jax.jacfwd(ahead, both), one),
            "ours": (jax.jacfwd(mine, both), one),
        },
        f"{MANY} values": {"diffrax": (jax.vmap(hand), many), "ours": (jax.vmap(mine), many)},
        f"{MANY} gradients": {
            "diffrax": (jax.grad(numbers(hand), both), many),
            "ours": (jax.grad(numbers(mine), both), many),
        },
    }


def measured(methods, repeats):
    found = {}
    for name, (function, args) in methods.items():
        begin = time.process_time()
        compiled = jax.jit(function).lower(*args).compile()
        found[name] = (compiled, args, time.process_time() - begin, [])
        jax.block_until_ready(compiled(*args))
    for _ in range(repeats):
        for compiled, args, _, times in found.values():
            count = 1 if args[0].ndim == 2 else 20
            begin = time.process_time()
            for _ in range(count):
                jax.block_until_ready(compiled(*args))
            times.append((time.process_time() - begin) / count)
    return {name: (cpu, float(np.median(times))) for name, (_, _, cpu, times) in found.items()}


def main():
    repeats = 3 if "--quick" in sys.argv else 9
    print(f"jax {jax.__version__}, CPU time; in brackets over plain diffrax")
    for saved in (2, 30):
        ts = jnp.linspace(0.0, END, saved)
        for row, methods in cases(ts).items():
            found = measured(methods, repeats)
            compile0, run0 = found["diffrax"]
            for name, (cpu, run) in found.items():
                print(
                    f"{saved:3d} times  {row:15s} {name:19s} compile {cpu:5.2f} s"
                    f" ({cpu / compile0:.2f})  run {run * 1e6:8.0f} us ({run / run0:.2f})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
