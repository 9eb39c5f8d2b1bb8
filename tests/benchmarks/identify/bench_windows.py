"""How long fits of windows take, beside numba with finite differences, and beside MJX.

    python tests/benchmarks/identify/bench_windows.py FOLDER [--count 1359] [--repeats 5] [--fit] [--mjx]

FOLDER with the csv files of the nano-drone benchmark (see `bench_nanodrone.py`; no part of this
project). 1359 windows of 50 steps, 25 free numbers: errors and their derivatives, summed to normal
equations. Times of the processor, one thread each, medians of interleaved repeats, compile apart.

- ours: one evaluation of the errors and their derivatives, as `identify.fit` takes it;
- numba: the same equations written out as loops, Runge–Kutta of order 4, forward differences;
- `--fit`: whole fits from the same start: `identify.fit`; SciPy's `least_squares` on numba's errors;
- `--mjx`: the runs alone, without derivatives, of MuJoCo's XLA version with its Runge–Kutta.
"""

import argparse
import importlib.util
import os
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify.search import stages
from rigidjax.motion.torques.base import AbstractForce

_spec = importlib.util.spec_from_file_location(
    "nanodrone", Path(__file__).with_name("bench_nanodrone.py")
)
nanodrone = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(nanodrone)

LENGTH, MASS = 50, 0.045
SPINS = np.array([1.0, -1, 1, -1])
# A root of the second moment, centre, thrust, drag of rotors, drag, damping, torque by velocity,
# by how much of a sample the speeds come before they are logged: 25 numbers.
GUESS = np.concatenate(
    [[1.6, 0, 1.4, 0, 0, 1.4], np.zeros(2), np.ones(8), np.ones(3), np.ones(3), np.zeros(2), [0.5]]
)


class Law(AbstractForce):
    """The law of the 19 numbers after the six of the body."""

    feels = rj.motion.HasPose
    x: jax.Array
    speeds: nanodrone.Between

    def __call__(self, t, state, body):
        x = self.x
        centre = jnp.concatenate([x[:2], jnp.zeros(1)])
        flap = jnp.zeros((3, 3)).at[0, 1].set(x[16]).at[1, 0].set(x[17])
        law = torques.Sum(
            torques.UniformGravity([0.0, 0.0, -9.81]),
            torques.Rotors(nanodrone.PLACES - 1e-3 * centre, nanodrone.UP, SPINS,
                           3.4e-8 * x[2:6], 2e-10 * x[6:10], self.speeds),
            torques.BodyDrag(1e-2 * x[10:13]),
            torques.Damping(1e-6 * x[13:16]),
            nanodrone.Flapping(1e-5 * flap),
        )  # fmt: skip
        return law(t, state, body)


FREE = (
    identify.Free(lambda s: s.torque.x, "x"),
    identify.Free(lambda s: s.torque.speeds.ahead, "ahead"),
)


def numbers(fit):
    """The 25 numbers of a fit, as numba's loops take them."""
    x = fit.values
    return np.concatenate([GUESS[:6] + fit.x[:6], x["x"], x["ahead"][None]])


def cut(folder, count):
    runs = [p for p in sorted(folder.glob("*.csv")) if p.stem not in nanodrone.HELD_OUT]
    for stride in range(40, 0, -1):
        found = identify.Windows.join(*(nanodrone.cut(p, LENGTH, stride) for p in runs))
        if found.count >= count:
            break
    # Evenly chosen where there are more.
    rows = np.linspace(0, found.count - 1, count).round().astype(int)
    parts = jax.tree.map(lambda a: a[rows], (found.starts, found.wanted, found.inputs))
    return identify.Windows(found.step, *parts)


def with_numba(windows, scales):
    """A function of the numbers: all errors, flat, in units of `scales`; None without numba."""
    try:
        import numba
    except ModuleNotFoundError:
        return None
    h, places = windows.step, nanodrone.PLACES
    starts = np.concatenate([np.asarray(getattr(windows.starts, k)) for k in _KINDS], 1)
    wanted = np.concatenate([np.asarray(getattr(windows.wanted, k)) for k in _KINDS], 2)
    logged, later = (np.asarray(windows.inputs[k]) for k in ("now", "soon"))
    units = np.asarray(scales)

    @numba.njit(fastmath=True)
    def slope(y, lift, tx, ty, tz, drag, damping, flap, inertia, inverse, out):
        w, a, b, c = y[6], y[7], y[8], y[9]
        p, q, r = y[10], y[11], y[12]
        xx, yy, zz = 1 - 2 * (b * b + c * c), 1 - 2 * (a * a + c * c), 1 - 2 * (a * a + b * b)
        xy, yx = 2 * (a * b - w * c), 2 * (a * b + w * c)
        xz, zx = 2 * (a * c + w * b), 2 * (a * c - w * b)
        yz, zy = 2 * (b * c - w * a), 2 * (b * c + w * a)
        u = xx * y[3] + yx * y[4] + zx * y[5]
        v = xy * y[3] + yy * y[4] + zy * y[5]
        s = xz * y[3] + yz * y[4] + zz * y[5]
        fx, fy, fz = -drag[0] * u, -drag[1] * v, lift - drag[2] * s
        out[0], out[1], out[2] = y[3], y[4], y[5]
        out[3] = (xx * fx + xy * fy + xz * fz) / MASS
        out[4] = (yx * fx + yy * fy + yz * fz) / MASS
        out[5] = (zx * fx + zy * fy + zz * fz) / MASS - 9.81
        out[6] = 0.5 * (-a * p - b * q - c * r)
        out[7] = 0.5 * (w * p + b * r - c * q)
        out[8] = 0.5 * (w * q + c * p - a * r)
        out[9] = 0.5 * (w * r + a * q - b * p)
        i, j = inertia, inverse
        lx = i[0, 0] * p + i[0, 1] * q + i[0, 2] * r
        ly = i[1, 0] * p + i[1, 1] * q + i[1, 2] * r
        lz = i[2, 0] * p + i[2, 1] * q + i[2, 2] * r
        mx = ly * r - lz * q + tx - damping[0] * p + flap[0] * v
        my = lz * p - lx * r + ty - damping[1] * q + flap[1] * u
        mz = lx * q - ly * p + tz - damping[2] * r
        for k in range(3):
            out[10 + k] = j[k, 0] * mx + j[k, 1] * my + j[k, 2] * mz

    @numba.njit(fastmath=True)
    def run(x, inertia, inverse, out):
        drag, damping, flap = 1e-2 * x[16:19], 1e-6 * x[19:22], 1e-5 * x[22:24]
        y, at, k = np.empty(13), np.empty(13), np.empty((4, 13))
        for n in range(starts.shape[0]):
            y[:] = starts[n]
            for m in range(LENGTH):
                lift, tx, ty, tz = 0.0, 0.0, 0.0, 0.0
                for i in range(4):
                    early, late = logged[n, m, i], later[n, m, i]
                    square = (early + x[24] * (late - early)) ** 2
                    one = 3.4e-8 * x[8 + i] * square
                    lift += one
                    tx += one * (places[i, 1] - 1e-3 * x[7])
                    ty -= one * (places[i, 0] - 1e-3 * x[6])
                    tz -= SPINS[i] * 2e-10 * x[12 + i] * square
                for stage in range(4):
                    part = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                    for d in range(13):
                        at[d] = y[d] + (part * k[stage - 1, d] if stage else 0.0)
                    slope(at, lift, tx, ty, tz, drag, damping, flap, inertia, inverse, k[stage])
                for d in range(13):
                    y[d] += h / 6.0 * (k[0, d] + 2.0 * k[1, d] + 2.0 * k[2, d] + k[3, d])
                y[6:10] /= np.sqrt(np.sum(y[6:10] ** 2))
                b = wanted[n, m]
                row = out[n, m]
                for d in range(6):
                    row[d] = y[d] - b[d]
                w0, x0, y0, z0 = b[6], -b[7], -b[8], -b[9]
                w1, x1, y1, z1 = y[6], y[7], y[8], y[9]
                real = w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1
                twice = -2.0 if real < 0 else 2.0
                row[6] = twice * (w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1)
                row[7] = twice * (w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1)
                row[8] = twice * (w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1)
                for d in range(3):
                    row[9 + d] = y[10 + d] - b[10 + d]

    def errors(x):
        root = np.zeros((3, 3))
        root[np.tril_indices(3)] = x[:6]
        second = 1e-5 * root @ root.T
        inertia = np.trace(second) * np.eye(3) - second
        out = np.empty((starts.shape[0], LENGTH, 12))
        run(np.asarray(x), inertia, np.linalg.inv(inertia), out)
        return (out / units).ravel()

    return errors


_KINDS = ("x", "v", "q", "omega")


def by_differences(errors, x):
    """Normal matrix, gradient and cost by forward differences."""
    here = errors(x)
    rows = np.stack([(errors(x + step) - here) / 1e-7 for step in 1e-7 * np.eye(x.size)])
    return rows @ rows.T, rows @ here, 0.5 * here @ here


def with_mjx(windows):
    """All runs by MJX with forces given in body axes, compiled; or None without it."""
    try:
        import mujoco
        from mujoco import mjx
    except (ModuleNotFoundError, ImportError):
        return None
    xml = f"""<mujoco><compiler balanceinertia="false"/>
    <option timestep="{windows.step}" integrator="RK4"><flag contact="disable"/></option>
    <worldbody><body><freejoint/><inertial pos="0 0 0" mass="{MASS}" diaginertia="3e-5 3e-5 4e-5"/>
    </body></worldbody></mujoco>"""
    model = mjx.put_model(mujoco.MjModel.from_xml_string(xml))
    data = mjx.make_data(model)

    def one(start, speeds, thrust):
        begin = data.replace(
            qpos=jnp.concatenate([start.x, start.q]), qvel=jnp.concatenate([start.v, start.omega])
        )

        def step(now, n):
            lift = jnp.sum(thrust * n * n)
            force = rj.quaternion.rotate(now.qpos[3:7], jnp.stack([0 * lift, 0 * lift, lift]))
            applied = jnp.zeros((2, 6)).at[1, :3].set(force)
            now = mjx.step(model, now.replace(xfrc_applied=applied))
            return now, now.qpos

        return jax.lax.scan(step, begin, speeds)[1]

    runs = jax.jit(jax.vmap(one, (0, 0, None)))
    return lambda: jax.block_until_ready(
        runs(windows.starts, windows.inputs["now"], 3.4e-8 * jnp.ones(4))
    )


def timed(name, task, repeats):
    begun = time.process_time()
    task()
    first = time.process_time() - begun
    taken = []
    for _ in range(repeats):
        begun = time.process_time()
        task()
        taken.append(time.process_time() - begun)
    print(f"{name}: {np.median(taken):.2f} CPU s, first call {first:.1f}", flush=True)
    return float(np.median(taken))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=1359)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--mjx", action="store_true")
    options = parser.parse_args()
    windows = cut(options.folder, options.count)
    print(f"{windows.count} windows of {LENGTH} steps, {GUESS.size} numbers; {os.getloadavg()}")
    law = Law(jnp.asarray(GUESS[6:24]), nanodrone.Between(jnp.asarray(GUESS[24])))
    found, scales = {}, windows.scales
    model = identify.Model(windows, nanodrone.Root(), torque=law, free=FREE)
    start = model.start()

    def ours():
        again = identify.Model(windows, nanodrone.Root(), torque=law, free=FREE)
        found["fit"] = identify.fit(again, starts=1)

    def evaluated():
        # A search of no steps, the inside of the fit.
        jax.block_until_ready(stages.blocks_at(model, start))

    errors_alone = eqx.filter_jit(identify.Model.errors)

    def alone():
        jax.block_until_ready(errors_alone(model, start))

    timed("ours, errors alone", alone, options.repeats)
    once = timed("ours, errors and derivatives", evaluated, options.repeats)
    errors = with_numba(windows, scales)
    if errors is not None:
        other = timed("numba, errors alone", lambda: errors(GUESS), options.repeats)
        other = timed("numba, differences", lambda: by_differences(errors, GUESS), options.repeats)
        print(f"ours / numba: {once / other:.2f}")
    if options.fit:
        timed("ours, whole fit", ours, 2)
        best = found["fit"]
        count = windows.count * LENGTH
        print(f"cost {0.5 * best.chi2 / count:.6f}, {best.search}")
        if errors is not None:
            for name, x in (("the start", GUESS), ("our end", numbers(best))):
                print(f"numba's cost at {name}: {0.5 * np.sum(errors(x) ** 2) / count:.6f}")
            begun = time.process_time()
            end = least_squares(errors, GUESS, method="lm", max_nfev=2000)
            print(
                f"SciPy and numba, whole fit: {time.process_time() - begun:.1f} CPU s, cost "
                f"{end.cost / count:.6f}, {end.nfev} evaluations"
            )
    if options.mjx:
        runs = with_mjx(windows)
        if runs is not None:
            timed("MJX, the runs alone", runs, options.repeats)


if __name__ == "__main__":
    main()
