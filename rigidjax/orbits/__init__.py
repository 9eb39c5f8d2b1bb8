"""Solve the circular restricted three-body problem and Hill's problem: periodic orbits, families of
such orbits, and their invariant manifolds. No rigid body is needed.

`rigidjax.simulate(None, Point(x, v), ts, orbits.cr3bp(mu))` solves one motion.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.orbits.cr3bp import Hill as Hill, ThreeBody as ThreeBody, cr3bp as cr3bp, hill as hill
from rigidjax.orbits.differential_correction import PeriodicOrbit as PeriodicOrbit

__all__ = ["Hill", "PeriodicOrbit", "ThreeBody", "cr3bp", "hill"]

define_dir_and_getattr(__name__)
