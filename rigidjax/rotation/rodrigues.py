"""Convert Rodrigues (Gibbs, Cayley) parameters g = n tan(θ/2).

A rotation by the angle θ about the unit vector n has these three parameters, the Rodrigues vector
g. The conversions to and from a rotation matrix are rational, and a rotation has only one g. The
parameters are infinite at a half turn, for which `is_singular` tests. M = (1 + hat g)(1 − hat g)⁻¹
is Cayley's transform. Source: Schaub & Junkins, 2018, Analytical Mechanics of Space Systems, sec.
3.5.1. Range: any g; in functions of rates, g and the rates up to 1e75 (float32: 1e9).
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Mat3, Mat3Like, Quat, QuatLike, Vec3, Vec3Like
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import components, cross, dot, power_of_two_scale
from rigidjax.rotation.validation import require_direction


def from_quaternion(q: QuatLike) -> Vec3:
    """Return the Rodrigues parameters g = q_v/q_w of a quaternion with the scalar part q_w and the
    vector part q_v; g is infinite at a half turn, and q and −q give the same g to the last bit.

    **Arguments:** `q` (4,), not zero, body → world. **Returns:** (3,) dimensionless. **Raises:**
    `ValueError` for zero or NaN.

    >>> from_quaternion(jnp.array([2.0, 0.0, 0.0, 2.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    q = require_direction(quaternion.canonical(q), "q")
    # The derivative of g = q_v/q_w divides by q_w²: q, which may have any length, is scaled first,
    # so that nothing overflows.
    q = power_of_two_scale(*components(q)) * q
    return q[1:] / q[0]


def to_quaternion(g: Vec3Like) -> Quat:
    """Return the unit quaternion (1, g)/√(1 + |g|²), with w > 0, of finite Rodrigues parameters `g`
    (3,), dimensionless.

    >>> to_quaternion(jnp.zeros(3)).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    g = _checks.finite_array(g, (3,), "g")
    return quaternion.normalise(jnp.concatenate([jnp.ones_like(g[:1]), g]))


def from_matrix(matrix: Mat3Like) -> Vec3:
    """Return the Rodrigues parameters g (3,) of a rotation `matrix` (3, 3), body → world; g is
    infinite at a half turn. **Raises:** as `so3.check` for known values; traced values are not
    checked.

    >>> from_matrix(jnp.eye(3)).tolist()
    [0.0, 0.0, 0.0]
    """
    return from_quaternion(quaternion.from_matrix(matrix))


def to_matrix(g: Vec3Like) -> Mat3:
    """Return the rotation matrix (1 + hat g)(1 − hat g)⁻¹ (Cayley's transform), body → world, of
    finite Rodrigues parameters `g` (3,); hat g is the matrix of the cross product with g.

    >>> to_matrix(jnp.array([0.0, 0.0, 1.0])).round(12)[0].tolist()
    [0.0, -1.0, 0.0]
    """
    return quaternion.to_matrix(to_quaternion(g))


def is_singular(q: QuatLike) -> Bool[Array, ""]:
    """Return whether the unit quaternion `q` (4,) is a half turn, to 4 units of round-off.

    The Rodrigues vector g of a half turn has no correct digit.

    >>> bool(is_singular(jnp.array([0.0, 0.0, 0.0, 1.0])))
    True
    """
    q = _checks.array_of_shape(q, (4,), "q")
    return jnp.abs(q[0]) < 4 * jnp.finfo(q.dtype).eps


def omega_to_rates(g: Vec3Like, omega: Vec3Like) -> Vec3:
    """Return the rates dg/dt = ½ [Ω + g × Ω + g (g·Ω)], 1/s, of Rodrigues parameters `g` (3,) at
    the angular velocity `omega` (3,) Ω, rad/s, body frame (Schaub & Junkins, eq 3.130).

    >>> omega_to_rates(jnp.zeros(3), jnp.array([0.0, 0.0, 2.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    g, omega = _checks.array_of_shape(g, (3,), "g"), _checks.array_of_shape(omega, (3,), "omega")
    return 0.5 * (omega + cross(g, omega) + dot(g, omega) * g)


def rates_to_omega(g: Vec3Like, rates: Vec3Like) -> Vec3:
    """Return the angular velocity Ω = 2/(1 + |g|²) [ġ − g × ġ], rad/s, body frame, of Rodrigues
    parameters `g` (3,) and their `rates` (3,) ġ = dg/dt, 1/s (Schaub & Junkins, eq 3.132).

    >>> rates_to_omega(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])).tolist()
    [0.0, 0.0, 2.0]
    """
    g, rates = _checks.array_of_shape(g, (3,), "g"), _checks.array_of_shape(rates, (3,), "rates")
    return 2 / (1 + dot(g, g)) * (rates - cross(g, rates))


__all__ = [
    "from_matrix", "from_quaternion", "is_singular", "omega_to_rates", "rates_to_omega",
    "to_matrix", "to_quaternion",
]  # fmt: skip

define_dir_and_getattr(__name__)
