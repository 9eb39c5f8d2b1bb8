"""How often the intervals of a fit of windows hold, where errors last and windows overlap.

    python tests/benchmarks/identify/bench_window_intervals.py [--records 150] [--samples 801]

A driven, damped body (four free numbers) whose rates are read with white noise, alone and with an
unknown torque that is correlated over 1 s or 4 s, as large as a tenth of the driving one. Each row
cuts every record into windows of so many samples, one every so many. Shown: the share of 95 %
intervals that hold, and the rms of the deviations over that of the errors.
"""

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[2] / "identify"))

from test_windows import BODY, DAMPING, GAIN, TRUE, H, Push

import rigidjax as rj
from rigidjax import identify, torques

NOISE, SIZE = 2e-3, 0.1
START = np.array([0.5, 1.0, -0.4])


@jax.jit
def motion(u, unknown):
    law = torques.Sum(Push(**TRUE), Push(jnp.ones(3), 0.0, torques.Input("unknown")))
    one = rj.Spin(jnp.asarray(START)[None])
    given = {"u": u[None], "unknown": unknown[None]}
    return rj.batch.rollout(BODY, one, H, u.size, law, inputs=given, save_every=1).omega[0]


def record(samples, memory, seed):
    """Times, rates and input of one record; the torque is correlated over `memory` s, 0 for none."""
    rng = np.random.default_rng(seed)
    u = np.cos(0.3 * np.arange(samples)) + rng.normal(size=samples)
    unknown = np.zeros((samples, 3))
    if memory:
        keep, draws = np.exp(-H / memory), rng.normal(size=(samples, 3))
        unknown[0] = draws[0]
        for i in range(1, samples):
            unknown[i] = keep * unknown[i - 1] + np.sqrt(1 - keep**2) * draws[i]
    rates = np.concatenate([START[None], motion(jnp.asarray(u[:-1]), SIZE * unknown[:-1])])
    return H * np.arange(samples), rates + NOISE * rng.normal(size=rates.shape), u


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=150)
    parser.add_argument("--samples", type=int, default=801)
    options = parser.parse_args()
    truth = np.append(TRUE["gain"], TRUE["damping"])
    for memory in (0.0, 1.0, 4.0):
        for length, stride in ((8, 8), (8, 2), (25, 5)):
            held, deviations, errors = [], [], []
            for seed in range(options.records):
                t, rates, u = record(options.samples, memory, seed)
                cut = identify.windows(t, rj.Spin(rates), {"u": u}, length=length, stride=stride)
                body, free = identify.Known(BODY), [GAIN, DAMPING]
                model = identify.Model(cut, body, torque=Push(**TRUE), free=free)
                numbers = identify.fit(model).quantities
                low, high = np.transpose([one.interval() for one in numbers])
                held.append((low < truth) & (truth < high))
                deviations.append([one.deviation for one in numbers])
                errors.append([one.value for one in numbers] - truth)
            ratio = np.sqrt(np.mean(np.square(deviations), 0) / np.mean(np.square(errors), 0))
            print(
                f"torque over {memory:g} s, windows of {length} every {stride}: "
                f"{np.mean(held):.3f} hold (gains, damping: {np.mean(held, 0).round(2)}); "
                f"deviations over errors {ratio.round(2)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
