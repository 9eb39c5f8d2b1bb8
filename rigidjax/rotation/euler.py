"""Convert Euler angles in all 24 sequences; the default is 3-1-3, "ZXZ", as in the notes.

A sequence is three letters, and the angles are in the order of the letters; all turns are active,
and all angles in radians. **Capitals are intrinsic**: each turn is about the moved axis, and M =
R_1(a) R_2(b) R_3(c) (notes, eqs 12, 27–31). **Lower case is extrinsic**: each turn is about a fixed
axis of the world, and M = R_3(c) R_2(b) R_1(a). SciPy uses the same letters. **Raises:**
`ValueError` for an unknown sequence.

**The singular case** ("gimbal lock") is a middle angle of 0 or π if the first and the last letter
agree, and of ±π/2 if all three differ. Only the sum or the difference of the outer angles is then
defined. If the sine or cosine that vanishes in this case is below 4 units of round-off, **the last
angle listed is 0**, and the rate of this angle is 0; the matrix is still right. Derivatives are
then finite: they are the derivatives of the other two angles at a fixed middle angle. `is_singular`
tests for the singular case.
"""

import warnings
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Mat3, Mat3Like, Quat, QuatLike, Scalar, Vec3, Vec3Like
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, components, cross, dot, power_of_two_scale
from rigidjax.rotation.validation import require_direction, require_turn

_MANY_TURNS = 8 * np.pi


def to_quaternion(angles: Vec3Like, sequence: str = "ZXZ") -> Quat:
    """Return the unit quaternion, body → world, of three Euler angles.

    **Arguments:** `angles` (3,), rad, in the order of `sequence`: three letters in capitals for
    turns about the moved axes, such as "ZXZ", or in lower case for turns about fixed axes.
    **Warns** if a known angle is beyond four turns: it may be in degrees.

    >>> to_quaternion(jnp.array([0.0, jnp.pi, 0.0])).round(12).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    axes, reverse = _turns(sequence)
    first, second, third = map(_turn, axes, _in_order(_checked_angles(angles), reverse))
    return quaternion.multiply(quaternion.multiply(first, second), third)


def to_matrix(angles: Vec3Like, sequence: str = "ZXZ") -> Mat3:
    """Return the rotation matrix, body → world, of three Euler angles (notes, eqs 31, 33 for
    "ZXZ").

    **Arguments:** `angles` (3,), rad, in the order of `sequence`: (φ, θ, ψ) for "ZXZ"; capitals are
    turns about the moved axes, lower case turns about fixed axes.

    >>> to_matrix(jnp.array([0.0, jnp.pi / 2, 0.0]), "ZXZ").round(12)[1].tolist()
    [0.0, 0.0, -1.0]
    """
    return quaternion.to_matrix(to_quaternion(angles, sequence))


def from_matrix(matrix: Mat3Like, sequence: str = "ZXZ") -> Vec3:
    """Return the Euler angles of a rotation matrix, rad, in the order of `sequence`.

    **Arguments:** `matrix` (3, 3) rotation, body → world. **Returns:** (3,): outer angles in (−π,
    π], the middle one in [0, π] if the first and the last letter agree, else in [−π/2, π/2]. In the
    singular case, in which the first and the last turn are about one axis, the last angle is 0.
    **Raises:** as `so3.check` for known values; traced values are not checked.

    >>> angles = jnp.array([0.3, 0.2, 0.1])
    >>> bool(abs(from_matrix(to_matrix(angles, "xyz"), "xyz") - angles).max() < 1e-15)
    True
    """
    return from_quaternion(quaternion.from_matrix(matrix), sequence)


def from_quaternion(q: QuatLike, sequence: str = "ZXZ") -> Vec3:
    """Return the Euler angles of a quaternion, rad, in the order of `sequence`; q and −q give the
    same angles to the last bit.

    **Arguments:** `q` (4,) of any length, body → world. **Raises:** `ValueError` for zero or NaN.
    Half the sum and half the difference of the outer angles come from two calls of atan2, so that
    the rotation keeps all its digits near the singular case (Bernardes & Viollet 2022,
    doi:10.1371/journal.pone.0276302).

    >>> from_quaternion(jnp.array([1.0, 0.0, 0.0, 0.0])).tolist()
    [0.0, 0.0, 0.0]
    """
    (i, j, k), reverse = _turns(sequence)
    q = quaternion.canonical(require_direction(_checks.array_of_shape(q, (4,), "q"), "q"))
    q = power_of_two_scale(*components(q)) * q
    symmetric = i == k
    last = 3 - i - j
    handed = _handedness(i, j)
    w, x, y, z = q[0], q[1 + i], q[1 + j], q[1 + last]
    if symmetric:
        z = handed * z
    else:
        # The three axes differ. A quarter turn about the middle axis takes the last axis into the
        # first, so that the formulas for equal outer axes apply. All four numbers are then √2 times
        # too large, which changes no angle.
        w, x, y, z = w + handed * y, x + z, w - handed * y, x - z
    flat, up = y * y + z * z, w * w + x * x
    tiny = (2 * jnp.finfo(q.dtype).eps) ** 2 * (flat + up)
    low, high = flat <= tiny, up <= tiny
    half_sum = jnp.arctan2(jnp.where(high, 0, x), jnp.where(high, 1, w))
    half_difference = jnp.arctan2(jnp.where(low, 0, z), jnp.where(low, 1, y))
    # In the singular case the last angle listed is 0: the third of the intrinsic turns, or the
    # first turn if the order is reversed.
    sign = -1 if reverse else 1
    half_difference = jnp.where(low, sign * half_sum, half_difference)
    half_sum = jnp.where(high, sign * half_difference, half_sum)
    s, c = jnp.sqrt(jnp.where(low, 1, flat)), jnp.sqrt(jnp.where(high, 1, up))
    s, c = jnp.where(low, 0, s), jnp.where(high, 0, c)
    middle = 2 * jnp.arctan2(s, c) if symmetric else handed * 2 * jnp.arctan2(c - s, c + s)
    angles = [
        _wrapped_angle(half_sum + half_difference),
        middle,
        _wrapped_angle(half_sum - half_difference),
    ]
    return jnp.stack(angles[::-1] if reverse else angles)


def is_singular(angles: Vec3Like, sequence: str = "ZXZ") -> Bool[Array, ""]:
    """Return whether the first and the last turn of Euler angles are about one axis, to 4 units of
    round-off.

    **Arguments:** `angles` (3,), rad, in the order of `sequence`. For a matrix:
    `is_singular(from_matrix(matrix, sequence), sequence)`.

    >>> bool(is_singular(jnp.array([0.1, 0.0, 0.0]), "ZXZ"))
    True
    """
    axes, _ = _turns(sequence)
    return _triple_product(_checked_angles(angles)[1], axes)[1]


def rates_to_omega(
    angles: Vec3Like,
    rates: Vec3Like,
    sequence: str = "ZXZ",
    *,
    frame: Literal["body", "world"] = "body",
) -> Vec3:
    """Return the angular velocity that belongs to Euler angles and their rates (notes, eqs 80–83
    for "ZXZ" and "body").

    **Arguments:** `angles` (3,), rad, and `rates` (3,), rad/s, in the order of `sequence`; `frame`
    of the result, (3,), rad/s.

    >>> rates_to_omega(jnp.array([0.1, 0.2, 0.3]), jnp.array([0.0, 0.0, 2.0])).tolist()
    [0.0, 0.0, 2.0]
    """
    _checks.require_option(frame, ("body", "world"), "frame")
    axes, reverse = _turns(sequence)
    angles, rates = _checked_angles(angles), _checks.array_of_shape(rates, (3,), "rates")
    first, second, third = _body_axes(axes, _in_order(angles, reverse))
    a, b, c = _in_order(rates, reverse)
    omega = a * first + b * second + c * third
    return omega if frame == "body" else apply(to_matrix(angles, sequence), omega)


def omega_to_rates(
    angles: Vec3Like,
    omega: Vec3Like,
    sequence: str = "ZXZ",
    *,
    frame: Literal["body", "world"] = "body",
) -> Vec3:
    """Return the rates of the Euler angles for an angular velocity: eqs 81–83 of the notes, solved.

    **Arguments:** `angles` (3,), rad, in the order of `sequence`; `omega` (3,), rad/s, in `frame`.
    **Returns:** (3,) rad/s. In the singular case (`is_singular`) the last rate is 0, and the
    component of `omega` that no rates can produce is dropped.

    >>> omega_to_rates(jnp.array([0.1, 0.2, 0.3]), jnp.array([0.0, 0.0, 2.0])).tolist()
    [0.0, 0.0, 2.0]
    """
    _checks.require_option(frame, ("body", "world"), "frame")
    axes, reverse = _turns(sequence)
    angles, omega = _checked_angles(angles), _checks.array_of_shape(omega, (3,), "omega")
    if frame == "world":
        omega = apply(to_matrix(angles, sequence).T, omega)
    first, second, third = _body_axes(axes, _in_order(angles, reverse))
    product, singular = _triple_product(angles[1], axes)
    # `second` is normal to `first` and `third`, so that `aside`, `second` and `third` are an
    # orthonormal frame: the rates follow from the components of `omega` in this frame.
    aside, along = cross(third, second), dot(first, third)
    a = dot(aside, omega) / jnp.where(singular, 1, product)
    a = jnp.where(singular, 0 if reverse else along * dot(third, omega), a)
    c = jnp.where(singular & (not reverse), 0, dot(third, omega) - along * a)
    b = dot(second, omega)
    return jnp.stack([c, b, a] if reverse else [a, b, c])


class _Turns(NamedTuple):
    """Hold three intrinsic turns, each about the axis that the turns before it have moved."""

    axes: tuple[int, int, int]  # 0 for x, 1 for y, 2 for z
    reverse: bool  # whether the user lists the angles in the opposite order, as in lower case


def _turns(sequence: str) -> _Turns:
    """Return the turns of a sequence such as "ZXZ"; raise `ValueError` for an unknown one."""
    extrinsic = isinstance(sequence, str) and sequence.islower()
    letters = "xyz" if extrinsic else "XYZ"
    reason = ""
    if not isinstance(sequence, str) or len(sequence) != 3 or not set(sequence) <= set(letters):
        reason = "three letters of one case are wanted"
    elif sequence[1] in (sequence[0], sequence[2]):
        reason = "two turns in a row are about one axis"
    if reason:
        raise ValueError(
            f"sequence: unknown {sequence!r}, {reason}; capitals are intrinsic (moving axes) as in "
            "'ZXZ' or 'ZYX', lower case is extrinsic (fixed axes) as in 'xyz'"
        )
    i, j, k = (letters.index(letter) for letter in sequence)
    return _Turns((k, j, i) if extrinsic else (i, j, k), extrinsic)


def _checked_angles(angles: Vec3Like) -> Vec3:
    """Return three angles, rad; warn of a known one beyond four turns (degrees?)."""
    angles = require_turn(_checks.array_of_shape(angles, (3,), "angles"), "angles")
    if _checks.is_known(angles) and bool(np.any(np.abs(np.asarray(angles)) > _MANY_TURNS)):
        words = "are over four turns: are they degrees? use jnp.deg2rad"
        warnings.warn(f"angles {angles.tolist()} rad {words}", stacklevel=3)
    return angles


def _in_order(numbers: Vec3, reverse: bool) -> tuple[Scalar, Scalar, Scalar]:
    """Return the components of a vector, in the opposite order if `reverse` is true."""
    a, b, c = numbers
    return (c, b, a) if reverse else (a, b, c)


def _handedness(i: int, j: int) -> int:
    """Return the sign s of e_i × e_j = s e_k for two axes i ≠ j."""
    return 1 if (j - i) % 3 == 1 else -1


def _turn(axis: int, angle: Scalar) -> Quat:
    """Return the unit quaternion of a turn by `angle`, rad, about a basis vector."""
    parts = [jnp.cos(0.5 * angle)] + [jnp.zeros_like(angle)] * 3
    parts[1 + axis] = jnp.sin(0.5 * angle)
    return jnp.stack(parts)


def _wrapped_angle(angle: Scalar) -> Scalar:
    """Return an angle between −2π and 2π, rad, shifted into the interval (−π, π]."""
    angle = jnp.where(angle > np.pi, angle - 2 * np.pi, angle)
    return jnp.where(angle <= -np.pi, angle + 2 * np.pi, angle)


def _body_axes(
    axes: tuple[int, int, int], angles: tuple[Scalar, Scalar, Scalar]
) -> tuple[Vec3, Vec3, Vec3]:
    """Return the axes of the three turns in the body frame: the angular velocity is the sum of the
    axes, each times the rate of its angle.
    """
    _, j, k = axes
    first, second, third = (jnp.eye(3, dtype=angles[0].dtype)[axis] for axis in axes)
    middle, last = _turn(j, angles[1]), _turn(k, angles[2])
    first = quaternion.rotate_inverse(last, quaternion.rotate_inverse(middle, first))
    return first, quaternion.rotate_inverse(last, second), third


def _triple_product(
    middle_angle: Scalar, axes: tuple[int, int, int]
) -> tuple[Scalar, Bool[Array, ""]]:
    """Return the product first · (third × second) of the axes of the turns, which vanishes in the
    singular case, and whether it is zero to round-off.
    """
    i, j, k = axes
    size = jnp.sin(middle_angle) if i == k else -_handedness(i, j) * jnp.cos(middle_angle)
    return size, jnp.abs(size) < 4 * jnp.finfo(middle_angle.dtype).eps


__all__ = [
    "from_matrix", "from_quaternion", "is_singular", "omega_to_rates", "rates_to_omega",
    "to_matrix", "to_quaternion",
]  # fmt: skip

define_dir_and_getattr(__name__)
