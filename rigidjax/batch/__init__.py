"""Simulate many bodies on one device, on several devices or on several hosts.

    rollout     fixed steps; returns the last states, every k-th state, or a reduced value
    simulate    closed form, adaptive steps, or `Steps`; returns a status for each body
    distributed several processes: `connect`, `share`, `gather`, `total`

Bodies are divided along their first axis among processes (`distributed.share`), then among the
devices of each process (`devices="all"`), then into chunks, which a device computes one after
another. Numbers that all bodies share are copied to every device. `distributed.total` adds the sums
that each process has computed, such as the sums of a fit or of `reduce=`. Each process writes its
own states (`distributed.save`), or `distributed.gather` sends all states to every process.

Under adaptive steps some bodies need more steps than others: shuffle the bodies before `share`, so
that no process gets most of the slow bodies. If one process ends early, every other process ends
within `patience` seconds (an argument of `distributed.connect`); `distributed.recover` reads the
files that the processes wrote before.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.batch import distributed as distributed
from rigidjax.batch.rollout import rollout as rollout
from rigidjax.batch.sharding import compiler_options as compiler_options
from rigidjax.batch.simulate import Steps as Steps, simulate as simulate

__all__ = ["Steps", "compiler_options", "distributed", "rollout", "simulate"]

define_dir_and_getattr(__name__)
