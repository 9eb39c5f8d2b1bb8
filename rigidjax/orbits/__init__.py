"""The three-body problem and Hill's: periodic orbits, families, manifolds; no body is needed.

`rigidjax.simulate(None, Point(x, v), ts, orbits.cr3bp(mu))` solves one motion.
"""

from rigidjax._names import show
from rigidjax.orbits.cr3bp import ThreeBody as ThreeBody, cr3bp as cr3bp
from rigidjax.orbits.differential_correction import PeriodicOrbit as PeriodicOrbit
from rigidjax.orbits.hill import Hill as Hill, hill as hill

show(__name__)
