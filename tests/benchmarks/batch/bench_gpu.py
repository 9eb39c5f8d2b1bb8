"""What a GPU takes, beside plain scans and diffrax, and whether its numbers are those of a CPU.

`python tests/benchmarks/batch/bench_gpu.py` on a machine with a GPU: about four minutes. Rows are printed as
soon as they are there; at the end the table is written into notebooks/figures.md, and to a file
given by `--table`. `--small` has the same programs in small, for a CPU, and writes nothing.
"""

import argparse
import importlib.metadata
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import rigidjax as rj
from rigidjax import identify

H, END = 0.01, 10.0
TOP = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
FIGURES = Path(__file__).parents[3] / "notebooks" / "figures.md"
MARKS = "<!-- bench_gpu -->\n", "<!-- /bench_gpu -->\n"


def numbers(count, kind=np.float64):
    """Moments, attitudes and rates of bodies, |Ω| = 1."""
    moments = np.random.default_rng(0).uniform(1.0, 1.9, (count, 3))
    omega = np.random.default_rng(1).normal(size=(count, 3))
    omega /= np.linalg.norm(omega, axis=1)[:, None]
    q = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return tuple(jnp.asarray(a, kind) for a in (moments, q, omega))


def scene(m, q, omega):
    return rj.Inertia(m[:, :, None] * jnp.eye(3, dtype=m.dtype)[None]), rj.Attitude(q, omega)


def rollout(torque, steps):
    return lambda *a: rj.batch.rollout(*scene(*a), jnp.asarray(H, a[0].dtype), steps, torque)


def simulated(torque, end):
    def run(*a):
        ts = jnp.asarray([0.0, end], a[0].dtype)
        ys = rj.batch.simulate(*scene(*a), ts, torque).ys
        return jax.tree.map(lambda y: y[:, -1], ys)

    return run


def gradient(run):
    def loss(*a):
        y = run(*a)
        return jnp.sum(y.q**2 * jnp.arange(1.0, 5.0, dtype=y.q.dtype)[None]) + jnp.sum(y.omega)

    return jax.grad(loss, (0, 1, 2))


def plain_slope(m, torque):
    """dq/dt and dΩ/dt on tuples of components, as a user writes them by hand for this one top."""
    a, b, c = m
    r, ia, ib = ((b - c) / a, (c - a) / b, (a - b) / c), 2 / a, 2 / b

    def slope(y):
        w, x, u, z, p, q, s = y
        i, j, k = 0.5 * p, 0.5 * q, 0.5 * s
        rate = (-x * i - u * j - z * k, w * i + u * k - z * j, w * j + z * i - x * k)
        rate = (*rate, w * k + x * j - u * i, r[0] * q * s, r[1] * s * p, r[2] * p * q)
        if torque is None:
            return rate
        push = rate[4] + ia * (u * z + w * x), rate[5] - ib * (x * z - w * u)
        return (*rate[:4], *push, rate[6])

    return slope


def plain_rollout(torque, steps):
    """One scan of RK4 over tuples of arrays, five steps in a turn."""

    def run(m, q, omega):
        f = plain_slope(tuple(m.T), torque)
        add = lambda y, h, k: tuple(a + h * b for a, b in zip(y, k, strict=True))

        def step(y, _):
            k1 = f(y)
            k2 = f(add(y, H / 2, k1))
            k3 = f(add(y, H / 2, k2))
            k4 = f(add(y, H, k3))
            whole = [k1[i] + 2 * (k2[i] + k3[i]) + k4[i] for i in range(7)]
            return add(y, H / 6, whole), None

        y, _ = lax.scan(step, (*q.T, *omega.T), None, steps, unroll=5)
        return rj.Attitude(jnp.stack(y[:4], 1), jnp.stack(y[4:], 1))

    return run


def plain_diffrax(end):
    """diffrax's Dopri8 on an array of seven numbers, to the median error of ours at 1e-9."""
    field = lambda t, y, m: jnp.stack(plain_slope(tuple(m), TOP)(tuple(y)))
    control = dfx.PIDController(rtol=1.79e-9, atol=1.79e-12)

    def one(m, q, omega):
        y = dfx.diffeqsolve(
            dfx.ODETerm(field), dfx.Dopri8(), 0.0, end, None, jnp.concatenate([q, omega]), m,
            stepsize_controller=control,
        ).ys[-1]  # fmt: skip
        return rj.Attitude(y[:4], y[4:])

    return jax.vmap(one)


def seconds(run, *args):
    """The median of five after one."""
    jax.block_until_ready(run(*args))
    found = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(run(*args))
        found.append(time.perf_counter() - begin)
    return float(np.median(found))


class Table:
    """Rows of (work, figure, unit), printed as they come."""

    def __init__(self):
        self.begin, self.rows = time.perf_counter(), []

    def add(self, work, figure, unit):
        self.rows.append(f"| {work} | {figure:.3g} | {unit} |")
        print(f"[{time.perf_counter() - self.begin:4.0f}] {self.rows[-1]}", flush=True)

    def text(self):
        device = jax.devices()[0]
        names = ("jax", "diffrax", "equinox")
        versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
        head = (
            f"{device.device_kind}, {versions}.\n\n| work | figure | unit |\n| --- | --- | --- |\n"
        )
        return head + "\n".join(self.rows) + "\n"


class Program:
    """A function that is compiled beside others."""

    def __init__(self, pool, run, args):
        options = rj.batch.compiler_options()
        jitted = jax.jit(run, compiler_options=options) if options else jax.jit(run)
        self.args, lowered = args, jitted.lower(*args)
        self.compiled = pool.submit(lowered.compile)

    def seconds(self):
        return seconds(self.compiled.result(), *self.args)

    @property
    def gigabytes(self):
        return self.compiled.result().memory_analysis().temp_size_in_bytes / 1e9


def measure(table, many, some, steps, end):
    pool = ThreadPoolExecutor(4 if steps < 100 else 14)
    jobs = []

    def put(name, unit, scale, run, args):
        jobs.append((name, unit, scale, Program(pool, run, args)))

    rate, of = "1e9 body-steps/s", {}
    for kind in (np.float64, np.float32):
        for count in (many, some) if kind == np.float64 else (many,):
            args, size = numbers(count, kind), f"{count:,}".replace(",", " ")
            for what, torque in (("free bodies", None), ("heavy tops", TOP)):
                name = f"{size} {what}, {np.dtype(kind).name}"
                work = count * steps / 1e9
                put(f"`rollout`, {name}", rate, work, rollout(torque, steps), args)
                if count == many:
                    by_hand = plain_rollout(torque, steps)
                    put(f"scan by hand, {name}", rate, work, by_hand, args)
                if kind == np.float64:
                    run = gradient(rollout(torque, steps))
                    put(f"gradient of `rollout`, {name}", rate, work, run, args)
    args = numbers(many)
    put(f"closed form, {many:.0e} bodies", "ns a body", many * 1e-9, simulated(None, 100.0), args)
    args = numbers(some)
    for name, run in (("`simulate`", simulated(TOP, end)), ("diffrax Dopri8", plain_diffrax(end))):
        put(f"{name}, {some:.0e} heavy tops to {end:g} s, 1e-9", "ms", 1e-3, run, args)
    run = gradient(simulated(TOP, end))
    put(f"gradient of `simulate`, {some:.0e} heavy tops", "ms", 1e-3, run, args)
    for name, unit, scale, job in jobs:
        try:
            of[name] = job.seconds()
        except Exception as error:
            print(f"{name}: {str(error).splitlines()[0][:120]}", flush=True)
            continue
        table.add(name, scale / of[name] if unit == rate else of[name] / scale, unit)
        if "gradient of" in name:
            table.add(f"memory of the {name}", job.gigabytes, "GB")
        job.compiled = job.args = None
    bodies, states = scene(*numbers(many))
    ts = jnp.asarray([0.0, 100.0])
    calls = (
        ("rollout", many * steps / 1e9, rate, lambda b, y: rj.batch.rollout(b, y, H, steps)),
        ("closed form", many * 1e-9, "ns a body", lambda b, y: rj.batch.simulate(b, y, ts)),
    )
    for name, scale, unit, call in calls:
        # The same numbers as arguments: with known times, or a tensor that is known to be diagonal,
        # XLA has less to compute.
        for where, run in (
            (f"public call of the {name}", call),
            ("inside of `jit`", jax.jit(call)),
        ):
            t = seconds(run, bodies, states)
            table.add(f"{where}, free bodies", scale / t if unit == rate else t / scale, unit)


def fits(table):
    """A fit of 100 samples, by default and on the first device."""
    t = jnp.linspace(0.0, 10.0, 101)
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 1.6, 2.2), rj.Spin([1.0, 0.5, 1.2]), t).ys

    def once(seed):
        noise = 0.05 * jax.random.normal(jax.random.key(seed), (101, 3))
        sensor = identify.Gyro(noise=0.05), motion.omega + noise
        model = identify.Model(identify.Recording(t, sensor), identify.PrincipalRatios())
        return identify.fit(model, starts=1).x

    def warm():
        once(0)
        found = []
        for seed in range(1, 6):
            begin = time.perf_counter()
            jax.block_until_ready(once(seed))
            found.append(time.perf_counter() - begin)
        return float(np.median(found))

    table.add("a fit of 100 samples, warm, as it comes", warm(), "s")
    if jax.devices()[0].platform != "cpu":
        with jax.default_device(jax.devices()[0]):
            table.add("the same on the GPU", warm(), "s")


def checks(table, count):
    """Values and gradients of a few bodies here and on the CPU."""
    cpu, largest = jax.devices("cpu")[0], 0.0
    runs = [simulated(None, 10.0), simulated(TOP, 2.0), rollout(None, 100), rollout(TOP, 100)]
    for run in runs:
        both = lambda *a, run=run: (run(*a), gradient(run)(*a))
        here = jax.jit(both)(*numbers(count))
        with jax.default_device(cpu):
            there = jax.jit(lambda *a, both=both: both(*a))(*numbers(count))
        for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
            a, b = np.asarray(a), np.asarray(b)
            largest = max(largest, float(np.abs(a - b).max() / np.abs(b).max()))
    table.add(
        "values and gradients beside those of a CPU, largest relative difference", largest, ""
    )
    return largest


def written(text, table):
    """The page with this table between the marks."""
    begin, end = MARKS
    pattern = re.escape(begin) + ".*" + re.escape(end)
    return re.sub(pattern, lambda _: f"{begin}\n{table}\n{end}", text, flags=re.S)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args(arguments)
    table = Table()
    if options.small:
        measure(table, 12, 6, 10, 0.5)
        return table
    measure(table, 1_000_000, 100_000, 1000, END)
    checks(table, 64)
    fits(table)
    if options.table is not None:
        options.table.write_text(table.text(), encoding="utf-8")
    if FIGURES.exists():
        page = FIGURES.read_text(encoding="utf-8")
        FIGURES.write_text(written(page, table.text()), encoding="utf-8")
    return table


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
