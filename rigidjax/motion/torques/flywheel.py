"""Wheels inside the body: gyrostats, momentum and reaction wheels."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasSpin, Scalar, ScalarLike, Vec3
from rigidjax.motion.torques.base import (
    AbstractTorque,
    constant_or_callable,
    jumps_of,
    vector_at,
)
from rigidjax.motion.torques.states import has_states
from rigidjax.rotation.linalg3 import cross


class Flywheel(AbstractTorque):
    """What wheels inside do to the body that carries them: `τ = h × Ω − dh/dt`.

    **Arguments:** `momentum` h, N m s, body frame: (3,) for wheels that run at constant speed, or a
    callable Module of time, t → (3,), for wheels that are spun up, such as `Linear(times, values)`.
    Several wheels: give the sum.

    The body's `Inertia` goes with the meaning of h. With the wheels counted as if locked, h is
    their momentum relative to the body. With the wheels' axial moments taken out (I − Σ J a aᵀ),
    h is their whole axial momentum, and dh/dt is the torque of the motors.

    The momentum in space, `R (IΩ + h)`, is kept; the energy `½ Ω·IΩ` too while h is constant.
    Source: Zhukovsky 1885, Volterra 1898; Hughes, Spacecraft Attitude Dynamics, chs. 3, 6.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> Flywheel([0.0, 0.0, 2.0]).internal_momentum(0.0)
    Array([0., 0., 2.], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    momentum: eqx.Module | Float[Array, "3"]

    def __init__(self, momentum: object):
        self.momentum = constant_or_callable(momentum, "momentum")
        if has_states(momentum):
            raise TypeError(
                "Flywheel: wanted a momentum whose derivative by time is known, got one with "
                "states of its own; see ReactionWheels"
            )

    @property
    def steady(self) -> bool:
        """Whether the wheels run at constant speed."""
        return not callable(self.momentum)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the wheels' torque jumps."""
        return jumps_of(self.momentum)

    def internal_momentum(self, t: ScalarLike) -> Vec3:
        """The wheels' momentum h at `t`, (3,), N m s, body frame."""
        return vector_at(self.momentum, t, "momentum")

    def energy(self, t: ScalarLike, state: HasSpin, body: object) -> Scalar:
        """Zero, J: h × Ω does no work."""
        return jnp.zeros((), state.omega.dtype)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        source: Any = self.momentum
        if not callable(source):
            return cross(source, state.omega)
        t = jnp.asarray(t, state.omega.dtype)
        h, rate = jax.jvp(self.internal_momentum, (t,), (jnp.ones_like(t),))
        return cross(h, state.omega) - rate
