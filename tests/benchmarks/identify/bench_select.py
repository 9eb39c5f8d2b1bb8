"""Select among eight terms in simulated records with 0 to 3 hidden ones: `python bench_select.py
[records] [seconds]`.

In records of 4 s linear drag, quadratic drag and a push are often alike: the criterion of the right
set is then within 6 of that of another, and no method can tell. Records of 10 s tell most of them.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify, torques

LENGTH = float(sys.argv[2]) if len(sys.argv) > 2 else 4.0  # s
TIMES = jnp.linspace(0.0, LENGTH, round(40 * LENGTH))
# The size of a term whose effect is of the order of the body's own motion.
SIZES = {
    "drag": 0.15, "quadratic drag": 0.05, "push": 0.3, "push in space": 0.3, "wheel": 0.3,
    "bias": 0.05, "scale": 0.03, "clock": 0.02,
}  # fmt: skip
FREE = {
    "drag": lambda s: s.torque.parts[0].coefficient,
    "quadratic drag": lambda s: s.torque.parts[1].coefficient,
    "push": lambda s: s.torque.parts[2].torque,
    "push in space": lambda s: s.torque.parts[3].torque,
    "wheel": lambda s: s.torque.parts[4].momentum,
    "bias": lambda s: s.sensors[0].bias,
    "scale": lambda s: s.sensors[0].scale,
    "clock": lambda s: s.sensors[0].offset,
}


def scene(values):
    """Return torque and sensors with the given `values`, zero or one for all others."""
    zero = jnp.zeros(3)
    law = torques.Sum(
        torques.Damping(values.get("drag", zero)),
        torques.QuadraticDamping(values.get("quadratic drag", zero)),
        torques.ConstantTorque(values.get("push", zero)),
        torques.InSpace(values.get("push in space", zero)),
        torques.Flywheel(values.get("wheel", zero)),
    )
    gyro = identify.Gyro(
        noise=0.02,
        bias=values.get("bias", zero),
        scale=1.0 + values.get("scale", zero),
        offset=values.get("clock", 0.0),
    )
    return law, (gyro, identify.AttitudeSensor(noise=0.01))


def record(rng, key):
    """Return a model of a record, and the names of its hidden terms."""
    names = list(rng.choice(list(SIZES), rng.integers(0, 4), replace=False))
    values = {}
    for name in names:
        size = SIZES[name] * rng.uniform(0.5, 1.5, () if name == "clock" else 3)
        values[name] = size if "drag" in name else size * rng.choice([-1, 1], np.shape(size))
    moments = [1.0, rng.uniform(1.3, 1.8), rng.uniform(1.9, 2.2)]
    spin = rng.normal(size=3)
    spin *= rng.uniform(2, 5) / np.linalg.norm(spin)
    law, sensors = scene(values)
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], spin)
    body = rj.Inertia.from_principal(*moments)
    readings = identify.simulate_readings(sensors, body, start, TIMES, law, key=key)
    law, sensors = scene({})
    recording = identify.Recording(TIMES, *zip(sensors, readings, strict=True))
    return identify.Model(recording, identify.Ratios(), torque=law), set(names)


def main(count):
    """Print how often the right terms are selected."""
    free = {n: identify.Free(FREE[n], n, scale=size) for n, size in SIZES.items()}
    right = told = 0
    took = []
    for seed in range(count):
        model, names = record(np.random.default_rng(seed), jax.random.key(seed))
        begin = time.process_time()
        found = identify.select(model, free, starts=2)
        took.append(time.process_time() - begin)
        right += set(found.terms) == names
        # Each hidden term is selected, or named as what the data do not tell from a selected one.
        told += names <= set(found.terms).union(*found.alternatives.values())
        if set(found.terms) != names:
            print(
                seed,
                took[-1],
                sorted(map(str, names)),
                "found",
                found.terms,
                found.alternatives,
                flush=True,
            )
            print(found)
    print(f"{count} records: right {right}, each hidden term found or an alternative {told}")
    print(f"CPU s of a selection, median {np.median(took):.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
