"""Compare error and cost, of the value and of the gradient: the choice of a method for a scene.

`measure(scene)` runs methods on a scene, `draw` makes the chart and marks the Pareto front,
`choose` the short table. `python -m rigidjax workprecision` does all of it.
"""

from rigidjax._names import show
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

show(__name__)
