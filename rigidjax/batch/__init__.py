"""Many bodies: on one device, on several, on several hosts.

    rollout     fixed steps; last states, thinned states, or reduced on the way
    simulate    closed form, adaptive steps, or `Steps`, with a status for each body
    distributed several processes: `connect`, `share`, `gather`, `total`

One call takes N bodies; `chunk` of them are computed at a time, and memory beyond the inputs and
results does not grow with N. Bodies are independent: no step needs communication.

On a cluster (tested with two processes on one machine) bodies, starts and recordings are cut along
their first axis: among processes (`distributed.share`), then among the devices of each
(`devices="all"`), then into chunks. Shared numbers are copied to all. Sums of a fit, an
iteration, or of `reduce=` are added by `distributed.total`; states are gathered only if one process
needs all, else each writes its own (`distributed.save`). Shares are equal in number, and the
slowest determines a run's time: shuffle bodies with adaptive steps before `share`. When a process
ends all end within `patience`; shares written before are recovered, the others run again.
"""

from rigidjax._names import show
from rigidjax.batch import distributed as distributed
from rigidjax.batch.rollout import rollout as rollout
from rigidjax.batch.sharding import compiler_options as compiler_options, cpu_flags as cpu_flags
from rigidjax.batch.simulate import Steps as Steps, simulate as simulate

show(__name__)
