"""What the first answer costs, and the next ones: `simulate` beside plain diffrax, in one process.

`python tests/benchmarks/solve/bench_loop.py [--quick] [TIMES …]` prints, for the asymmetric heavy top at 1e-9
with so many saved times (2 and 30 unless given), CPU seconds to trace and compile and CPU time to
run, each over that of a vector field written by hand under `diffrax.Dopri8`; beside them our solver
inside `diffeqsolve`, the closed form, `simulate` with a solver of diffrax, and Jacobians through
the loop that has both modes ("ours" asks for forward mode); then the same for a particle (Foucault,
Arenstorf). Medians of interleaved repeats.
"""

import sys
import time
from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import orbits
from rigidjax.frames import scenes
from rigidjax.motion.equations import AttitudeEquations

jax.config.update("jax_enable_x64", True)

Q = np.array([0.9, 0.1, 0.3, 0.2]) / np.linalg.norm([0.9, 0.1, 0.3, 0.2])
MOMENTS, OMEGA = np.array([1.6, 2.0, 3.0]), np.array([0.5, 1.0, 6.0])
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])
END, RTOL, ATOL, MANY, FEW = 10.0, 1e-9, 1e-12, 256, 64
WEIGHTS = np.arange(1.0, 4.0)
REVERSE, FORWARD = dfx.RecursiveCheckpointAdjoint(), dfx.ForwardMode()


def by_hand(t, y, p):
    """What a user would write: principal moments and the centre of mass, constants outside."""
    q, w, c = y[:4], y[4:], p[3:] if len(p) == 6 else (0.1, 0.2, 0.9)
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


def under_diffrax(field, start, p, ts, adjoint):
    """The states of a field written by hand."""
    return dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Dopri8(), ts[0], ts[-1], None, start, p, saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=RTOL, atol=ATOL), adjoint=adjoint,
        max_steps=100_000,
    ).ys  # fmt: skip


def plain(ts, adjoint):
    def run(p, omega):
        start = jnp.concatenate([jnp.asarray(Q), omega])
        return under_diffrax(by_hand, start, p, ts, adjoint)[:, 4:]

    return run


def ours(ts, adjoint=None, solver=None):
    how = dict(rtol=RTOL, atol=ATOL, adjoint=adjoint, solver=solver)

    def run(p, omega):
        body, start = rj.Inertia.from_principal(p[0], p[1], p[2]), rj.Attitude(Q, omega)
        return rj.simulate(body, start, ts, TOP, **how).ys.omega

    return run


def plain_of_all(ts):
    def run(x):
        p, start = x[:6], jnp.concatenate([x[9:], x[6:9]])
        return under_diffrax(by_hand, start, p, ts, FORWARD)[:, 4:]

    return run


def ours_of_all(ts, adjoint):
    """Of all numbers that a fit would look for: moments, centre of mass, rate, attitude."""

    def run(x):
        body = rj.Inertia.from_principal(x[0], x[1], x[2])
        top = rj.torques.HeavyTop(1.0, x[3:6], [0.0, 0.0, -9.81])
        start = rj.Attitude(x[9:], x[6:9])
        return rj.simulate(body, start, ts, top, rtol=RTOL, atol=ATOL, adjoint=adjoint).ys.omega

    return run


def foucault_by_hand(t, y, p):
    """A pendulum on the turning Earth, axes east, north, up; p = g, Ω north, Ω up."""
    g, n, u = p
    (px, py, pz), (vx, vy, vz) = y[:3], y[3:]
    along, square = n * py + u * pz, n * n + u * u
    ax = square * px + 2 * (u * vy - n * vz)
    ay = square * py - along * n - 2 * u * vx
    az = square * pz - along * u + 2 * n * vx - g
    pull = px * ax + py * ay + pz * az + vx * vx + vy * vy + vz * vz
    pull = pull / (px * px + py * py + pz * pz)
    return jnp.stack([vx, vy, vz, ax - pull * px, ay - pull * py, az - pull * pz])


def three_body_by_hand(t, y, p):
    (x, z, u), (vx, vy, vz), m = y[:3], y[3:], p[0]
    near = ((x + m) ** 2 + z * z + u * u) ** 1.5
    far = ((x - 1 + m) ** 2 + z * z + u * u) ** 1.5
    pull, tide = (1 - m) / near, m / far
    ax = x + 2 * vy - pull * (x + m) - tide * (x - 1 + m)
    return jnp.stack([vx, vy, vz, ax, z - 2 * vx - (pull + tide) * z, -(pull + tide) * u])


def particles(count):
    """Name → functions by hand and ours of (start's velocity, constants), and arguments."""
    law = scenes.foucault(0.85, 67.0)
    start, (_, north, up) = law.start(3.0, 0.0), law.place.angular_velocity()
    earth = jnp.array([law.place.gravity, north, up])
    orbit, mu = jnp.array([0.994, 0.0, 0.0]), jnp.array([0.012277471])
    speed = jnp.array([0.0, -2.00158510637908252240, 0.0])
    found = {}
    for name, field, x, v, p, end, scene in (
        ("Foucault", foucault_by_hand, start.x, start.v, earth, 600.0, lambda p: law),
        ("Arenstorf", three_body_by_hand, orbit, speed, mu, 17.0652, lambda p: orbits.cr3bp(p[0])),
    ):
        ts = jnp.linspace(0.0, end, count)

        def hand(v, p, adjoint=REVERSE, field=field, x=x, ts=ts):
            return under_diffrax(field, jnp.concatenate([x, v]), p, ts, adjoint)[:, :3]

        def mine(v, p, adjoint=None, scene=scene, x=x, ts=ts):
            start = rj.Point(x, v)
            run = rj.simulate(None, start, ts, scene(p), rtol=RTOL, atol=ATOL, adjoint=adjoint)
            return run.ys.x

        found[name] = hand, mine, (v, p)
    return found


def inside_diffrax(ts):
    def run(p, omega):
        body = rj.Inertia.from_principal(p[0], p[1], p[2])
        out = dfx.diffeqsolve(
            dfx.ODETerm(AttitudeEquations(body, TOP)), rj.solvers.DormandPrince8(), ts[0],
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
    few = jax.tree.map(lambda a: a[:FEW], many)
    whole = jnp.concatenate([one[0], jnp.array([0.1, 0.2, 0.9]), one[1], jnp.asarray(Q)])
    hand, ahead = plain(ts, REVERSE), plain(ts, FORWARD)
    mine, along, both = ours(ts), ours(ts, FORWARD), (0, 1)
    other = ours(ts, solver=dfx.Dopri8())
    return {
        "value": {
            "diffrax": (hand, one),
            "ours": (mine, one),
            "ours, by diffrax": (other, one),
            "closed form": (closed_form(ts), one),
        },
        "gradient": {
            "diffrax": (jax.grad(number(hand), both), one),
            "ours": (jax.grad(number(mine), both), one),
            "ours, by diffrax": (jax.grad(number(other), both), one),
            "inside diffeqsolve": (jax.grad(number(inside_diffrax(ts)), both), one),
            "closed form": (jax.grad(number(closed_form(ts)), both), one),
        },
        "Jacobian by 6": {
            "diffrax": (jax.jacfwd(ahead, both), one),
            "ours": (jax.jacfwd(along, both), one),
            "our loop": (jax.jacfwd(mine, both), one),
        },
        "Jacobian by 13": {
            "diffrax": (jax.jacfwd(plain_of_all(ts)), (whole,)),
            "ours": (jax.jacfwd(ours_of_all(ts, FORWARD)), (whole,)),
            "our loop": (jax.jacfwd(ours_of_all(ts, None)), (whole,)),
        },
        f"{FEW} Jacobians by 6": {
            "diffrax": (jax.vmap(jax.jacfwd(ahead, both)), few),
            "ours": (jax.vmap(jax.jacfwd(along, both)), few),
            "our loop": (jax.vmap(jax.jacfwd(mine, both)), few),
        },
        f"{MANY} values": {
            "diffrax": (jax.vmap(hand), many),
            "ours": (jax.vmap(mine), many),
            "ours, by diffrax": (jax.vmap(other), many),
        },
        f"{MANY} gradients": {
            "diffrax": (jax.grad(numbers(hand), both), many),
            "ours": (jax.grad(numbers(mine), both), many),
            "ours, by diffrax": (jax.grad(numbers(other), both), many),
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
    counts = [int(word) for word in sys.argv[1:] if word.isdigit()] or [2, 30]
    for saved in counts:
        for row, methods in cases(jnp.linspace(0.0, END, saved)).items():
            shown(saved, row, measured(methods, repeats))
        for name, (hand, mine, args) in particles(saved).items():
            shown(saved, name, measured({"diffrax": (hand, args), "ours": (mine, args)}, repeats))
            slopes = {
                who: (jax.grad(number(f)), args) for who, f in (("diffrax", hand), ("ours", mine))
            }
            shown(saved, f"{name}, grad", measured(slopes, repeats))
            columns = {
                who: (jax.jacfwd(partial(f, adjoint=adjoint)), args)
                for who, f, adjoint in (
                    ("diffrax", hand, FORWARD),
                    ("ours", mine, FORWARD),
                    ("our loop", mine, None),
                )
            }
            shown(saved, f"{name}, Jacobian by 3", measured(columns, repeats))


def shown(saved, row, found):
    compile0, run0 = found["diffrax"]
    for name, (cpu, run) in found.items():
        print(
            f"{saved:3d} times  {row:24s} {name:19s} compile {cpu:5.2f} s"
            f" ({cpu / compile0:.2f})  run {run * 1e6:8.0f} us ({run / run0:.2f})",
            flush=True,
        )


if __name__ == "__main__":
    main()
