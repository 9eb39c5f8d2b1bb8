"""Torques with a potential: gravity on a body with a fixed point, a magnet in a field, any U(q)."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, Scalar, ScalarLike, Vec3, Vector
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.motion.torques import base
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot


class HeavyTop(base.AbstractTorque):
    """Gravity on a body with a fixed point: `τ = c × m Rᵀg`, `U = −m g·Rc`.

    **Arguments:** `mass` m, kg; `com` (3,) c, from the fixed point to the centre of mass, m, body
    frame; `gravity` (3,) g, m/s², world frame, such as [0, 0, −9.81]. The body's `Inertia` is the
    one **about the fixed point** (`MassProperties.inertia_about`, `Inertia.shifted`). Any top is
    allowed: Lagrange's, Kovalevskaya's, Goryachev–Chaplygin's, a general one, the physical
    pendulum.

    It conserves the energy and the momentum along g. Source: Landau and Lifshitz, Mechanics, §35;
    Arnold, Mathematical Methods of Classical Mechanics, §30. **Raises:** `TypeError` on a `Rigid`,
    which has no fixed point.

    >>> top = HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    >>> top.energy(0.0, rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), rj.Inertia(jnp.eye(3)))
    Array(9.81, dtype=float64)
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    steady: ClassVar[bool] = True
    mass: Float[Array, ""] = eqx.field(converter=base.number("mass"))
    com: Float[Array, "3"] = eqx.field(converter=base.vector("com"))
    gravity: Float[Array, "3"] = eqx.field(converter=base.vector("gravity", hint=base.WORLD))

    @property
    def axis(self) -> Vec3:
        """Gravity, world frame: there is no torque about it."""
        return self.gravity

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J: `U = −m g·Rc`, zero where c is level with the pivot."""
        return -self.mass * dot(self.com, quaternion.rotate_inverse(state.q, self.gravity))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        if isinstance(state, HasPose):
            raise TypeError(
                "HeavyTop turns about a fixed point, got a state that moves "
                f"({type(state).__name__}); with Rigid use UniformGravity, or take an Attitude and "
                "the inertia about the fixed point"
            )
        return cross(self.mass * self.com, quaternion.rotate_inverse(state.q, self.gravity))


class GravityGradient(base.OfTime):
    """The torque of a far central body: `τ = (3μ/r³) r̂' × I r̂'`, `r̂' = Rᵀ r̂`.

    **Arguments:** `mu` μ = G M of the central body, m³/s²; `position` r (3,) m, world frame,
    between the central body and the body (either sign): constant, or a callable Module of time, t →
    (3,), for an orbit. **Raises:** `ValueError` for a distance of zero.

    `U = (μ/2r³)(3 r̂'·I r̂' − Tr I)`, the second term of MacCullagh's formula; the orbit itself
    does not change. Source: Hughes, Spacecraft Attitude Dynamics, §8.1; Goldstein, Poole and Safko,
    Classical Mechanics, eq 5.86.

    >>> law, body = GravityGradient(1.0, [1.0, 1.0, 0.0]), rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> round(float(law(0.0, state, body)[2]), 6)  # 3/r³ · ½ (I₂ − I₁), r = √2
    0.53033
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    mu: Float[Array, ""]
    position: eqx.Module | Float[Array, "3"]

    def __init__(self, mu: ScalarLike, position: object):
        self.mu = _checks.given(mu, (), "mu")
        self.position = base.constant_or_callable(position, "position")
        at: Any = self.position
        if not callable(at) and _checks.known(at) and not np.asarray(at).any():
            words = "the vector between the body and the central body"
            raise ValueError(f"position: wanted {words}, got zero")

    @property
    def axis(self) -> Vec3 | None:
        """The position, world frame, if it is constant: there is no torque about it."""
        source: Any = self.position
        return None if callable(source) else source

    def energy(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Scalar:
        """Potential energy of the attitude, J: `U = (μ/2r³)(3 r̂'·I r̂' − Tr I)`."""
        tensor = tensor_of(body)
        down, strength = self._down(t, state)
        trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
        return 0.5 * strength * (3 * dot(down, apply(tensor, down)) - trace)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Vec3:
        down, strength = self._down(t, state)
        return cross(3 * strength * down, apply(tensor_of(body), down))

    def _down(self, t, state):
        """Direction of the central body in body axes, and μ/r³."""
        r = base.vector_at(self.position, t, "position")
        distance = jnp.sqrt(dot(r, r))
        # r³ overflows in float32 beyond 7e12 m: divide by r three times instead.
        strength = self.mu / distance / distance / distance
        return quaternion.rotate_inverse(state.q, r / distance), strength


class MagneticDipole(base.OfTime):
    """A magnetic moment fixed in the body, in a uniform field: `τ = m × RᵀB`, `U = −m·RᵀB`.

    **Arguments:** `moment` (3,) m, A m², body frame; `field` B, T, world frame: (3,), or a callable
    Module of time, t → (3,), for a field that changes along an orbit. Source: Jackson, Classical
    Electrodynamics, eqs 5.71, 5.72.

    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> MagneticDipole([0.0, 0.0, 2.0], [3.0, 0.0, 0.0])(0.0, state, None).tolist()  # z × x = y
    [0.0, 6.0, 0.0]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    moment: Float[Array, "3"]
    field: eqx.Module | Float[Array, "3"]

    def __init__(self, moment: Vector, field: object):
        self.moment = _checks.given(moment, (3,), "moment")
        self.field = base.constant_or_callable(field, "field")

    @property
    def axis(self) -> Vec3 | None:
        """The field, world frame, if it is constant: there is no torque about it."""
        source: Any = self.field
        return None if callable(source) else source

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J: `U = −m·RᵀB`."""
        return -dot(self.moment, self._field_in_body(t, state))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        return cross(self.moment, self._field_in_body(t, state))

    def _field_in_body(self, t, state):
        return quaternion.rotate_inverse(state.q, base.vector_at(self.field, t, "field"))


class FromPotential(base.AbstractTorque):
    """The torque of any potential `U(q)` on the attitude, by differentiation.

    **Arguments:** `potential` a callable Module `q → U`, J, with `q` (4,) unit, body → world. The
    torque about body axis i is `τ_i = −∂U/∂q · ½ q ⊗ e_i`, the derivative along a turn about it.
    Source: Landau and Lifshitz, Mechanics, §34. **Raises:** `TypeError` for anything but a
    function, `ValueError` for a U that is not a number.

    >>> class Spring(eqx.Module):
    ...     k: Array
    ...     def __call__(self, q):
    ...         return 2.0 * self.k * (q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    >>> at = rj.Attitude(rj.quaternion.exp(jnp.array([0.0, 0.0, 1e-3])), [0.0, 0, 0])
    >>> FromPotential(Spring(jnp.array(2.0)))(0.0, at, None).round(5).tolist()
    [-0.0, -0.0, -0.002]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    steady: ClassVar[bool] = True
    potential: Callable[[Any], Any]

    def __init__(self, potential: Callable[[Any], Any]):
        self.potential = _checks.function(potential, "potential", "q → U, J")

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J."""
        return self._value(state.q)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        slope = jax.grad(self._value)(state.q)
        return -0.5 * quaternion.multiply(quaternion.conjugate(state.q), slope)[1:]

    def _value(self, q):
        return _checks.floating(self.potential(q), (), "potential", hint="one number, J")
