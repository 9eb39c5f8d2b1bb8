"""What the filter and the smoother cost: `python tests/benchmarks/identify/filtering/bench_filter.py [readings]`.

A tumbling body under a white torque, read by a gyro (3 numbers of state), and by a gyro and a
direction (6). Beside them an extended Kalman filter for the gyro written by hand, its loops compiled
by numba where that is installed: one classical Runge–Kutta step with its Jacobian between readings,
the covariance in Joseph's form. CPU seconds, medians of five interleaved repeats, compiling apart.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import identify

jax.config.update("jax_enable_x64", True)

MOMENTS, DENSITY, NOISE, DT = (1.0, 2.0, 2.5), 1e-4, 0.02, 0.01
START = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, 1.0, 0.2])
SUN = np.array([0.0, 0.6, 0.8])


def scene(count):
    """The models of a recording of the gyro alone, and of one with the direction."""
    body, process = rj.Inertia.from_principal(*MOMENTS), rj.torques.RandomTorque(DENSITY)
    keys = jax.random.split(jax.random.key(0), 3)
    ts = DT * jnp.arange(count, dtype=float)
    real = identify.sample(keys[0], body, START, ts, process=process)
    rates = real.states.omega + NOISE * jax.random.normal(keys[1], (count, 3))
    seen = jax.vmap(lambda q: rj.quaternion.rotate_inverse(q, jnp.asarray(SUN)))(real.states.q)
    seen = seen + NOISE * jax.random.normal(keys[2], (count, 3))
    seen = seen / jnp.linalg.norm(seen, axis=-1, keepdims=True)
    gyro = (identify.Gyro(NOISE), rates)
    records = (
        identify.Recording(ts, gyro),
        identify.Recording(ts, gyro, (identify.Direction(SUN, NOISE), seen)),
    )
    return [identify.Model(one, identify.Known(body), process=process) for one in records]


def by_hand():
    """The filter for a gyro in NumPy, compiled by numba; `None` without it."""
    try:
        import numba
    except ImportError:
        return None

    @numba.njit(fastmath=True)
    def product(a, b, out):
        for i in range(3):
            for j in range(3):
                out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]

    @numba.njit(fastmath=True)
    def run(readings, dt, moments, density, noise, first, spread):
        count = len(readings)
        means, total = np.empty((count, 3)), 0.0
        k, dk = np.empty((4, 3)), np.empty((4, 3, 3))
        a, y, dy = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
        w, p, gain = first.copy(), spread.copy(), np.empty(3)
        grown, left, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        node = (0.0, 0.5, 0.5, 1.0)
        weight = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
        one = np.eye(3)
        for n in range(count):
            if n:
                for s in range(4):
                    for i in range(3):
                        y[i] = w[i] + node[s] * dt * k[s - 1, i] if s else w[i]
                        for j in range(3):
                            dy[i, j] = one[i, j]
                            if s:
                                dy[i, j] += node[s] * dt * dk[s - 1, i, j]
                    for i in range(3):
                        j, m = (i + 1) % 3, (i + 2) % 3
                        c = (moments[j] - moments[m]) / moments[i]
                        k[s, i] = c * y[j] * y[m]
                        a[i, j], a[i, m] = c * y[m], c * y[j]
                    product(a, dy, dk[s])
                for i in range(3):
                    for j in range(3):
                        grown[i, j] = one[i, j]
                    for s in range(4):
                        w[i] += dt * weight[s] * k[s, i]
                        for j in range(3):
                            grown[i, j] += dt * weight[s] * dk[s, i, j]
                product(grown, p, half)
                product(half, grown.T, p)
                for i in range(3):
                    p[i, i] += dt * density / moments[i] ** 2
            # The gyro's axes one after another: no matrix is inverted.
            for i in range(3):
                variance = p[i, i] + noise * noise
                innovation = readings[n, i] - w[i]
                for j in range(3):
                    gain[j] = p[j, i] / variance
                for j in range(3):
                    w[j] += gain[j] * innovation
                    for m in range(3):
                        left[j, m] = one[j, m] - (gain[j] if m == i else 0.0)
                product(left, p, half)
                product(half, left.T, p)
                for j in range(3):
                    for m in range(3):
                        p[j, m] += noise * noise * gain[j] * gain[m]
                total -= 0.5 * (innovation**2 / variance + np.log(2 * np.pi * variance))
            means[n] = w
        return means, total

    return run


def cost(calls):
    """CPU seconds of the first call and of the next ones, calls interleaved."""
    first, rest = {}, {name: [] for name in calls}
    for name, call in calls.items():
        begin = time.process_time()
        jax.block_until_ready(call())
        first[name] = time.process_time() - begin
    for _ in range(5):
        for name, call in calls.items():
            begin = time.process_time()
            jax.block_until_ready(call())
            rest[name].append(time.process_time() - begin)
    return {name: (first[name], float(np.median(rest[name]))) for name in calls}


def main(count):
    alone, both = scene(count)
    spin = identify.first_belief(alone, rate=0.1)
    pose = identify.first_belief(both, state=START, rate=0.1, attitude=0.1)
    calls = {
        "filter, gyro": lambda: identify.filter(alone, spin).states.omega,
        "filter, gyro and direction": lambda: identify.filter(both, pose).states.omega,
        "log-likelihood, gyro": lambda: identify.log_likelihood(alone, spin),
        "smoother, gyro": lambda: identify.smooth(alone, spin).states.omega,
        "smoother, gyro and direction": lambda: identify.smooth(both, pose).states.omega,
    }
    hand = by_hand()
    if hand is not None:
        readings = np.asarray(alone.recording.readings[0].values)
        first = np.asarray(spin.x.motion.omega), np.asarray(spin.root @ spin.root.T)
        calls["numba, gyro"] = lambda: hand(readings, DT, np.array(MOMENTS), DENSITY, NOISE, *first)
    found = cost(calls)
    print(f"{count} readings; CPU seconds: first call (compiling included), next calls")
    for name, (one, more) in found.items():
        print(f"{name:32}{one:8.2f}{more:10.3f}")

    if hand is not None:
        means, total = calls["numba, gyro"]()
        ours = identify.filter(alone, spin)
        apart = np.abs(np.asarray(ours.states.omega) - means).max()
        print(f"rates differ by {apart:.1e} at most, log-likelihoods by "
              f"{abs(float(ours.log_likelihood) - total):.1e} of {total:.0f}")  # fmt: skip
    for name, model, first in (("gyro", alone, spin), ("gyro and direction", both, pose)):
        print(f"smoother, {name}: {int(identify.smooth(model, first).iterations)} iterations")
    belief, reading = spin, alone.recording.readings[0].values[1]
    step = jax.jit(lambda belief, t, value: identify.step(alone, belief, t, value))
    jax.block_until_ready(step(belief, DT, reading).root)
    times = []
    for _ in range(5):
        begin = time.process_time()
        for k in range(1000):
            belief = step(belief, DT * (k + 1), reading)
        jax.block_until_ready(belief.root)
        belief = spin
        times.append((time.process_time() - begin) / 1000)
    print(f"one reading at a time, compiled: {1e6 * np.median(times):.0f} µs")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
