"""Compute with unit quaternions (w, x, y, z), scalar first: q turns body vectors into world
vectors.

q and −q are the same rotation. `log`, and every error computed with `log`, gives the same bits for
q and −q. The functions of this module take one quaternion and do not normalise it, so that they
cost little in a vector field; `check` is for data from outside. The functions check only known
values, not traced values.

Range: functions of a quaternion or axis of any length (`normalise`, `log`, `angle`, `about_axis`)
take lengths from 1e-307 to 1e308 (float32: 1e-37 to 1e38). An angle beyond 1/ε, where ε is the unit
of round-off, has no correct digit: `exp` and the functions that use `exp` refuse an angle above
4.5e15 rad (float32: 8.4e6 rad). A traced angle beyond 1/ε gives an arbitrary rotation, and NaN
beyond 1e150 rad (float32: 1e18 rad). Vectors and rates that a function takes besides a unit
quaternion may have components up to 1e307 (float32: 1e37).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import (
    Mat3,
    Mat3Like,
    Quat,
    QuatLike,
    Rotation,
    Scalar,
    ScalarLike,
    Vec3,
    Vec3Like,
)
from rigidjax.rotation.barrier import barrier
from rigidjax.rotation.kernels import (
    hat_polynomial,
    is_noncanonical,
    matrix_to_quaternion,
    quaternion_product,
    quaternion_to_vector,
    to_unit_length,
    vector_to_quaternion,
)
from rigidjax.rotation.linalg3 import (
    components,
    cross_components,
    dot,
    dot_components,
    power_of_two_scale,
)
from rigidjax.rotation.validation import (
    require_direction,
    require_rotation,
    require_turn,
    require_unit,
)

_HINT = "one quaternion is (w, x, y, z), scalar first; batch with jax.vmap"


def exp(v: Vec3Like) -> Quat:
    """Return the quaternion of a rotation vector: (cos θ/2, ½ v sin(θ/2)/(θ/2)), θ = |v|.

    **Arguments:** `v` (3,) rotation vector, rad (notes, eqs 17, 18, where v = γ y has the angle γ
    and the unit axis y). The angle has an error of ε|v|, where ε is the unit of round-off.
    **Returns:** (4,) of norm 1; value and derivatives are correct also at v = 0. **Raises:**
    `ValueError` for NaN, and for an angle beyond 1/ε, which has no correct digit.

    >>> exp(jnp.array([0.0, 0.0, jnp.pi])).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return vector_to_quaternion(require_turn(_checks.array_of_shape(v, (3,), "v"), "v"))


def log(q: QuatLike) -> Vec3:
    """Return the shortest rotation vector of a quaternion, rad, |v| ≤ π.

    **Arguments:** `q` (4,) of any length. **Returns:** v = 2 atan2(|q_v|, q_w) q_v/|q_v| (3,), with
    the scalar part q_w and the vector part q_v of `canonical(q)`. The derivative is that of the
    rotation vector of q/|q|, by the inverse of the right Jacobian, and is correct for angles from 0
    to π (Solà 2018, arXiv:1711.02508; the angle is halved twice to avoid cancellation and
    branches). **Raises:** `ValueError` for zero or NaN.

    >>> abs(log(jnp.array([0.0, 0.0, 0.0, -1.0]))).round(6).tolist()
    [0.0, 0.0, 3.141593]
    """
    return quaternion_to_vector(
        require_direction(_checks.array_of_shape(q, (4,), "q", hint=_HINT), "q")
    )


def multiply(p: QuatLike, q: QuatLike) -> Quat:
    """Return the product p q: first turn by q, then by p (the matrices multiply in the same order).

    **Arguments:** `p`, `q` (4,). With q body → world, `multiply(q, d)` is a turn by d about axes of
    the body, and `multiply(d, q)` about axes of the world (notes, eqs 27–29).

    >>> multiply(jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0, 0.0])).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    first = components(_checks.array_of_shape(p, (4,), "p", hint=_HINT))
    return jnp.stack(
        quaternion_product(first, components(_checks.array_of_shape(q, (4,), "q", hint=_HINT)))
    )


def conjugate(q: QuatLike) -> Quat:
    """Return the conjugate (w, −x, −y, −z) of `q` (4,), the opposite rotation if `q` is unit.

    >>> conjugate(jnp.array([1.0, 2.0, 3.0, 4.0])).tolist()
    [1.0, -2.0, -3.0, -4.0]
    """
    w, x, y, z = components(_checks.array_of_shape(q, (4,), "q", hint=_HINT))
    return jnp.stack([w, -x, -y, -z])


def rotate(q: QuatLike, y: Vec3Like) -> Vec3:
    """Return the world components M y of a vector with the body components `y` (3,), where M is the
    rotation matrix of the unit quaternion `q` (4,) (notes, eqs 8, 21).

    >>> rotate(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    w, *u = components(_checks.array_of_shape(q, (4,), "q", hint=_HINT))
    return _rotated_vector(w, u, components(_checks.array_of_shape(y, (3,), "y")))


def rotate_inverse(q: QuatLike, y: Vec3Like) -> Vec3:
    """Return the body components Mᵀ y of a vector with the world components `y` (3,), where M is
    the rotation matrix of the unit quaternion `q` (4,) (notes, eqs 8, 22).

    >>> rotate_inverse(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0])).tolist()
    [-1.0, -2.0, 3.0]
    """
    w, *u = components(_checks.array_of_shape(q, (4,), "q", hint=_HINT))
    return _rotated_vector(-w, u, components(_checks.array_of_shape(y, (3,), "y")))


def check(
    q: Float[ArrayLike, "*batch 4"] | Rotation, *, name: str = "q"
) -> Float[Array, "*batch 4"]:
    """Normalise a quaternion that a user gives, or refuse it if its length is not near 1.

    **Arguments:** `q` (..., 4), scalar first, or a `Rotation` of SciPy; `name` the name of the
    argument in messages. **Returns:** the quaternion, with length 1 to round-off. **Raises:**
    `ValueError` (under `jit` `equinox.error_if`) for NaN, zero, and a length that differs from 1 by
    more than 1e-6 (float32: 1e-3).

    >>> check(jnp.array([1.0, 0.0, 0.0, 1e-9])).tolist()[0]
    1.0
    """
    return require_unit(_checks.array_of_shape(q, (4,), name, hint=_HINT, batched=True), name)


def from_xyzw(xyzw: Float[ArrayLike, "4"]) -> Quat:
    """Return (w, x, y, z) of scalar-last components `xyzw` (4,) (SciPy, ROS, glTF).

    **Raises:** `TypeError` for a `Rotation` of SciPy, which every other function takes as it is in
    the place of a quaternion.

    >>> from_xyzw(jnp.array([0.0, 0.0, 0.0, 1.0])).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    if _checks.is_rotation(xyzw):
        words = "xyzw: wanted components (x, y, z, w), got a Rotation"
        raise TypeError(f"{words}; pass it as the attitude itself, or give its .as_quat()")
    return jnp.roll(_checks.array_of_shape(xyzw, (4,), "xyzw"), 1)


def to_xyzw(q: QuatLike) -> Float[Array, "4"]:
    """Return the components (x, y, z, w), scalar last as in SciPy, ROS and glTF, of `q` (4,) = (w,
    x, y, z).

    >>> to_xyzw(jnp.array([1.0, 0.0, 0.0, 0.0])).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    return jnp.roll(_checks.array_of_shape(q, (4,), "q", hint=_HINT), -1)


def about_axis(axis: Vec3Like, angle: ScalarLike) -> Quat:
    """Return the rotation by an angle about an axis (notes, eqs 17, 18).

    **Arguments:** `axis` (3,) of any length; `angle` rad, right-handed about `axis`. **Raises:**
    `ValueError` for an axis of zero, for NaN, and, as `exp`, for an angle beyond 1/ε with the unit
    of round-off ε, which has no correct digit.

    >>> about_axis(jnp.array([0.0, 0.0, 2.0]), jnp.pi).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    axis = require_direction(_checks.array_of_shape(axis, (3,), "axis"), "axis")
    half = 0.5 * require_turn(
        _checks.array_of_shape(angle, (), "angle").astype(axis.dtype), "angle"
    )
    axis = power_of_two_scale(*components(axis)) * axis
    unit = axis / jnp.sqrt(dot(axis, axis))
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * unit])


def advance(q: QuatLike, omega: Vec3Like, dt: ScalarLike) -> Quat:
    """Return the attitude after a constant body rate for a time dt: q exp(Ω dt), exact.

    **Arguments:** `q` (4,) unit, body → world; `omega` (3,) rad/s, body frame; `dt` s. **Raises:**
    as `exp`.

    >>> advance(jnp.array([1.0, 0, 0, 0]), jnp.array([0, 0, jnp.pi]), 1.0).round(12).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    q = _checks.array_of_shape(q, (4,), "q", hint=_HINT)
    omega = _checks.array_of_shape(omega, (3,), "omega")
    dt = _checks.array_of_shape(dt, (), "dt").astype(omega.dtype)
    return multiply(q, vector_to_quaternion(require_turn(dt * omega, "dt * omega")))


def rate(q: QuatLike, omega: Vec3Like) -> Quat:
    """Return dq/dt = ½ q (0, Ω), 1/s, of `q` (4,) unit and `omega` (3,) Ω, rad/s, body frame
    (notes, eq 50).

    >>> float(rate(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 2.0]))[3])
    1.0
    """
    q, omega = _checks.array_of_shape(q, (4,), "q"), _checks.array_of_shape(omega, (3,), "omega")
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = 0.5 * omega[0], 0.5 * omega[1], 0.5 * omega[2]
    rates = w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a
    return jnp.stack([-x * a - y * b - z * c, *rates])


def interpolate(p: QuatLike, q: QuatLike, s: ScalarLike) -> Quat:
    """Return the rotation at the fraction s of the shortest turn from p (s = 0) to q (s = 1).

    **Arguments:** `p`, `q` (4,) unit, either sign; `s` dimensionless, also beyond [0, 1]. The
    result is p exp(s log(p̄ q)), with the conjugate p̄ of p: the angle from p is proportional to s.
    It is regular at p = q (Shoemake 1985, doi:10.1145/325334.325242). **Raises:** `ValueError` if
    the product p̄ q is zero or NaN.

    >>> p, q = exp(jnp.array([0, 0, 1.0])), exp(jnp.array([0, 0, 2.0]))
    >>> bool(abs(interpolate(p, q, 0.5) - exp(jnp.array([0, 0, 1.5]))).max() < 1e-15)
    True
    """
    p = _checks.array_of_shape(p, (4,), "p", hint=_HINT)
    v = quaternion_to_vector(require_direction(multiply(conjugate(p), q), "p̄ q"))
    part = require_turn(_checks.array_of_shape(s, (), "s").astype(v.dtype) * v, "s times the turn")
    return multiply(p, vector_to_quaternion(part))


def uniform(key: PRNGKeyArray, dtype: DTypeLike = float) -> Quat:
    """Return a uniformly distributed random rotation (Haar measure): four normally distributed
    numbers divided by the root of the sum of their squares.

    **Arguments:** `key` of `jax.random`; `dtype` float32 or float64 (Muller 1959).

    >>> uniform(jax.random.key(0)).shape
    (4,)
    """
    return normalise(jax.random.normal(_checks.random_key(key), (4,), _checks.float_type(dtype)))


def normalise(q: QuatLike) -> Quat:
    """Return `q` (4,) scaled to length 1, with its sign. **Raises:** `ValueError` for zero or NaN.

    >>> normalise(jnp.array([0.0, 4.0, 0.0, 0.0])).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    return to_unit_length(require_direction(_checks.array_of_shape(q, (4,), "q", hint=_HINT), "q"))


def canonical(q: QuatLike) -> Quat:
    """Return `q` (4,) or −q: the one whose first nonzero component is positive.

    >>> canonical(jnp.array([-1.0, 0.0, 0.0, 0.0])).tolist()
    [1.0, -0.0, -0.0, -0.0]
    """
    q = _checks.array_of_shape(q, (4,), "q", hint=_HINT)
    return jnp.where(is_noncanonical(components(q)), -q, q)


def angle(q: QuatLike) -> Scalar:
    """Return the angle of a rotation, rad, in [0, π]; q and −q give the same angle to the last bit.

    **Arguments:** `q` (4,) of any length. The angle is 2 atan2(|q_v|, |q_w|), with the scalar part
    q_w and the vector part q_v. At the identity the angle has no derivative: zero is taken in its
    place, the subgradient of least length. **Raises:** `ValueError` for zero or NaN.

    >>> round(float(angle(exp(jnp.array([0.0, 1e-9, 0.0]))) * 1e9), 9)
    1.0
    """
    q = require_direction(_checks.array_of_shape(q, (4,), "q", hint=_HINT), "q")
    w, *u = components(power_of_two_scale(*components(q)) * q)
    n2 = dot_components(u, u)
    # At the identity the arguments of atan2 and of the root are replaced by ones: at zero the
    # derivative would be 0/0 = NaN.
    there = n2 != 0
    half = jnp.arctan2(jnp.sqrt(jnp.where(there, n2, 1)), jnp.abs(w))
    return jnp.where(there, 2 * half, 0)


def to_matrix(q: QuatLike) -> Mat3:
    """Return the rotation matrix M (3, 3), body → world, of `q` (4,) unit; q and −q give the same
    matrix to the last bit.

    >>> to_matrix(jnp.array([0.0, 0.0, 0.0, 1.0])).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, *u = components(_checks.array_of_shape(q, (4,), "q", hint=_HINT))
    return hat_polynomial(u, 2 * w, 2.0)


def from_matrix(matrix: Mat3Like) -> Quat:
    """Return the canonical unit quaternion of a rotation matrix.

    **Arguments:** `matrix` (3, 3) rotation, body → world. **Returns:** (4,) with w ≥ 0: the largest
    of the four rows of 4 q qᵀ, normalised (Shepperd 1978, doi:10.2514/3.55767b). No case loses
    digits; the derivative uses the largest row only. **Raises:** as `so3.check` for known values;
    values that `jit`, `grad` or `vmap` trace are not checked.

    >>> from_matrix(jnp.diag(jnp.array([-1.0, -1.0, 1.0]))).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    matrix = _checks.array_of_shape(matrix, (3, 3), "matrix", hint="a rotation matrix is wanted")
    return matrix_to_quaternion(_checks.check_if_known(require_rotation, matrix, "matrix"))


def _rotated_vector(w: Scalar, u: Sequence[Scalar], y: Sequence[Scalar]) -> Vec3:
    """Return a vector turned by a unit quaternion (w, u), y + 2 (w u × y + u × (u × y))."""
    across = cross_components(u, y)
    again = cross_components(u, across)
    # The barrier makes XLA compute each component once: otherwise a torque that uses the turned
    # vector would compute all three again for each of its own components.
    return jnp.stack(barrier([y[i] + 2 * (w * across[i] + again[i]) for i in range(3)]))


__all__ = [
    "about_axis", "advance", "angle", "canonical", "check", "conjugate", "exp", "from_matrix",
    "from_xyzw", "interpolate", "log", "multiply", "normalise", "rate", "rotate", "rotate_inverse",
    "to_matrix", "to_xyzw", "uniform",
]  # fmt: skip

define_dir_and_getattr(__name__)
