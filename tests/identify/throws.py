"""Throws of a box with a gyro and a flywheel inside (Delft, arXiv:2503.13137), read and modelled.

The device (gyro, accelerometer, flywheel) is thrown alone, with a proof body of known inertia, and
with two objects. The flywheel's own inertia is not known: the proof body calibrates it.
"""

from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import savgol_filter

import rigidjax as rj
from rigidjax import identify

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "tudelft_throw"
# The flywheel starts at t = 0; its speed is not told before it turns at some tens of rad/s.
WINDOW = (0.03, 0.565)
# What the fits assume: the calibration says by how much it is off.
WHEEL = 1.2e-6
DEVICE, PROOF = 0.10067, 0.346
PROOF_MOMENTS = np.array([130.097, 167.580, 245.083])
OBJECTS = {
    "object_empty": (0.1785, np.array([123.43, 368.06, 431.01])),
    "object_a": (0.4589, np.array([189.83, 1524.66, 1577.14])),
}
MODELS = ("delay", "delay drag", "delay drag bias")


def paths(group):
    return sorted(FOLDER.glob(f"{group}_log*.csv"))


def columns(path, first):
    names = ("t", "wx", "wy", "wz", "ax", "ay", "az", "flywheel")
    table = identify.read_table(path, names)
    inside = (table["t"] >= first - 1e-9) & (table["t"] <= WINDOW[1] + 1e-9)
    return {name: values[inside] for name, values in table.items()}


def speed(path):
    """The wheel's log: it begins a little earlier, so that its delay has room."""
    wide = columns(path, WINDOW[0] - 0.02)
    return rj.torques.Series(wide["t"], wide["flywheel"])


def law(drag=rj.torques.Damping, **options):
    """The wheel with the logged speed, and a drag."""
    source = rj.torques.Input("speed")
    wheel = rj.torques.Wheel(WHEEL, [0.0, 0.0, 1.0], source, delay=0.0, **options)
    return rj.torques.Sum(rj.torques.Flywheel(wheel), drag([0.0, 0.0, 0.0]))


LAW = law()


def record(path):
    log = columns(path, WINDOW[0])
    gyro = identify.Gyro(bias=[0.0, 0.0, 0.0])
    rates = np.stack([log["wx"], log["wy"], log["wz"]], axis=1)
    return identify.Recording(log["t"], (gyro, rates), inputs={"speed": speed(path)})


def problem(recordings, model, torque=LAW):
    free = [
        identify.Free(lambda s: s.torque.parts[0].momentum.delay, "delay", scale=1e-3, each=True)
    ]
    if "drag" in model:
        free.append(identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-5))
    if "bias" in model:
        free.append(identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05))
    return identify.Model(recordings, identify.Tensor(3e-4), torque=torque, free=free)


def fits(group, model):
    """One fit for each throw, from a blind start (regression on Euler's equations)."""
    return [identify.fit(problem([record(p)], model), starts=1) for p in paths(group)]


def preference(group, found):
    """Bayesian information of each model, added up over the throws of a group."""
    total = dict.fromkeys(found, 0.0)
    for throw in range(len(paths(group))):
        rows = identify.compare({model: found[model][throw] for model in found})
        for row in rows:
            total[row.name] += row.information
    return total


def lever(group):
    """From the centre of mass to the accelerometer (3,), m: the median over a group's throws."""
    return np.median(levers(group), axis=0)


def levers(group):
    """From the centre of mass to the accelerometer (throws, 3), m, as each throw shows it.

    Linear regression of the specific force on dΩ/dt × r + Ω × (Ω × r) + bias, away from the
    wheel's jerks.
    """
    found = []
    for path in paths(group):
        log = columns(path, WINDOW[0])
        t = log["t"]
        w = np.stack([log["wx"], log["wy"], log["wz"]], axis=1)
        a = np.stack([log["ax"], log["ay"], log["az"]], axis=1)
        rate = savgol_filter(w, 25, 3, deriv=1, delta=1e-3, axis=0)
        w, a = (savgol_filter(x, 25, 3, axis=0) for x in (w, a))
        quiet = (t < 0.18) | ((t > 0.21) & (t < 0.37)) | (t > 0.42)
        hat = np.stack([np.cross(np.eye(3)[i], np.eye(3)) for i in range(3)])
        spin, turning = (-np.einsum("ti,ijk->tjk", x, hat) for x in (w, rate))
        rows = np.concatenate([turning + spin @ spin, np.broadcast_to(np.eye(3), spin.shape)], 2)
        rows, side = rows[quiet].reshape(-1, 6), a[quiet].reshape(-1)
        found.append(np.linalg.lstsq(rows, side, rcond=None)[0][:3])
    return np.array(found)


def shifted(mass, d):
    return mass * (d @ d * np.eye(3) - np.outer(d, d))


def without_device(total, device, masses, levers):
    """The tensor of what was measured with the device, about its own centre of mass, kg m²."""
    between = levers[1] - levers[0]
    other = -(masses[0] / masses[1]) * between
    return total - device - shifted(masses[0], between) - shifted(masses[1], other)


def mean_tensor(found):
    return np.mean([np.asarray(f.body.tensor) for f in found], axis=0)


def calibrate(device, proof):
    """By what factor the wheel's inertia is off, and the moments of the proof body, kg mm²."""
    levers = lever("calibration_device_only"), lever("calibration_proof_body")

    def moments(factor):
        tensors = factor * mean_tensor(proof), factor * mean_tensor(device)
        tensor = without_device(*tensors, (DEVICE, PROOF), levers)
        return np.linalg.eigvalsh(tensor) * 1e6

    def off(factor):
        return np.sum((moments(factor) / PROOF_MOMENTS - 1) ** 2)

    factor = minimize_scalar(off, bounds=(0.5, 3.0), method="bounded").x
    return factor, moments(factor)


def object_moments(group, tensor, device, factor):
    """Principal moments of an object, kg mm², of a tensor measured with the device inside."""
    levers = lever("calibration_device_only"), lever(group)
    mass, _ = OBJECTS[group]
    tensors = factor * np.asarray(tensor), factor * mean_tensor(device)
    return np.linalg.eigvalsh(without_device(*tensors, (DEVICE, mass), levers)) * 1e6


def relative_deviation(found):
    """Standard deviations of the log of the three moments of one fit, ascending moments."""
    order = np.argsort([q.value for q in found.quantities[:3]])
    return np.array([found.quantities[i].deviation / found.quantities[i].value for i in order])
