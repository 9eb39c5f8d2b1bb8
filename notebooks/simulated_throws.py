"""Throws of a box with a flywheel, simulated: they stand for the recordings of Delft on a clone.

The recordings (arXiv:2503.13137) have no licence, so they are not part of the project. These tables
have the same columns, rates, numbers of throws and published moments; the device, the noise and the
starts are invented.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import PchipInterpolator

import rigidjax as rj

# kg; kg mm², principal; m, from the centre of device and body together to the accelerometer; number
# of throws. The device alone comes first.
BODIES = {
    "calibration_device_only": (0.10067, [88.0, 64.0, 92.0], [-0.011, -0.0015, -0.009], 5),
    "calibration_proof_body": (0.346, [130.097, 167.58, 245.083], [-0.0125, 0.002, -0.0325], 5),
    "object_empty": (0.1785, [123.43, 368.06, 431.01], [-0.011, -0.002, -0.0305], 10),
    "object_a": (0.4589, [189.83, 1524.66, 1577.14], [-0.0105, 0.0, -0.039], 11),
}
DEVICE = "calibration_device_only"
# The speed of the wheel, rad/s: it spins up with a jerk at 0.19 s and is braked from 0.39 s on.
T = 1e-3 * np.arange(571)
SPEED = PchipInterpolator(
    [0.0, 0.05, 0.1, 0.15, 0.19, 0.21, 0.25, 0.3, 0.35, 0.39, 0.42, 0.45, 0.5, 0.58],
    [0, -145, -200, -212, -250, -600, -1120, -1270, -1300, -1290, -700, -350, -240, -200],
)(T)
# The moment of inertia of the wheel, kg m², and a linear drag, N m s.
WHEEL, DRAG = 1.7e-6, (4e-5, 2e-5, 3e-5)
# What the gyro adds, rad/s; standard deviations of the readings: rad/s, m/s².
BIAS, NOISE, FORCE_NOISE = np.array([-0.012, -0.027, 0.015]), 0.005, 0.05


def tensor(name):
    """The inertia of a body with its device, kg m², about their centre of mass."""
    mass, moments, place, _ = BODIES[name]
    own, lever = 1e-6 * np.diag(BODIES[DEVICE][1]), BODIES[DEVICE][2]
    if name == DEVICE:
        return own
    # The body is turned a little in the axes of the device.
    axes = np.asarray(rj.so3.exp(jnp.array([0.03, -0.02, 0.05])))
    d, light = np.subtract(place, lever), BODIES[DEVICE][0]
    apart = light * (1 + light / mass) * (d @ d * np.eye(3) - np.outer(d, d))
    return own + axes @ np.diag(1e-6 * np.array(moments)) @ axes.T + apart


@jax.jit
@jax.vmap
def throw(inertia, omega, place):
    """Rates, rad/s, and specific forces, m/s², of one throw at 1 kHz."""
    wheel = rj.torques.Wheel(WHEEL, [0.0, 0.0, 1.0], rj.torques.Series(T, SPEED))
    law = rj.torques.Sum(rj.torques.Flywheel(wheel), rj.torques.Damping(DRAG))
    body, start = rj.Inertia(inertia), rj.Spin(omega)
    states = rj.simulate(body, start, T, law, throw=False).ys
    field = rj.equations_of_motion(body, start, law)
    slope = jax.vmap(lambda t, y: field(t, y, None).omega)(jnp.asarray(T), states)
    w = states.omega
    return w, jnp.cross(slope, place) + jnp.cross(w, jnp.cross(w, place))


def tables(name):
    """The logs of all throws of a body: a dictionary of columns each, as `read_table` returns."""
    count, place = BODIES[name][3], np.array(BODIES[name][2])
    rng = np.random.default_rng(list(BODIES).index(name))
    # Bodies are thrown about their long axis, roughly.
    starts = rng.normal([9.5, 0.0, 0.0], [1.0, 2.5, 2.5], (count, 3))
    places = place + rng.normal(0.0, 2e-4, (count, 3))
    repeated = np.broadcast_to(tensor(name), (count, 3, 3))
    rates, forces = (np.asarray(a) for a in throw(repeated, starts, places))
    rates = rates + BIAS + NOISE * rng.normal(size=rates.shape)
    forces = forces + FORCE_NOISE * rng.normal(size=forces.shape)
    return [
        {"t": T, "flywheel": SPEED}
        | {f"w{axis}": w[:, k] for k, axis in enumerate("xyz")}
        | {f"a{axis}": a[:, k] for k, axis in enumerate("xyz")}
        for w, a in zip(rates, forces, strict=True)
    ]
