"""Predictions onward from a fit and from a filter: how many 95 % intervals hold.

    python tests/benchmarks/identify/bench_predictions.py [COUNT]

The recordings are those of the guide's page "Predict with intervals", drawn anew COUNT times. Of the
fit: by time, the share of intervals of the three rates that contain the true rates, by the covariance
(`Fit.interval_of`), and by the weighted draws of `refit`; and the median half-width of Ωx. Of the
filter: the same, of the belief carried on without readings.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import identify

jax.config.update("jax_enable_x64", True)

FREE = rj.Inertia.from_principal(1.0, 1.6, 2.2)
SPUN = rj.Spin([1.0, 0.5, 1.2])
RECORDED = jnp.linspace(0.0, 10.0, 101)
LATER = jnp.array([15.0, 20.0, 40.0, 80.0, 160.0, 320.0])
PUSHED, PUSH = rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.RandomTorque(1e-3)
STEPS = jnp.linspace(0.0, 2.0, 101)
READ = 51  # the readings of the first second; the rest is predicted


def onward(point):
    """The rates at the later times of a fitted body."""
    ts = jnp.concatenate([jnp.zeros(1), LATER])
    return rj.simulate(point.body, point.state0, ts).ys.omega[1:]


def held(ends, truth):
    low, high = ends
    return np.asarray((low <= truth) & (truth <= high))


def show(name, times, shares, widths):
    print(f"\n{name}: time, share of intervals that hold, median half-width of Ωx")
    for when, share, width in zip(
        times, np.mean(shares, (0, 2)), np.median(widths, 0), strict=True
    ):
        print(f"{when:8.2f} s {100 * share:6.1f} % {width:9.4f} rad/s")


def fits(count):
    ts = jnp.concatenate([jnp.zeros(1), LATER])
    truth = rj.simulate(FREE, SPUN, ts).ys.omega[1:]
    by_slope, by_draws, wide, drawn = [], [], [], []
    for seed in range(count):
        key, gyro = jax.random.key(seed), identify.Gyro(0.05)
        rates = identify.simulate_readings(gyro, FREE, SPUN, RECORDED, key=key)
        record = identify.Recording(RECORDED, (gyro, rates))
        found = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)
        best = identify.refit(identify.LogDensity(found))
        for way, hits, widths in ((found, by_slope, wide), (best, by_draws, drawn)):
            low, high = way.interval_of(onward)
            hits.append(held((low, high), truth))
            widths.append(0.5 * (high - low)[:, 0])
    show("covariance and derivative", LATER, by_slope, wide)
    show("weighted draws of refit", LATER, by_draws, drawn)


def filters(count):
    shares, widths = [], []
    for seed in range(count):
        keys = jax.random.split(jax.random.key(seed))
        start = rj.Spin([0.3, 1.0, 0.2])
        real = identify.sample(keys[0], PUSHED, start, STEPS, process=PUSH).states.omega
        read = real + 0.02 * jax.random.normal(keys[1], real.shape)
        record = identify.Recording(STEPS[:READ], (identify.Gyro(0.02), read[:READ]))
        model = identify.Model(record, identify.Known(PUSHED), process=PUSH)
        run = identify.filter(model, identify.first_belief(model, rate=0.1))
        belief = jax.tree.map(lambda leaf: leaf[-1], run.belief)
        hits, halves = [], []
        for k in range(READ + 9, STEPS.size, 10):
            belief = identify.step(model, belief, STEPS[k], jnp.zeros(3), mask=[False])
            reach = 1.96 * belief.deviation
            hits.append(held((belief.state.omega - reach, belief.state.omega + reach), real[k]))
            halves.append(reach[0])
        shares.append(hits)
        widths.append(halves)
    show("filter, without readings from 1 s on", STEPS[READ + 9 :: 10], shares, widths)


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    for part in (filters, fits):
        before = time.process_time()
        part(number)
        print(f"({time.process_time() - before:.0f} s of CPU)")
