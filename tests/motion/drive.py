"""A law that its tests drive."""

import jax.numpy as jnp

import rigidjax as rj
from rigidjax import torques


class Drive(torques.AbstractTorque):
    """A torque about the third axis, as given."""

    feels = rj.motion.HasSpin
    source: object

    @property
    def jump_times(self):
        return getattr(self.source, "jump_times", jnp.zeros(0))

    def __call__(self, t, state, body):
        return jnp.stack([0.0, 0.0, 1.0]) * self.source(t)
