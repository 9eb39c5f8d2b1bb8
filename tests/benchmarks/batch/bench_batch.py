"""Many bodies: body-steps a second beside C++, numba, naive scans, diffrax and MJX, in one process.

Run `python tests/benchmarks/batch/bench_batch.py [--quick] [--float32] [--flag] [--devices 2] [--any-core]
[--numba-python /venv/bin/python]`.
Everything is timed in turn, round after round, on one pinned core, as processor time (on a GPU as
wall time); medians are printed, and ratios to the first row of each table. Compilation is apart.
What is not installed is left out and says so. `--flag` starts again with XLA's flag for small loops;
`--devices 2` compares one device with two, in wall time, on as many cores.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rigidjax.motion.equations import AttitudeEquations

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("--quick", action="store_true", help="1e3 bodies, fewer rounds")
parser.add_argument("--float32", action="store_true")
parser.add_argument("--flag", action="store_true", help="with the process-wide XLA flag")
parser.add_argument("--devices", type=int, default=1)
parser.add_argument("--any-core", action="store_true", help="do not pin to one core")
parser.add_argument("--numba-python", default=sys.executable, help="an interpreter that has numba")
parser.add_argument("--bodies", type=int, nargs="*", default=None)
OPTIONS = parser.parse_args()
FLAG = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"
if OPTIONS.flag and FLAG not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAG}".strip()
if OPTIONS.devices > 1:
    count = f"--xla_force_host_platform_device_count={OPTIONS.devices}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {count}".strip()
elif not OPTIONS.any_core and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

jax.config.update("jax_enable_x64", True)

import rigidjax as rj

DTYPE = jnp.float32 if OPTIONS.float32 else jnp.float64
H, STEPS = 0.01, 1000
ROUNDS = 5 if OPTIONS.quick else 7
ON_CPU = jax.default_backend() == "cpu"
CLOCK = time.process_time if ON_CPU and OPTIONS.devices == 1 else time.perf_counter

CPP = r"""
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>
typedef REAL real;
// Classical Runge-Kutta on (q, Omega), structure of arrays, all steps of a block before the next.
static const int W = 64;
static inline void slope(const real* r, const real* y, real* k) {
  real a = real(.5)*y[4], b = real(.5)*y[5], c = real(.5)*y[6];
  k[0] = -y[1]*a - y[2]*b - y[3]*c; k[1] = y[0]*a + y[2]*c - y[3]*b;
  k[2] = y[0]*b + y[3]*a - y[1]*c;  k[3] = y[0]*c + y[1]*b - y[2]*a;
  k[4] = r[0]*y[5]*y[6]; k[5] = r[1]*y[6]*y[4]; k[6] = r[2]*y[4]*y[5];
}
int main(int argc, char** argv) {
  long n = atol(argv[1]), steps = atol(argv[2]);
  const real h = real(0.01);
  std::vector<real> y(7*n), r(3*n);
  for (long i = 0; i < n; i++) {
    real I0 = 1 + real(.9)*(i%97)/97, I1 = 1 + real(.9)*(i%89)/89, I2 = 1 + real(.9)*(i%83)/83;
    r[i] = (I1-I2)/I0; r[n+i] = (I2-I0)/I1; r[2*n+i] = (I0-I1)/I2;
    y[i] = 1; y[4*n+i] = real(.6); y[5*n+i] = real(.7); y[6*n+i] = real(.4);
  }
  clock_t begin = clock();
  for (long block = 0; block < n; block += W) {
    real Y[7][W], R[3][W];
    int m = n - block < W ? n - block : W;
    for (int j = 0; j < 7; j++) for (int i = 0; i < W; i++) Y[j][i] = y[j*n + block + (i < m ? i : 0)];
    for (int j = 0; j < 3; j++) for (int i = 0; i < W; i++) R[j][i] = r[j*n + block + (i < m ? i : 0)];
    for (long s = 0; s < steps; s++) {
#pragma GCC ivdep
      for (int i = 0; i < W; i++) {
        real x[7], z[7], k[7], sum[7], c[3] = {R[0][i], R[1][i], R[2][i]};
        for (int j = 0; j < 7; j++) x[j] = Y[j][i];
        slope(c, x, k);
        for (int j = 0; j < 7; j++) { sum[j] = k[j]; z[j] = x[j] + real(.5)*h*k[j]; }
        slope(c, z, k);
        for (int j = 0; j < 7; j++) { sum[j] += 2*k[j]; z[j] = x[j] + real(.5)*h*k[j]; }
        slope(c, z, k);
        for (int j = 0; j < 7; j++) { sum[j] += 2*k[j]; z[j] = x[j] + h*k[j]; }
        slope(c, z, k);
        for (int j = 0; j < 7; j++) Y[j][i] = x[j] + h/6*(sum[j] + k[j]);
      }
    }
    for (int j = 0; j < 7; j++) for (int i = 0; i < m; i++) y[j*n + block + i] = Y[j][i];
  }
  double seconds = double(clock() - begin)/CLOCKS_PER_SEC, total = 0;
  for (real v : y) total += v;
  printf("%.9f %.9f\n", seconds, total);
}
"""

NUMBA = """
import sys, time
import numba, numpy as np
count, steps, kind = int(sys.argv[1]), int(sys.argv[2]), np.dtype(sys.argv[3])

@numba.njit(fastmath=True)
def run(r, y, steps, h):
    half, sixth, two = h / h / (h / h + h / h), h / h / 6, h / h + h / h
    for block in range(0, y.shape[1], 64):
        for _ in range(steps):
            for i in range(block, min(block + 64, y.shape[1])):
                q0, q1, q2, q3, a, b, c = y[0, i], y[1, i], y[2, i], y[3, i], y[4, i], y[5, i], y[6, i]
                s0 = s1 = s2 = s3 = s4 = s5 = s6 = y[0, i] - y[0, i]
                z0, z1, z2, z3, z4, z5, z6 = q0, q1, q2, q3, a, b, c
STAGES                g = h * sixth
                y[0, i], y[1, i], y[2, i], y[3, i] = q0 + g * s0, q1 + g * s1, q2 + g * s2, q3 + g * s3
                y[4, i], y[5, i], y[6, i] = a + g * s4, b + g * s5, c + g * s6

rng = np.random.default_rng(0)
m = rng.uniform(1, 1.9, (3, count)).astype(kind)
r = (np.roll(m, -1, 0) - np.roll(m, -2, 0)) / m
y = np.concatenate([np.ones((1, count)), np.zeros((3, count)), np.full((3, count), 0.577)]).astype(kind)
run(r, y.copy(), 2, kind.type(0.01))
begin = time.process_time()
run(r, y, steps, kind.type(0.01))
print(time.process_time() - begin)
"""

# Written out, for a loop over stages keeps LLVM from vectors.
STAGE = """
                k0 = -half * (z1 * z4 + z2 * z5 + z3 * z6)
                k1 = half * (z0 * z4 + z2 * z6 - z3 * z5)
                k2 = half * (z0 * z5 + z3 * z4 - z1 * z6)
                k3 = half * (z0 * z6 + z1 * z5 - z2 * z4)
                k4, k5, k6 = r[0, i] * z5 * z6, r[1, i] * z6 * z4, r[2, i] * z4 * z5
                w = WEIGHT
                s0, s1, s2, s3 = s0 + w * k0, s1 + w * k1, s2 + w * k2, s3 + w * k3
                s4, s5, s6 = s4 + w * k4, s5 + w * k5, s6 + w * k6
                f = h * FRACTION
                z0, z1, z2, z3 = q0 + f * k0, q1 + f * k1, q2 + f * k2, q3 + f * k3
                z4, z5, z6 = a + f * k4, b + f * k5, c + f * k6
"""
ONE = "(two * half)"
STAGES = "".join(
    STAGE.replace("WEIGHT", weight).replace("FRACTION", fraction)
    for weight, fraction in ((ONE, "half"), ("two", "half"), ("two", ONE), (ONE, ONE))
)
NUMBA = NUMBA.replace("STAGES", STAGES)


def data(count, dtype=None):
    dtype = DTYPE if dtype is None else dtype
    rng = np.random.default_rng(0)
    moments, omega = rng.uniform(1.0, 1.9, (count, 3)), rng.normal(size=(count, 3))
    omega /= np.linalg.norm(omega, axis=1)[:, None]
    tensor = moments[:, None, :] * np.eye(3)
    q = np.tile([1.0, 0, 0, 0], (count, 1))
    array = lambda a: jnp.asarray(a, dtype)
    return rj.Inertia(array(tensor)), rj.Attitude(array(q), array(omega))


def compiled_cpp():
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp())
    (folder / "rk4.cpp").write_text(CPP)
    subprocess.run(
        [compiler, "-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512",
         f"-DREAL={'float' if OPTIONS.float32 else 'double'}", str(folder / "rk4.cpp"),
         "-o", str(folder / "rk4")],
        check=True,
    )  # fmt: skip

    def run(count):
        out = subprocess.run(
            [str(folder / "rk4"), str(count), str(STEPS)],
            check=True,
            capture_output=True,
            text=True,
        )
        return float(out.stdout.split()[0])

    return run


def timed(call):
    """Seconds of one call, after one that compiles."""
    jax.block_until_ready(call())

    def once():
        begin = CLOCK()
        jax.block_until_ready(call())
        return CLOCK() - begin

    return once


def table(title, rows, work):
    """Rows of (name, a function that gives seconds, its share of the work); in turn, medians."""
    found = {name: [] for name, _, _ in rows}
    for _ in range(ROUNDS):
        for name, once, _ in rows:
            found[name].append(once())
    print(f"\n{title}")
    first = None
    for name, _, share in rows:
        rate = share * work / np.median(found[name]) / 1e6
        first = rate if first is None else first
        print(f"  {name:44s} {rate:10.2f} M/s   {rate / first:8.3f}", flush=True)


def naive(bodies, states):
    """vmap(scan) of a Runge-Kutta step on arrays of 7 numbers."""
    moments = jnp.diagonal(bodies.tensor, axis1=1, axis2=2)
    ratios = (jnp.roll(moments, -1, 1) - jnp.roll(moments, -2, 1)) / moments

    def slope(ratios, y):
        q, o = y[:4], y[4:]
        rate = rj.quaternion.rate(q, o)
        return jnp.concatenate([rate, ratios * jnp.roll(o, -1) * jnp.roll(o, -2)])

    def one(ratios, y):
        def step(y, _):
            a = slope(ratios, y)
            b = slope(ratios, y + 0.5 * H * a)
            c = slope(ratios, y + 0.5 * H * b)
            d = slope(ratios, y + H * c)
            return y + H / 6 * (a + 2 * (b + c) + d), None

        return lax.scan(step, y, None, length=STEPS)[0]

    start = jnp.concatenate([states.q, states.omega], axis=1)
    run = jax.jit(jax.vmap(one))
    return lambda: run(ratios, start)


def plain_diffrax(bodies, states, steps):
    def one(body, state):
        return dfx.diffeqsolve(
            dfx.ODETerm(AttitudeEquations(body)), dfx.Tsit5(), 0.0, H * steps, H, state,
            stepsize_controller=dfx.ConstantStepSize(), max_steps=steps + 1,
        ).ys  # fmt: skip

    run = jax.jit(jax.vmap(one))
    return lambda: run(bodies, states)


def numba_run(count):
    """Seconds of the same in numba, in a process of its own."""
    python = OPTIONS.numba_python
    if subprocess.run([python, "-c", "import numba"], capture_output=True).returncode:
        return None

    def run():
        arguments = [str(count), str(STEPS), np.dtype(DTYPE).name]
        out = subprocess.run(
            [python, "-c", NUMBA, *arguments], check=True, capture_output=True, text=True
        )
        return float(out.stdout)

    return run


def mjx_run(count, steps):
    try:
        import mujoco
        from mujoco import mjx
    except ImportError:
        return None
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.01" gravity="0 0 0" integrator="RK4"/><worldbody><body>'
        '<freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1.3 1.7"/></body></worldbody></mujoco>'
    )
    there = mjx.put_model(model)
    start = mjx.make_data(there)

    @jax.jit
    def run(rates):
        def one(rate):
            begin = start.replace(qvel=start.qvel.at[3:].set(rate.astype(start.qvel.dtype)))
            return lax.scan(lambda d, _: (mjx.step(there, d), None), begin, None, length=steps)[
                0
            ].qpos

        return jax.vmap(one)(rates)

    rates = data(count)[1].omega
    return lambda: run(rates)


TOP = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
GYROSTAT = rj.torques.Sum(
    rj.torques.Damping([0.01, 0.01, 0.01]), rj.torques.Flywheel([0.0, 0.0, 0.3])
)


def throughput(count, cpp):
    bodies, states = data(count)
    run = lambda *more, **kw: lambda: rj.batch.rollout(bodies, states, H, STEPS, *more, **kw)
    kutta = rj.solvers.RungeKutta4()
    work = count * STEPS
    rows = (
        [("C++ RK4, -O3 -march=native -ffast-math", lambda: cpp(count), 1)]
        if cpp and ON_CPU
        else []
    )
    rows += [
        ("rj.batch.rollout, free (Magnus4)", timed(run()), 1),
        ("rj.batch.rollout, free (RungeKutta4)", timed(run(solver=kutta)), 1),
        ("rj.batch.rollout, gyrostat with damping", timed(run(GYROSTAT)), 1),
        ("rj.batch.rollout, heavy top", timed(run(TOP)), 1),
    ]
    other = numba_run(count) if ON_CPU else None
    if other is None:
        print("numba: absent, or not on a CPU")
    else:
        rows.append(("numba RK4, blocks of 64", other, 1))
    rows.append(("naive vmap(scan), RK4", timed(naive(bodies, states)), 1))
    few = 50 if ON_CPU else STEPS
    rows.append(
        ("diffrax vmap, Tsit5, equal steps", timed(plain_diffrax(bodies, states, few)), few / STEPS)
    )
    peer = mjx_run(count, few)
    if peer is None:
        print("MJX: absent")
    else:
        rows.append(("MJX RK4", timed(peer), few / STEPS))
    table(f"{count} bodies, {STEPS} steps of {H}, {np.dtype(DTYPE)}: body-steps", rows, work)


def accuracy():
    bodies, states = data(1024)
    wide = data(1024, jnp.float64)
    truth = jax.jit(jax.vmap(lambda b, s: rj.exact.free_body(b, s, H * STEPS)))(*wide)
    print(f"\nError of the attitude at T = {H * STEPS:g}, rad (median, largest)")
    for name, method in (("Magnus4", None), ("RungeKutta4", rj.solvers.RungeKutta4())):
        end = rj.batch.rollout(bodies, states, H, STEPS, solver=method)
        q = end.q.astype(jnp.float64)
        off = 2 * jnp.linalg.norm(q - truth.q, axis=1)
        print(f"  {name:44s} {jnp.median(off):10.1e} {off.max():10.1e}")


def closed_form(count):
    bodies, states = data(count)
    cases = [(f"T = {end:g}", timed(lambda end=end: rj.batch.simulate(bodies, states, [0.0, end]).ys), 1)
             for end in (1.0, 100.0, 1e4)]  # fmt: skip
    found = {name: [] for name, _, _ in cases}
    for _ in range(ROUNDS):
        for name, once, _ in cases:
            found[name].append(once())
    print(f"\nClosed form, {count} bodies, start and one time: µs a body")
    for name, _, _ in cases:
        print(f"  {name:44s} {np.median(found[name]) / count * 1e6:10.3f}")


def adaptive(count):
    bodies, states = data(count)
    small = min(count, 512)
    few = jax.tree.map(lambda a: a[:small], (bodies, states))

    def plain(body, state):
        field = AttitudeEquations(body, TOP)
        return dfx.diffeqsolve(
            dfx.ODETerm(field), dfx.Dopri8(), 0.0, 10.0, None, state,
            stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-12),
        ).ys  # fmt: skip

    run = jax.jit(jax.vmap(plain))
    rows = [
        ("rj.batch.simulate, heavy top to T = 10", timed(lambda: rj.batch.simulate(
            bodies, states, [0.0, 10.0], TOP, rtol=1e-9, atol=1e-12).ys), 1),
        ("diffrax vmap, Dopri8", timed(lambda: run(*few)), small / count),
    ]  # fmt: skip
    table(f"Adaptive at 1e-9, {count} bodies: bodies", rows, count)


def gradients(count):
    bodies, states = data(count)

    def loss(tensor, states, torque):
        end = rj.batch.rollout(rj.Inertia(tensor), states, H, STEPS, torque)
        return jnp.sum(end.q**2 * jnp.arange(1.0, 5.0, dtype=DTYPE)[None]) + jnp.sum(end.omega)

    print(f"\nValue and gradient by inertia and start, {count} bodies x {STEPS} steps")
    cases = []
    options = rj.batch.compiler_options()
    for name, torque in (("free", None), ("gyrostat", GYROSTAT), ("heavy top", TOP)):
        both = lambda tensor, states, torque=torque: jax.value_and_grad(
            lambda t, s: loss(t, s, torque), (0, 1)
        )(tensor, states)
        begin = time.perf_counter()
        run = jax.jit(both, compiler_options=options).lower(bodies.tensor, states).compile()
        compiling = time.perf_counter() - begin
        memory = run.memory_analysis().temp_size_in_bytes / 1e6
        once = timed(lambda run=run: run(bodies.tensor, states))
        cases.append((name, once, compiling, memory))
    found = {name: [] for name, *_ in cases}
    for _ in range(ROUNDS):
        for name, once, *_ in cases:
            found[name].append(once())
    for name, _, compiling, memory in cases:
        print(
            f"  {name:44s} {np.median(found[name]) * 1e3:10.1f} ms, {memory:.1f} MB beside in and out, "
            f"compiled in {compiling:.0f} s"
        )


def two_devices(count):
    bodies, states = data(count)
    run = lambda **kw: timed(lambda: rj.batch.rollout(bodies, states, H, STEPS, **kw))
    rows = [("one device", run(), 1), (f"{OPTIONS.devices} devices", run(devices="all"), 1)]
    table(f"{count} free bodies on devices, wall time: body-steps", rows, count * STEPS)


def main():
    device = jax.devices()[0]
    print(f"jax {jax.__version__}, {device.platform} {device.device_kind}, {np.dtype(DTYPE)}")
    print(os.environ.get("XLA_FLAGS", "no XLA_FLAGS") if ON_CPU else "")
    if DTYPE == jnp.float32:
        print("float32: the error of a long run is at least about 5e-6, whatever the step")
    counts = OPTIONS.bodies or ([1000] if OPTIONS.quick else [10_000, 100_000])
    if OPTIONS.devices > 1:
        for count in counts:
            two_devices(count)
        return
    cpp = compiled_cpp() if ON_CPU else None
    if cpp is None:
        print("C++: no compiler, or not on a CPU")
    accuracy()
    for count in counts:
        throughput(count, cpp)
    closed_form(counts[-1])
    if DTYPE == jnp.float64:
        adaptive(min(counts[-1], 10_000))
    gradients(1024)


if __name__ == "__main__":
    sys.exit(main())
