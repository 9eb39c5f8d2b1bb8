"""Define constant torques in the body frame or in the world frame, and torques against the body
rate.
"""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasSpin, ScalarLike, Vec3
from rigidjax.motion.torques import base
from rigidjax.rotation import quaternion


class ConstantTorque(base.AbstractTorque):
    """Apply a constant torque in the body frame, such as a thruster's: `τ = const`.

    **Arguments:** `torque` (3,) N m, body frame (for a torque in the world frame take `InSpace`). A
    constant torque about a principal axis increases the rate about this axis linearly in time
    (Euler 1758).

    >>> ConstantTorque([0.0, 0.0, 1.0])(0.0, rj.Spin([0.0, 0.0, 5.0]), None).tolist()
    [0.0, 0.0, 1.0]
    """

    feels: ClassVar[type] = HasSpin
    rate_free: ClassVar[bool] = True
    steady: ClassVar[bool] = True
    torque: Float[Array, "3"] = eqx.field(converter=base.vector_converter("torque"))

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return self.torque


class InSpace(base.AbstractTimeTorque):
    """Apply a torque given in the world frame: `τ = Rᵀ τ_w`, with the attitude R of the body.

    **Arguments:** `torque` τ_w, N m, world frame: (3,), or a function of time, t → (3,), that is an
    `equinox.Module`, such as `Linear(times, values)`, straight lines between samples. In a time t a
    constant τ_w adds τ_w t to the angular momentum in the world frame; the component of this
    momentum normal to τ_w is conserved.

    >>> turned = rj.Attitude([0.0, 1.0, 0.0, 0.0], [0.0, 0, 0])  # half a turn about x
    >>> InSpace([0.0, 0.0, 1.0])(0.0, turned, None).tolist()  # in body axes
    [0.0, 0.0, -1.0]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    torque: eqx.Module | Float[Array, "3"] = eqx.field(converter=base.source_converter("torque"))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        return quaternion.rotate_inverse(state.q, base.vector_at(self.torque, t, "torque"))


class _AbstractRateTorque(base.AbstractTorque):
    """Define a torque that opposes the body rate Ω, such as damping.

    `coefficient` (3,) holds the strength of the torque along each body axis; a subclass defines the
    formula and the unit.
    """

    feels: ClassVar[type] = HasSpin
    steady: ClassVar[bool] = True
    coefficient: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("coefficient", hint="one number for each body axis")
    )


class Damping(_AbstractRateTorque):
    """Apply linear damping `τ = −c Ω`, component by component.

    **Arguments:** `coefficient` (3,) c along the body axes, N m s/rad. The rate Ω of a sphere with
    the moment of inertia I decays as exp(−c t/I); a ball of radius r in a fluid of viscosity η has
    c = 8πηr³ (Kirchhoff 1876; Lamb, Hydrodynamics, §334).

    >>> Damping([0.1, 0.1, 0.1]).coefficient.shape
    (3,)
    """

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return -self.coefficient * state.omega


class QuadraticDamping(_AbstractRateTorque):
    """Apply quadratic damping `τ = −c |Ω| Ω`, component by component: drag at a large Reynolds
    number.

    **Arguments:** `coefficient` (3,) c along the body axes, N m s²/rad². The rate about a principal
    axis with the moment of inertia I decays from Ω₀ as Ω₀/(1 + c Ω₀ t/I) (Newton, Principia, Book
    II, Section II). At Ω = 0 the first derivative of the torque with respect to Ω is zero, and the
    second derivative does not exist.

    >>> QuadraticDamping([0.1, 0.1, 0.1]).coefficient.shape
    (3,)
    """

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return -base.length_or_zero(state.omega) * self.coefficient * state.omega
