"""Describe the circular restricted three-body problem, and Hill's problem, its limit near the small
body.
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


def least_distance(dtype: DTypeLike) -> float:
    """Return the distance r = eps^0.4 from a body below which the attraction loses too many digits:
    positions have rounding errors of about eps, and so its relative error at r is about eps/r =
    eps^0.6.
    """
    return float(jnp.finfo(dtype).eps) ** 0.4


class ThreeBody(AbstractReversible):
    """Describe a particle under two bodies on circular orbits; `orbits.cr3bp(mu)` makes it.

    The axes rotate about the common centre of mass, which is the origin. The first body (mass 1 −
    μ) is at (−μ, 0, 0), the second body (mass μ) at (1 − μ, 0, 0). The units are the distance
    between the bodies, the total mass of the bodies, and 1/(angular rate of the bodies); hence the
    period of the bodies is 2π. **Fields:** `mu` the mass ratio μ; `radii` (2,) the radii of the
    bodies: a run ends by a collision when the particle is closer to a body than its radius.

    >>> scene = cr3bp(0.5)
    >>> [float(r) for r in scene.distances(jnp.array([0.0, 0.0, 0.0]))]
    [0.5, 0.5]
    """

    mu: Scalar
    radii: Float[Array, "2"]

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return the acceleration d²x/dt² (3,) of the particle, rotating axes (notes, eq 91).

        It is the sum of the attraction of both bodies and the centrifugal and Coriolis
        accelerations.
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
        """Return the potential U = ½(x² + y²) + (1 − μ)/r₁ + μ/r₂ at the position `x` (3,).

        r₁ and r₂ are the distances from the two bodies. The acceleration without the Coriolis
        acceleration is +∇U (Szebehely 1967, sec. 1.5, where U has an additional constant).
        """
        x = _checks.array_of_shape(x, (3,), "x")
        r1, r2 = self.distances(x)
        mu = self.mu.astype(x.dtype)
        return 0.5 * (x[0] * x[0] + x[1] * x[1]) + (1 - mu) / r1 + mu / r2

    def distances(self, x: Vector) -> tuple[Scalar, Scalar]:
        """Return the distances of the position `x` (3,) from the first and from the second body."""
        a, b, c = components(_checks.array_of_shape(x, (3,), "x"))
        mu = self.mu.astype(a.dtype)
        first, second, flat = a + mu, (a - 1) + mu, b * b + c * c
        return jnp.sqrt(first * first + flat), jnp.sqrt(second * second + flat)

    def jacobi_constant(self, state: Point) -> Scalar:
        """Return Jacobi's constant C = 2U − |v|², with the `potential` U.

        C is conserved along the motion.

        Source: Szebehely 1967, eq 1.5(20).

        >>> float(rj.orbits.cr3bp(0.5).jacobi_constant(Point([0.0, 0, 0], [0.0, 0, 0])))
        4.0
        """
        require_point(state)
        return self.speed_squared(state.x, 0.0) - jnp.sum(state.v * state.v)

    def speed_squared(self, x: Vector, jacobi: ScalarLike) -> Scalar:
        """Return |v|² = 2U(x) − C at the position `x` (3,) for Jacobi's constant C = `jacobi`.

        U is the `potential`. The result is negative where no particle with this C can be.
        """
        u = self.potential(x)
        return 2 * u - _checks.array_of_shape(jacobi, (), "jacobi").astype(u.dtype)

    def zero_velocity(
        self,
        xs: Float[ArrayLike, " columns"] | Sequence[float],
        ys: Float[ArrayLike, " rows"] | Sequence[float],
    ) -> Float[Array, "rows columns"]:
        """Return 2U, twice the `potential` U, on a grid of the plane z = 0.

        A particle with Jacobi's constant C stays where 2U ≥ C. With `grid` for the result,
        `matplotlib.pyplot.contour(xs, ys, grid, levels=[C])` draws the curve 2U = C, on which the
        velocity is zero (Szebehely 1967, sec. 4.7).

        **Arguments:** `xs` (columns,), `ys` (rows,) the coordinates x and y of the grid.

        >>> rj.orbits.cr3bp(0.5).zero_velocity([0.0], [0.0]).tolist()
        [[4.0]]
        """
        columns, rows = _checks.numeric_array(xs, "xs"), _checks.numeric_array(ys, "ys")
        if columns.ndim != 1 or rows.ndim != 1 or 0 in (columns.size, rows.size):
            shapes = f"{columns.shape} and {rows.shape}; give the axes, not a mesh"
            raise ValueError(f"zero_velocity: wanted xs (N,) and ys (M,), got {shapes}")

        def doubled_potential(x: Scalar, y: Scalar) -> Scalar:
            return 2 * self.potential(jnp.stack([x, y, jnp.zeros_like(x)]))

        along = jax.vmap(doubled_potential, (0, None))
        return jax.vmap(along, (None, 0))(columns, rows.astype(columns.dtype))

    def approach(
        self, t: ScalarLike, state: Point
    ) -> tuple[Float[Array, "distances=2"], Float[Array, "collision_distances=2"]]:
        """Return two arrays (2,) for the two bodies: the distance of the particle from each body;
        and the distance that counts as a collision with this body.
        """
        gaps = jnp.stack(self.distances(state.x))
        return gaps, jnp.maximum(self.radii.astype(gaps.dtype), least_distance(gaps.dtype))

    @property
    def lagrange_points(self) -> Float[Array, "5 3"]:
        """Return the positions of L1 … L5 (5, 3), rotating axes, differentiable with respect to μ.

        Source: Szebehely 1967, sec. 4.4.
        """
        return richardson.lagrange_points(self.mu)

    def hessian(self, x: Vector) -> Mat3:
        """Return the matrix (3, 3) of the second derivatives of the potential U at the position `x`
        (3,).
        """
        return jax.hessian(self.potential)(_checks.array_of_shape(x, (3,), "x"))

    def exponents(self, x: Vector) -> Complex[Array, "6"]:
        """Return the six exponents λ of small motions e^{λt} about an equilibrium point with z = 0.

        **Arguments:** `x` (3,) the equilibrium, such as a row of `lagrange_points`. The equilibrium
        is stable to first order if no λ has a positive real part: L4 and L5 are stable for μ below
        Routh's value ½(1 − √(23/27)), and L1–L3 are never stable. For motions in the plane λ⁴ + (4
        − U_xx − U_yy) λ² + U_xx U_yy − U_xy² = 0, and for motions along z λ² = U_zz, where U_xx and
        so on are the second derivatives of the `potential` U at `x` (Szebehely 1967, sec. 5.2).

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
        """Return an approximate planar Lyapunov orbit about L1, L2 or L3, as a guess for
        `periodic_orbit`.

        **Arguments:** `point` 1, 2 or 3; `amplitude` along x, in the scene's unit. Source:
        Richardson 1980, doi:10.1007/BF01229511 (third order).
        """
        return richardson.orbit_guess(self.mu, point, amplitude, None)

    def halo_guess(self, point: int, amplitude: ScalarLike) -> PeriodicOrbit:
        """Return an approximate halo orbit about L1, L2 or L3, a guess for `periodic_orbit(…,
        hold="z")`.

        **Arguments:** `point` 1, 2 or 3; `amplitude` along z, in the scene's unit: its sign selects
        the northern or the southern branch. Source: Richardson 1980, doi:10.1007/BF01229511 (third
        order).
        """
        return richardson.orbit_guess(self.mu, point, None, amplitude)


def cr3bp(mu: ScalarLike, radii: Float[Array, "2"] | object = (0.0, 0.0)) -> ThreeBody:
    """Return the circular restricted three-body problem with mass ratio μ.

    **Arguments:** `mu` μ = m₂/(m₁ + m₂) for the masses m₁ and m₂ of the bodies, 0 < μ ≤ ½
    (Earth–Moon 0.01215…); `radii` (2,) the radii of the two bodies in units of the distance between
    them. A run that comes closer to a body than its radius ends with a message that says the body,
    the time and the distance. For radii of zero a run ends at the distance where rounding spoils
    the attraction (`least_distance`). **Raises:** `ValueError` for μ outside (0, ½]
    (`EquinoxRuntimeError` under `jit`). Source: notes, eq 91, with a uniform Ω = (0, 0, 1);
    Szebehely 1967, Theory of Orbits.

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
    """Describe Hill's problem: a particle near a small body on a circular orbit about a large body.

    `orbits.hill()` makes this scene.

    The rotating axes are centred on the small body, with x away from the large body. The unit of
    length is μ^{1/3} times the distance between the bodies, with the mass ratio μ; the unit of time
    is 1/(angular rate of the bodies). **Field:** `radius` the radius of the small body, in the unit
    of length.

    >>> scene = hill()
    >>> float(scene.acceleration(0.0, Point([1.0, 0, 0], [0.0, 0, 0]))[0])  # 3 x − x/r³
    2.0
    """

    radius: Scalar

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return the acceleration (3,) of the particle at the position (x, y, z): 2 v_y + 3x −
        x/r³, −2 v_x − y/r³, −z − z/r³.

        Here r is the distance from the small body.
        """
        x, y, z = components(state.x)
        vx, vy, _ = components(state.v)
        square = x * x + y * y + z * z
        pull = 1 / (square * jnp.sqrt(square))
        return jnp.stack([2 * vy + 3 * x - pull * x, -2 * vx - pull * y, -z - pull * z])

    def jacobi_constant(self, state: Point) -> Scalar:
        """Return Jacobi's constant C = 3x² − z² + 2/r − |v|² (Hill 1878).

        Here r is the distance from the small body.

        >>> float(Hill(jnp.asarray(0.0)).jacobi_constant(Point([1.0, 0, 0], [0.0, 0, 0])))
        5.0
        """
        require_point(state)
        x, y, z = components(state.x)
        speed = jnp.sum(state.v * state.v)
        return 3 * x * x - z * z + 2 / jnp.sqrt(x * x + y * y + z * z) - speed

    def approach(
        self, t: ScalarLike, state: Point
    ) -> tuple[Float[Array, "distances=1"], Float[Array, "collision_distances=1"]]:
        """Return two arrays (1,) for the small body: the distance of the particle from it; and the
        distance that counts as a collision with it.
        """
        gap = jnp.sqrt(jnp.sum(state.x * state.x, keepdims=True))
        least = jnp.maximum(self.radius.astype(gap.dtype), least_distance(gap.dtype))
        return gap, least.reshape(1)

    @property
    def lagrange_points(self) -> Float[Array, "2 3"]:
        """Return the positions (2, 3) of L1, (−3^{−1/3}, 0, 0), and of L2, (3^{−1/3}, 0, 0)."""
        place = jnp.zeros(3, self.radius.dtype).at[0].set(3.0 ** (-1 / 3))
        return jnp.stack([-place, place])


def hill(radius: ScalarLike = 0.0) -> Hill:
    """Return the scene of Hill's problem, the limit of `cr3bp(mu)` as the mass ratio μ → 0.

    The unit of length in this limit is μ^{1/3} times the distance between the bodies.

    **Arguments:** `radius` the radius of the small body, in units of μ^{1/3} times the distance
    between the bodies. A run ends when the particle comes closer to the small body than its radius.
    Source: Hill 1878, doi:10.2307/2369430; Szebehely 1967, sec. 10.4.

    >>> hill().lagrange_points[1].round(12).tolist()
    [0.693361274351, 0.0, 0.0]
    """
    radius = _checks.array_of_shape(radius, (), "radius")
    return Hill(_checks.error_if(radius, ~(radius >= 0), "radius: wanted a number ≥ 0"))
