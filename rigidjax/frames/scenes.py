"""Provide scenes of a particle, for `rigidjax.simulate(None, Point(x, v), ts, scene)`."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.frames.earth import (
    Earth as Earth,
    Foucault as Foucault,
    earth as earth,
    foucault as foucault,
)
from rigidjax.frames.hoop import Hoop as Hoop, hoop as hoop, turntable as turntable
from rigidjax.frames.libration import (
    libration as libration,
    libration_integral as libration_integral,
)

__all__ = [
    "Earth", "Foucault", "Hoop", "earth", "foucault", "hoop", "libration", "libration_integral",
    "turntable",
]  # fmt: skip

define_dir_and_getattr(__name__)
