"""Many bodies: on one device, on several, on several hosts.

    rollout     fixed steps; last states, thinned states, or reduced on the way
    simulate    closed form, adaptive steps, or `Steps`, with a status for each body
    distributed several processes: `connect`, `share`, `gather`, `total`

One call takes N bodies; `chunk` of them are computed at a time, and memory beyond the inputs and
results does not grow with N; `devices="all"` cuts N into shares for the devices of a process,
and `distributed.share` into shares for processes. Bodies are independent: no step needs
communication.

**On a cluster** (a plan; the tests use two processes on one machine). *Sharded:* bodies,
starts, recordings, all along their first axis: processes first (`distributed.share`), then the
devices of each, then chunks. Shared numbers (one inertia, one torque) are copied to all. *Reduced:*
a fit's loss, gradient and normal equations, once an iteration, by `distributed.total`: some hundred
numbers; histograms and moments of a large batch by `reduce=` on the way and `distributed.total` at
the end. States are gathered (`distributed.gather`) only if one process needs them all; else each
writes its own (`distributed.save`). *Expect:* the slowest share determines a run's time.
Shares are equal in number, so fixed steps scale with cores; bodies with adaptive steps are
distributed over the devices of a process by speed, not over processes: shuffle them before `share`.
An iteration of a fit adds one all-reduce of a few kilobytes, against 35 to 55 ms for the gradient
of 1000 bodies over 1000 steps: with 1000 bodies per process it counts for little. *When one process
ends* all end within `patience`; shares written before the collective are recovered, the others run
again.
"""

from rigidjax._names import show
from rigidjax.batch import distributed as distributed
from rigidjax.batch.rollout import rollout as rollout
from rigidjax.batch.sharding import compiler_options as compiler_options
from rigidjax.batch.simulate import Steps as Steps, simulate as simulate
from rigidjax.batch.xla_flags import cpu_flags as cpu_flags

show(__name__)
