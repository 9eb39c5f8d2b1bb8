"""Describe the turning Earth: dropped and thrown bodies, and Foucault's pendulum."""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point, require_point
from rigidjax.rotation.linalg3 import components, dot_components

# These are the rate of the Earth's rotation, rad/s (source: NIMA TR8350.2, WGS84, table 3.1), and
# standard gravity, m/s² (source: ISO 80000-3).
RATE = 7.292115e-5
GRAVITY = 9.80665


class Earth(AbstractScene):
    """Describe free fall and throws near one place of the turning Earth; `scenes.earth` makes it.

    The axes are east, north, up; up is along the plumb line. Gravity is uniform and contains the
    centrifugal acceleration at the origin. The centrifugal acceleration at another place differs
    from that at the origin, and this difference is added. **Fields:** `latitude` rad; `gravity`
    m/s²; `rate` the angular rate of the Earth, rad/s.

    >>> scene = earth(0.5)
    >>> float(scene.latitude), float(scene.gravity)
    (0.5, 9.80665)
    """

    latitude: Scalar
    gravity: Scalar
    rate: Scalar

    def angular_velocity(self) -> Vec3:
        """Return the Earth's angular velocity (0, Ω cos λ, Ω sin λ) (3,), rad/s, in the axes east,
        north, up, with the `rate` Ω and the `latitude` λ.
        """
        north, up = self.rate * jnp.cos(self.latitude), self.rate * jnp.sin(self.latitude)
        return jnp.stack([jnp.zeros_like(north), north, up])

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return the acceleration g − Ω×(Ω×x') − 2Ω×v' (3,), m/s², of a body in free fall, in the
        axes east, north, up (notes, eq 91).

        Here x' and v' are the position and velocity of `state`, Ω is the Earth's angular velocity,
        and g = (0, 0, −`gravity`).
        """
        x, v = components(state.x), components(state.v)
        dtype = state.x.dtype
        _, north, up = components(self.angular_velocity().astype(dtype))
        along, gravity = north * x[1] + up * x[2], self.gravity.astype(dtype)
        square = north * north + up * up
        east = square * x[0] + 2 * (up * v[1] - north * v[2])
        across = square * x[1] - along * north - 2 * up * v[0]
        return jnp.stack([east, across, square * x[2] - along * up + 2 * north * v[0] - gravity])

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        return {"jacobi": self.jacobi_integral(state)}

    def jacobi_integral(self, state: Point) -> Scalar:
        """Return the Jacobi integral ½|v'|² + g z − ½|Ω × x'|², m²/s², which free fall on the
        turning Earth conserves.

        Here x' and v' are the position and velocity of `state`, in the axes east, north, up; z is
        the height, g the field `gravity`, and Ω the Earth's angular velocity.
        """
        require_point(state)
        x, v = components(state.x), components(state.v)
        dtype = state.x.dtype
        _, north, up = components(self.angular_velocity().astype(dtype))
        along, square = north * x[1] + up * x[2], north * north + up * up
        moved = square * (x[0] ** 2 + x[1] ** 2 + x[2] ** 2) - along**2
        speed = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
        return 0.5 * (speed - moved) + self.gravity.astype(dtype) * x[2]

    def eastward_deflection(self, height: ScalarLike) -> Scalar:
        """Return the eastward deflection, m, of a body dropped from the height h = `height`, m.

        It is ⅓ Ω g cos λ (2h/g)^{3/2}, correct to first order in the angular rate Ω of the Earth; g
        is gravity and λ the latitude (Landau and Lifshitz, Mechanics, sec. 39, problem 1).

        >>> round(float(earth(0.0).eastward_deflection(100.0)), 5)
        0.02195
        """
        h = _checks.array_of_shape(height, (), "height")
        h = _checks.require_positive(
            h, "height", "metres above the ground, a number ≥ 0", allow_zero=True
        )
        time = jnp.sqrt(2 * h / self.gravity)
        return self.rate * self.gravity * jnp.cos(self.latitude) * time**3 / 3


def earth(latitude: ScalarLike, gravity: ScalarLike = GRAVITY, rate: ScalarLike = RATE) -> Earth:
    """Return the scene of one place on the turning Earth, for dropped and thrown bodies.

    **Arguments:** `latitude` λ, rad, geodetic, north positive; `gravity` along the plumb line,
    m/s²; `rate` Ω of the Earth, rad/s (WGS84: 7.292115e-5, one turn in 86164.1 s). States are
    `Point(x, v)`: position and velocity relative to the place, in the axes east, north, up.
    **Raises:** `ValueError` for a latitude beyond ±π/2, which is probably in degrees, or for
    gravity that is not positive.

    >>> earth(0.5).acceleration(0.0, Point([0.0, 0, 0], [0.0, 0, 0])).tolist()
    [0.0, 0.0, -9.80665]
    """
    lat, g, w = _checks.scalars(latitude=latitude, gravity=gravity, rate=rate)
    words = "latitude: wanted radians between −π/2 and π/2; were these degrees?"
    lat = _checks.error_if(lat, ~(jnp.abs(lat) <= 0.5000001 * jnp.pi), words)
    g = _checks.require_positive(g, "gravity", "a positive number, m/s²; it points down")
    return Earth(
        lat, g, _checks.error_if(w, ~jnp.isfinite(w), "rate: wanted a finite number, rad/s")
    )


class Foucault(AbstractScene):
    """Describe a pendulum on the turning Earth; `scenes.foucault` makes it.

    The bob keeps the distance `length` from the pivot at the origin; the axes are east, north, up.
    The force of the string is eliminated from the equations of motion. The distance is therefore
    constant to the tolerance of the solver, not exactly, and `drift` reports its error. **Fields:**
    `place` the `Earth` scene at the pivot; `length` m.

    >>> pendulum = foucault(0.85, 67.0)
    >>> float(pendulum.length), float(pendulum.place.latitude)
    (67.0, 0.85)
    """

    place: Earth
    length: Scalar

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return the acceleration d²x'/dt² (3,), m/s², of the pendulum's bob at the position x'
        from the pivot, in the axes east, north, up (notes, eq 91).

        The acceleration along the string is such that the bob keeps its distance from the pivot;
        across the string the acceleration is that of a free particle.
        """
        x, v = components(state.x), components(state.v)
        a = components(self.place.acceleration(t, state))
        pull = (dot_components(x, a) + dot_components(v, v)) / dot_components(x, x)
        return jnp.stack([a[i] - pull * x[i] for i in range(3)])

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        length = jnp.sqrt(jnp.sum(state.x * state.x))
        return {"jacobi": self.place.jacobi_integral(state), "length": length}

    def start(self, east: ScalarLike, north: ScalarLike) -> Point:
        """Return the state of the pendulum's bob at rest, at the horizontal distances `east` and
        `north`, m, from the pivot.

        >>> foucault(0.5, 10.0).start(6.0, 0.0).x.tolist()
        [6.0, 0.0, -8.0]
        """
        return self.state(east, north, 0.0, 0.0)

    def state(
        self, east: ScalarLike, north: ScalarLike, east_speed: ScalarLike, north_speed: ScalarLike
    ) -> Point:
        """Return the state of the pendulum's bob, below the pivot, from its horizontal position and
        velocity.

        **Arguments:** `east`, `north` the horizontal distances from the pivot, m, with √(east² +
        north²) less than the length of the string; `east_speed`, `north_speed` the horizontal
        velocity, m/s. The height and the vertical velocity follow from the constant length.

        >>> foucault(0.5, 10.0).state(6.0, 0.0, 4.0, 0.0).v.tolist()
        [4.0, 0.0, 3.0]
        """
        named = dict(east=east, north=north, east_speed=east_speed, north_speed=north_speed)
        length, e, n, ve, vn = _checks.scalars(length=self.length, **named)
        below = length**2 - e * e - n * n
        words = "foucault: wanted a start below the pivot, got one beyond the length of the string"
        below = _checks.error_if(below, ~(below > 0), words)
        up = -jnp.sqrt(below)
        return Point(jnp.stack([e, n, up]), jnp.stack([ve, vn, -(e * ve + n * vn) / up]))

    def small_swing(self, state: Point, t: ScalarLike) -> Point:
        """Return the state of the pendulum's bob at the time `t`, s, in closed form, for small
        swings.

        The complex number z = east + i north, with the position of the bob, obeys z'' + 2iΩ_z z' +
        ω₀² z = 0. Here Ω_z = Ω sin λ, with the rate Ω of the Earth and the latitude λ; and ω₀² =
        g/L, with gravity g and the length L of the string. The solution is z = e^{−iΩ_z t} (A cos
        ωt + B sin ωt) with ω² = ω₀² + Ω_z², where A and B follow from the initial state (Landau and
        Lifshitz, Mechanics, sec. 39, problem 3). The relative error of the solution is of the order
        of (amplitude/length)².

        **Arguments:** `state` the state at t = 0. **Returns** a `Point` at the height at which the
        bob hangs at rest.

        >>> pendulum = foucault(0.5, 10.0)
        >>> pendulum.small_swing(pendulum.start(0.1, 0.0), 0.0).x[0]
        Array(0.1, dtype=float64)
        """
        require_point(state)
        t = _checks.array_of_shape(t, (), "t").astype(state.x.dtype)
        x, y, _ = components(state.x)
        vx, vy, _ = components(state.v)
        place = self.place
        up = (place.rate * jnp.sin(place.latitude)).astype(t.dtype)
        swing = jnp.sqrt(place.gravity.astype(t.dtype) / self.length.astype(t.dtype) + up * up)
        # In horizontal axes that turn with the plane of swing the bob is a harmonic oscillator: its
        # position is a cos ωt + b sin ωt, where the vectors a and b follow from the position and
        # velocity at t = 0.
        ax, ay, bx, by = x, y, (vx - up * y) / swing, (vy + up * x) / swing
        c, s = jnp.cos(swing * t), jnp.sin(swing * t)
        px, py = ax * c + bx * s, ay * c + by * s
        qx, qy = swing * (bx * c - ax * s), swing * (by * c - ay * s)
        c, s = jnp.cos(up * t), jnp.sin(up * t)
        ex, ey = c * px + s * py, c * py - s * px
        wx, wy = c * qx + s * qy + up * ey, c * qy - s * qx - up * ex
        zero = jnp.zeros_like(ex)
        return Point(jnp.stack([ex, ey, -self.length.astype(t.dtype)]), jnp.stack([wx, wy, zero]))

    def precession_rate(self) -> Scalar:
        """Return the rate at which the plane of small swings of the pendulum turns, rad/s: −Ω sin
        λ, with the rate Ω of the Earth and the latitude λ.

        Seen from above, the plane turns clockwise in the northern hemisphere, where λ > 0.

        >>> round(float(2 * jnp.pi / -foucault(jnp.pi / 6, 67.0).precession_rate()))
        172328
        """
        return -self.place.rate * jnp.sin(self.place.latitude)


def foucault(
    latitude: ScalarLike, length: ScalarLike, gravity: ScalarLike = GRAVITY, rate: ScalarLike = RATE
) -> Foucault:
    """Return the scene of Foucault's pendulum.

    **Arguments:** `latitude` λ, rad, north positive; `length` of the string, m; `gravity` m/s²,
    along the plumb line; `rate` of the Earth, rad/s (WGS84 by default). All arguments may be
    traced: `latitude` and `rate`, for example, can be fitted to measurements. **Raises:**
    `ValueError` for a length or gravity that is not positive, or for a latitude beyond ±π/2, which
    is probably in degrees.

    >>> pendulum = foucault(0.85, 67.0)
    >>> pendulum.start(3.0, 0.0).v.tolist()
    [0.0, 0.0, 0.0]
    """
    place = earth(latitude, gravity, rate)
    string = _checks.array_of_shape(length, (), "length")
    string = _checks.require_positive(string, "length", "a positive number, m")
    return Foucault(place, string.astype(jnp.promote_types(string.dtype, place.rate.dtype)))
