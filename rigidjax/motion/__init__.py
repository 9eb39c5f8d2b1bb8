"""States, their equations of motion, torques. Take the smallest state that the scene needs."""

from rigidjax._names import show
from rigidjax._types import (
    HasAttitude as HasAttitude,
    HasPose as HasPose,
    HasSpin as HasSpin,
)
from rigidjax.motion import torques as torques
from rigidjax.motion.conserved import (
    conserved as conserved,
    drift as drift,
    energy as energy,
)
from rigidjax.motion.coupled import Coupled as Coupled
from rigidjax.motion.equations import (
    Attitude as Attitude,
    AttitudeEquations as AttitudeEquations,
    EulerEquations as EulerEquations,
    NewtonEuler as NewtonEuler,
    Rigid as Rigid,
    Spin as Spin,
    on_the_group as on_the_group,
)

show(__name__)
