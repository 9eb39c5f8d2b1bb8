"""Describe the attitude of a body in a circular orbit, relative to the orbital frame."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, Scalar, ScalarLike, Vec3
from rigidjax.body import inertia as _inertia, validation
from rigidjax.frames.frame_dynamics import BodyInFrame
from rigidjax.frames.moving import MovingFrame
from rigidjax.frames.rotation_models import Uniform
from rigidjax.rotation import linalg3, quaternion


class OrbitalGravityGradient(eqx.Module):
    """Compute the gravity-gradient torque 3n² u × I u, N m, body axes, on a circular orbit with the
    angular rate n, rad/s, where u is the unit vector away from the planet (Hughes 1986, sec. 8.1).
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    rate: Scalar

    def __call__(self, t: ScalarLike, state: PyTree, body: _inertia.Inertia) -> Vec3:
        up = quaternion.rotate_inverse(state.q, jnp.eye(3, dtype=state.q.dtype)[0])
        n = self.rate.astype(up.dtype)
        return 3 * n * n * linalg3.cross(up, _inertia.apply(body.tensor, up))


def libration(rate: ScalarLike) -> BodyInFrame:
    """Return the gravity-gradient torque on a body in a circular orbit, for `simulate` with
    `Attitude` states relative to the orbital frame.

    The orbital frame has x away from the planet, y along the motion and z along the orbit's normal;
    the frame turns at the rate n about z. `q` takes body axes to the orbital frame; `omega` is the
    rate relative to this frame, in body axes.

    **Arguments:** `rate` the angular rate n of the orbit, rad/s. Small oscillations (librations) in
    the orbital plane have the angular frequency n √(3 (b − a)/c), where a, b, c are the moments of
    inertia of the body about x, y, z. Source: Hughes 1986, ch. 9; notes, eqs 50, 91.

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> at_rest = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> libration(0.001)(0.0, at_rest, body).tolist()
    [0.0, 0.0, 0.0]
    """
    n = _checks.require_finite(_checks.array_of_shape(rate, (), "rate"), "rate")
    return BodyInFrame(
        MovingFrame(Uniform(n * jnp.eye(3, dtype=n.dtype)[2])), OrbitalGravityGradient(n)
    )


def libration_integral(state: PyTree, body: _inertia.Inertia, rate: ScalarLike) -> Scalar:
    """Return the Jacobi integral, in joules, that a motion under the torque `libration` conserves:
    ½Ω'·IΩ' + (3/2)n² u·Iu − ½n² w·Iw.

    Here Ω' is the body rate relative to the orbital frame, I the inertia, and u and w the unit
    vectors along the x and z axes of this frame, all in body axes (Hughes 1986, sec. 9.1).
    **Arguments:** `state` an `Attitude` in the orbital frame; `body` an `Inertia`; `rate` the
    angular rate n of the orbit, rad/s.

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> at_rest = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> float(libration_integral(at_rest, body, 2.0))
    1.0
    """
    _checks.require_unbatched_instance(
        state, HasAttitude, "state", requirement="an Attitude in the orbital frame"
    )
    body = validation.require_single_body(body, _inertia.Inertia, "body")
    axes = jnp.eye(3, dtype=state.q.dtype)
    n = _checks.array_of_shape(rate, (), "rate").astype(state.q.dtype)
    up, normal = (quaternion.rotate_inverse(state.q, axes[i]) for i in (0, 2))

    def form(y: Vec3) -> Scalar:
        return linalg3.dot(y, _inertia.apply(body.tensor, y))

    return 0.5 * (form(state.omega) + n * n * (3 * form(up) - form(normal)))
