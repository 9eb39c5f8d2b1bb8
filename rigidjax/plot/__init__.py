"""Draw pictures (extra `view`): matplotlib and viser are imported when a function is called.

Each function draws into your axes (`ax`) or into new ones, and returns the axes. Okabe and Ito's
colours are distinct also for colour-blind readers. **Raises:** `ModuleNotFoundError`, with the
command that installs the missing package; `TypeError` for states without the attitude that is to be
drawn, or for flat axes where 3-D axes are needed; `ValueError` for a batch instead of one body, for
times and states of different length, for an unknown unit or option, and for axes of a wrong shape.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.plot.animation import player as player, tumble as tumble
from rigidjax.plot.ellipsoids import inertia_ellipsoid as inertia_ellipsoid
from rigidjax.plot.fit import fit as fit
from rigidjax.plot.frames import frames as frames
from rigidjax.plot.horizons import horizons as horizons
from rigidjax.plot.phase_portrait import phase_portrait as phase_portrait
from rigidjax.plot.phases import phases as phases
from rigidjax.plot.poinsot import (
    body_axes as body_axes,
    herpolhode as herpolhode,
    polhode as polhode,
)
from rigidjax.plot.residuals import residuals as residuals
from rigidjax.plot.style import COLOURS as COLOURS
from rigidjax.plot.time_series import motion as motion

__all__ = [
    "COLOURS", "body_axes", "fit", "frames", "herpolhode", "horizons", "inertia_ellipsoid",
    "motion", "phase_portrait", "phases", "player", "polhode", "residuals", "tumble",
]  # fmt: skip

define_dir_and_getattr(__name__)
