"""Error against cost, of the value and of the gradient: the choice of a method for a scene.

`measure(scene)` runs methods on a scene, `front` finds the Pareto front, `draw` makes the chart,
`choose` the short table. `python -m rigidjax workprecision` is all of it.
"""

from rigidjax._names import show
from rigidjax.workprecision.chart import draw as draw
from rigidjax.workprecision.jax_methods import diffrax_method as diffrax_method
from rigidjax.workprecision.measurement import (
    long_drift as long_drift,
    measure as measure,
    worked_out as worked_out,
)
from rigidjax.workprecision.pareto import (
    Choice as Choice,
    choose as choose,
    first_answers as first_answers,
    front as front,
    table as table,
    time_to as time_to,
)
from rigidjax.workprecision.peers import methods as methods
from rigidjax.workprecision.record import (
    Record as Record,
    moved as moved,
    read_csv as read_csv,
    write_csv as write_csv,
)
from rigidjax.workprecision.scene import (
    Method as Method,
    Ready as Ready,
    Reference as Reference,
    Run as Run,
    Scene as Scene,
)
from rigidjax.workprecision.standard_scenes import scenes as scenes

show(__name__)
