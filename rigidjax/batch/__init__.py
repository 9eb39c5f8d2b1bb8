"""Many bodies: on one device, on several, on several hosts.

    rollout     fixed steps; last states, thinned states, or reduced on the way
    simulate    closed form, adaptive steps, or `Steps`, with a status for each body
    distributed several processes: `connect`, `share`, `gather`, `total`

Bodies are cut along their first axis among processes (`distributed.share`), then among the devices
of each (`devices="all"`), then into chunks, one of which is computed at a time. Shared numbers are
copied to all. Sums of a fit or of `reduce=` are added by `distributed.total`; each process writes
its states (`distributed.save`), or `gather`s all. Shuffle bodies with adaptive steps before
`share`. When a process ends all end within `patience`; shares written before are recovered.
"""

from rigidjax._names import show
from rigidjax.batch import distributed as distributed
from rigidjax.batch.rollout import rollout as rollout
from rigidjax.batch.sharding import compiler_options as compiler_options
from rigidjax.batch.simulate import Steps as Steps, simulate as simulate

__all__ = ["Steps", "compiler_options", "distributed", "rollout", "simulate"]

show(__name__)
