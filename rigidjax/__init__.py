"""Compute rigid-body and rotating-frame mechanics that JAX can differentiate.

The modules are, from the ground up: `quaternion`, `so3`, `euler` and `body`; `motion` and
`torques`; `frames`; `exact` and `solve` (the motion in closed form, or by a solver); and
`identify`, `batch`, `workprecision` and `plot`, which use the others. `elliptic`, `lagrangian`,
`orbits`, `suspensions` and `tumblers` are loaded when they are first used. Most programs begin with
`simulate`.

Every function raises `TypeError` for an argument of a wrong type (also for half precision) and
`ValueError` for a wrong shape; docstrings list the other errors. Under `jit` the errors are errors
of `equinox`. A container of many states or bodies has equal leading axes in all of its parts;
functions and methods take one state or body. The examples assume `import rigidjax as rj` and
`import jax.numpy as jnp`.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from rigidjax import (
    batch as batch,
    body as body,
    exact as exact,
    frames as frames,
    identify as identify,
    motion as motion,
    solve as solve,
)
from rigidjax._names import define_dir_and_getattr, raise_unknown
from rigidjax.body import (
    Inertia as Inertia,
    MassProperties as MassProperties,
    angular_momentum as angular_momentum,
    kinetic_energy as kinetic_energy,
    parameters as parameters,
    shapes as shapes,
    spatial_angular_momentum as spatial_angular_momentum,
    volumes as volumes,
)
from rigidjax.frames import Point as Point, scenes as scenes
from rigidjax.motion import (
    Attitude as Attitude,
    Rigid as Rigid,
    Spin as Spin,
    Turn as Turn,
    torques as torques,
)
from rigidjax.motion.conserved import conserved as conserved, drift as drift, energy as energy
from rigidjax.rotation import (
    euler as euler,
    mrp as mrp,
    quaternion as quaternion,
    rodrigues as rodrigues,
    so3 as so3,
)
from rigidjax.rotation.barrier import set_xla_flags as set_xla_flags
from rigidjax.solve import (
    Event as Event,
    crossings as crossings,
    equations_of_motion as equations_of_motion,
    lyapunov_exponents as lyapunov_exponents,
    simulate as simulate,
    solvers as solvers,
)
from rigidjax.solve.answer.error import error_of as error_of

if TYPE_CHECKING:
    from rigidjax import (
        datasets as datasets,
        elliptic as elliptic,
        lagrangian as lagrangian,
        orbits as orbits,
        plot as plot,
        suspensions as suspensions,
        tumblers as tumblers,
        workprecision as workprecision,
    )

__version__ = "0.2.0"

# These packages are loaded when they are first asked for: few programs draw, and fewer compare
# methods.
_LATER = (
    "datasets",
    "elliptic",
    "lagrangian",
    "orbits",
    "plot",
    "suspensions",
    "tumblers",
    "workprecision",
)

__all__ = [
    "Attitude", "Event", "Inertia", "MassProperties", "Point", "Rigid", "Spin", "Turn",
    "angular_momentum", "batch", "body", "conserved", "crossings", "datasets", "drift", "elliptic",
    "energy", "equations_of_motion", "error_of", "euler", "exact", "frames", "identify",
    "kinetic_energy", "lagrangian", "lyapunov_exponents", "motion", "mrp", "orbits", "parameters",
    "plot", "quaternion", "rodrigues", "scenes", "set_xla_flags", "shapes", "simulate", "so3",
    "solve", "solvers", "spatial_angular_momentum", "suspensions", "torques", "tumblers", "volumes",
    "workprecision",
]  # fmt: skip

define_dir_and_getattr(__name__)


def __getattr__(name: str) -> ModuleType:
    later = name in _LATER
    return importlib.import_module(f"rigidjax.{name}") if later else raise_unknown(__name__, name)
