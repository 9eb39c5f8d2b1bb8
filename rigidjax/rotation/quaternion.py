"""Unit quaternions (w, x, y, z), scalar first: q turns body vectors into world vectors (floor 1).

q and −q are the same rotation. `log`, and every error built on it, gives the same bits for both.
The maps here take one quaternion, look at no values and normalise nothing, so that they cost
little in a vector field; `check` is the gate for data from outside.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, QuatLike, Scalar, Vec3, Vec3Like
from rigidjax.rotation.algebra import (
    components,
    cross_components,
    dot_components,
    entries,
    square,
)
from rigidjax.special.series import arctan_ratio, inverse_kernel, stumpff

_HINT = "a quaternion is (w, x, y, z), scalar first"


def exp(v: Vec3Like) -> Quat:
    """The quaternion of a rotation vector: (cos θ/2, ½ v sin(θ/2)/(θ/2)), θ = |v|.

    **Arguments:** `v` (3,) rotation vector, rad (notes, eqs 17, 18, with v = γ y). Any length.

    **Returns:** (4,) of norm 1; value and derivatives are right at v = 0 too.

    >>> exp(jnp.array([0.0, 0.0, jnp.pi])).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    x, y, z = v = components(_checks.floating(v, (3,), "v"))
    s = 0.25 * square(v)
    half = 0.5 * stumpff(1, s)
    return jnp.stack([stumpff(0, s), half * x, half * y, half * z])


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
    a, b, c, d = components(_checks.floating(p, (4,), "p", hint=_HINT))
    e, f, g, h = components(_checks.floating(q, (4,), "q", hint=_HINT))
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
    w, x, y, z = components(_checks.floating(q, (4,), "q", hint=_HINT))
    return jnp.stack([w, -x, -y, -z])


def rotate(q: QuatLike, y: Vec3Like) -> Vec3:
    """Body components → world components, M y' (notes, eqs 8, 21).

    **Arguments:** `q` (4,) unit; `y` (3,) in the body frame, any units. Bits are the same for −q.

    >>> rotate(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    w, *u = components(_checks.floating(q, (4,), "q", hint=_HINT))
    return _turn(w, u, components(_checks.floating(y, (3,), "y")))


def rotate_inverse(q: QuatLike, y: Vec3Like) -> Vec3:
    """World components → body components, Mᵀ y (notes, eqs 8, 22).

    **Arguments:** `q` (4,) unit; `y` (3,) in the world frame, any units.

    >>> rotate_inverse(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    w, *u = components(_checks.floating(q, (4,), "q", hint=_HINT))
    return _turn(-w, u, components(_checks.floating(y, (3,), "y")))


def normalise(q: QuatLike) -> Quat:
    """The quaternion of length 1 in the direction of q.

    **Arguments:** `q` (4,), not zero. The sign is kept.

    >>> normalise(jnp.array([0.0, 3.0, 0.0, 4.0])).round(12).tolist()
    [0.0, 0.6, 0.0, 0.8]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return q / jnp.sqrt(_square(components(q)))


def canonical(q: QuatLike) -> Quat:
    """Of q and −q, the one with w > 0; if w = 0, the one whose first nonzero component is positive.

    **Arguments:** `q` (4,). The same bits come back for q and −q.

    >>> canonical(jnp.array([-1.0, 0.0, 0.0, 0.0])).tolist()
    [1.0, -0.0, -0.0, -0.0]
    """
    q = _checks.floating(q, (4,), "q", hint=_HINT)
    return jnp.where(_flipped(components(q)), -q, q)


def angle(q: QuatLike) -> Scalar:
    """The angle of a rotation, rad, in [0, π]; the same bits for q and −q.

    **Arguments:** `q` (4,), not zero; its length does not matter. 2 atan2(|q_v|, |q_w|). At the
    identity the derivative does not exist; 0 is returned, the shortest subgradient.

    >>> round(float(angle(exp(jnp.array([0.0, 1e-9, 0.0]))) * 1e9), 9)
    1.0
    """
    w, *u = components(_checks.floating(q, (4,), "q", hint=_HINT))
    n2 = dot_components(u, u)
    # Both atan2 and the root see ones, not zeros, where their derivative would be 0/0.
    there = n2 > 0
    half = jnp.arctan2(jnp.sqrt(jnp.where(there, n2, 1)), jnp.abs(w))
    return jnp.where(there, 2 * half, 0)


def to_matrix(q: QuatLike) -> Mat3:
    """The rotation matrix M, body → world, of a unit quaternion.

    **Arguments:** `q` (4,) unit. **Returns:** (3, 3); bits are the same for −q.

    >>> to_matrix(jnp.array([0.0, 0.0, 0.0, 1.0])).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = components(_checks.floating(q, (4,), "q", hint=_HINT))
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
    a, b, c, d, e, f, g, h, i = entries(m)
    w, x, y, z = 1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i
    wx, wy, wz, xy, yz, zx = h - f, c - g, d - b, b + d, f + h, c + g
    rows = (w, wx, wy, wz), (wx, x, xy, zx), (wy, xy, y, yz), (wz, zx, yz, z)
    upper = [jnp.where(x > w, one, other) for one, other in zip(rows[1], rows[0], strict=True)]
    lower = [jnp.where(z > y, one, other) for one, other in zip(rows[3], rows[2], strict=True)]
    down = jnp.maximum(y, z) > jnp.maximum(w, x)
    row = [jnp.where(down, one, other) for one, other in zip(lower, upper, strict=True)]
    scale = 1 / jnp.sqrt(row[0] ** 2 + row[1] ** 2 + row[2] ** 2 + row[3] ** 2)
    scale = jnp.where(_flipped(row), -scale, scale)
    return jnp.stack([scale * part for part in row])


def _turn(w: Scalar, u: Sequence[Scalar], y: Sequence[Scalar]) -> Vec3:
    """The sum y + 2w u×y + 2 u×(u×y)."""
    t = [2 * part for part in cross_components(u, y)]
    again = cross_components(u, t)
    return jnp.stack([y[i] + (w * t[i] + again[i]) for i in range(3)])


def _square(q: Sequence[Scalar]) -> Scalar:
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


def _flipped(q: Sequence[Scalar]) -> Array:
    """Whether −q, not q, is canonical."""
    w, x, y, z = q
    lead = jnp.where(w != 0, w, jnp.where(x != 0, x, jnp.where(y != 0, y, z)))
    return lead < 0


@jax.custom_jvp
def _log(q: Quat) -> Vec3:
    w, x, y, z = parts = components(q)
    n2 = x * x + y * y + z * z
    # tan of the half angle is n/|w|, of the quarter n/a, of the eighth n/b: nothing cancels.
    a = jnp.abs(w) + jnp.sqrt(n2 + w * w)
    inverse = 1 / (a + jnp.sqrt(n2 + a * a))
    scale = 8 * inverse * arctan_ratio(n2 * inverse * inverse)
    scale = jnp.where(_flipped(parts), -scale, scale)
    return jnp.stack([scale * x, scale * y, scale * z])


@_log.defjvp
def _log_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (q,), (dq,) = primals, tangents
    v = _log(q)
    w, *u = parts = components(q)
    dw, *du = components(dq)
    # The turn seen from the body, 2 vec(q̄ dq)/|q|², then the inverse right Jacobian.
    scale, aside = 2 / _square(parts), cross_components(u, du)
    turn = [scale * (w * du[i] - dw * u[i] - aside[i]) for i in range(3)]
    vs = components(v)
    across = cross_components(vs, turn)
    twice = cross_components(vs, across)
    g = inverse_kernel(dot_components(vs, vs))
    return v, jnp.stack([turn[i] + 0.5 * across[i] + g * twice[i] for i in range(3)])
