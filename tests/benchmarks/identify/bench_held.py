"""Twelve tools in a robot's hand (`shared/data/held_tools`): errors, intervals and times.

    python tests/benchmarks/identify/bench_held.py [SEEDS] [--poses]

Each tool is fitted from its exact record, then SEEDS times (5) at each of three noises: 0.05 N and
0.0025 N m, twice, four times. A line for each noise: the median over tools and seeds of the largest
error of a principal moment over the largest moment; how many 95 % intervals hold, of mass, centre
and the six components, and of the sorted moments as reported; bodies that are possible; times of
warm fits. A light tool is one below 0.15 kg. `--poses`: the motion is known from poses alone,
whose noise is 0.1 mm and 0.02°.
"""

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify

FOLDER = Path(__file__).parents[4] / "shared" / "data" / "held_tools"
NOISE = np.repeat([0.05, 0.0025], 3)
GRAVITY = [0.0, 0.0, 9.81]  # z points down in these records
LEVELS = 1, 2, 4
CHART = identify.Mass(rj.shapes.box(1.0, [0.1, 0.1, 0.1]))
NAMES = ["mass", *(f"com {k}" for k in "xyz"), "Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy"]
MOMENTS = ["I1", "I2", "I3"]


def columns(table, names):
    return np.stack([table[name] for name in names.split()], axis=1)


def motion_of(table, random):
    """The motion as logged, or for `random` that of noisy poses alone."""
    t, x, q = table["t"], columns(table, "x y z"), columns(table, "qw qx qy qz")
    q = q / np.linalg.norm(q, axis=1)[:, None]
    if random is None:
        rates = (columns(table, names) for names in ("wx wy wz", "ax ay az", "alx aly alz"))
        return rj.torques.LoggedMotion(t, x, q, *rates)
    turned = Rotation.from_rotvec(np.deg2rad(0.02) * random.normal(size=x.shape))
    q = (Rotation.from_quat(q, scalar_first=True) * turned).as_quat(scalar_first=True)
    return rj.torques.LoggedMotion.from_poses(t, x + 1e-4 * random.normal(size=x.shape), q)


def fitted(t, motion, readings, noise):
    """The fit, and its time without the making of the model."""
    sensor = identify.ForceTorque(noise, gravity=GRAVITY)
    record = identify.Recording(t, (sensor, readings), inputs={"motion": motion})
    model = identify.Model(record, CHART, torque=rj.torques.Carried())
    begin = time.perf_counter()
    return identify.fit(model), time.perf_counter() - begin


def truth_of(one):
    tensor = np.array(one["tensor_about_com_sensor_axes"])
    six = [tensor[k] for k in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))]
    return dict(
        zip(NAMES + MOMENTS, [one["mass"], *one["com"], *six, *one["moments"]], strict=True)
    )


def main(seeds, poses):
    everything, out = json.loads((FOLDER / "truth.json").read_text()), []
    for number, (name, one) in enumerate(sorted(everything.items())):
        table = np.genfromtxt(FOLDER / f"{name}.csv", delimiter=",", names=True)
        truth, exact = truth_of(one), columns(table, "fx fy fz tx ty tz")
        logged = motion_of(table, None)
        fit, _ = fitted(table["t"], logged, exact, NOISE)
        off = {q.name: abs(q.value - truth[q.name]) for q in fit.quantities}
        tensor = max(off[k] for k in NAMES[4:]) / truth["I3"]
        com = max(off[k] for k in NAMES[1:4])
        print(
            f"{name}, exact: mass {off['mass']:.0e} kg, com {com:.0e} m, tensor {tensor:.0e} of I3"
        )
        for level, seed in ((level, seed) for level in LEVELS for seed in range(seeds)):
            random = np.random.default_rng([number, level, seed])
            noise = level * NOISE
            motion = motion_of(table, random) if poses else logged
            readings = exact + noise * random.normal(size=exact.shape)
            fit, wall = fitted(table["t"], motion, readings, noise)
            held = {k: low <= truth[k] <= high for k, (low, high) in fit.interval(0.95).items()}
            error = np.abs(np.asarray(fit.body.inertia.moments) - one["moments"]).max()
            possible = np.linalg.eigvalsh(fit.body.second_moment).min() > -1e-12
            out.append(
                (level, one["mass"] < 0.15, error / truth["I3"], np.mean([held[k] for k in NAMES]),
                 np.mean([held[k] for k in MOMENTS]), possible, fit.ok, wall)
            )  # fmt: skip
        print(f"  {len(out)} fits", flush=True)
    rows = np.array(out, float)
    for level in LEVELS:
        light, error, ten, three, possible, ok, wall = rows[rows[:, 0] == level, 1:].T
        print(
            f"noise × {level}: error {np.median(error):.1%}; held: ten numbers {ten.mean():.1%} "
            f"(light tools {ten[light > 0].mean():.1%}), I1 I2 I3 {three.mean():.1%}; possible "
            f"{possible.mean():.0%}, ok {ok.mean():.0%}; {1e3 * np.median(wall):.0f} ms, 90 % "
            f"below {1e3 * np.quantile(wall, 0.9):.0f}"
        )


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    main(numbers[0] if numbers else 5, "--poses" in sys.argv)
