"""Compute the costly functions of `quaternion` and `so3`, without checks of the arguments. They are
compiled also if they are called outside of `jit`.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from rigidjax._types import Mat3, Quat, Scalar, Vec3
from rigidjax.rotation.barrier import computed_once
from rigidjax.rotation.linalg3 import (
    components,
    cross_components,
    dot_components,
    entries,
    power_of_two_scale,
    squared_length,
)
from rigidjax.rotation.stumpff import arctan_ratio, inverse_coefficient, stumpff

# Each function below that `_compiled` wraps is inlined where another function that is being traced
# calls it, so that XLA and `jax.grad` see no boundary between the two.
_compiled = partial(jax.jit, inline=True)


@_compiled
def vector_to_quaternion(v: Vec3) -> Quat:
    """Return (cos θ/2, ½ v sin(θ/2)/(θ/2)) of a rotation vector v, rad, with θ = |v|."""
    x, y, z = parts = components(v)
    s = 0.25 * squared_length(parts)
    half = 0.5 * stumpff(1, s)
    return jnp.stack([stumpff(0, s), half * x, half * y, half * z])


@_compiled
def vector_to_matrix(v: Vec3) -> Mat3:
    """Return the rotation matrix of a rotation vector, rad: 1 + A hat v + B (hat v)², with A = sin
    θ/θ, B = (1 − cos θ)/θ² and θ = |v|.
    """
    parts = components(v)
    s = 0.25 * squared_length(parts)
    half = stumpff(1, s)
    return hat_polynomial(
        parts, computed_once(stumpff(0, s) * half), computed_once(0.5 * half * half)
    )


@_compiled
def matrix_to_quaternion(m: Mat3) -> Quat:
    """Return the canonical quaternion q of a rotation matrix, by the largest row of 4 q qᵀ."""
    a, b, c, d, e, f, g, h, i = entries(m)
    w, x, y, z = 1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i
    wx, wy, wz, xy, yz, zx = h - f, c - g, d - b, b + d, f + h, c + g
    rows = (w, wx, wy, wz), (wx, x, xy, zx), (wy, xy, y, yz), (wz, zx, yz, z)
    upper = [jnp.where(x > w, one, other) for one, other in zip(rows[1], rows[0], strict=True)]
    lower = [jnp.where(z > y, one, other) for one, other in zip(rows[3], rows[2], strict=True)]
    down = jnp.maximum(y, z) > jnp.maximum(w, x)
    row = [jnp.where(down, one, other) for one, other in zip(lower, upper, strict=True)]
    scale = 1 / jnp.sqrt(row[0] ** 2 + row[1] ** 2 + row[2] ** 2 + row[3] ** 2)
    scale = jnp.where(is_noncanonical(row), -scale, scale)
    return jnp.stack([scale * part for part in row])


@jax.custom_jvp
def _log(q: Quat) -> Vec3:
    """Return the rotation vector, rad, of the shortest turn of q, of any length, and of −q."""
    w, x, y, z = parts = components(power_of_two_scale(*components(q)) * q)
    n2 = x * x + y * y + z * z
    # Let n² = x² + y² + z², and let θ be the angle of the rotation. The tangent of θ/2 is n/|w|,
    # that of θ/4 is n/a, and that of θ/8 is n times `inverse`: all terms of the sums are positive,
    # so nothing cancels.
    a = jnp.abs(w) + jnp.sqrt(n2 + w * w)
    inverse = 1 / (a + jnp.sqrt(n2 + a * a))
    scale = 8 * inverse * arctan_ratio(n2 * inverse * inverse)
    scale = jnp.where(is_noncanonical(parts), -scale, scale)
    return jnp.stack([scale * x, scale * y, scale * z])


@_log.defjvp
def _log_jvp(primals: tuple[Quat], tangents: tuple[PyTree, ...]) -> tuple[Vec3, Vec3]:
    """Return the rotation vector and its tangent."""
    (q,), (dq,) = primals, tangents
    v = _log(q)
    # q may have any length: q and dq are multiplied by a common factor, which does not change the
    # derivative.
    scale = power_of_two_scale(*components(q))
    w, *u = parts = components(scale * q)
    dw, *du = components(scale * dq)
    # `turn` is the small turn in the body frame, 2 vec(q̄ dq)/|q|², with the conjugate q̄ of q and
    # the vector part vec. The inverse right Jacobian, which is applied to it below, gives the
    # tangent of the rotation vector.
    scale, aside = 2 / squared_norm(parts), cross_components(u, du)
    turn = [scale * (w * du[i] - dw * u[i] - aside[i]) for i in range(3)]
    vs = components(v)
    across = cross_components(vs, turn)
    twice = cross_components(vs, across)
    g = inverse_coefficient(dot_components(vs, vs))
    return v, jnp.stack([turn[i] + 0.5 * across[i] + g * twice[i] for i in range(3)])


quaternion_to_vector = _compiled(_log)


@_compiled
def to_unit_length(q: Quat) -> Quat:
    """Return a quaternion of any length but zero, scaled to length 1."""
    q = power_of_two_scale(*components(q)) * q
    return q / jnp.sqrt(squared_norm(components(q)))


def hat_polynomial(v: Sequence[Scalar], a: Scalar, b: Scalar | float) -> Mat3:
    """Return the matrix 1 + a hat v + b (hat v)², where hat(v) y = v × y."""
    x, y, z = v
    xx, yy, zz = b * x * x, b * y * y, b * z * z
    xy, yz, zx = b * x * y, b * y * z, b * z * x
    ax, ay, az = a * x, a * y, a * z
    rows = [1 - yy - zz, xy - az, zx + ay], [xy + az, 1 - zz - xx, yz - ax]
    return jnp.stack([*rows[0], *rows[1], zx - ay, yz + ax, 1 - xx - yy]).reshape(3, 3)


def left_jacobian_inverse(v: Vec3) -> Mat3:
    """Return the inverse of the left Jacobian of a rotation vector, rad: 1 − ½ hat v + g (hat v)²,
    with g of `inverse_coefficient`.
    """
    t = squared_length(parts := components(v))
    return hat_polynomial(parts, jnp.full_like(t, -0.5), inverse_coefficient(t))


def squared_norm(q: Sequence[Scalar]) -> Scalar:
    """Return |q|²."""
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


def quaternion_product(p: Iterable[Any], q: Iterable[Any]) -> tuple[Any, ...]:
    """Return the product p q of two quaternions, of scalars of JAX or NumPy."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def is_noncanonical(q: Sequence[Scalar]) -> Array:
    """Return whether the first nonzero component of q is negative: of q and −q, which are one
    rotation, the other one is called canonical.
    """
    w, x, y, z = q
    lead = jnp.where(w != 0, w, jnp.where(x != 0, x, jnp.where(y != 0, y, z)))
    return lead < 0
