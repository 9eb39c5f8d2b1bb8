"""Describe a frame that turns and moves in any way (notes, section 3, eqs 84–91)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rigidjax import _checks, _show
from rigidjax._types import Mat3, Scalar, ScalarLike, Vec3, Vector
from rigidjax.frames import rotation_models
from rigidjax.frames.frame_kinematics import Instant, fictitious_of_rotation
from rigidjax.frames.point import require_point
from rigidjax.rotation import linalg3


class MovingFrame(eqx.Module):
    """Describe a frame S' that turns and moves in any smooth way relative to an inertial frame S.

    Coordinates transform as x = X(t) + M(t) x' (notes, eqs 85, 86, with an origin added).
    **Arguments:**

    - `rotation`: a function of the time, s, that returns the matrix M (3, 3), S' → S, or the unit
      quaternion (4,) of M. For a frame that is fixed in a body, the function returns the state of
      the body, with `q` and `omega`; a solution of `simulate` (its method `evaluate` is called) or
      a `FreeBody` (the exact motion of a free body) is such a function. Derivatives through a
      solution of `simulate` are in forward mode only. A Module such as `frames.Uniform` may get
      other numbers without a new compilation; a new `lambda` is compiled again.
    - `origin`: a function of the time that returns the origin X (3,) of S', m, axes of S; `None` if
      the origins of S and S' coincide.
    - `rate`: a function of the time that returns the angular velocity Ω (3,), rad/s, **axes of
      S'**; if it is `None`, Ω = vee(Mᵀ dM/dt) (eqs 45–50) by automatic differentiation. dΩ/dt
      always comes from automatic differentiation.

    The numbers of a frame may be traced: motions in the frame can be differentiated with respect to
    them. **Raises:** `TypeError` for a `rotation` that cannot be called; `ValueError`, when the
    frame is used, if `rotation` returns a value that is no rotation, unless JAX traces the value.

    >>> turntable = MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0]))
    >>> turntable.centrifugal([1.0, 0.0, 0.0], 0.3).tolist()
    [4.0, 0.0, 0.0]
    """

    rotation: Any
    origin: Callable[[Any], Any] | None
    rate: Callable[[Any], Any] | None

    __repr__ = _show.fields_as_text

    def __init__(
        self,
        rotation: PyTree,
        origin: Callable[[Any], Any] | None = None,
        rate: Callable[[Any], Any] | None = None,
    ):
        if isinstance(rotation, type) or not hasattr(rotation, "evaluate"):
            wanted = "of time or a solution of simulate"
            hint = "for a uniform turn take frames.Uniform(omega)"
            _checks.require_function(rotation, "rotation", wanted, hint=hint)
        if origin is not None:
            hint = "for an origin at rest pass lambda t: point"
            _checks.require_function(origin, "origin", "of time to (3,)", hint=hint)
        if rate is not None:
            _checks.require_function(rate, "rate", "of time to (3,)")
        self.rotation, self.origin = rotation_models.forward_mode(rotation), origin
        self.rate = getattr(rotation, "rate", None) if rate is None else rate

    def matrix(self, t: ScalarLike) -> Mat3:
        """Return the rotation matrix M(t) (3, 3) of this moving frame S' at the time `t`, s, which
        takes components in S' to components in the inertial frame S (notes, eq 85).
        """
        return rotation_models.matrix_at(self.rotation, _checks.checked_time(t))

    def at(self, t: ScalarLike) -> Instant:
        """Return the motion of this frame at the time `t`, s, as an `Instant`: its rotation matrix
        M, its angular velocity Ω and dΩ/dt, and the position X of its origin with dX/dt and
        d²X/dt².

        >>> MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0])).at(0.0).rate.tolist()
        [0.0, 0.0, 2.0]
        """
        t = _checks.checked_time(t)
        one = jnp.ones_like(t)
        rate, rate_change = jax.jvp(self.angular_velocity, (t,), (one,))
        twice = jax.jvp(lambda s: jax.jvp(self.place, (s,), (one,)), (t,), (one,))
        (origin, velocity), (_, acceleration) = twice
        return Instant(self.matrix(t), rate, rate_change, origin, velocity, acceleration)

    def angular_velocity(self, t: ScalarLike) -> Vec3:
        """Return the angular velocity Ω(t) (3,), rad/s, of this moving frame S' at the time `t`, s,
        in the axes of S' (notes, eqs 45–50).

        It is `rate(t)` if the frame has a field `rate`. Otherwise it is vee(Mᵀ dM/dt): the vector
        of the antisymmetric matrix Mᵀ dM/dt, with the rotation matrix M of the frame.
        """
        t = _checks.checked_time(t)
        if self.rate is not None:
            return _checks.array_of_shape(self.rate(t), (3,), "rate").astype(t.dtype)
        state = rotation_models.value_at(self.rotation, t)
        if hasattr(state, "omega"):
            return state.omega.astype(t.dtype)
        m, m_dot = jax.jvp(self.matrix, (t,), (jnp.ones_like(t),))
        return linalg3.vee(linalg3.product(m.T, m_dot))

    def to_inertial(self, state: PyTree, t: ScalarLike) -> PyTree:
        """Return `state`, which is given in the moving frame S', transformed to the inertial frame
        S; the type of the state does not change.

        **Arguments:** `state` a `Point`, `Attitude` or `Rigid`, or any Module with `x` and `v`,
        with `q` and `omega`, or with all four fields; one state, not a batch. `t` the time, s. Then

        x = X + M x',  v = dX/dt + M (v' + Ω × x')  (notes, eqs 85, 87, 88),  q = q_M q',  Ω_body =
        Ω'_body + Q'ᵀ Ω, where q_M is the quaternion of M, and Q' the matrix of q'; the body rates
        Ω_body and Ω'_body, in S and in S', have components in body axes.

        For many states use `jax.vmap(frame.to_inertial)(states, times)`.

        >>> frame = MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0]))
        >>> frame.to_inertial(rj.frames.Point([1.0, 0, 0], [0.0, 0, 0]), 0.0).v.tolist()
        [0.0, 2.0, 0.0]
        """
        return self.at(t).to_inertial(state)

    def from_inertial(self, state: PyTree, t: ScalarLike) -> PyTree:
        """Return `state`, which is given in the inertial frame S, transformed to the moving frame
        S': the inverse of `to_inertial`.

        **Arguments:** as for `to_inertial`. The position and the velocity in S' are x' = Mᵀ(x − X)
        and v' = Mᵀ(v − dX/dt) − Ω × x' (notes, eqs 86–88).

        >>> frame = MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0]))
        >>> frame.from_inertial(rj.frames.Point([1.0, 0, 0], [0.0, 2, 0]), 0.0).v.tolist()
        [0.0, 0.0, 0.0]
        """
        return self.at(t).from_inertial(state)

    def centrifugal(self, x: Vector, t: ScalarLike) -> Vec3:
        """Return the centrifugal acceleration −Ω × (Ω × x') (3,), m/s², in the axes of this moving
        frame S' with the angular velocity Ω (notes, eq 91).

        **Arguments:** `x` x' (3,), the position in S', m; `t` the time, s.
        """
        return self.at(t).centrifugal(x)

    def coriolis(self, v: Vector, t: ScalarLike) -> Vec3:
        """Return the Coriolis acceleration −2 Ω × v' (3,), m/s², in the axes of this moving frame
        S' with the angular velocity Ω (notes, eq 91).

        **Arguments:** `v` v' (3,), the velocity in S', m/s; `t` the time, s.
        """
        return self.at(t).coriolis(v)

    def euler_acceleration(self, x: Vector, t: ScalarLike) -> Vec3:
        """Return the Euler acceleration −dΩ/dt × x' (3,), m/s², in the axes of this moving frame S'
        with the angular velocity Ω (notes, eq 91, which calls it "inercial").

        **Arguments:** `x` x' (3,), the position in S', m; `t` the time, s.
        """
        return self.at(t).euler_acceleration(x)

    def translational_acceleration(self, t: ScalarLike) -> Vec3:
        """Return the fictitious acceleration −Mᵀ d²X/dt² (3,), m/s², in the axes of this moving
        frame S', due to the acceleration of its origin X, at the time `t`, s; M is the rotation
        matrix of S'.
        """
        return self.at(t).translational_acceleration()

    def acceleration(
        self, x: Vector, v: Vector, t: ScalarLike, force: Vector | None = None
    ) -> Vec3:
        """Return the acceleration d²x'/dt² (3,), m/s², of a particle relative to this moving frame
        S', in the axes of S' (notes, eq 91, corrected).

        d²x'/dt² = f − Ω×(Ω×x') − 2Ω×v' − dΩ/dt×x' − Mᵀ d²X/dt², with the angular velocity Ω, the
        rotation matrix M and the origin X of S'. (The notes have no moving origin, and eq 91 prints
        one more x'' inside its bracket, a slip: see eq 90.)

        **Arguments:** `x`, `v` (3,) position x' and velocity v' in S', m and m/s; `t` the time, s;
        `force` the force per mass f = MᵀF (3,), m/s², **axes of S'** (`force_from_inertial` makes f
        from F, in the axes of S), or `None` for a free particle.

        >>> frame = MovingFrame(rj.frames.Uniform([0.0, 0.0, 2.0]))
        >>> frame.acceleration([1.0, 0, 0], [0.0, -2, 0], 0.0).tolist()
        [-4.0, 0.0, 0.0]
        """
        free = fictitious_acceleration(self, self.at(t), x, v)
        return free if force is None else _checks.array_of_shape(force, (3,), "force") + free

    def acceleration_to_inertial(self, x: Vector, v: Vector, a: Vector, t: ScalarLike) -> Vec3:
        """Return the acceleration (3,), m/s², in the inertial frame S of a particle whose motion in
        the moving frame S' is given.

        **Arguments:** `x`, `v`, `a` (3,) its position, velocity and acceleration in S', m, m/s and
        m/s²; `t` the time, s. Source: notes, eqs 89, 90.
        """
        now, a = self.at(t), _checks.array_of_shape(a, (3,), "a")
        return now.to_inertial_axes(a - now.fictitious(x, v))

    def force_from_inertial(self, force: Vector, t: ScalarLike) -> Vec3:
        """Return the components MᵀF (3,) in the axes of this moving frame S' of a force or
        direction F = `force` (3,), which is given in the axes of the inertial frame S, at the time
        `t`, s (notes, eq 91).
        """
        return linalg3.apply(self.matrix(t).T, _checks.array_of_shape(force, (3,), "force"))

    def force_to_inertial(self, force: Vector, t: ScalarLike) -> Vec3:
        """Return the components M f (3,) in the axes of the inertial frame S of a force or
        direction f = `force` (3,), which is given in the axes of this moving frame S', at the time
        `t`, s (notes, eq 85).
        """
        return linalg3.apply(self.matrix(t), _checks.array_of_shape(force, (3,), "force"))

    def jacobi_integral(self, state: PyTree, t: ScalarLike, potential: ScalarLike = 0.0) -> Scalar:
        """Return the Jacobi integral ½|v'|² − ½|Ω × x'|² + V, m²/s², of a particle in this moving
        frame S', whose angular velocity is Ω.

        It is conserved if the origin is fixed and Ω and V(x') do not depend on time.

        **Arguments:** `state` a `Point` in S', with x' and v'; `t` the time, s; `potential` the
        potential V per mass at x', m²/s². Source: Goldstein, Mechanics, sec. 3.12. In the
        three-body problem the integral is −C/2, with Jacobi's constant C.
        """
        require_point(state)
        speed = linalg3.dot(state.v, state.v)
        moved = linalg3.cross(self.at(t).rate.astype(state.x.dtype), state.x)
        v = _checks.array_of_shape(potential, (), "potential").astype(state.x.dtype)
        return 0.5 * (speed - linalg3.dot(moved, moved)) + v

    def compose(self, inner: "MovingFrame") -> "MovingFrame":
        """Return the frame that moves relative to **this frame** as `inner` does relative to an
        inertial frame.

        Its rotation matrix is M = M₁M₂ and its origin X = X₁ + M₁X₂, with the index 1 for this
        frame and 2 for `inner`.

        >>> half = MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.0]))
        >>> half.compose(half).at(0.0).rate.tolist()
        [0.0, 0.0, 2.0]
        """
        motion = _ComposedMotion(self, require_frame(inner, "inner"))
        return MovingFrame(motion.rotation, motion.origin, motion.rate)

    def inverse(self) -> "MovingFrame":
        """Return the frame that moves as the inertial frame S does if it is seen from this frame
        S'.

        Its rotation matrix is Mᵀ and its origin −MᵀX, with the matrix M and the origin X of S'.
        `frame.compose(frame.inverse())` does not move.
        """
        motion = _InverseMotion(self)
        return MovingFrame(motion.rotation, motion.origin, motion.rate)

    def place(self, t: ScalarLike) -> Vec3:
        """Return the position X(t) (3,), m, of the origin of the moving frame S', in the axes of
        the inertial frame S.
        """
        t = _checks.checked_time(t)
        if self.origin is None:
            return jnp.zeros(3, t.dtype)
        return _checks.array_of_shape(self.origin(t), (3,), "origin").astype(t.dtype)


def fictitious_acceleration(frame: MovingFrame, instant: Instant, x: Vector, v: Vector) -> Vec3:
    """Return the fictitious acceleration, m/s², in the axes of S'.

    The rotation matrix of S', which most frames compute by sines and cosines, is used only if S'
    has an `origin`.
    """
    if frame.origin is None:
        return fictitious_of_rotation(instant, x, v)
    return instant.fictitious(x, v)


def require_frame(frame: object, name: str) -> MovingFrame:
    """Return `frame` if it is a `MovingFrame`; raise a `TypeError` for anything else."""
    hint = "make one from a rotation with MovingFrame(rotation)"
    return _checks.require_instance(
        frame, MovingFrame, name, requirement="a MovingFrame", hint=hint
    )


class _ComposedMotion(eqx.Module):
    """Describe, by functions of time, the motion of a frame that moves relative to `outer` as
    `inner` does relative to an inertial frame.
    """

    outer: MovingFrame
    inner: MovingFrame

    def rotation(self, t: ScalarLike) -> Mat3:
        return linalg3.product(self.outer.matrix(t), self.inner.matrix(t))

    def rate(self, t: ScalarLike) -> Vec3:
        # The angular velocities of both frames are added, in the axes of the inner frame: this
        # needs no derivative of the product of the two rotations.
        carried = linalg3.apply(self.inner.matrix(t).T, self.outer.angular_velocity(t))
        return carried + self.inner.angular_velocity(t)

    def origin(self, t: ScalarLike) -> Vec3:
        return self.outer.place(t) + linalg3.apply(self.outer.matrix(t), self.inner.place(t))


class _InverseMotion(eqx.Module):
    """Describe, by functions of time, the motion of the inertial frame relative to `frame`."""

    frame: MovingFrame

    def rotation(self, t: ScalarLike) -> Mat3:
        return self.frame.matrix(t).T

    def rate(self, t: ScalarLike) -> Vec3:
        return -linalg3.apply(self.frame.matrix(t), self.frame.angular_velocity(t))

    def origin(self, t: ScalarLike) -> Vec3:
        return -linalg3.apply(self.frame.matrix(t).T, self.frame.place(t))
