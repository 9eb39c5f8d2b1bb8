"""What a sensor reads of a state, and how far a reading is from it."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin, Vec3
from rigidjax.rotation import quaternion


class AbstractSensor(eqx.Module):
    """A sensor: what shape its readings have, which rung it sees, and the error of a reading.

    `noise` is the standard deviation of one reading, (3,) or one number for the three, in the units
    of `error`; `None` has it estimated from the residuals.
    """

    reading_shape: eqx.AbstractClassVar[tuple[int, ...]]
    feels: eqx.AbstractClassVar[type]
    unit: eqx.AbstractClassVar[str]
    noise: eqx.AbstractVar[Array | None]

    @abc.abstractmethod
    def error(self, state: Any, reading: Array) -> Vec3:
        """Reading minus prediction (3,), in the sensor's unit."""


def _noise(noise: Any) -> Array | None:
    if noise is None:
        return None
    noise = jnp.asarray(noise, jnp.result_type(float))
    if noise.shape not in ((), (3,)):
        raise ValueError(f"noise: wanted one number or three, got shape {noise.shape}")
    noise = jnp.broadcast_to(noise, (3,))
    return _checks.refuse(noise, ~(noise > 0), "noise: wanted a positive standard deviation")


class Gyro(AbstractSensor):
    """Reads the body rate Ω, rad/s, body frame.

    **Arguments:** `noise` standard deviation of a reading, rad/s, one number or (3,); `None` has it
    estimated from the residuals. **Raises** `ValueError` for a noise that is not positive.

    >>> Gyro(noise=0.01).noise.shape
    (3,)
    """

    reading_shape: ClassVar[tuple[int, ...]] = (3,)
    feels: ClassVar[type] = HasSpin
    unit: ClassVar[str] = "rad/s"
    noise: Float[Array, "3"] | None

    def __init__(self, noise: Any = None):
        self.noise = _noise(noise)

    def error(self, state: HasSpin, reading: Array) -> Vec3:
        return reading - state.omega


class AttitudeSensor(AbstractSensor):
    """Reads the attitude as a quaternion (w, x, y, z), body → world; q and −q read the same.

    The error is the rotation vector in the body frame that takes the predicted attitude to the
    reading, `log(q⁻¹ q_read)`: its length is the angle between them.

    **Arguments:** `noise` standard deviation of each component of that vector, rad, one number or
    (3,); `None` has it estimated. **Raises** `ValueError` for a noise that is not positive.

    >>> AttitudeSensor(noise=0.01).reading_shape
    (4,)
    """

    reading_shape: ClassVar[tuple[int, ...]] = (4,)
    feels: ClassVar[type] = HasAttitude
    unit: ClassVar[str] = "rad"
    noise: Float[Array, "3"] | None

    def __init__(self, noise: Any = None):
        self.noise = _noise(noise)

    def error(self, state: HasAttitude, reading: Array) -> Vec3:
        return quaternion.log(quaternion.multiply(quaternion.conjugate(state.q), reading))
