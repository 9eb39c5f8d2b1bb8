"""Read the motion of a carried body from its log, in the place of an integration."""

import equinox as eqx
import jax
from jaxtyping import Array

from rigidjax.body.inertia import MassProperties
from rigidjax.motion import Rigid
from rigidjax.motion.torques import Carried
from rigidjax.motion.torques.carried import Kinematics, relative_acceleration
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross


class CarriedMotion(eqx.Module):
    """Hold the motion of a carried body; call it with times (n,), s, as a `FreeMotion`."""

    body: MassProperties
    torque: Carried

    def __call__(self, ts: Array) -> Rigid:
        def state(t: Array) -> Rigid:
            now, com = self.torque.motion(t), self.body.com
            v = now.v + quaternion.rotate(now.q, cross(now.omega, com))
            return Rigid(now.x + quaternion.rotate(now.q, com), v, now.q, now.omega)

        return jax.vmap(state)(ts)

    def field(self, t: Array, state: Rigid, args: object = None) -> Rigid:
        """Return the logged time derivative of the state, for which I⁻¹ is not needed."""
        now: Kinematics = self.torque.motion(t)
        moved = relative_acceleration(now.omega, now.alpha, self.body.com)
        a = now.a + quaternion.rotate(now.q, moved)
        return Rigid(state.v, a, quaternion.rate(state.q, state.omega), now.alpha)
