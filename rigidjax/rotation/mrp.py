"""Convert modified Rodrigues parameters σ = n tan(θ/4), and their shadow set.

A rotation by the angle θ about the unit vector n has these three parameters. They are computed from
a quaternion without sine or cosine, and are regular up to a full turn, at which σ is infinite. σ
and its shadow −σ/|σ|² are the same rotation; a switch at |σ| = 1 keeps θ ≤ π. Source: Schaub &
Junkins, 2018, Analytical Mechanics of Space Systems, sec. 3.5.2. Range: any σ; in functions of
rates, σ and the rates up to 1e75 (float32: 1e9).
"""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Mat3, Mat3Like, Quat, QuatLike, Vec3, Vec3Like
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import components, cross, dot, power_of_two_scale
from rigidjax.rotation.validation import require_direction


def from_quaternion(q: QuatLike) -> Vec3:
    """Return the modified Rodrigues parameters σ = q_v/(1 + q_w) (3,), |σ| ≤ 1, of a unit
    quaternion `q` (4,), where q_w ≥ 0 and q_v are the scalar and vector part of `q` or −q, the one
    whose first nonzero component is positive. Both give the same parameters to the last bit.

    >>> from_quaternion(jnp.array([-1.0, 0.0, 0.0, 0.0])).tolist()
    [-0.0, -0.0, -0.0]
    """
    q = quaternion.canonical(q)
    return q[1:] / (1 + q[0])


def to_quaternion(sigma: Vec3Like) -> Quat:
    """Return the unit quaternion q = ((1 − s), 2σ)/(1 + s), s = |σ|², of modified Rodrigues
    parameters `sigma` σ (3,). Their shadow −σ/|σ|², the other parameters of the same rotation,
    gives −q.

    >>> to_quaternion(jnp.array([0.0, 0.0, 1.0])).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    sigma = _checks.finite_array(sigma, (3,), "sigma")
    # Numerator and denominator are multiplied by the square of a power of two, `one`, so that
    # |σ|² does not overflow; the number 1 of the formula becomes `one`².
    one = jnp.minimum(power_of_two_scale(*components(sigma)), 1)
    sigma = one * sigma
    s, one2 = dot(sigma, sigma), one * one
    return jnp.concatenate([(one2 - s)[None], 2 * one * sigma]) / (one2 + s)


def from_matrix(matrix: Mat3Like) -> Vec3:
    """Return the modified Rodrigues parameters σ (3,), |σ| ≤ 1, of a rotation `matrix` (3, 3), body
    → world. **Raises:** as `so3.check` for known values; traced values are not checked.

    >>> from_matrix(jnp.eye(3)).tolist()
    [0.0, 0.0, 0.0]
    """
    return from_quaternion(quaternion.from_matrix(matrix))


def to_matrix(sigma: Vec3Like) -> Mat3:
    """Return the rotation matrix (3, 3), body → world, of modified Rodrigues parameters `sigma` σ
    (3,); their shadow −σ/|σ|² gives the same matrix.

    >>> to_matrix(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return quaternion.to_matrix(to_quaternion(sigma))


def shadow(sigma: Vec3Like) -> Vec3:
    """Return the shadow −σ/|σ|² of modified Rodrigues parameters `sigma` σ (3,): the other
    parameters of the same rotation (Schaub & Junkins, eq 3.145). **Raises:** `ValueError` for zero
    or NaN.

    >>> shadow(jnp.array([0.0, 0.5, 0.0])).tolist()
    [-0.0, -2.0, -0.0]
    """
    return _shadow(require_direction(_checks.array_of_shape(sigma, (3,), "sigma"), "sigma"))


def switch(sigma: Vec3Like) -> Vec3:
    """Return the modified Rodrigues parameters `sigma` σ (3,) if |σ| ≤ 1, else their shadow
    −σ/|σ|², which describes the same rotation by the shorter turn. Call this function only between
    two steps of a solver: within a step a solver needs parameters that do not jump.

    >>> switch(jnp.array([0.0, 2.0, 0.0])).tolist()
    [-0.0, -0.5, -0.0]
    """
    sigma = _checks.array_of_shape(sigma, (3,), "sigma")
    beyond = dot(sigma, sigma) > 1
    return jnp.where(beyond, _shadow(jnp.where(beyond, sigma, 1)), sigma)


def _shadow(sigma: Vec3) -> Vec3:
    """Return −σ/|σ|² of parameters that are not zero: the others of the same rotation."""
    scale = power_of_two_scale(*components(sigma))
    near = scale * sigma
    return -scale * (near / dot(near, near))


def omega_to_rates(sigma: Vec3Like, omega: Vec3Like) -> Vec3:
    """Return the rates of modified Rodrigues parameters σ at the angular velocity Ω, dσ/dt = ¼ [(1
    − s) Ω + 2 σ × Ω + 2 σ (σ·Ω)], per second, with s = |σ|²; the rates are finite for every finite
    σ (Schaub & Junkins, eq 3.160).

    **Arguments:** `sigma` (3,) dimensionless; `omega` (3,) Ω, in radians per second, body frame.

    >>> omega_to_rates(jnp.zeros(3), jnp.array([0.0, 0.0, 4.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    sigma = _checks.array_of_shape(sigma, (3,), "sigma")
    omega = _checks.array_of_shape(omega, (3,), "omega")
    s = dot(sigma, sigma)
    return 0.25 * ((1 - s) * omega + 2 * cross(sigma, omega) + 2 * dot(sigma, omega) * sigma)


def rates_to_omega(sigma: Vec3Like, rates: Vec3Like) -> Vec3:
    """Return the angular velocity, body frame, of modified Rodrigues parameters σ and their rates
    σ̇ = dσ/dt: Ω = 4/(1 + s)² [(1 − s) σ̇ − 2 σ × σ̇ + 2 σ (σ·σ̇)], with s = |σ|² (Schaub &
    Junkins, eq 3.164).

    **Arguments:** `sigma` (3,) dimensionless; `rates` (3,) σ̇, per second. **Returns:** (3,) in
    radians per second.

    >>> rates_to_omega(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])).tolist()
    [0.0, 0.0, 4.0]
    """
    sigma = _checks.array_of_shape(sigma, (3,), "sigma")
    rates = _checks.array_of_shape(rates, (3,), "rates")
    s = dot(sigma, sigma)
    turned = (1 - s) * rates - 2 * cross(sigma, rates) + 2 * dot(sigma, rates) * sigma
    return 4 / (1 + s) ** 2 * turned


__all__ = [
    "from_matrix", "from_quaternion", "omega_to_rates", "rates_to_omega", "shadow", "switch",
    "to_matrix", "to_quaternion",
]  # fmt: skip

define_dir_and_getattr(__name__)
