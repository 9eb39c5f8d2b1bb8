"""Solve the three-body problem and Hill's: periodic orbits, families, manifolds; no body is needed.

`rigidjax.simulate(None, Point(x, v), ts, orbits.cr3bp(mu))` solves one motion.
"""

from rigidjax._names import show
from rigidjax.orbits.cr3bp import Hill as Hill, ThreeBody as ThreeBody, cr3bp as cr3bp, hill as hill
from rigidjax.orbits.differential_correction import PeriodicOrbit as PeriodicOrbit

__all__ = ["Hill", "PeriodicOrbit", "ThreeBody", "cr3bp", "hill"]

show(__name__)
