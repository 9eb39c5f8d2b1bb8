"""Define the states of a body and their equations of motion."""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks, _show, _types
from rigidjax._types import HasAttitude, HasPose, HasSpin, Mat3, ScalarLike, Vec3, Vectors
from rigidjax.body.inertia import Inertia, MassProperties, apply, inverse
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.torques.base import Torque, evaluate_torque, force_and_torque, require_torque
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import squared_norm
from rigidjax.rotation.linalg3 import components, cross

State = TypeVar("State")
_HINT = "Inertia.from_tensor takes a matrix; from MassProperties pass .inertia"


class Spin(eqx.Module):
    """Hold the state of a turning body without its attitude: the body rate alone.

    **Arguments:** `omega` (3,) angular velocity Ω in the body frame, rad/s (notes, eq 49).

    >>> Spin([1.0, 0.0, 0.0]).omega.shape
    (3,)
    """

    omega: Float[Array, "*batch 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, omega: Vectors):
        self.omega = _checks.array_of_shape(omega, (3,), "omega", batched=True)


class Attitude(eqx.Module):
    """Hold the state of a body that turns: attitude and body rate.

    **Arguments:** `q` (4,) unit quaternion (w, x, y, z), **scalar first**, body → world (its
    rotation matrix is `M` in the notes, eq 8), or a `Rotation` of SciPy; `omega` (3,) angular
    velocity Ω in the body frame, rad/s. `simulate` and `rigidjax.exact.free_body` check that `q` is
    a unit quaternion; this class does not.

    >>> Attitude([1.0, 0, 0, 0], [0.0, 0, 1]).q.shape
    (4,)
    """

    q: Float[Array, "*batch 4"]
    omega: Float[Array, "*batch 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, q: _types.Quaternions, omega: Vectors):
        self.q = _checks.array_of_shape(
            q, (4,), "q", batched=True, hint="a quaternion is (w, x, y, z)"
        )
        self.omega = _checks.array_of_shape(omega, (3,), "omega", batched=True)
        _checks.require_same_batch(q=(self.q, 1), omega=(self.omega, 1))


class Turn(eqx.Module):
    """Hold the state of a body that turns about one axis of a suspension: an angle and its rate.

    **Arguments:** `angle` γ, rad, about the `axis` of the suspension (`rigidjax.suspensions`), from
    the place where the axes of the body are those of the world; `rate` dγ/dt, rad/s.

    >>> Turn(0.1, 0.0).angle.shape
    ()
    """

    angle: Float[Array, "*batch"]
    rate: Float[Array, "*batch"]

    __repr__ = _show.fields_as_text

    def __init__(self, angle: _types.Scalars, rate: _types.Scalars):
        angle = _checks.array_of_shape(angle, (), "angle", batched=True)
        rate = _checks.array_of_shape(rate, (), "rate", batched=True)
        _checks.require_same_batch(angle=(angle, 0), rate=(rate, 0))
        dtype = jnp.promote_types(angle.dtype, rate.dtype)
        self.angle, self.rate = angle.astype(dtype), rate.astype(dtype)


class Rigid(eqx.Module):
    """Hold the state of a body that moves: position and velocity, attitude and body rate.

    **Arguments:** `x` (3,) position of the centre of mass, m, world frame (the `X` of the notes, eq
    1); `v` (3,) its velocity, m/s, world frame; `q` (4,) unit quaternion (w, x, y, z), scalar
    first, body → world, or a `Rotation` of SciPy; `omega` (3,) Ω in the body frame, rad/s.

    >>> Rigid([0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 1]).v.shape
    (3,)
    """

    x: Float[Array, "*batch 3"]
    v: Float[Array, "*batch 3"]
    q: Float[Array, "*batch 4"]
    omega: Float[Array, "*batch 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, x: Vectors, v: Vectors, q: _types.Quaternions, omega: Vectors):
        self.x = _checks.array_of_shape(x, (3,), "x", batched=True, unit="m")
        self.v = _checks.array_of_shape(v, (3,), "v", batched=True, unit="m/s")
        self.q = _checks.array_of_shape(
            q, (4,), "q", batched=True, hint="a quaternion is (w, x, y, z)"
        )
        self.omega = _checks.array_of_shape(omega, (3,), "omega", batched=True)
        _checks.require_same_batch(
            x=(self.x, 1), v=(self.v, 1), q=(self.q, 1), omega=(self.omega, 1)
        )


class EulerEquations(eqx.Module):
    """Evaluate Euler's equations `I dΩ/dt = IΩ × Ω + τ` as a vector field `f(t, y, args)`; I, kg
    m², is about the point that the body turns about, and τ, N m, in the body frame.

    Source: Landau and Lifshitz, Mechanics, eq 36.4; the equations are in Lie–Poisson form, `dΠ/dt =
    Π × ∇H(Π) + τ` with the momentum `Π = IΩ` and the energy `H = ½ Π·I⁻¹Π`. **Raises:**
    `ValueError` for the inertia of a rod or a point, which has no inverse, unless JAX traces the
    inertia.
    """

    inertia: Inertia
    inverse: Mat3
    torque: Torque | None

    def __init__(self, inertia: Inertia, torque: Torque | None = None):
        _checks.require_unbatched_instance(inertia, Inertia, "inertia", hint=_HINT)
        if torque is not None:
            require_torque(torque)
        # An inertia that has no inverse is refused here only if its numbers are known. Numbers that
        # JAX traces are not refused: during a fit an optimiser may try numbers that no body has.
        self.inertia = inertia.require_invertible() if _checks.is_known(inertia.tensor) else inertia
        # The inverse of the inertia is computed here, once per solve: a division inside the vector
        # field costs 25 times as much as the rest of the field.
        self.inverse = inverse(inertia.tensor)
        self.torque = torque

    def __call__(self, t: ScalarLike, y: HasSpin, args: object = None) -> Spin:
        return Spin(self.angular_acceleration(t, y))

    def angular_acceleration(self, t: ScalarLike, state: HasSpin) -> Vec3:
        """Return dΩ/dt, rad/s², body frame, under the torque of these equations."""
        torque = None
        if self.torque is not None:
            torque = evaluate_torque(self.torque, t, state, self.inertia)
        return self.acceleration_under(torque, state)

    def acceleration_under(self, torque: Vec3 | None, state: HasSpin) -> Vec3:
        """Return dΩ/dt = I⁻¹ (IΩ × Ω + τ), rad/s², under a torque τ, N m, body frame."""
        dtype = state.omega.dtype
        momentum = apply(self.inertia.tensor.astype(dtype), state.omega)
        turning = cross(momentum, state.omega)
        if torque is not None:
            turning = turning + torque
        return apply(self.inverse.astype(dtype), turning)


class AttitudeEquations(eqx.Module):
    """Evaluate the equations of motion of a body that turns, Euler's equations and `dq/dt = ½ q ⊗
    (0, Ω)` (notes, eq 50), as a vector field `f(t, y, args)` of an `Attitude`.

    The inertia, kg m², is about the point that the body turns about; the torque is in N m, body
    frame.
    """

    euler: EulerEquations

    def __init__(self, inertia: Inertia, torque: Torque | None = None):
        self.euler = EulerEquations(inertia, torque)

    def __call__(self, t: ScalarLike, y: HasAttitude, args: object = None) -> Attitude:
        return Attitude(quaternion.rate(y.q, y.omega), self.euler.angular_acceleration(t, y))


class NewtonEuler(eqx.Module):
    """Evaluate the Newton–Euler equations of a body about its centre of mass as a vector field
    `f(t, y, args)` of a `Rigid` (notes, eqs 1, 50, 56, 84).

    They are `dx/dt = v`, `m dv/dt = F`, `dq/dt = ½ q ⊗ (0, Ω)` and `I dΩ/dt = IΩ × Ω + τ`; the
    torque model returns τ, N m, body frame, or a `Wrench` of τ and F, N, world frame.
    """

    euler: EulerEquations
    body: MassProperties

    def __init__(self, body: MassProperties, torque: Torque | None = None):
        _checks.require_unbatched_instance(
            body, MassProperties, "body", hint="an Inertia has no mass"
        )
        self.euler = EulerEquations(body.inertia, torque)
        self.body = body

    def __call__(self, t: ScalarLike, y: HasPose, args: object = None) -> Rigid:
        force, torque = None, None
        if self.euler.torque is not None:
            force, torque = force_and_torque(self.euler.torque, t, y, self.body)
        if force is None:
            acceleration = jnp.zeros_like(y.v)
        else:
            acceleration = force / self.body.mass.astype(y.v.dtype)
        spin = self.euler.acceleration_under(torque, y)
        return Rigid(y.v, acceleration, quaternion.rate(y.q, y.omega), spin)


def project_to_group(state: State) -> State:
    """Return the state with its quaternion, if it has one, scaled to length 1; raise `ValueError`
    for a known quaternion that is zero.
    """
    if isinstance(state, Coupled):
        return eqx.tree_at(lambda s: s.motion, state, project_to_group(state.motion))
    if isinstance(state, HasAttitude):
        q = _checks.array_of_shape(state.q, (4,), "state.q")
        if _checks.is_known(q):
            length = float(np.linalg.norm(np.asarray(q)))
            _checks.error_if(
                q, length**2 == 0, f"state.q: wanted a length near 1, got {length:.3g}"
            )
        # The digits of q/√n, with the squared length n, must be the same in every compiled program.
        # XLA replaces the quotient by the product of q and 1/√n in some programs, which changes the
        # last digit. Reverse-mode differentiation computes the steps of a solver again in another
        # program: another last digit there would change the lengths of the steps, and the gradient
        # would belong to another discretisation (an error of 7e-6 at a tolerance of 1e-11). The
        # barrier keeps the root and the quotient apart, which round equally in every program.
        length = lax.optimization_barrier(jnp.sqrt(squared_norm(components(state.q))))
        return eqx.tree_at(lambda s: s.q, state, state.q / length)
    return state
