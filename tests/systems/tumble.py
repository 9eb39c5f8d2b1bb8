"""One tumbling body and the laws that the rows share."""

import jax.numpy as jnp
import numpy as np

import rigidjax as rj

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
BODY = rj.Inertia(TENSOR)
Q = np.array([0.8, -0.2, 0.4, 0.4]) / np.linalg.norm([0.8, -0.2, 0.4, 0.4])
OMEGA = np.array([0.9, -1.1, 0.4])
START = rj.Attitude(Q, OMEGA)
TOP = rj.torques.HeavyTop(1.0, [0.0, 0.1, 0.4], [0.0, 0.0, -9.81])


class Nothing(rj.torques.AbstractTorque):
    """No torque, but through a solver."""

    feels = rj.motion.HasSpin
    rate_free = True

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)
