"""Define torques with a potential: gravity on a body with a fixed point, a magnet in a field, any
U(q).
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, Quat, Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.motion.torques import base
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, components, cross, dot


class HeavyTop(base.AbstractTorque):
    """Apply gravity to a body with a fixed point: the torque `τ = c × m Rᵀg`, with the potential
    energy `U = −m g·Rc`; R is the attitude.

    **Arguments:** `mass` m, in kg; `com` c (3,), the vector from the fixed point to the centre of
    mass, in metres, body frame; `gravity` g (3,), in m/s², world frame, such as [0, 0, −9.81]. The
    `Inertia` of the body must be that **about the fixed point** (`MassProperties.inertia_about`,
    `Inertia.shift`). Any top is allowed: Lagrange's, Kovalevskaya's, Goryachev–Chaplygin's, a
    general one, the physical pendulum.

    The energy and the angular momentum along g are conserved. Source: Landau and Lifshitz,
    Mechanics, §35; Arnold, Mathematical Methods of Classical Mechanics, §30. **Raises:**
    `TypeError` on a `Rigid`, which has no fixed point.

    >>> top = HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    >>> top.energy(0.0, rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), rj.Inertia(jnp.eye(3)))
    Array(9.81, dtype=float64)
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    steady: ClassVar[bool] = True
    mass: Float[Array, ""] = eqx.field(converter=base.number_converter("mass"))
    com: Float[Array, "3"] = eqx.field(converter=base.vector_converter("com"))
    gravity: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("gravity", hint=base.GRAVITY_HINT)
    )

    @property
    def axis(self) -> base.AxisWithoutTorque:
        """Return a vector (3,), world frame, along which the torque of gravity has no component:
        the vector g of gravity, m/s².
        """
        return self.gravity

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Return the potential energy, in joules: `U = −m g·Rc`, which is zero where the centre of
        mass is level with the fixed point.

        Here m is the mass, g the gravity, R the attitude, and c the vector from the fixed point to
        the centre of mass.
        """
        return -self.mass * dot(self.com, quaternion.rotate_inverse(state.q, self.gravity))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        if isinstance(state, HasPose):
            raise TypeError(
                f"HeavyTop: wanted an Attitude, about a fixed point, got {type(state).__name__}, "
                "which moves; with Rigid use UniformGravity, or take an Attitude and the inertia "
                "about the fixed point"
            )
        return cross(self.mass * self.com, quaternion.rotate_inverse(state.q, self.gravity))


class _Pull(NamedTuple):
    """Hold the gravity of a far point mass at one time."""

    # The unit vector u from the body to the point mass, body axes.
    direction: Vec3
    # The gravity gradient μ/r³, 1/s².
    strength: Scalar
    # μ/rⁿ⁺¹ ∇Hₙ(u) for each degree n = 3, 4, …
    slopes: list[Vec3]


class GravityGradient(base.AbstractTimeTorque):
    """Apply the gravity-gradient torque of a far point mass on a body with the inertia I: `τ =
    (3μ/r³) u × Iu − Σ (μ/rⁿ⁺¹) u × ∇Hₙ(u)`, a sum over the degrees n = 3, 4, … of `harmonics`.

    Here r is the distance of the point mass and u (3,) its direction, in body axes. Hₙ is the solid
    harmonic of degree n of the body's own gravity, `Σ ρⁿ Pₙₘ (C cos mλ + S sin mλ)`, a sum over m =
    0, …, n, at a point with the distance ρ from the centre of mass and the longitude λ; Pₙₘ is an
    associated Legendre function of the sine of the latitude. The potential energy is `U = (μ/2r³)(3
    u·Iu − Tr I) − Σ (μ/rⁿ⁺¹) Hₙ(u)`, MacCullagh's formula and its next terms. The orbit is given by
    `position`; the torque does not change it. **Arguments:**

    - `mu`: μ, m³/s², the constant of gravitation times the mass of the point mass.
    - `position`: the vector (3,), in metres, world frame, from the body to the point mass:
      constant, or, for an orbit, a function of time, t → (3,), that is an `equinox.Module`, such as
      a `Chebyshev`. Without `harmonics` its sign does not matter.
    - `harmonics`: the coefficients C and S of Hₙ, an array (2n + 1,) for each degree n = 3, 4, …,
      in kg times metreⁿ and in body axes. They are the mass of the body times the n-th power of its
      reference radius times its Stokes coefficients (Cn0, Cn1, Sn1, Cn2, Sn2, …), not normalised.

    For several point masses take a `Sum`. Source: Hughes, Spacecraft Attitude Dynamics, §8.1;
    Goldstein, Poole and Safko, Classical Mechanics, eq 5.86; Montenbruck and Gill, Satellite
    Orbits, §3.2.

    >>> law, body = GravityGradient(1.0, [1.0, 1.0, 0.0]), rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> round(float(law(0.0, state, body)[2]), 6)  # 3/r³ · ½ (I₂ − I₁), r = √2
    0.53033
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    mu: Float[Array, ""]
    position: eqx.Module | Float[Array, "3"]
    harmonics: tuple[Float[Array, " orders"], ...]

    def __init__(self, mu: ScalarLike, position: object, harmonics: Sequence[ArrayLike] = ()):
        self.mu = _checks.finite_array(mu, (), "mu")
        self.position = base.checked_source(position, "position")
        self.harmonics = tuple(
            _checks.finite_array(row, (2 * n + 1,), f"harmonics: degree {n}")
            for n, row in enumerate(harmonics, 3)
        )
        at: Any = self.position
        if not callable(at) and _checks.is_known(at) and not np.asarray(at).any():
            words = "the vector from the body to the point mass"
            raise ValueError(f"position: wanted {words}, got zero")

    @property
    def axis(self) -> base.AxisWithoutTorque | None:
        """Return a vector (3,), world frame, along which the torque has no component: the position
        of the point mass, m, if it is constant; `None` otherwise.
        """
        source: Any = self.position
        return None if callable(source) else source

    def energy(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Scalar:
        """Return the terms of the potential energy that depend on the attitude, in joules: `U =
        (μ/2r³)(3 u·Iu − Tr I) − Σ (μ/rⁿ⁺¹) Hₙ(u)`, with the quantities that the class defines.
        """
        tensor = tensor_of(body)
        u, strength, slopes = self._pull(t, state)
        trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
        potential = 0.5 * strength * (3 * dot(u, apply(tensor, u)) - trace)
        for n, slope in enumerate(slopes, 3):
            potential = potential - dot(u, slope) / n  # Euler's theorem: u·∇Hₙ = n Hₙ
        return potential

    def __call__(self, t: ScalarLike, state: HasAttitude, body: Inertia | MassProperties) -> Vec3:
        u, strength, slopes = self._pull(t, state)
        pull = 3 * strength * apply(tensor_of(body), u)
        for slope in slopes:
            pull = pull - slope
        return cross(u, pull)

    def _pull(self, t: ScalarLike, state: HasAttitude) -> _Pull:
        r = base.vector_at(self.position, t, "position")
        distance = jnp.sqrt(dot(r, r))
        # The strength μ/r³ is computed by three divisions by the distance r, because r³ overflows
        # in float32 beyond r = 7e12 m.
        strength = self.mu / distance / distance / distance
        u = quaternion.rotate_inverse(state.q, r / distance)
        slopes, factor = [], strength
        for slope in _gradients(self.harmonics, u):
            factor = factor / distance
            slopes.append(factor * slope)
        return _Pull(u, strength, slopes)


def _gradients(harmonics: Sequence[Array], u: Vec3) -> list[Vec3]:
    """Return the gradients at a unit vector of the solid harmonics Hₙ = Σ rⁿ Pₙₘ (C cos mλ + S sin
    mλ) of the degrees n = 3, 4, …, by Cunningham's recurrence (1970, doi:10.1007/BF01229495).

    The coefficients of a degree have the order Cn0, Cn1, Sn1, Cn2, Sn2, …; Pₙₘ is a function of
    z/r.
    """
    x, y, z = components(u)
    zero = jnp.zeros_like(z)
    # For each degree n of the loop below, `here` holds the real and imaginary parts of the solid
    # harmonics rᵏ Pₖₘ exp(imλ) of the degree k = n − 1 for m = 0 … k + 1, and `before` holds those
    # of the degree n − 2. Harmonics with m above their degree are zero.
    before, here = [(zero, zero)] * 2, [(jnp.ones_like(z), zero), (zero, zero)]
    out = []
    for n in range(1, len(harmonics) + 3):
        if n >= 3:
            out.append(_gradient(components(harmonics[n - 3]), n, here))
        k = 2 * n - 1
        (re, im), following = here[n - 1], []
        for m in range(n):
            pairs = zip(here[m], before[m], strict=True)
            following.append(tuple((k * z * a - (n + m - 1) * p) / (n - m) for a, p in pairs))
        top = k * (x * re - y * im), k * (x * im + y * re)
        before, here = [*here, (zero, zero)], [*following, top, (zero, zero)]
    return out


def _gradient(
    coefficients: Sequence[Scalar], n: int, lower: Sequence[tuple[Scalar, Scalar]]
) -> Vec3:
    """Return the gradient of the solid harmonic of degree n at a point, from the real and imaginary
    parts of rⁿ⁻¹ Pₙ₋₁,ₘ exp(imλ) there for m = 0, …, n.
    """
    zonal = coefficients[0]
    along = n * zonal * lower[0][0]
    flat_x, flat_y = (-zonal * part for part in lower[1])
    for m in range(1, n + 1):
        c, s = coefficients[2 * m - 1 : 2 * m + 1]
        (a, b), (p, q) = lower[m - 1], lower[m + 1] if m < n else (0.0, 0.0)
        half = 0.5 * (n + m) * (n + m - 1)
        along = along + (n + m) * (c * lower[m][0] + s * lower[m][1])
        flat_x = flat_x + c * (half * a - 0.5 * p) + s * (half * b - 0.5 * q)
        flat_y = flat_y - c * (half * b + 0.5 * q) + s * (half * a + 0.5 * p)
    return jnp.stack([flat_x, flat_y, along])


class MagneticDipole(base.AbstractTimeTorque):
    """Apply the torque of a uniform magnetic field on a magnetic moment that is fixed in the body:
    `τ = m × RᵀB`, with the potential energy `U = −m·RᵀB`; R is the attitude.

    **Arguments:** `moment` m (3,), in ampere metre², body frame; `field` B, in tesla, world frame:
    (3,), or, for a field that changes along an orbit, a function of time, t → (3,), that is an
    `equinox.Module`, such as `Linear(times, values)`. Source: Jackson, Classical Electrodynamics,
    eqs 5.71, 5.72.

    >>> state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> MagneticDipole([0.0, 0.0, 2.0], [3.0, 0.0, 0.0])(0.0, state, None).tolist()  # z × x = y
    [0.0, 6.0, 0.0]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    moment: Float[Array, "3"] = eqx.field(converter=base.vector_converter("moment"))
    field: eqx.Module | Float[Array, "3"] = eqx.field(converter=base.source_converter("field"))

    @property
    def axis(self) -> base.AxisWithoutTorque | None:
        """Return a vector (3,), world frame, along which the torque has no component: the magnetic
        field, T, if it is constant; `None` otherwise.
        """
        source: Any = self.field
        return None if callable(source) else source

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Return the potential energy, J: `U = −m·RᵀB`, with the magnetic moment m, the field B and
        the attitude R.
        """
        return -dot(self.moment, self._field_at(t, state))

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        return cross(self.moment, self._field_at(t, state))

    def _field_at(self, t: ScalarLike, state: HasAttitude) -> Vec3:
        """Return the magnetic field, T, body axes."""
        return quaternion.rotate_inverse(state.q, base.vector_at(self.field, t, "field"))


class FromPotential(base.AbstractTorque):
    """Apply the torque of any potential `U(q)` of the attitude, by differentiation.

    **Arguments:** `potential` a function of the unit quaternion q (4,), body → world, that returns
    the potential energy U, J. The torque about body axis i is `τ_i = −∂U/∂q · ½ q ⊗ e_i`: minus the
    derivative of U with respect to the angle of a turn about this axis. Source: Landau and
    Lifshitz, Mechanics, §34.

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
        self.potential = _checks.require_function(potential, "potential", "q → U, J")

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Return the potential energy, J: the value of the user's function `potential` at the
        attitude of `state`.
        """
        return self._energy_at(state.q)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        slope = jax.grad(self._energy_at)(state.q)
        return -0.5 * quaternion.multiply(quaternion.conjugate(state.q), slope)[1:]

    def _energy_at(self, q: Quat) -> Scalar:
        """Return the potential energy, J; raise an error unless the user's value is a number."""
        return _checks.array_of_shape(self.potential(q), (), "potential", hint="one number, J")
