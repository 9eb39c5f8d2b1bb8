"""Dropped and thrown bodies on the turning Earth."""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point, require_point
from rigidjax.rotation.linalg3 import components

# NIMA TR8350.2 (WGS84), table 3.1; ISO 80000-3 for the standard fall.
RATE = 7.292115e-5
GRAVITY = 9.80665


class Earth(AbstractScene):
    """Free fall and throws near one place of the turning Earth: make one with `scenes.earth`.

    Axes east, north, up; up is the plumb line. Gravity is uniform and holds the centrifugal
    acceleration at the origin; what changes of it with x' is added apart.

    **Fields:** `latitude` rad, `gravity` m/s², `rate` rad/s.

    >>> scene = earth(0.5)
    >>> float(scene.latitude), float(scene.gravity)
    (0.5, 9.80665)
    """

    latitude: Scalar
    gravity: Scalar
    rate: Scalar

    def angular_velocity(self) -> Vec3:
        """Ω (0, Ω cos λ, Ω sin λ) (3,), rad/s, east, north, up."""
        north, up = self.rate * jnp.cos(self.latitude), self.rate * jnp.sin(self.latitude)
        return jnp.stack([jnp.zeros_like(north), north, up])

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Acceleration g − Ω×(Ω×x') − 2Ω×v' (3,), m/s² (notes, eq 91)."""
        x, v = components(state.x), components(state.v)
        dtype = state.x.dtype
        _, north, up = components(self.angular_velocity().astype(dtype))
        along, gravity = north * x[1] + up * x[2], self.gravity.astype(dtype)
        square = north * north + up * up
        return jnp.stack(
            [
                square * x[0] + 2 * (up * v[1] - north * v[2]),
                square * x[1] - along * north - 2 * up * v[0],
                square * x[2] - along * up + 2 * north * v[0] - gravity,
            ]
        )

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        return {"jacobi": self.jacobi_integral(state)}

    def jacobi_integral(self, state: Point) -> Scalar:
        """½|v'|² + g z − ½|Ω × x'|², m²/s², kept along the motion."""
        require_point(state)
        x, v = components(state.x), components(state.v)
        dtype = state.x.dtype
        _, north, up = components(self.angular_velocity().astype(dtype))
        along, square = north * x[1] + up * x[2], north * north + up * up
        moved = square * (x[0] ** 2 + x[1] ** 2 + x[2] ** 2) - along**2
        speed = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
        return 0.5 * (speed - moved) + self.gravity.astype(dtype) * x[2]

    def eastward_deflection(self, height: ScalarLike) -> Scalar:
        """How far east a dropped body lands, m, to first order in Ω: ⅓ Ω g cos λ (2h/g)^{3/2}.

        **Arguments:** `height` h, m. Source: Landau and Lifshitz, Mechanics, sec. 39, problem 1.

        >>> round(float(earth(0.0).eastward_deflection(100.0)), 5)
        0.02195
        """
        h = _checks.floating(height, (), "height")
        h = _checks.sign(h, "height", "metres above the ground, a number ≥ 0", zero=True)
        time = jnp.sqrt(2 * h / self.gravity)
        return self.rate * self.gravity * jnp.cos(self.latitude) * time**3 / 3


def earth(latitude: ScalarLike, gravity: ScalarLike = GRAVITY, rate: ScalarLike = RATE) -> Earth:
    """A place on the turning Earth, for dropped and thrown bodies.

    **Arguments:** `latitude` λ, rad, geodetic, north positive; `gravity` along the plumb line,
    m/s²; `rate` Ω of the Earth, rad/s (WGS84: 7.292115e-5, one turn in 86164.1 s).

    States are `Point(x, v)` in east, north, up from that place. **Raises:** `ValueError` for a
    latitude beyond a right angle (degrees?) or gravity that is not positive.

    >>> earth(0.5).acceleration(0.0, Point([0.0, 0, 0], [0.0, 0, 0])).tolist()
    [0.0, 0.0, -9.80665]
    """
    return Earth(*checked(latitude, gravity, rate))


def checked(
    latitude: ScalarLike, gravity: ScalarLike, rate: ScalarLike
) -> tuple[Scalar, Scalar, Scalar]:
    """Latitude, gravity and rate as scalars of one dtype, or the likely mistake."""
    lat, g, w = _checks.scalars(latitude=latitude, gravity=gravity, rate=rate)
    lat = _checks.refuse(
        lat,
        ~(jnp.abs(lat) <= 0.5000001 * jnp.pi),
        "latitude: wanted radians between −π/2 and π/2; were these degrees?",
    )
    g = _checks.sign(g, "gravity", "a positive number, m/s²; it points down")
    return lat, g, _checks.refuse(w, ~jnp.isfinite(w), "rate: wanted a finite number, rad/s")
