"""Integrate the motion of a particle or of a rigid body inside a moving frame."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import HasAttitude, Scalar, ScalarLike, Vec3
from rigidjax.body import inertia as _inertia
from rigidjax.frames.base import AbstractScene, Force, force_per_mass, jump_times_within
from rigidjax.frames.moving import MovingFrame, fictitious_acceleration, require_frame
from rigidjax.frames.rotation_models import Uniform
from rigidjax.rotation import linalg3, quaternion


class InFrame(AbstractScene):
    """Describe a particle whose motion is solved in a moving frame (notes, eq 91, corrected).

    **Arguments:**

    - `frame`: the `MovingFrame` S'; the states are positions and velocities in S'.
    - `inside`: a force per mass, m/s², that is a function of the time and the state in S', `(t,
      Point in S') → (3,)`, in the axes of S'.
    - `outside`: a force per mass, m/s², that is a function of the time and the state in the
      inertial frame S, `(t, Point in S) → (3,)`, in the axes of S.
    - `potential`: a function of the position x' in S', `(3,) → ()`, that returns the potential V
      per mass, m²/s²; the force per mass −∇V is computed by automatic differentiation.

    If the rotation of the frame is a `frames.Uniform` (a constant angular velocity), and its
    `origin`, `inside` and `outside` are `None`, `conserved` returns the Jacobi integral.

    >>> scene = InFrame(MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.0])))
    >>> scene.acceleration(0.0, rj.frames.Point([2.0, 0, 0], [0.0, 0, 0])).tolist()
    [2.0, 0.0, 0.0]
    """

    frame: MovingFrame
    inside: Callable[..., Any] | None = None
    outside: Callable[..., Any] | None = None
    potential: Callable[..., Any] | None = None

    def __check_init__(self) -> None:
        require_frame(self.frame, "InFrame")
        for name in ("inside", "outside"):
            if getattr(self, name) is not None:
                _checks.require_function(getattr(self, name), name, "(t, state) → (3,)")
        if self.potential is not None:
            _checks.require_function(
                self.potential, "potential", "of a place (3,) to a number, m²/s²"
            )

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,), s, at which a force of this scene, `inside` or `outside`, jumps or
        has a kink.
        """
        return jump_times_within(self.inside, self.outside)

    def acceleration(self, t: ScalarLike, state: PyTree) -> Vec3:
        now = self.frame.at(t)
        total = fictitious_acceleration(self.frame, now, state.x, state.v)
        if self.inside is not None:
            total = total + force_per_mass(self.inside(t, state), self.inside).astype(total.dtype)
        if self.outside is not None:
            outer = force_per_mass(self.outside(t, now.to_inertial(state)), self.outside)
            total = total + now.from_inertial_axes(outer).astype(total.dtype)
        if self.potential is not None:
            total = total - jax.grad(self.potential)(state.x)
        return total

    def conserved(self, t: ScalarLike, state: PyTree) -> dict[str, Scalar]:
        frame = self.frame
        steady = isinstance(frame.rotation, Uniform) and frame.origin is None
        if not steady or self.inside is not None or self.outside is not None:
            return {}
        v = jnp.zeros((), state.x.dtype) if self.potential is None else self.potential(state.x)
        return {"jacobi": frame.jacobi_integral(state, t, v)}


def scene_of_force(force: object) -> AbstractScene:
    """Return the scene that `simulate` solves for a particle under `force`.

    `force` is a scene, which is returned unchanged; a `MovingFrame`, in which the particle moves
    freely; a force per mass `(t, state, body) → (3,)`, m/s²; or `None` for a free particle.
    """
    if isinstance(force, AbstractScene):
        return force
    if isinstance(force, MovingFrame):
        return InFrame(force)
    if force is None or (callable(force) and not isinstance(force, type)):
        return Force(force)
    raise TypeError(
        "Point: wanted a scene (rigidjax.scenes), a MovingFrame or a force (t, state, body) → (3,) "
        f"per mass, got {type(force).__name__}"
    )


class FrameWrench(eqx.Module):
    """Hold a force and a torque on a body, relative to a moving frame S': the value that the torque
    model `BodyInFrame` returns for a `Rigid` state.

    **Fields:** `force` (3,) on the centre of mass, N, axes of S'; `torque` (3,) about the centre of
    mass, N m, body axes.
    """

    force: Vec3
    torque: Vec3


class BodyInFrame(eqx.Module):
    """Compute the fictitious torque, and for `Rigid` the fictitious force, on a body in a moving
    frame S'.

    Pass this to `simulate` as the torque of an `Attitude` or `Rigid` state in S'. Such a state has
    the quaternion q', body → S', whose matrix is Q', and the rate Ω' relative to S', in body axes;
    a `Rigid` state also has the position x' and velocity v' of the centre of mass in S'.
    **Arguments:**

    - `frame`: the `MovingFrame` S', whose rate is Ω, axes of S'.
    - `torque`: the real torque τ, `(t, state in S', body) → (3,)`, N m, body axes; or a model that
      returns a `Wrench`, whose force is in the axes of S'; or `None`. `simulate` refuses torques
      that need the absolute rate (wheels, `ChangingInertia`), both as this `torque` and in a sum
      with a `BodyInFrame`.

    The absolute rate of the body is Ω_abs = Ω' + W, where W = Q'ᵀ Ω is the rate of the frame in
    body axes. Ω_abs obeys I dΩ_abs/dt = IΩ_abs × Ω_abs + τ, with the inertia I. Hence the equation
    of Ω' is

    I dΩ'/dt = IΩ' × Ω' + [τ + IΩ_abs × Ω_abs − IΩ' × Ω' − I(Q'ᵀ dΩ/dt − Ω' × W)],

    in which the bracket is the torque that this object returns. The centre of mass moves as a
    `Point` does (eq 91). Source: notes, eqs 50, 91, for a body instead of a point. **Raises:**
    `TypeError` for a force on a state that has no position.

    >>> frame = MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.0]))
    >>> still = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, -1.0])
    >>> BodyInFrame(frame)(0.0, still, rj.Inertia.from_principal(1.0, 2.0, 3.0)).tolist()
    [0.0, 0.0, 0.0]
    """

    feels: ClassVar[type] = HasAttitude
    frame: MovingFrame
    torque: Callable[..., Any] | None = None

    __repr__ = _show.fields_as_text

    def __check_init__(self) -> None:
        require_frame(self.frame, "BodyInFrame")
        if self.torque is not None:
            _checks.require_function(
                self.torque, "torque", "(t, state, body) → (3,), N m, or a Wrench"
            )

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,), s, at which the field `torque`, the real torque or force on the
        body without the fictitious ones, jumps or has a kink.
        """
        return jump_times_within(self.torque)

    def __call__(self, t: ScalarLike, state: PyTree, body: _inertia.Body) -> Vec3 | FrameWrench:
        now = self.frame.at(t)
        tensor, omega = _inertia.tensor_of(body), state.omega
        carried = quaternion.rotate_inverse(state.q, now.rate.astype(omega.dtype))
        change = quaternion.rotate_inverse(state.q, now.rate_change.astype(omega.dtype))
        total = omega + carried
        gyroscopic = linalg3.cross(_inertia.apply(tensor, total), total)
        relative = linalg3.cross(_inertia.apply(tensor, omega), omega)
        needed = _inertia.apply(tensor, change - linalg3.cross(omega, carried))
        torque = gyroscopic - relative - needed
        force = None
        if hasattr(state, "x"):
            mass = body.mass.astype(omega.dtype)  # pyright: ignore[reportAttributeAccessIssue]
            force = mass * fictitious_acceleration(self.frame, now, state.x, state.v)
        if self.torque is not None:
            real = self.torque(t, state, body)
            if hasattr(real, "force"):
                if force is None:
                    raise TypeError(
                        f"BodyInFrame: {type(self.torque).__name__} returns a force: wanted a "
                        f"Rigid state, got {type(state).__name__}, which has no position"
                    )
                force, real = force + real.force.astype(omega.dtype), real.torque
            real = _checks.array_of_shape(real, (3,), "torque", hint="body-frame N m")
            torque = torque + real.astype(omega.dtype)
        return torque if force is None else FrameWrench(force, torque)
