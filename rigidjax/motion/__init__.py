"""States of a body, and what a motion conserves."""

from rigidjax._names import show
from rigidjax._types import HasAttitude as HasAttitude, HasPose as HasPose, HasSpin as HasSpin
from rigidjax.motion.conserved import conserved as conserved, drift as drift, energy as energy
from rigidjax.motion.equations import Attitude as Attitude, Rigid as Rigid, Spin as Spin

show(__name__)
