"""Describe states of a body. For the quantities that a motion conserves see `rj.conserved`,
`rj.drift`, `rj.energy`.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax._types import HasAttitude as HasAttitude, HasPose as HasPose, HasSpin as HasSpin
from rigidjax.motion.equations import (
    Attitude as Attitude,
    Rigid as Rigid,
    Spin as Spin,
    Turn as Turn,
)
from rigidjax.motion.suspension import AbstractSuspension as AbstractSuspension

__all__ = [
    "AbstractSuspension", "Attitude", "HasAttitude", "HasPose", "HasSpin", "Rigid", "Spin", "Turn",
]  # fmt: skip

define_dir_and_getattr(__name__)
