"""The vector field of a scene: the equations of motion of a body, by the kind of its state."""

from collections.abc import Callable
from typing import Any

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import AbstractScene, MovingFrame, Point
from rigidjax.frames.frame_dynamics import scene_of
from rigidjax.motion import Attitude, AttitudeEquations, EulerEquations, NewtonEuler, Rigid, Spin
from rigidjax.motion.coupled import Coupled, CoupledEquations
from rigidjax.motion.torques import Torque
from rigidjax.solve import validation


def equations_of_motion(
    body: Inertia | MassProperties | None,
    state0: Spin | Attitude | Rigid | Point | Coupled,
    torque: Torque | AbstractScene | MovingFrame | None = None,
) -> Callable[..., Any]:
    """The vector field of this body for states like `state0`, for plain `diffrax.ODETerm`.

    **Arguments** `body`, `state0`, `torque` as for `simulate`; under a torque with states of its
    own `state0` is a `rigidjax.motion.Coupled`. **Raises** `TypeError` where they do not fit.

    >>> import rigidjax as rj
    >>> type(equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 0, 0])))
    <class 'rigidjax.motion.equations.EulerEquations'>
    """
    if isinstance(state0, Coupled):
        return CoupledEquations(equations_of_motion(body, state0.motion, torque), body)
    validation.require_fit(body, state0, torque)
    if isinstance(state0, Point):
        return scene_of(torque).field
    matter: Any = body
    turning: Any = torque
    if isinstance(body, MassProperties):
        return NewtonEuler(body, turning)
    if isinstance(state0, Attitude):
        return AttitudeEquations(matter, turning)
    return EulerEquations(matter, turning)
