"""The throws of `shared/data/tudelft_throw` as one problem of four bodies with one sensor.

    python tests/identify/bench_throws.py [EVERY] [END]

The recipe. All throws together: each group has a body of its own (six numbers) and a drag of its
own; all share the gyro (bias, scale an axis, three skew terms) and the wheel's tilt; each throw has
a first rate, a delay of the wheel's log, and a bias that deviates from the shared one by 0.02
rad/s. Noise is estimated for each body. No object's truth enters: the proof body's moments fix the
scale of the wheel. Then each throw alone, with the sensor as it was found.

EVERY keeps each so many samples (default 1: 1 kHz), END is the last time, s (default 0.53).
"""

import importlib.util
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify

_spec = importlib.util.spec_from_file_location("throws", Path(__file__).with_name("throws.py"))
throws = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(throws)

DEVICE, PROOF, *OBJECTS = (
    "calibration_device_only",
    "calibration_proof_body",
    "object_empty",
    "object_a",
)
MASSES = {DEVICE: throws.DEVICE, PROOF: throws.PROOF} | {
    name: throws.OBJECTS[name][0] for name in OBJECTS
}
TRUTH = {PROOF: throws.PROOF_MOMENTS} | {name: throws.OBJECTS[name][1] for name in OBJECTS}
# How far a throw's bias is from the sensor's, rad/s.
OWN_BIAS = 0.02


def record(path, every, end):
    wide = throws.columns(path, throws.WINDOW[0] - 0.02)
    log = throws.columns(path, throws.WINDOW[0])
    speed = rj.torques.Series(wide["t"], wide["flywheel"])
    wheel = rj.torques.Wheel(throws.WHEEL, [0.0, 0.0, 1.0], speed, delay=0.0, tilt=[0.0, 0.0])
    law = rj.torques.Sum(rj.torques.Flywheel(wheel), rj.torques.Damping([0.0, 0.0, 0.0]))
    gyro = identify.Gyro(bias=[0.0] * 3, scale=[1.0] * 3, skew=[0.0] * 3)
    rates = np.stack([log["wx"], log["wy"], log["wz"]], axis=1)
    kept = np.flatnonzero(log["t"] <= end + 1e-9)[::every]
    return identify.Recording(log["t"][kept], (gyro, rates[kept]), torque=law)


def free(own_bias):
    return [
        identify.Free(lambda r: r.readings[0].sensor.bias, "bias", scale=0.05, **own_bias),
        identify.Free(lambda r: r.torque.parts[0].momentum.delay, "delay", scale=1e-3, each=True),
        identify.Free(lambda r: r.torque.parts[1].coefficient, "drag", scale=1e-5, each="body"),
    ]


SENSOR = [
    identify.Free(lambda r: r.readings[0].sensor.scale, "scale", scale=0.01),
    identify.Free(lambda r: r.readings[0].sensor.skew, "skew", scale=0.01),
    identify.Free(lambda r: r.torque.parts[0].momentum.tilt, "tilt", scale=0.01),
]


def together(records):
    charts = {name: identify.Tensor(3e-4) for name in records}
    problem = identify.Problem(
        records, charts, free=[*free({"spread": OWN_BIAS}), *SENSOR], noise_each="body"
    )
    return identify.fit(problem, starts=1)


def alone(name, row, joint):
    """One throw with the sensor of the joint fit; its own bias about the shared one."""
    index = row + joint.problem.of.index(name)
    scene = jax.tree.map(
        lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf,
        joint.problem.scenes(joint.parameters),
    )
    shared = joint.values["bias"]
    scene = eqx.tree_at(lambda r: r.readings[0].sensor.bias, scene, shared)
    problem = identify.Problem(
        {name: scene}, {name: identify.Tensor(3e-4)}, free=free({"prior": OWN_BIAS})
    )
    start = problem.start({name: joint.body[name]})
    spin = joint.parameters.own.spin[index][None]
    start = eqx.tree_at(lambda p: p.own.spin, start, spin)
    return identify.fit(problem, starts=1, initial=start)


def shift(mass, d):
    return mass * (jnp.sum(d * d) * jnp.eye(3) - d[:, None] * d[None, :])


def moments(name, total, device, factor, levers):
    """Principal moments, kg mm², of what was measured with the device, ascending."""
    between = jnp.asarray(levers[name] - levers[DEVICE])
    other = -(MASSES[DEVICE] / MASSES[name]) * between
    tensor = factor * (total - device) - shift(MASSES[DEVICE], between)
    return jnp.linalg.eigvalsh(tensor - shift(MASSES[name], other)) * 1e6


def factor_of(bodies, levers):
    """By what factor the wheel's inertia is off: the least squares of the proof body's moments."""
    factor = 1.0
    for _ in range(8):

        def off(f):
            found = moments(PROOF, bodies[PROOF].tensor, bodies[DEVICE].tensor, f, levers)
            return found / jnp.asarray(TRUTH[PROOF]) - 1.0

        error, slope = off(factor), jax.jacfwd(off)(jnp.asarray(factor))
        factor = factor - jnp.sum(error * slope) / jnp.sum(slope * slope)
    return factor


def main(every=1, end=0.53):
    levers = {name: throws.lever(name) for name in MASSES}
    records = {
        name: [record(path, every, end) for path in throws.paths(name)] for name in MASSES
    }
    began = time.perf_counter()
    joint = together(records)
    print(f"{joint.problem.count} throws: {time.perf_counter() - began:.1f} s, {joint.status}")
    for name, value in joint.values.items():
        if name in ("bias", "scale", "skew", "tilt"):
            print(f"  {name}", np.array2string(np.asarray(value), precision=4))
    factor = float(factor_of(joint.body, levers))
    device = joint.body[DEVICE].tensor
    print(f"  the wheel's inertia times {factor:.4f}; noise {np.unique(joint.noise[0]).round(4)}")
    held = []
    for name in TRUTH:

        def joint_moments(bodies, _, name=name):
            f = factor_of(bodies, levers)
            return jnp.log(moments(name, bodies[name].tensor, bodies[DEVICE].tensor, f, levers))

        low, high = joint.interval_of(joint_moments)
        found = np.exp(0.5 * (low + high))
        inside = (np.exp(low) <= TRUTH[name]) & (np.exp(high) >= TRUTH[name])
        print(
            f"{name}: together, error % {np.round(100 * (found / TRUTH[name] - 1), 2)}, 95 % ±% "
            f"{np.round(50 * (high - low), 2)}, hold {inside.sum()} of 3"
        )
        errors = []
        for row in range(len(records[name])):
            one = alone(name, row, joint)

            def own(bodies, _, name=name):
                total = bodies[name].tensor
                return jnp.log(moments(name, total, device, factor, levers))

            low, high = one.interval_of(own)
            errors.append(np.exp(0.5 * (low + high)) / TRUTH[name] - 1)
            held.append((np.exp(low) <= TRUTH[name]) & (np.exp(high) >= TRUTH[name]))
        errors = 100 * np.abs(errors)
        print(
            f"  {len(errors)} throws alone: mean {errors.mean():.2f} %, worst {errors.max():.2f} %, "
            f"intervals that hold {np.mean(held[-len(errors) :]):.0%}"
        )
    print(f"all throws alone: intervals that hold {np.mean(held):.0%}")


if __name__ == "__main__":
    main(*(kind(text) for kind, text in zip((int, float), sys.argv[1:], strict=False)))
