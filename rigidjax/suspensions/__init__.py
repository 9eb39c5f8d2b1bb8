"""Bind a body to one axis: an axle, a torsion bar, strings; the body's state is a `rigidjax.Turn`.

`rigidjax.simulate(body, Turn(angle, rate), ts, suspension)` solves the motion, `period` the time of
one swing.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.motion.suspension import (
    AbstractSuspension as AbstractSuspension,
    Friction as Friction,
    period as period,
)
from rigidjax.suspensions.axle import Axle as Axle
from rigidjax.suspensions.strings import Strings as Strings
from rigidjax.suspensions.torsion import TorsionBar as TorsionBar

__all__ = ["AbstractSuspension", "Axle", "Friction", "Strings", "TorsionBar", "period"]

define_dir_and_getattr(__name__)
