"""Rotation matrices M, active, body → world, and their tangent vectors (floor 1).

`exp` and `log` take and return one rotation; batch with `jax.vmap`. Every kernel is a smooth
function of θ², so that values and derivatives of any order are right at θ = 0.
"""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Scalar, Vec3, Vec3Like
from rigidjax.rotation import quaternion
from rigidjax.rotation.algebra import (
    apply as apply,
    basis as basis,
    components,
    cross as cross,
    determinant as determinant,
    dot as dot,
    hat as hat,
    product as product,
    solve as solve,
    square,
    vee as vee,
)
from rigidjax.special.series import inverse_kernel, stumpff


def exp(v: Vec3Like) -> Mat3:
    """The rotation by |v| about v: exp(hat v) = 1 + A hat v + B (hat v)² (notes, eqs 15, 17, 18).

    **Arguments:** `v` (3,) rotation vector, rad, any length. A = sin θ/θ, B = (1 − cos θ)/θ²
    (Rodrigues 1840), both from half the angle.

    >>> exp(jnp.array([0.0, 0.0, jnp.pi / 2])).round(12)[0].tolist()
    [0.0, -1.0, 0.0]
    """
    v = components(_checks.floating(v, (3,), "v"))
    s = 0.25 * square(v)
    half = stumpff(1, s)
    return _polynomial(v, stumpff(0, s) * half, 0.5 * half * half)


def log(matrix: Mat3Like) -> Vec3:
    """The shortest rotation vector of a rotation matrix, rad, |v| ≤ π.

    **Arguments:** `matrix` (3, 3) rotation. Values are not looked at: `check` is the gate.

    **Returns:** (3,), by way of the quaternion: right to round-off, with its derivatives, from 0
    to π. At a half turn, of v and −v the one whose first nonzero component is positive.

    >>> log(exp(jnp.array([0.1, 0.2, 0.3]))).round(12).tolist()
    [0.1, 0.2, 0.3]
    """
    return quaternion.log(quaternion.from_matrix(matrix))


def left_jacobian(v: Vec3Like) -> Mat3:
    """J_l with exp(v + dv) = exp(J_l dv) exp(v): what dv turns, seen from the world.

    **Arguments:** `v` (3,) rotation vector, rad. J_l = 1 + B hat v + C (hat v)², C = (θ − sin θ)/θ³
    (Chirikjian 2012, doi:10.1007/978-0-8176-4944-9; Solà 2018, eq 145).

    >>> left_jacobian(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    v = components(_checks.floating(v, (3,), "v"))
    t = square(v)
    return _polynomial(v, stumpff(2, t), stumpff(3, t))


def right_jacobian(v: Vec3Like) -> Mat3:
    """J_r with exp(v + dv) = exp(v) exp(J_r dv): what dv turns, seen from the body.

    **Arguments:** `v` (3,) rotation vector, rad. J_r(v) = J_l(−v) = J_l(v)ᵀ (Solà 2018, eq 143).

    >>> right_jacobian(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return left_jacobian(-_checks.floating(v, (3,), "v"))


def left_jacobian_inverse(v: Vec3Like) -> Mat3:
    """Inverse of the left Jacobian, 1 − ½ hat v + g (hat v)², g = (1 − (θ/2) cot(θ/2))/θ².

    **Arguments:** `v` (3,) rotation vector, rad, |v| < 2π, where it ends (Solà 2018, eq 146).

    >>> left_jacobian_inverse(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    v = components(_checks.floating(v, (3,), "v"))
    t = square(v)
    return _polynomial(v, jnp.full_like(t, -0.5), inverse_kernel(t))


def right_jacobian_inverse(v: Vec3Like) -> Mat3:
    """Inverse of the right Jacobian, 1 + ½ hat v + g (hat v)².

    **Arguments:** `v` (3,) rotation vector, rad, |v| < 2π (Solà 2018, eq 144).

    >>> right_jacobian_inverse(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return left_jacobian_inverse(-_checks.floating(v, (3,), "v"))


def distance(a: Mat3Like, b: Mat3Like) -> Scalar:
    """The angle of the rotation from a to b, rad, in [0, π].

    **Arguments:** `a`, `b` (3, 3) rotations. By atan2 of the quaternion of aᵀb, right from 1e-12 to
    π (arccos of the trace is useless below 1e-8). Its derivative does not exist where a = b; 0 is
    returned there, the shortest subgradient. For a loss take |log(aᵀb)|², which is smooth.

    >>> round(float(distance(jnp.eye(3), exp(jnp.array([0.0, 3e-9, 0.0]))) * 1e9), 9)
    3.0
    """
    a, b = _checks.floating(a, (3, 3), "a"), _checks.floating(b, (3, 3), "b")
    return quaternion.angle(quaternion.from_matrix(product(a.T, b)))


def _polynomial(v: tuple[Scalar, ...], a: Scalar, b: Scalar) -> Mat3:
    """1 + a hat v + b (hat v)²."""
    x, y, z = v
    xx, yy, zz = b * x * x, b * y * y, b * z * z
    xy, yz, zx = b * x * y, b * y * z, b * z * x
    ax, ay, az = a * x, a * y, a * z
    return jnp.stack(
        [
            1 - yy - zz,
            xy - az,
            zx + ay,
            xy + az,
            1 - zz - xx,
            yz - ax,
            zx - ay,
            yz + ax,
            1 - xx - yy,
        ]
    ).reshape(3, 3)
