"""Describe rotations as functions of time: uniform, about one axis, or from another motion."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import Mat3, ScalarLike, Vec3
from rigidjax.rotation import linalg3, quaternion, so3
from rigidjax.rotation.validation import require_near_unit, require_rotation


class Uniform(eqx.Module):
    """Describe a frame S' that turns uniformly: its rotation matrix is M(t) = exp(t hat Ω), the
    unit matrix at t = 0, where hat Ω is the matrix of the cross product with Ω.

    **Arguments:** `omega` the angular velocity Ω (3,), rad/s. Its components in S' and in the
    inertial frame S are equal.

    >>> Uniform([0.0, 0.0, 1.0])(jnp.pi).round(12)[0].tolist()
    [-1.0, -0.0, 0.0]
    """

    omega: Float[Array, "3"]

    __repr__ = _show.fields_as_text

    def __init__(self, omega: Float[Array, "3"] | object):
        self.omega = _checks.require_finite(_checks.array_of_shape(omega, (3,), "omega"), "omega")

    def __call__(self, t: ScalarLike) -> Mat3:
        t = _checks.checked_time(t)
        return so3.exp(t * self.omega.astype(t.dtype))

    def rate(self, t: ScalarLike) -> Vec3:
        """Return the angular velocity Ω (3,), rad/s, of this uniformly turning frame S', in the
        axes of S'; it does not depend on `t`.
        """
        return self.omega.astype(_checks.checked_time(t).dtype)


class AboutAxis(eqx.Module):
    """Describe a frame that turns about a fixed axis by an angle that is any function of the time.

    **Arguments:** `axis` (3,), a vector along the axis, of any length but zero; `angle` a function
    of the time, s, that returns the angle, rad.

    >>> float(AboutAxis([0.0, 0.0, 2.0], lambda t: 3.0 * t**2).rate(1.0)[2])
    6.0
    """

    axis: Float[Array, "3"]
    angle: Callable[[Any], Any]

    __repr__ = _show.fields_as_text

    def __init__(self, axis: Float[Array, "3"] | object, angle: Callable[[Any], Any]):
        axis = _checks.require_finite(_checks.array_of_shape(axis, (3,), "axis"), "axis")
        hint = "for a uniform turn take frames.Uniform(omega)"
        _checks.require_function(angle, "angle", "of time to rad", hint=hint)
        length = jnp.sqrt(linalg3.dot(axis, axis))
        self.axis = (
            _checks.error_if(axis, length == 0, "axis: wanted a direction, got zero") / length
        )
        self.angle = angle

    def __call__(self, t: ScalarLike) -> Mat3:
        t = _checks.checked_time(t)
        return so3.exp(
            _checks.array_of_shape(self.angle(t), (), "angle") * self.axis.astype(t.dtype)
        )

    def rate(self, t: ScalarLike) -> Vec3:
        """Return the angular velocity Ω (3,), rad/s, of this turning frame S' at the time `t`, s,
        in the axes of S': the unit vector along the axis times the derivative of the angle.
        """
        t = _checks.checked_time(t)
        _, speed = jax.jvp(self.angle, (t,), (jnp.ones_like(t),))
        return speed * self.axis.astype(t.dtype)


def forward_mode(rotation: PyTree) -> PyTree:
    """Return the function of time `rotation` with `diffrax.ForwardMode` in place of each
    `diffrax.RecursiveCheckpointAdjoint`.

    A solution of `simulate` contains such an adjoint; the derivative of a frame's angular velocity
    is computed in forward mode, which is not possible through it.
    """

    def reverse(part: PyTree) -> bool:
        return isinstance(part, dfx.RecursiveCheckpointAdjoint)

    return jax.tree.map(lambda p: dfx.ForwardMode() if reverse(p) else p, rotation, is_leaf=reverse)


def value_at(rotation: PyTree, t: Array) -> PyTree:
    """Return matrix, quaternion or state of a function of time, or a `Solution`, at t."""
    return rotation.evaluate(t) if hasattr(rotation, "evaluate") else rotation(t)


def matrix_at(rotation: PyTree, t: Array) -> Mat3:
    """Return the rotation matrix, S' → S, of a frame's field `rotation` at the time t."""
    value = value_at(rotation, t)
    value = getattr(value, "q", value)
    shape = jnp.shape(value)
    if shape == (4,):
        q = _checks.array_of_shape(value, (4,), "rotation").astype(t.dtype)
        return quaternion.to_matrix(quaternion.normalise(require_near_unit(q, "rotation", 1e-3)))
    m = _checks.array_of_shape(
        value, (3, 3), "rotation", hint="wanted a matrix or a quaternion (4,)"
    )
    return _checks.check_if_known(require_rotation, m, "rotation").astype(t.dtype)
