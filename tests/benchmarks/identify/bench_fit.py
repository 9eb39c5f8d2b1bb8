"""How long fits of throws take, beside SciPy with numba and beside `mujoco.sysid`.

    python tests/benchmarks/identify/bench_fit.py [--repeats 9] [--joint] [--many] [--real]

One throw: 0.7 s at 1 kHz with a wheel inside, twelve free numbers (`Tensor`, rates, drag). All
from the same start but where it says otherwise, times of the processor, medians of interleaved
repeats in one process, other readings each time; compile apart.

- ours: `identify.fit` whole, with its assessment, intervals and the check of its steps;
- SciPy: `least_squares` (method lm) with finite differences through a Runge–Kutta of order 4 at
  the same steps, its loop compiled by numba;
- `mujoco.sysid.optimize` (its optimiser "scipy"; "mujoco" stops far away from two of three starts)
  on a smaller problem that MuJoCo has, too: a known torque in body axes, nine numbers (inertia,
  rates), `mujoco.rollout` with its Runge–Kutta of order 4 at the same steps; ours on the same.

What is not installed is left out. `--joint` adds all throws of the data beside the checkout as one
problem (see `bench_throws.py`), then 55: throws of the groups that have fewest are in it twice.
`--many` adds up to a thousand recordings, six numbers each.
`--steps` adds what one evaluation costs in equal and in adaptive steps. `--real` has only the first
comparison, with the throws of an object beside the checkout in the place of simulated readings:
their errors are not white, and the fit estimates its noise.
"""

import argparse
import contextlib
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.model.model import error_jacobians

COUNT, STEP, SIGMA, WHEEL = 700, 1e-3, 0.02, 1.7e-6
T = np.arange(COUNT) * STEP
SPEED = -1300.0 * 0.5 * (np.tanh((T - 0.2) / 0.03) - np.tanh((T - 0.45) / 0.05))
MOMENTS = np.diag([4.1e-4, 1.3e-4, 4.6e-4]) + 1e-5 * (np.ones((3, 3)) - np.eye(3))
DRAG, OMEGA = np.array([2e-5, 1e-5, 3e-5]), np.array([11.0, 1.5, -2.0])
RATE = np.gradient(SPEED, STEP)
TORQUE, UNIT = np.array([2e-3, -1e-3, 1.5e-3]), 3e-4
# Where all begin: diagonal moments a tenth too large, no drag, the first reading.
GUESS = np.diag(np.diag(MOMENTS) * 1.1)
COLD = """
import time, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import rigidjax as rj
from rigidjax import identify
imported = time.process_time()
t = np.arange(200) * 1e-2
motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1.0, 0.1, 1.0]), t, LAW)
read = motion.ys.omega + 0.01 * np.random.default_rng(0).normal(size=(200, 3))
def fitted(read):
    record = identify.Recording(t, (identify.Gyro(0.01), read))
    return identify.fit(identify.Model(record, identify.CHART, torque=LAW), starts=1)
begun = time.process_time()
fitted(read)
first = time.process_time()
fitted(read + 0.001)
print(imported, begun - imported, first - begun, time.process_time() - first, first)
"""


def law(drag):
    wheel = rj.torques.Flywheel(
        rj.torques.Wheel(WHEEL, [0.0, 0.0, 1.0], rj.torques.Series(T, SPEED))
    )
    return rj.torques.Sum(wheel, rj.torques.Damping(drag))


def real():
    """Of each throw of an object what SciPy needs, the problem of twelve numbers, its start."""
    places = Path(__file__).parents[2] / "identify"
    loaded = importlib.util.spec_from_file_location("throws", places / "throws.py")
    throws = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(throws)
    free = [identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-5)]
    out = []
    for path in throws.paths("object_empty"):
        record = throws.record(path)
        h = np.asarray(jax.vmap(record.inputs["speed"])(record.t)) * throws.WHEEL
        scene = np.asarray(record.readings[0].values), h, np.gradient(h, STEP)
        made = identify.Model(record, identify.Tensor(UNIT), torque=throws.LAW, free=free)
        out.append((scene, made, start(made, scene[0])))
    return out


def problem(readings, integrator=None):
    record = identify.Recording(T, (identify.Gyro(SIGMA), readings))
    free = [identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-5)]
    torque = law([0.0, 0.0, 0.0])
    return identify.Model(
        record, identify.Tensor(UNIT), torque=torque, free=free, integrator=integrator
    )


def driven(readings):
    push = rj.torques.ConstantTorque(TORQUE)
    record = identify.Recording(T, (identify.Gyro(SIGMA), readings))
    return identify.Model(record, identify.Tensor(UNIT), torque=push)


def start(of, readings):
    """The free numbers of the common start."""
    return of.start(rj.Inertia(GUESS), readings[0])


def with_numba():
    """`least_squares` on the same twelve numbers, or None without numba."""
    try:
        import numba
    except ModuleNotFoundError:
        return None

    @numba.njit(cache=False)
    def rate(w, h, dh, inertia, inverse, drag):
        p0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
        p1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
        p2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2] + h
        a = p1 * w[2] - p2 * w[1] - drag[0] * w[0]
        b = p2 * w[0] - p0 * w[2] - drag[1] * w[1]
        c = p0 * w[1] - p1 * w[0] - drag[2] * w[2] - dh
        return np.array(
            [
                inverse[0, 0] * a + inverse[0, 1] * b + inverse[0, 2] * c,
                inverse[1, 0] * a + inverse[1, 1] * b + inverse[1, 2] * c,
                inverse[2, 0] * a + inverse[2, 1] * b + inverse[2, 2] * c,
            ]
        )

    @numba.njit(cache=False)
    def motion(w, inertia, inverse, drag, h, dh, step):
        out = np.empty((h.size, 3))
        out[0] = w
        for i in range(h.size - 1):
            hm, dm = 0.5 * (h[i] + h[i + 1]), 0.5 * (dh[i] + dh[i + 1])
            k1 = rate(w, h[i], dh[i], inertia, inverse, drag)
            k2 = rate(w + 0.5 * step * k1, hm, dm, inertia, inverse, drag)
            k3 = rate(w + 0.5 * step * k2, hm, dm, inertia, inverse, drag)
            k4 = rate(w + step * k3, h[i + 1], dh[i + 1], inertia, inverse, drag)
            w = w + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
            out[i + 1] = w
        return out

    def residual(x, readings, h, dh):
        inertia = UNIT * symmetric(x)
        inverse = np.linalg.inv(inertia)
        w = motion(10 * x[6:9], inertia, inverse, 1e-5 * x[9:], h, dh, STEP)
        return ((w - readings) / SIGMA).ravel()

    def fit(readings, h=WHEEL * SPEED, dh=WHEEL * RATE):
        begin = np.r_[np.diag(GUESS) / UNIT, np.zeros(3), readings[0] / 10, np.zeros(3)]
        return least_squares(residual, begin, args=(readings, h, dh), method="lm").cost

    return fit


def symmetric(x):
    return np.array([[x[0], x[3], x[4]], [x[3], x[1], x[5]], [x[4], x[5], x[2]]])


def with_mujoco():
    """`mujoco.sysid.optimize` on nine numbers of `driven`, or None without it."""
    try:
        import mujoco
        from mujoco import rollout, sysid

        empty = sysid.ParameterDict
    except (ModuleNotFoundError, ImportError, AttributeError):
        return None
    motors = "".join(
        f'<motor joint="j" gear="{gear} 0 0 0"/>' for gear in ("1 0 0", "0 1 0", "0 0 1")
    )
    xml = f"""<mujoco><compiler balanceinertia="false"/>
    <option timestep="{STEP}" integrator="RK4" gravity="0 0 0"><flag contact="disable"/></option>
    <worldbody><body><joint name="j" type="ball"/><site name="s"/>
    <inertial pos="0 0 0" mass="1" fullinertia="4e-4 4e-4 4e-4 0 0 0"/></body></worldbody>
    <actuator>{motors}</actuator><sensor><gyro site="s"/></sensor></mujoco>"""
    data = mujoco.MjData(mujoco.MjSpec.from_string(xml).compile())
    control = np.tile(TORQUE, (COUNT, 1))

    def rates(x):
        tensor = UNIT * symmetric(x)
        # Anew each time: a specification that was once refused stays so.
        spec = mujoco.MjSpec.from_string(xml)
        spec.bodies[1].fullinertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        try:
            model = spec.compile()
        except ValueError:
            # No real body: its optimiser is to turn back.
            return np.full((COUNT, 3), 1e3)
        begin = np.r_[0.0, 1.0, 0.0, 0.0, 0.0, 10 * x[6:9]]
        states, _ = rollout.rollout(model, data, begin, control)
        # The state's rates are those after each step.
        return np.concatenate([begin[None, 5:8], states[0, :-1, 5:8]])

    def fit(readings):
        begin = np.r_[np.diag(GUESS) / UNIT, np.zeros(3), readings[0] / 10]
        low, high = np.r_[0.1 * np.ones(3), -np.ones(6)], np.r_[np.full(9, 5.0)]
        made = empty()
        made.add(sysid.Parameter("x", begin, low, high))

        def residual(x, params, **_):
            columns = [((rates(c) - readings) / SIGMA).ravel() for c in np.atleast_2d(x.T)]
            return [columns[0] if x.ndim == 1 else np.stack(columns, 1)], None, None

        with contextlib.redirect_stdout(None):
            found, _ = sysid.optimize(made, residual, "scipy", verbose=False)
        return 0.5 * float(np.sum(residual(found.as_vector(), None)[0][0] ** 2))

    return fit


def compared(tasks, draws):
    """Medians of times of the processor, ms, of interleaved repeats, and the last results."""
    taken, last = {name: [] for name in tasks}, {}
    for readings in draws:
        for name, task in tasks.items():
            begun = time.process_time()
            last[name] = task(readings)
            taken[name].append(time.process_time() - begun)
    return {name: 1e3 * float(np.median(some)) for name, some in taken.items()}, last


def first_time(name, task, readings):
    begun = time.process_time()
    task(readings)
    print(f"{name}, first call: {time.process_time() - begun:.1f} CPU s")


def draws_of(body, torque, count, seed):
    clean = np.asarray(rj.simulate(body, rj.Spin(OMEGA), T, torque).ys.omega)
    rng = np.random.default_rng(seed)
    return [clean + SIGMA * rng.normal(size=clean.shape) for _ in range(count)]


def table(title, tasks, draws, beside):
    print(f"\n{title}")
    for name, task in tasks.items():
        first_time(name, task, draws[0])
        task(draws[1])
    median, last = compared(tasks, draws[2:])
    for name, value in median.items():
        ratio = f"{value / median[beside]:.2f} of {beside}" if beside in median else ""
        print(f"{name}: {value:.1f} ms, {ratio}; misfit {last[name]:.6f}")


def cold():
    """A process of its own: import, a first run, a first fit, a second one."""
    print("\na new process: CPU s of import, a first simulation, a first small fit, the next fit")
    torque = "rj.torques.Damping([0.01, 0.02, 0.01])"
    for law_text, chart in (("None", "PrincipalRatios()"), (torque, "Principal(1.5)")):
        code = COLD.replace("LAW", law_text).replace("CHART", chart)
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
        )
        parts = [float(word) for word in done.stdout.split()]
        kind = "free body" if law_text == "None" else "damped body"
        shown = ", ".join(f"{part:.2f}" for part in parts[:4])
        print(f"{kind}: {shown}; from nothing to the first fit {parts[4]:.1f}")


def recordings(counts=(100, 500, 1000)):
    """Recordings of a free body by one gyro, each with a rate and a bias of its own."""
    body, ts, rng = rj.Inertia.from_principal(1.0, 2.0, 2.5), T[:600:10], np.random.default_rng(0)
    move = jax.jit(jax.vmap(lambda w: rj.simulate(body, rj.Spin(w), 5.0 * ts).ys.omega))
    bias = lambda s: s.sensors[0].bias
    free = [identify.Free(bias, "bias", scale=0.02, spread=0.02)]
    for count in counts:
        rates = np.asarray(move(jnp.asarray(3.0 * rng.normal(size=(count, 3)))))
        read = rates + 0.02 * rng.normal(size=(count, 1, 3)) + 0.01 * rng.normal(size=rates.shape)
        gyro = identify.Gyro(0.01, bias=np.zeros(3))
        records = [identify.Recording(5.0 * ts, (gyro, row)) for row in read]
        for name in ("first call", "warm"):
            begun = time.perf_counter()
            made = identify.Model(records, identify.PrincipalRatios(), free=free)
            found = identify.fit(made, starts=1)
            size = found.covariance.shape[0]
            print(
                f"{count} recordings, {size} numbers, {name}: {time.perf_counter() - begun:.1f} s"
            )


def joint(more):
    """All throws of the data beside the checkout as one problem, and so many again; three times."""
    places = Path(__file__).parent
    loaded = importlib.util.spec_from_file_location("bench_throws", places / "bench_throws.py")
    bench = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(bench)
    names = bench.MASSES
    given = {n: bench.throws.paths(n) for n in names}
    paths = dict(given)
    for _ in range(more):
        shortest = min(paths, key=lambda n: len(paths[n]))
        again = given[shortest][len(paths[shortest]) % len(given[shortest])]
        paths[shortest] = [*paths[shortest], again]
    records = {n: [bench.record(p, 1, 0.53) for p in paths[n]] for n in names}
    count = sum(map(len, records.values()))
    for name in ("first call", "warm", "warm"):
        begun = time.process_time(), time.perf_counter()
        found = bench.together(records)
        size = found.covariance.shape[0]
        print(
            f"{count} throws together, {size} numbers, 11 shared by all, {name}: "
            f"{time.process_time() - begun[0]:.1f} CPU s, {time.perf_counter() - begun[1]:.1f} s"
        )


def steps():
    """Errors and derivatives by each kind of steps: a smooth law, and a throw's noisy log."""
    body, rates = rj.Inertia.from_principal(1.0, 1.6, 2.2), np.array([0.3, 1.0, 0.2])
    smooth, tasks = rj.torques.Damping([0.01, 0.01, 0.01]), {}
    for apart in (0.1, 0.4, 1.6):
        ts = np.arange(0.0, 100.0, apart / np.linalg.norm(rates))
        read = np.asarray(rj.simulate(body, rj.Spin(rates), ts, smooth).ys.omega)
        record = identify.Recording(ts, (identify.Gyro(0.01), read))
        made = identify.Model(record, identify.Principal(1.2), torque=smooth)
        tasks[f"smooth, {apart} rad apart"] = made, made.start(body)
    places = Path(__file__).parent
    loaded = importlib.util.spec_from_file_location("bench_throws", places / "bench_throws.py")
    bench = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(bench)
    record = bench.record(bench.throws.paths("object_empty")[0], 1, 0.53)
    made = identify.Model(record, identify.Tensor(3e-4), torque=bench.LAW)
    tasks["a throw with its log"] = made, made.start(rj.Inertia(GUESS))
    print("\none evaluation of errors and derivatives, ms")
    for name, (made, at) in tasks.items():
        for way in (made.integrator, identify.Adaptive()):
            chosen = eqx.tree_at(lambda p: p.integrator, made, way)
            run = eqx.filter_jit(lambda at, chosen: error_jacobians(chosen, at))
            found, _ = compared(
                {"it": lambda at, run=run, chosen=chosen: jax.block_until_ready(run(at, chosen))},
                [at] * 9,
            )
            kind = type(way).__name__ + str(getattr(way, "substeps", ""))
            print(f"{name}, {made.records.t.size} samples, {kind}: {found['it']:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--joint", action="store_true")
    parser.add_argument("--many", action="store_true")
    parser.add_argument("--steps", action="store_true")
    parser.add_argument("--real", action="store_true")
    options = parser.parse_args()
    print("load of the machine:", os.getloadavg())
    if options.steps:
        steps()
    body, count = rj.Inertia(MOMENTS), options.repeats + 2

    def ours(of, **more):
        return lambda readings: identify.fit(of(readings), **more).starts[0].cost

    def same(of):
        def fit(readings):
            made = of(readings)
            return identify.fit(made, starts=1, initial=start(made, readings)).starts[0].cost

        return fit

    peer = with_numba()
    if options.real:
        thrown = real()
        draws = [thrown[k % len(thrown)] for k in range(count)]
        tasks = {} if peer is None else {"SciPy and numba": lambda draw: peer(*draw[0])}

        def misfit(found):
            # As SciPy counts it, from the noise that was estimated.
            left = found.model.records.size - found.covariance.shape[0]
            return 0.5 * left * float(found.noises[0][0, 0] / SIGMA) ** 2

        tasks["ours from the same start"] = lambda draw: misfit(
            identify.fit(draw[1], starts=1, initial=draw[2])
        )
        tasks["ours blind (8 starts)"] = lambda draw: misfit(identify.fit(draw[1]))
        table("a real throw, 0.5 s, twelve numbers", tasks, draws, "SciPy and numba")
        return
    draws = draws_of(body, law(DRAG), count, 0)
    tasks = {} if peer is None else {"SciPy and numba": peer}

    def prepared(integrator=None):
        built = [problem(readings, integrator) for readings in draws]
        ready = {id(r): (p, start(p, r)) for p, r in zip(built, draws, strict=True)}

        def fit(readings):
            made, begin = ready[id(readings)]
            return identify.fit(made, starts=1, initial=begin).starts[0].cost

        return fit

    tasks |= {
        "ours from the same start": prepared(),
        "ours from the same start, adaptive steps": prepared(identify.Adaptive()),
        "ours from the same start, with making the problem": same(problem),
        "ours from where it begins by itself": ours(problem, starts=1),
        "ours blind (8 starts)": ours(problem),
    }
    table("one throw, 0.7 s, twelve numbers", tasks, draws, "SciPy and numba")
    other = with_mujoco()
    tasks = {} if other is None else {"mujoco.sysid": other}
    tasks["ours from the same start"] = same(driven)
    pushed = draws_of(body, rj.torques.ConstantTorque(TORQUE), min(count, 7), 1)
    table("a known torque, nine numbers", tasks, pushed, "mujoco.sysid")
    cold()
    if options.many:
        recordings()
    if options.joint:
        joint(0)
        joint(24)


if __name__ == "__main__":
    main()
