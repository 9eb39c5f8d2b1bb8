"""Compute with a moving frame at one instant: the kinematics of section 3 of the notes."""

import equinox as eqx
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax._types import Mat3, Vec3, Vector
from rigidjax.rotation import linalg3, quaternion


class Instant(eqx.Module):
    """Hold the position, rotation and motion of a moving frame S' at one time.

    `MovingFrame.at(t)` makes an `Instant`. **Fields**, where S is the inertial frame:

    - `rotation`: the rotation matrix M (3, 3), S' → S.
    - `rate`, `rate_change`: the angular velocity Ω (3,), rad/s, and its derivative dΩ/dt (3,),
      rad/s², in the axes of S'.
    - `origin`, `origin_velocity`, `origin_acceleration`: the position X (3,) of the origin of S',
      m, its velocity dX/dt (3,), m/s, and its acceleration d²X/dt² (3,), m/s², in the axes of S.

    The arguments `x` and `v` of the methods are a position x' and a velocity v' in S'.

    >>> now = rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0])).at(0.0)
    >>> now.rate.tolist(), now.coriolis([1.0, 0.0, 0.0]).tolist()
    ([0.0, 0.0, 2.0], [0.0, -4.0, 0.0])
    """

    rotation: Mat3
    rate: Vec3
    rate_change: Vec3
    origin: Vec3
    origin_velocity: Vec3
    origin_acceleration: Vec3

    def to_inertial(self, state: PyTree) -> PyTree:
        """Return `state`, which is given in the moving frame S', transformed to the inertial frame
        S (notes, eqs 85, 88).
        """
        _require_transformable(state)
        turned: dict[str, Array] = {}
        if hasattr(state, "x"):
            x, rate = state.x, self.rate.astype(state.x.dtype)
            turned["x"] = self.origin.astype(x.dtype) + self.to_inertial_axes(x)
            velocity = state.v + linalg3.cross(rate, x)
            turned["v"] = self.origin_velocity.astype(x.dtype) + self.to_inertial_axes(velocity)
        if hasattr(state, "q"):
            q = quaternion.from_matrix(self.rotation).astype(state.q.dtype)
            rate = quaternion.rotate_inverse(state.q, self.rate.astype(state.q.dtype))
            turned["q"] = quaternion.multiply(q, state.q)
            turned["omega"] = state.omega + rate
        return _replace_fields(state, turned)

    def from_inertial(self, state: PyTree) -> PyTree:
        """Return `state`, which is given in the inertial frame S, transformed to the moving frame
        S' (notes, eqs 86, 88).
        """
        _require_transformable(state)
        turned: dict[str, Array] = {}
        if hasattr(state, "x"):
            dtype = state.x.dtype
            x = self.from_inertial_axes(state.x - self.origin.astype(dtype))
            v = self.from_inertial_axes(state.v - self.origin_velocity.astype(dtype))
            turned["x"], turned["v"] = x, v - linalg3.cross(self.rate.astype(dtype), x)
        if hasattr(state, "q"):
            back = quaternion.from_matrix(self.rotation.T).astype(state.q.dtype)
            turned["q"] = quaternion.multiply(back, state.q)
            rate = self.rate.astype(state.q.dtype)
            turned["omega"] = state.omega - quaternion.rotate_inverse(turned["q"], rate)
        return _replace_fields(state, turned)

    def to_inertial_axes(self, y: Vector) -> Vec3:
        """Return the components M y (3,) in the inertial frame S of a vector `y` (3,), which is
        given in the axes of the moving frame S' (notes, eq 85).
        """
        y = _checks.array_of_shape(y, (3,), "y")
        return linalg3.apply(self.rotation.astype(y.dtype), y)

    def from_inertial_axes(self, y: Vector) -> Vec3:
        """Return the components Mᵀ y (3,) in the moving frame S' of a vector `y` (3,), which is
        given in the axes of the inertial frame S (notes, eq 86).
        """
        y = _checks.array_of_shape(y, (3,), "y")
        return linalg3.apply(self.rotation.T.astype(y.dtype), y)

    def centrifugal(self, x: Vector) -> Vec3:
        """Return the centrifugal acceleration −Ω × (Ω × x') (3,), m/s², at the position x' = `x` in
        the moving frame S', in the axes of S'; Ω is the angular velocity of S'.
        """
        x = _checks.array_of_shape(x, (3,), "x")
        rate = self.rate.astype(x.dtype)
        return linalg3.cross(linalg3.cross(rate, x), rate)

    def coriolis(self, v: Vector) -> Vec3:
        """Return the Coriolis acceleration −2 Ω × v' (3,), m/s², of a particle with the velocity v'
        = `v` in the moving frame S', in the axes of S'; Ω is the angular velocity of S'.
        """
        v = _checks.array_of_shape(v, (3,), "v")
        return 2 * linalg3.cross(v, self.rate.astype(v.dtype))

    def euler_acceleration(self, x: Vector) -> Vec3:
        """Return the Euler acceleration −dΩ/dt × x' (3,), m/s², at the position x' = `x` in the
        moving frame S', in the axes of S'; Ω is the angular velocity of S'.
        """
        x = _checks.array_of_shape(x, (3,), "x")
        return linalg3.cross(x, self.rate_change.astype(x.dtype))

    def translational_acceleration(self) -> Vec3:
        """Return the fictitious acceleration −Mᵀ d²X/dt² (3,), m/s², due to the acceleration of the
        origin X of the moving frame S', in the axes of S'; M is the rotation matrix of S'.
        """
        return -self.from_inertial_axes(self.origin_acceleration)

    def fictitious(self, x: Vector, v: Vector) -> Vec3:
        """Return the sum of the four fictitious accelerations (3,), m/s², in the axes of the moving
        frame S' (notes, eq 91): centrifugal, Coriolis, Euler, and translational.

        - `x`, `v`: the position (3,), m, and the velocity (3,), m/s, of a particle in S'
        """
        turning = fictitious_of_rotation(self, x, v)
        return turning + self.translational_acceleration().astype(turning.dtype)


def fictitious_of_rotation(instant: Instant, x: Vector, v: Vector) -> Vec3:
    """Return the acceleration −Ω × (Ω × x) − 2 Ω × v − dΩ/dt × x, m/s², in the axes of a moving
    frame S'; it does not depend on the rotation matrix of S'.
    """
    x, v = _checks.array_of_shape(x, (3,), "x"), _checks.array_of_shape(v, (3,), "v")
    return instant.centrifugal(x) + instant.coriolis(v) + instant.euler_acceleration(x)


def _require_transformable(state: PyTree) -> None:
    """Raise an error unless `state` is one state with `x` and `v`, `q` and `omega`, or all."""
    point = hasattr(state, "x") and hasattr(state, "v")
    attitude = hasattr(state, "q") and hasattr(state, "omega")
    if not (point or attitude):
        alone = "; a rate alone has no direction in another frame"
        raise TypeError(
            "state: wanted x and v (Point), q and omega (Attitude), or all four (Rigid), to "
            f"transform between frames, got {type(state).__name__}"
            + (alone if hasattr(state, "omega") else "")
        )
    hint = "one state at one time; batch with jax.vmap(frame.to_inertial)(states, times)"
    for name, size in (("x", 3), ("v", 3), ("q", 4), ("omega", 3)):
        if hasattr(state, name):
            _checks.array_of_shape(getattr(state, name), (size,), name, hint=hint)


def _replace_fields(state: PyTree, fields: dict[str, Array]) -> PyTree:
    """Return a copy of `state` with new values of some fields."""
    names = list(fields)
    return eqx.tree_at(lambda s: [getattr(s, n) for n in names], state, [fields[n] for n in names])
