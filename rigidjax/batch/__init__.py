"""From one body to a machine to many."""

from rigidjax.batch.chunks import compiler_options as compiler_options
from rigidjax.batch.magnus import Magnus4 as Magnus4
from rigidjax.batch.rollout import rollout as rollout
from rigidjax.batch.simulate import Batch as Batch, Steps as Steps, simulate as simulate
