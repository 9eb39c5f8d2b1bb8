"""Throws with time stamps that scatter: a plain gyro beside one that expects it.

    python tests/benchmarks/identify/bench_jitter.py [COUNT]

Each throw is 1 s at 100 Hz and 8 rad/s; the gyro has a noise of 0.02 rad/s, its stamps scatter by 5
ms (`none`: a regular clock). Readings are made at the scattered times by SciPy's `solve_ivp`. Per
set-up: how many fits are `ok`, the rms errors of log Ix/Iz and log Iy/Iz, how many 95 % intervals
hold.
"""

import sys

import jax
import numpy as np
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)

from rigidjax import identify

MOMENTS, TS, SIGMA, TAU = np.array([1.0, 1.6, 2.1]), np.linspace(0.0, 1.0, 101), 0.02, 5e-3
TRUTH = MOMENTS[:2] / MOMENTS[2]
WAYS = {
    "plain gyro": lambda: identify.Gyro(SIGMA),
    "jitter known": lambda: identify.Gyro(SIGMA, jitter=TAU),
    "jitter known, noise estimated": lambda: identify.Gyro(jitter=TAU),
}


def throw(seed, tau):
    """The readings (T, 3) of a throw, each at a time of its own."""
    rng = np.random.default_rng(seed)
    omega = rng.normal(size=3)
    omega *= 8.0 / np.linalg.norm(omega)

    def field(_, w):
        return np.cross(MOMENTS * w, w) / MOMENTS

    way = dict(method="DOP853", rtol=1e-11, atol=1e-11, dense_output=True)
    parts = [solve_ivp(field, (0.0, end), omega, **way).sol for end in (-0.1, 1.1)]
    at = TS + tau * rng.normal(size=TS.size)
    rates = np.where(at < 0, parts[0](np.minimum(at, 0.0)), parts[1](np.maximum(at, 0.0))).T
    return rates + SIGMA * rng.normal(size=rates.shape)


def main(count=120):
    for tau in (TAU, 0.0):
        print(f"\nstamps that scatter by {1e3 * tau:.0f} ms, {count} throws")
        records = [throw(seed, tau) for seed in range(count)]
        for name, gyro in WAYS.items():
            if tau == 0.0 and "jitter" in name:
                continue
            errors, held, good = [], [], 0
            for rates in records:
                record = identify.Recording(TS, (gyro(), rates))
                found = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)
                ends = np.array([found.interval()[f"{axis}/Iz"] for axis in ("Ix", "Iy")])
                errors.append(np.log([q.value for q in found.quantities[:2]] / TRUTH))
                held.append((ends[:, 0] <= TRUTH) & (ends[:, 1] >= TRUTH))
                good += found.ok
            rms = np.sqrt(np.mean(np.square(errors), axis=0))
            print(
                f"{name}: ok {good}, rms {rms[0]:.4f} and {rms[1]:.4f}, hold "
                f"{100 * np.mean(held, axis=0)[0]:.0f} and {100 * np.mean(held, axis=0)[1]:.0f} %"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
