"""Unknown torques: the motion, the torques and the body from a recording.

`filter`, `step` and `smooth` give states, torques and sensor errors with their standard deviations;
`log_likelihood` what readings say of anything else, the unknown torques integrated out; `sample` a
motion under random torques.
"""

from rigidjax._names import show
from rigidjax.identify.filtering.filter import (
    filter as filter,
    log_likelihood as log_likelihood,
    start as start,
    step as step,
)
from rigidjax.identify.filtering.linear import (
    LinearModel as LinearModel,
    linear_filter as linear_filter,
    linear_smooth as linear_smooth,
)
from rigidjax.identify.filtering.smoother import smooth as smooth
from rigidjax.identify.filtering.steps import (
    NoiseModel as NoiseModel,
    Walk as Walk,
    sample as sample,
)
from rigidjax.identify.inference.density import LogDensity as LogDensity
from rigidjax.identify.inference.draws import (
    Nuts as Nuts,
    Posterior as Posterior,
    Refit as Refit,
    posterior as posterior,
    refit as refit,
)

Model = NoiseModel

show(__name__)
