"""Unit quaternions (w, x, y, z), scalar first: q turns body vectors into world vectors (floor 1).

q and −q are the same rotation. `log`, and every error built on it, gives the same bits for both.
The maps here take one quaternion, look at no values and normalise nothing, so that they cost
little in a vector field; `check` is the gate for data from outside.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, QuatLike, Scalar, Vec3, Vec3Like
from rigidjax.rotation.algebra import cross, dot
from rigidjax.special.series import arctan_ratio, inverse_kernel, stumpff

_HINT = "a quaternion is (w, x, y, z), scalar first"


def exp(v: Vec3Like) -> Quat:
    """The quaternion of a rotation vector: (cos θ/2, ½ v sin(θ/2)/(θ/2)), θ = |v|.

    **Arguments:** `v` (3,) rotation vector, rad (notes, eqs 17, 18, with v = γ y). Any length.

    **Returns:** (4,) of norm 1; value and derivatives are right at v = 0 too.

    >>> exp(jnp.array([0.0, 0.0, jnp.pi])).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    v = _checks.floating(v, (3,), "v")
    s = 0.25 * dot(v, v)
    half = 0.5 * stumpff(1, s)
    return jnp.stack([stumpff(0, s), half * v[0], half * v[1], half * v[2]])


def log(q: QuatLike) -> Vec3:
    """The shortest rotation vector of a quaternion, rad, |v| ≤ π.

    **Arguments:** `q` (4,), not zero; its length does not matter.

    **Returns:** v = 2 atan2(|q_v|, q_w) q_v/|q_v| (3,), from q or −q, whichever has q_w > 0; at
    q_w = 0 the one whose first nonzero component is positive. The derivative is that of
    Q(q)/|q|, by the inverse right Jacobian, and right from 0 to π (Solà 2018, arXiv:1711.02508;
    the angle is halved twice so that nothing cancels or branches).

    >>> log(jnp.array([0.0, 0.0, 0.0, -1.0])).round(6).tolist()
    [0.0, 0.0, 3.141593]
    """
    return _log(_checks.floating(q, (4,), "q", hint=_HINT))


def multiply(p: QuatLike, q: QuatLike) -> Quat:
    """Product p q: first turn by q, then by p (the matrices multiply in the same order).

    **Arguments:** `p`, `q` (4,). With q body → world, `multiply(q, d)` turns by d seen from the
    body and `multiply(d, q)` by d seen from the world (notes, eqs 27–29).

    >>> multiply(jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0, 0.0])).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    a, b, c, d = _checks.floating(p, (4,), "p", hint=_HINT)
    e, f, g, h = _checks.floating(q, (4,), "q", hint=_HINT)
    return jnp.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def conjugate(q: QuatLike) -> Quat:
    """The opposite rotation of a unit quaternion, (w, −x, −y, −z).

    **Arguments:** `q` (4,).

    >>> conjugate(jnp.array([1.0, 2.0, 3.0, 4.0])).tolist()
    [1.0, -2.0, -3.0, -4.0]
    """
    w, x, y, z = _checks.floating(q, (4,), "q", hint=_HINT)
    return jnp.stack([w, -x, -y, -z])


def rotate(q: QuatLike, y: Vec3Like) -> Vec3:
    """Body components → world components, M y' (notes, eqs 8, 21).

    **Arguments:** `q` (4,) unit; `y` (3,) in the body frame, any units. Bits are the same for −q.

    >>> rotate(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return _turn(q[0], q[1:], _checks.floating(y, (3,), "y"))


def rotate_inverse(q: QuatLike, y: Vec3Like) -> Vec3:
    """World components → body components, Mᵀ y (notes, eqs 8, 22).

    **Arguments:** `q` (4,) unit; `y` (3,) in the world frame, any units.

    >>> rotate_inverse(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return _turn(-q[0], q[1:], _checks.floating(y, (3,), "y"))


def normalise(q: QuatLike) -> Quat:
    """The quaternion of length 1 in the direction of q.

    **Arguments:** `q` (4,), not zero. The sign is kept.

    >>> normalise(jnp.array([0.0, 3.0, 0.0, 4.0])).round(12).tolist()
    [0.0, 0.6, 0.0, 0.8]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return q / jnp.sqrt(_square(q))


def canonical(q: QuatLike) -> Quat:
    """Of q and −q, the one with w > 0; if w = 0, the one whose first nonzero component is positive.

    **Arguments:** `q` (4,). The same bits come back for q and −q.

    >>> canonical(jnp.array([-1.0, 0.0, 0.0, 0.0])).tolist()
    [1.0, -0.0, -0.0, -0.0]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return jnp.where(_flipped(q), -q, q)


def angle(q: QuatLike) -> Scalar:
    """The angle of a rotation, rad, in [0, π]; the same bits for q and −q.

    **Arguments:** `q` (4,), not zero; its length does not matter. 2 atan2(|q_v|, |q_w|). At the
    identity the derivative does not exist; 0 is returned, the shortest subgradient.

    >>> round(float(angle(exp(jnp.array([0.0, 1e-9, 0.0]))) * 1e9), 9)
    1.0
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    n2 = dot(q[1:], q[1:])
    # Both atan2 and the root see ones, not zeros, where their derivative would be 0/0.
    there = n2 > 0
    half = jnp.arctan2(jnp.sqrt(jnp.where(there, n2, 1)), jnp.abs(q[0]))
    return jnp.where(there, 2 * half, 0)


def to_matrix(q: QuatLike) -> Mat3:
    """The rotation matrix M, body → world, of a unit quaternion.

    **Arguments:** `q` (4,) unit. **Returns:** (3, 3); bits are the same for −q.

    >>> to_matrix(jnp.array([0.0, 0.0, 0.0, 1.0])).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = _checks.floating(q, (4,), "q", hint=_HINT)
    xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
    xy, yz, zx = 2 * x * y, 2 * y * z, 2 * z * x
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    return jnp.stack(
        [
            1 - yy - zz,
            xy - wz,
            zx + wy,
            xy + wz,
            1 - zz - xx,
            yz - wx,
            zx - wy,
            yz + wx,
            1 - xx - yy,
        ]
    ).reshape(3, 3)


def from_matrix(matrix: Mat3Like) -> Quat:
    """The canonical unit quaternion of a rotation matrix.

    **Arguments:** `matrix` (3, 3) rotation, body → world. Values are not looked at: `so3.check`.

    **Returns:** (4,) with w ≥ 0: the largest of the four rows of 4 q qᵀ, normalised (Shepperd 1978,
    doi:10.2514/3.55767b), so that no case loses digits; the derivative goes through that row only.

    >>> from_matrix(jnp.diag(jnp.array([-1.0, -1.0, 1.0]))).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    m = _checks.floating(matrix, (3, 3), "matrix", hint="a rotation matrix is wanted")
    (a, b, c), (d, e, f), (g, h, i) = m[0], m[1], m[2]
    w, x, y, z = 1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i
    wx, wy, wz, xy, yz, zx = h - f, c - g, d - b, b + d, f + h, c + g
    upper = jnp.where(x > w, jnp.stack([wx, x, xy, zx]), jnp.stack([w, wx, wy, wz]))
    lower = jnp.where(z > y, jnp.stack([wz, zx, yz, z]), jnp.stack([wy, xy, y, yz]))
    return canonical(normalise(jnp.where(jnp.maximum(y, z) > jnp.maximum(w, x), lower, upper)))


def _turn(w: Float[Array, ""], u: Vec3, y: Vec3) -> Vec3:
    """y + 2w u×y + 2 u×(u×y)."""
    t = 2 * cross(u, y)
    return y + w * t + cross(u, t)


def _square(q: Quat) -> Float[Array, ""]:
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


def _flipped(q: Quat) -> Array:
    """Whether −q, not q, is canonical."""
    lead = jnp.where(q[2] != 0, q[2], q[3])
    lead = jnp.where(q[1] != 0, q[1], lead)
    return jnp.where(q[0] != 0, q[0], lead) < 0


@jax.custom_jvp
def _log(q: Quat) -> Vec3:
    q = canonical(q)
    w, u = q[0], q[1:]
    n2 = dot(u, u)
    # tan of the half angle is n/w, of the quarter n/a, of the eighth n/b: no difference is taken.
    a = w + jnp.sqrt(n2 + w * w)
    inverse = 1 / (a + jnp.sqrt(n2 + a * a))
    return (8 * inverse * arctan_ratio(n2 * inverse * inverse)) * u


@_log.defjvp
def _log_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (q,), (dq,) = primals, tangents
    v = _log(q)
    # The turn seen from the body, 2 vec(q̄ dq)/|q|², then the inverse right Jacobian.
    turn = (2 / _square(q)) * (q[0] * dq[1:] - dq[0] * q[1:] - cross(q[1:], dq[1:]))
    across = cross(v, turn)
    return v, turn + 0.5 * across + inverse_kernel(dot(v, v)) * cross(v, across)
