"""Define random torques, of which only the statistics are known."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.motion.torques.base import AbstractTorque


class RandomTorque(AbstractTorque):
    """Describe a torque that is white noise, independent along the three body axes: `E[τᵢ(t)
    τᵢ(t′)] = density · δ(t − t′)` for each body axis i and any two times t and t′.

    **Arguments:** `density` N² m² s, one number or one for each body axis (3,), ≥ 0. In a time t
    the rate about an axis with the moment of inertia I changes by about √(density · t)/I.

    `simulate` and a fit of `rigidjax.identify` use the mean of the torque, which is zero. If the
    torque is the `process` of a `rigidjax.identify.Model`, the functions `filter`, `smooth` and
    `log_likelihood` allow for the noise, and `sample` draws a motion under this noise. `Sum` adds
    several random torques. Source: Gelb, Applied Optimal Estimation (1974), §3.6. **Raises:**
    `ValueError` for a density below zero.

    >>> RandomTorque(1e-4).density
    Array([0.0001, 0.0001, 0.0001], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    steady: ClassVar[bool] = True
    density: Float[Array, "3"]

    def __init__(self, density: NumbersLike):
        self.density = checked_density(density)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return jnp.zeros_like(self.density)


class CorrelatedTorque(AbstractTorque):
    """Describe correlated torque noise (Ornstein–Uhlenbeck): `T dτ/dt = −τ + white noise`.

    **Arguments:** `density` of the white noise, N² m² s, one number or (3,), ≥ 0; `time` T, s,
    positive: the correlation time. About each body axis `E[τ(t) τ(t′)] = density/(2T) exp(−|t −
    t′|/T)` for any two times t and t′: for T → 0 this is a `RandomTorque` with an equal density.

    `simulate` and a fit use the mean of the torque, which is zero; see `RandomTorque`. A filter
    estimates this torque as a part of its state, because its noise is correlated in time. Source:
    Uhlenbeck and Ornstein 1930, doi:10.1103/PhysRev.36.823. **Raises:** `ValueError` for a density
    below zero, a time that is not positive.

    >>> CorrelatedTorque(2e-4, 0.5).deviation
    Array([0.01414214, 0.01414214, 0.01414214], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    steady: ClassVar[bool] = True
    density: Float[Array, "3"]
    time: Scalar

    def __init__(self, density: NumbersLike, time: NumbersLike):
        self.density = checked_density(density)
        number = _checks.array_of_shape(time, (), "time").astype(self.density.dtype)
        self.time = _checks.require_positive(number, "time", "a positive correlation time, s")

    @property
    def deviation(self) -> Vec3:
        """Return the standard deviation (3,), N m, of this torque noise at any time, about each
        body axis.
        """
        return jnp.sqrt(0.5 * self.density / self.time)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return jnp.zeros_like(self.density)


def checked_density(value: NumbersLike, name: str = "density", size: int = 3) -> Array:
    """Return a spectral density, one number for each axis; raise `ValueError` below zero."""
    density = _checks.numeric_array(value, name)
    if density.shape not in ((), (size,)):
        raise ValueError(f"{name}: wanted one number or {size} numbers, got shape {density.shape}")
    density = jnp.broadcast_to(density, (size,)).astype(density.dtype)
    return _checks.require_positive(
        density, name, "a finite number that is not below zero", allow_zero=True
    )
