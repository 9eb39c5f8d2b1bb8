"""Describe a bead on a turning hoop, and a turntable."""

import equinox as eqx
import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.frames.base import AbstractScene, cast_like
from rigidjax.frames.earth import GRAVITY
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.frames.moving import MovingFrame
from rigidjax.frames.point import Point, require_point
from rigidjax.frames.rotation_models import AboutAxis
from rigidjax.rotation.linalg3 import components


class Hoop(AbstractScene):
    """Describe a bead that slides on a hoop, which turns about its vertical diameter.

    `scenes.hoop` makes this scene.

    The axes turn with the hoop: x is in the plane of the hoop, y across this plane, z up; the
    centre of the hoop is the origin. **Fields:** `radius` m, `rate` rad/s, `gravity` m/s².

    >>> scene = hoop(2.0, 0.0)
    >>> float(scene.radius), float(scene.gravity)
    (2.0, 9.80665)
    """

    radius: Scalar
    rate: Scalar
    gravity: Scalar

    def acceleration(self, t: ScalarLike, state: Point) -> Vec3:
        """Return the acceleration d²x'/dt² (3,), m/s², of the bead on the hoop at the position x',
        in the axes that turn with the hoop.

        It is the sum of gravity, the centrifugal acceleration, and the force per mass of the hoop
        within its plane, which keeps the bead at the distance `radius` from the centre.
        """
        x, _, z = components(state.x)
        vx, _, vz = components(state.v)
        rate, gravity = cast_like(x, self.rate, self.gravity)
        push, down = rate * rate * x, -gravity
        pull = (x * push + z * down + vx * vx + vz * vz) / (x * x + z * z)
        return jnp.stack([push - pull * x, jnp.zeros_like(x), down - pull * z])

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        x, _, z = components(state.x)
        rate, gravity = cast_like(x, self.rate, self.gravity)
        jacobi = 0.5 * (jnp.sum(state.v * state.v) - (rate * x) ** 2) + gravity * z
        return {"jacobi": jacobi, "radius": jnp.sqrt(x * x + z * z)}

    def side_push(self, state: Point) -> Scalar:
        """Return the force per mass, m/s², with which the hoop pushes the bead along y, across its
        plane: 2Ω v_x, which balances the Coriolis acceleration; Ω is the rate of the hoop.

        >>> float(hoop(1.0, 3.0).side_push(Point([0.0, 0, -1], [2.0, 0, 0])))
        12.0
        """
        require_point(state)
        return 2 * cast_like(state.x, self.rate)[0] * state.v[0]

    def state(self, angle: ScalarLike, speed: ScalarLike = 0.0) -> Point:
        """Return the state of the bead on the hoop at the angle θ = `angle` from the lowest place,
        rad, with the angular velocity dθ/dt = `speed`, rad/s.

        >>> hoop(2.0, 3.0).state(0.0, 1.0).v.tolist()
        [2.0, 0.0, 0.0]
        """
        angle, speed = (
            _checks.array_of_shape(angle, (), "angle"),
            _checks.array_of_shape(speed, (), "speed"),
        )
        c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
        place, along = jnp.stack([s, zero, -c]), jnp.stack([c, zero, s])
        radius = cast_like(place, self.radius)[0]
        return Point(radius * place, radius * speed.astype(angle.dtype) * along)

    def equilibrium_angle(self) -> Scalar:
        """Return the angle of the bead's stable equilibrium from the lowest place, rad.

        It is arccos(g/(Ω²R)), with gravity g and the hoop's rate Ω and radius R, or 0 if g ≥ Ω²R.

        >>> float(hoop(1.0, 1.0).equilibrium_angle())
        0.0
        """
        ratio = self.gravity / (self.rate**2 * self.radius)
        fast = ratio < 1
        return jnp.where(fast, jnp.arccos(jnp.where(fast, ratio, 0.5)), 0)


def hoop(radius: ScalarLike, rate: ScalarLike, gravity: ScalarLike = GRAVITY) -> Hoop:
    """Return the scene of a bead that slides without friction on a hoop with a vertical rotation
    axis.

    The angle θ of the bead from the lowest place obeys θ'' = sin θ (Ω² cos θ − g/R). **Arguments:**
    `radius` R, m; `rate` Ω of the hoop, rad/s; `gravity` g, m/s². Source: Goldstein, Mechanics,
    sec. 2.7; notes, eq 91. **Raises:** `ValueError` for a radius that is not positive.

    >>> hoop(1.0, 5.0).acceleration(0.0, Point([0.0, 0, -1], [0.0, 0, 0])).tolist()
    [0.0, 0.0, 0.0]
    """
    r, w, g = _checks.scalars(radius=radius, rate=rate, gravity=gravity)
    r = _checks.require_positive(r, "radius", "a positive number, m")
    return Hoop(r, _checks.require_finite(w, "rate"), _checks.require_finite(g, "gravity"))


class _QuadraticAngle(eqx.Module):
    """Compute the angle Ωt + ½αt², rad, of a uniformly accelerated frame at the time t, s.

    **Fields:** `rate` Ω at t = 0, rad/s; `growth` α = dΩ/dt, rad/s².
    """

    rate: Scalar
    growth: Scalar

    def __call__(self, t: Scalar) -> Scalar:
        rate, growth = cast_like(t, self.rate, self.growth)
        return t * (rate + 0.5 * growth * t)


def turntable(rate: ScalarLike, growth: ScalarLike = 0.0) -> InFrame:
    """Return the scene of a puck on a frictionless table that turns about z, in the table's frame.

    **Arguments:** `rate` the angular rate Ω of the table at t = 0, rad/s; `growth` dΩ/dt, rad/s².
    In the inertial frame the puck moves in a straight line. `turntable(…).frame` transforms states
    between the frame of the table and the inertial frame (notes, eqs 85–91).

    >>> turntable(2.0).acceleration(0.0, Point([1.0, 0, 0], [0.0, 0, 0])).tolist()
    [4.0, 0.0, 0.0]
    """
    rate = _checks.require_finite(_checks.array_of_shape(rate, (), "rate"), "rate")
    growth = _checks.require_finite(_checks.array_of_shape(growth, (), "growth"), "growth")
    up = jnp.eye(3, dtype=rate.dtype)[2]
    return InFrame(MovingFrame(AboutAxis(up, _QuadraticAngle(rate, growth))))
