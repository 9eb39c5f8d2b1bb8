"""How well the part held out of simulated records is predicted, by models that are right and models that lack a term.

`python tests/benchmarks/identify/bench_held_out.py` prints a line for each kind of record: how many of 10 fits are `ok`
with and without the part held out, the median of held out / fitted, mean and spread of `ratio`, and the median time of a
warm fit over that of a fit with `held_out=False`.
"""

import sys
from time import process_time

import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import identify, torques

DRAG = torques.Damping([0.01, 0.01, 0.01])
TIMES = jnp.linspace(0.0, 0.5, 63)
WHEEL = torques.Flywheel(
    torques.Wheel(1.7e-6, [0, 0, 1], torques.Series(TIMES, 600.0 - 40.0 * TIMES), delay=0.0)
)
PUSH = torques.ConstantTorque([0.02, 0.0, 0.0])
BIAS = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05)


def record(random, sensors, end, count, torque=None, size=3.0, hidden=None, body=None, shown=None):
    """A record of `sensors`, read as `shown` (those without what the model lacks)."""
    body = body or rj.Inertia.from_principal(1.0, random.uniform(1.3, 1.8), 2.1)
    rate = random.normal(size=3)
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], size * rate / np.linalg.norm(rate))
    t, key = jnp.linspace(0.0, end, count), jax.random.key(random.integers(1 << 30))
    values = identify.simulate_readings(sensors, body, start, t, hidden or torque, key=key)
    return identify.Recording(t, *zip(shown or sensors, values, strict=True))


def gyro(noise=0.02, **more):
    return (identify.Gyro(noise, **more),)


def free(record, **more):
    return identify.Model(record, identify.Ratios(), **more)


def throws(random):
    body = rj.Inertia.from_principal(1.0, 1.5, 2.1)
    return free([record(random, gyro(), 2.0, 40, body=body) for _ in range(8)])


def wheel(random, hidden=None):
    body = rj.Inertia.from_principal(2e-4, 3e-4, 4e-4)
    sensors = gyro(0.01, bias=[0.05, -0.03, 0.02]), gyro(0.01, bias=[0.0] * 3)
    read = record(random, sensors[0], 0.5, 63, WHEEL, 8.0, hidden, body, sensors[1])
    return identify.Model(read, identify.Tensor(3e-4), torque=WHEEL, free=[BIAS])


def windows(random):
    t = np.arange(400) / 20
    run = record(random, gyro(), 20.0 - 0.05, 400, body=rj.Inertia.from_principal(1.0, 1.5, 2.1))
    rates = rj.Spin(run.readings[0].values)
    deviations = dict(noise={"omega": 0.02}, starts={"omega": 0.02})
    return free(identify.windows(t, rates, length=8, stride=8, **deviations))


RIGHT = {
    "free, 120 rates in 4 s": lambda r: free(record(r, gyro(), 4.0, 120)),
    "the same, noise estimated": lambda r: free(
        record(r, gyro(), 4.0, 120, shown=(identify.Gyro(),))
    ),
    "free, 60 rates in 1 s": lambda r: free(record(r, gyro(), 1.0, 60)),
    "free, 400 rates in 40 s": lambda r: free(record(r, gyro(), 40.0, 400)),
    "rates and attitudes": lambda r: free(
        record(r, (*gyro(), identify.AttitudeSensor(0.01)), 4.0, 120)
    ),
    "eight throws": throws,
    "a wheel and a bias": wheel,
    "windows": windows,
}
LACKING = {
    "drag is left out": lambda r: free(record(r, gyro(), 4.0, 120, hidden=DRAG)),
    "drag, noise estimated": lambda r: free(
        record(r, gyro(), 4.0, 120, hidden=DRAG, shown=(identify.Gyro(),))
    ),
    "a bias of 0.03 is left out": lambda r: free(
        record(r, gyro(bias=[0.03, -0.02, 0.025]), 6.0, 300, shown=gyro())
    ),
    "a push is left out": lambda r: free(
        record(r, (*gyro(), identify.AttitudeSensor(0.01)), 4.0, 120, hidden=PUSH)
    ),
}


def main(many=10):
    for lacking, kinds in enumerate((RIGHT, LACKING)):
        print("models that lack a term" if lacking else "models that are right")
        for name, make in kinds.items():
            rows, ok = [], np.zeros(2, int)
            for seed in range(many):
                model = make(np.random.default_rng(1000 * lacking + seed))
                fits, times = [], np.zeros(2)
                for _ in range(1 + (seed > 0)):  # the first record compiles
                    for index, held_out in enumerate((True, False)):
                        begin = process_time()
                        fits.append(identify.fit(model, starts=2, held_out=held_out))
                        times[index] = process_time() - begin
                both, plain = fits[:2]
                ok += [both.ok, plain.ok]
                if both.held_out is None:  # its search did not end
                    continue
                pair = both.held_out.pairs[0]
                rows.append([pair.held_out / pair.fitted, both.held_out.ratio, times[0] / times[1]])
            raw, ratio, time = np.array(rows).T
            print(
                f"{name:28} ok {ok[0]:3} (without {ok[1]:3}) of {many}, held out / fitted "
                f"{np.median(raw):.3f}, ratio {ratio.mean():.3f} ± {ratio.std():.3f}, "
                f"time {np.median(time[1:]):.2f}",
                flush=True,
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(*map(int, sys.argv[1:]))
