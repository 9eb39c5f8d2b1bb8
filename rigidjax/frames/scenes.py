"""Ready-made scenes: `rigidjax.simulate(None, Point(x, v), ts, scene)`, no body is needed."""

from typing import TYPE_CHECKING

from rigidjax._names import own_names, suggests
from rigidjax.frames.earth import Earth as Earth, earth as earth
from rigidjax.frames.foucault import Foucault as Foucault, foucault as foucault
from rigidjax.frames.hoop import Hoop as Hoop, hoop as hoop, turntable as turntable
from rigidjax.frames.libration import (
    libration as libration,
    libration_integral as libration_integral,
)

if not TYPE_CHECKING:
    __getattr__ = suggests(__name__)
__dir__ = own_names(__name__)
