"""Hold the scene of a recording, which is everything that its readings depend on."""

import equinox as eqx
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.suspension import Law
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque, Sum
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.composite import parts_of

# An unknown torque is white, correlated in time, or a sum of such torques.
Process = RandomTorque | CorrelatedTorque | Sum


class Scene(eqx.Module):
    """Hold the scene of a recording, which is everything that its readings depend on.

    `Model.scenes(x)` makes the scenes of the parameters x. A `Free(where, …)` picks a number of a
    scene, such as `lambda s: s.torque.coefficient` or `lambda s: s.sensors[0].bias`.

    **Fields:**

    - `body`: the body, or `None` while it is not known.
    - `torque`: the known torque on the body, its suspension, or `None`.
    - `process`: the unknown torque on the body, as noise, or `None`.
    - `sensors`: the sensors, in the order of the readings.
    - `start`: the state at the first time of the recording, or `None` while it is not known.
    - `beside`: the values of `Free`s that belong to no part of a scene, such as a length.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> model = rj.identify.Model(record, rj.identify.PrincipalRatios())
    >>> model.scenes(model.start()).start.omega.tolist()
    [[1.0, 0.0, 0.0]]
    """

    body: Inertia | MassProperties | None
    torque: Law | None
    process: Process | None
    sensors: tuple[AbstractSensor, ...]
    start: Spin | Attitude | Rigid | Turn | None
    beside: tuple[Array, ...] = ()


def require_unknown_torque(process: PyTree) -> None:
    """Raise `TypeError` unless `process` is an unknown torque, or a `Sum` of unknown torques."""
    wanted = "a RandomTorque, a CorrelatedTorque or a Sum of them"
    for part in parts_of(process) or (process,):
        _checks.require_instance(
            part, (RandomTorque, CorrelatedTorque), "process", requirement=wanted
        )


def require_known_torque(torque: Torque | None) -> None:
    """Raise `TypeError` if the `torque` or a summand of it is an unknown torque."""
    for part in parts_of(torque):
        if isinstance(part, RandomTorque | CorrelatedTorque):
            raise TypeError(
                f"torque: wanted the known torque, got a {type(part).__name__}; give it as process="
            )
