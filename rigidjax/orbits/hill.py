"""Hill's problem: the limit of the three-body problem near the small body."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.frames.point import Point, require_point
from rigidjax.orbits.reversible_scene import AbstractReversible
from rigidjax.orbits.state_transition import smallest_distance
from rigidjax.rotation.linalg3 import components


class Hill(AbstractReversible):
    """A particle near a small body on a circular orbit about a large one; `orbits.hill()` makes it.

    Rotating axes centred on the small body, x away from the large one. Units: μ^{1/3} of the
    bodies' distance, and 1/(their angular rate). **Field:** `radius` of the small body.

    >>> scene = hill()
    >>> float(scene.acceleration(0.0, Point([1.0, 0, 0], [0.0, 0, 0]))[0])  # 3 x − x/r³
    2.0
    """

    radius: Scalar

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """d²x/dt² = 2 v_y + 3x − x/r³, −2 v_x − y/r³, −z − z/r³."""
        x, y, z = components(state.x)
        vx, vy, _ = components(state.v)
        square = x * x + y * y + z * z
        pull = 1 / (square * jnp.sqrt(square))
        return jnp.stack([2 * vy + 3 * x - pull * x, -2 * vx - pull * y, -z - pull * z])

    def jacobi_constant(self, state: Point) -> Scalar:
        """C = 3x² − z² + 2/r − |v|² (Hill 1878).

        >>> float(Hill(jnp.asarray(0.0)).jacobi_constant(Point([1.0, 0, 0], [0.0, 0, 0])))
        5.0
        """
        require_point(state)
        x, y, z = components(state.x)
        speed = jnp.sum(state.v * state.v)
        return 3 * x * x - z * z + 2 / jnp.sqrt(x * x + y * y + z * z) - speed

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        return {"jacobi": self.jacobi_constant(state)}

    def approach(self, t: ScalarLike, state: Point) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """Distance from the small body, and the distance of a collision, which ends a run."""
        gap = jnp.sqrt(jnp.sum(state.x * state.x, keepdims=True))
        least = jnp.maximum(self.radius.astype(gap.dtype), smallest_distance(gap.dtype))
        return gap, least.reshape(1)

    @property
    def lagrange_points(self) -> Float[Array, "2 3"]:
        """L1 and L2 (2, 3), at x = ∓3^{−1/3}."""
        place = jnp.zeros(3, self.radius.dtype).at[0].set(3.0 ** (-1 / 3))
        return jnp.stack([-place, place])


def hill(radius: ScalarLike = 0.0) -> Hill:
    """Hill's problem, the limit of `cr3bp(mu)` as μ → 0 in units of μ^{1/3}.

    **Arguments:** `radius` of the small body, in these units, for collisions. Source: Hill 1878,
    doi:10.2307/2369430; Szebehely 1967, sec. 10.4.

    >>> hill().lagrange_points[1].round(12).tolist()
    [0.693361274351, 0.0, 0.0]
    """
    radius = _checks.floating(radius, (), "radius")
    return Hill(_checks.refuse(radius, ~(radius >= 0), "radius: wanted a number ≥ 0"))
