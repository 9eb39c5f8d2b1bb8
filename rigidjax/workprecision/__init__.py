"""Compare the error and the cost of methods, for motions and gradients, to choose a method.

`measure(scene)` runs methods on a scene (a motion to run), `draw` makes a chart with the Pareto
front, and `choose` finds the quickest methods. `python -m rigidjax workprecision` does all three.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.workprecision.chart import draw as draw
from rigidjax.workprecision.jax_methods import diffrax_method as diffrax_method
from rigidjax.workprecision.measurement import measure as measure
from rigidjax.workprecision.pareto import choose as choose, table as table
from rigidjax.workprecision.peers import methods as methods
from rigidjax.workprecision.scene import BenchmarkScene as BenchmarkScene
from rigidjax.workprecision.standard_scenes import scenes as scenes

__all__ = [
    "BenchmarkScene",
    "choose",
    "diffrax_method",
    "draw",
    "measure",
    "methods",
    "scenes",
    "table",
]

define_dir_and_getattr(__name__)
