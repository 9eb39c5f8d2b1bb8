"""Describe the circular restricted three-body problem, and its limit near the small body: Hill's
problem.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Complex, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Scalar, ScalarLike, Vec3, Vector
from rigidjax.frames.point import Point, require_point
from rigidjax.orbits import richardson
from rigidjax.orbits.differential_correction import PeriodicOrbit
from rigidjax.orbits.reversible_scene import AbstractReversible
from rigidjax.rotation.linalg3 import components


def smallest_distance(dtype: DTypeLike) -> float:
    """Return eps^0.4, the distance r at which an attraction is known only to eps/r = eps^0.6."""
    return float(jnp.finfo(dtype).eps) ** 0.4


class ThreeBody(AbstractReversible):
    """Describe a particle under two bodies on circular orbits; `orbits.cr3bp(mu)` makes it.

    The axes rotate, with the origin at the common centre of mass, the first body (mass 1 − μ) at
    (−μ, 0, 0), the second (mass μ) at (1 − μ, 0, 0). Units: their distance, their total mass, and
    1/(their angular rate); their period is 2π. **Fields:** `mu` μ, scalar; `radii` (2,) of the
    bodies, for collisions.

    >>> scene = cr3bp(0.5)
    >>> [float(r) for r in scene.distances(jnp.array([0.0, 0.0, 0.0]))]
    [0.5, 0.5]
    """

    mu: Scalar
    radii: Float[Array, "2"]

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return d²x/dt² (3,), rotating axes: attraction, centrifugal and Coriolis (notes, eq
        91).
        """
        x, y, z = components(state.x)
        vx, vy, _ = components(state.v)
        mu = self.mu.astype(x.dtype)
        first, second = x + mu, (x - 1) + mu
        flat = y * y + z * z
        d1, d2 = first * first + flat, second * second + flat
        a1, a2 = (1 - mu) / (d1 * jnp.sqrt(d1)), mu / (d2 * jnp.sqrt(d2))
        pull = a1 + a2
        return jnp.stack([2 * vy + x - a1 * first - a2 * second, y - 2 * vx - pull * y, -pull * z])

    def potential(self, x: Vector) -> Scalar:
        """Return U = ½(x² + y²) + (1 − μ)/r₁ + μ/r₂ at `x` (3,) (Szebehely, sec. 1.5, no
        constant).
        """
        x = _checks.array_of_shape(x, (3,), "x")
        r1, r2 = self.distances(x)
        mu = self.mu.astype(x.dtype)
        return 0.5 * (x[0] * x[0] + x[1] * x[1]) + (1 - mu) / r1 + mu / r2

    def distances(self, x: Vector) -> tuple[Scalar, Scalar]:
        """Return the distances of a place (3,) from the first and from the second body."""
        a, b, c = components(_checks.array_of_shape(x, (3,), "x"))
        mu = self.mu.astype(a.dtype)
        first, second, flat = a + mu, (a - 1) + mu, b * b + c * c
        return jnp.sqrt(first * first + flat), jnp.sqrt(second * second + flat)

    def jacobi_constant(self, state: Point) -> Scalar:
        """Return C = 2U − |v|², conserved along the motion (Szebehely 1967, eq 1.5(20)).

        >>> float(rj.orbits.cr3bp(0.5).jacobi_constant(Point([0.0, 0, 0], [0.0, 0, 0])))
        4.0
        """
        require_point(state)
        return self.speed_squared(state.x, 0.0) - jnp.sum(state.v * state.v)

    def speed_squared(self, x: Vector, jacobi: ScalarLike) -> Scalar:
        """Return |v|² = 2U(x) − C at `x` (3,) for C = `jacobi`; it is negative where no particle
        with this C can be.
        """
        u = self.potential(x)
        return 2 * u - _checks.array_of_shape(jacobi, (), "jacobi").astype(u.dtype)

    def zero_velocity(
        self,
        xs: Float[ArrayLike, " columns"] | Sequence[float],
        ys: Float[ArrayLike, " rows"] | Sequence[float],
    ) -> Float[Array, "rows columns"]:
        """Return 2U on a grid of the plane z = 0, rows along y; a particle of constant C stays
        where 2U ≥ C.

        **Arguments:** `xs`, `ys` places along the axes. `matplotlib.pyplot.contour(xs, ys, grid,
        levels=[C])` draws the curve of zero velocity (Szebehely 1967, sec. 4.7).

        >>> rj.orbits.cr3bp(0.5).zero_velocity([0.0], [0.0]).tolist()
        [[4.0]]
        """
        columns, rows = _checks.numeric_array(xs, "xs"), _checks.numeric_array(ys, "ys")
        if columns.ndim != 1 or rows.ndim != 1 or 0 in (columns.size, rows.size):
            shapes = f"{columns.shape} and {rows.shape}; give the axes, not a mesh"
            raise ValueError(f"zero_velocity: wanted xs (N,) and ys (M,), got {shapes}")

        def value(x: Scalar, y: Scalar) -> Scalar:
            return 2 * self.potential(jnp.stack([x, y, jnp.zeros_like(x)]))

        along = jax.vmap(value, (0, None))
        return jax.vmap(along, (None, 0))(columns, rows.astype(columns.dtype))

    def approach(self, t: ScalarLike, state: Point) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Return the distances from the two bodies, and the distances at which a collision ends the
        run.
        """
        gaps = jnp.stack(self.distances(state.x))
        return gaps, jnp.maximum(self.radii.astype(gaps.dtype), smallest_distance(gaps.dtype))

    @property
    def lagrange_points(self) -> Float[Array, "5 3"]:
        """Return L1 … L5 (5, 3), rotating axes (Szebehely 1967, sec. 4.4), differentiable by μ."""
        return richardson.lagrange_points(self.mu)

    def hessian(self, x: Vector) -> Mat3:
        """Return the second derivatives of U (3, 3) at a place."""
        return jax.hessian(self.potential)(_checks.array_of_shape(x, (3,), "x"))

    def exponents(self, x: Vector) -> Complex[Array, "6"]:
        """Return the six exponents λ of small motions e^{λt} about an equilibrium in the plane.

        **Arguments:** `x` (3,), such as a row of `lagrange_points`. The equilibrium is stable to
        first order if no real part is positive: L4 and L5 below Routh's μ = ½(1 − √(23/27)), L1–L3
        never. In the plane λ⁴ + (4 − U_xx − U_yy) λ² + U_xx U_yy − U_xy² = 0, across it λ² = U_zz
        (Szebehely 1967, sec. 5.2).

        >>> moon = rj.orbits.cr3bp(0.0121505856)
        >>> bool((moon.exponents(moon.lagrange_points[3]).real < 1e-12).all())
        True
        """
        u = self.hessian(x)
        middle = 0.5 * (4 - u[0, 0] - u[1, 1])
        product = u[0, 0] * u[1, 1] - u[0, 1] * u[0, 1]
        kind = jnp.complex128 if u.dtype == jnp.float64 else jnp.complex64
        middle, product, across = (number.astype(kind) for number in (middle, product, u[2, 2]))
        half = jnp.sqrt(middle * middle - product)
        roots = jnp.sqrt(jnp.stack([half - middle, -half - middle, across]))
        return jnp.concatenate([roots, -roots])

    def lyapunov_guess(self, point: int, amplitude: ScalarLike) -> PeriodicOrbit:
        """Return a start near a planar Lyapunov orbit about L1, L2 or L3, for `periodic_orbit`.

        **Arguments:** `point` 1, 2 or 3; `amplitude` along x. Source: `richardson.orbit_guess`.
        """
        return richardson.orbit_guess(self.mu, point, amplitude, None)

    def halo_guess(self, point: int, amplitude: ScalarLike) -> PeriodicOrbit:
        """Return a start near a halo orbit about L1, L2 or L3, for `periodic_orbit(…, hold="z")`.

        **Arguments:** `point` 1, 2 or 3; `amplitude` along z, whose sign is that of the branch.
        Source: Richardson 1980, doi:10.1007/BF01229511 (third order).
        """
        return richardson.orbit_guess(self.mu, point, None, amplitude)


def cr3bp(mu: ScalarLike, radii: Float[Array, "2"] | object = (0.0, 0.0)) -> ThreeBody:
    """Return the circular restricted three-body problem with mass ratio μ.

    **Arguments:** `mu` μ = m₂/(m₁ + m₂), 0 < μ ≤ ½ (Earth–Moon 0.01215…); `radii` (2,) of the two
    bodies in units of their distance. A run that comes closer ends, with the collision's body, time
    and distance; for radii of zero it ends at a distance that float64 cannot resolve. **Raises:**
    `ValueError` for μ outside (0, ½] (`EquinoxRuntimeError` under `jit`). Source: notes, eq 91,
    with a uniform Ω = (0, 0, 1); Szebehely 1967, Theory of Orbits.

    >>> cr3bp(0.5).lagrange_points[3].round(12).tolist()
    [0.0, 0.866025403784, 0.0]
    """
    ratio = _checks.array_of_shape(mu, (), "mu")
    bad = ~((ratio > 0) & (ratio <= 0.5))
    words = "mu: wanted 0 < mu ≤ ½, the mass of the lighter body over the mass of both"
    ratio = _checks.error_if(ratio, bad, words)
    radii = _checks.array_of_shape(
        list(radii) if isinstance(radii, tuple) else radii, (2,), "radii"
    )
    return ThreeBody(ratio, _checks.error_if(radii, ~(radii >= 0), "radii: wanted two numbers ≥ 0"))


class Hill(AbstractReversible):
    """Describe a particle near a small body on a circular orbit about a large one; `orbits.hill()`
    makes it.

    The rotating axes are centred on the small body, with x away from the large body. Units: μ^{1/3}
    of the bodies' distance, and 1/(their angular rate). **Field:** `radius` of the small body.

    >>> scene = hill()
    >>> float(scene.acceleration(0.0, Point([1.0, 0, 0], [0.0, 0, 0]))[0])  # 3 x − x/r³
    2.0
    """

    radius: Scalar

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return d²x/dt² = 2 v_y + 3x − x/r³, −2 v_x − y/r³, −z − z/r³."""
        x, y, z = components(state.x)
        vx, vy, _ = components(state.v)
        square = x * x + y * y + z * z
        pull = 1 / (square * jnp.sqrt(square))
        return jnp.stack([2 * vy + 3 * x - pull * x, -2 * vx - pull * y, -z - pull * z])

    def jacobi_constant(self, state: Point) -> Scalar:
        """Return C = 3x² − z² + 2/r − |v|² (Hill 1878).

        >>> float(Hill(jnp.asarray(0.0)).jacobi_constant(Point([1.0, 0, 0], [0.0, 0, 0])))
        5.0
        """
        require_point(state)
        x, y, z = components(state.x)
        speed = jnp.sum(state.v * state.v)
        return 3 * x * x - z * z + 2 / jnp.sqrt(x * x + y * y + z * z) - speed

    def approach(self, t: ScalarLike, state: Point) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """Return the distance from the small body, and the distance at which a collision ends the
        run.
        """
        gap = jnp.sqrt(jnp.sum(state.x * state.x, keepdims=True))
        least = jnp.maximum(self.radius.astype(gap.dtype), smallest_distance(gap.dtype))
        return gap, least.reshape(1)

    @property
    def lagrange_points(self) -> Float[Array, "2 3"]:
        """Return L1 and L2 (2, 3), at x = ∓3^{−1/3}."""
        place = jnp.zeros(3, self.radius.dtype).at[0].set(3.0 ** (-1 / 3))
        return jnp.stack([-place, place])


def hill(radius: ScalarLike = 0.0) -> Hill:
    """Return the scene of Hill's problem, the limit of `cr3bp(mu)` as μ → 0 in units of μ^{1/3}.

    **Arguments:** `radius` of the small body, in these units, for collisions. Source: Hill 1878,
    doi:10.2307/2369430; Szebehely 1967, sec. 10.4.

    >>> hill().lagrange_points[1].round(12).tolist()
    [0.693361274351, 0.0, 0.0]
    """
    radius = _checks.array_of_shape(radius, (), "radius")
    return Hill(_checks.error_if(radius, ~(radius >= 0), "radius: wanted a number ≥ 0"))
