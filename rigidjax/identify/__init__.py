"""Find a body from recordings of its motion, with its uncertainty.

`fit` finds the body and all other parameters of a `Model`. `filter`, `step` and `smooth` follow a
model with an unknown torque: they give states, torques and sensor errors with their standard
deviations. `log_likelihood` is the logarithm of the density of the readings, after integration over
the unknown torques; `sample` draws a motion under random torques. `LogDensity` is the posterior
density of a fit: `posterior` draws from it, `refit` finds its maximum.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.cli.logs.table import read_table as read_table
from rigidjax.identify import report as report
from rigidjax.identify.answer.fit import fit as fit
from rigidjax.identify.answer.result import Fit as Fit
from rigidjax.identify.data.phases import Phase as Phase, find_phases as find_phases
from rigidjax.identify.data.recording import Recording as Recording
from rigidjax.identify.data.windows import Windows as Windows, windows as windows
from rigidjax.identify.filtering.filter import (
    filter as filter,
    first_belief as first_belief,
    log_likelihood as log_likelihood,
    step as step,
)
from rigidjax.identify.filtering.smoother import smooth as smooth
from rigidjax.identify.filtering.steps import sample as sample
from rigidjax.identify.inference.compare import compare as compare
from rigidjax.identify.inference.density import LogDensity as LogDensity
from rigidjax.identify.inference.design import (
    expected_quantities as expected_quantities,
    fisher as fisher,
)
from rigidjax.identify.inference.draws import (
    Nuts as Nuts,
    Posterior as Posterior,
    Refit as Refit,
    posterior as posterior,
    refit as refit,
)
from rigidjax.identify.inference.horizons import predict_windows as predict_windows
from rigidjax.identify.inference.selection import (
    Candidates as Candidates,
    Selection as Selection,
    select as select,
    usual_terms as usual_terms,
)
from rigidjax.identify.model.charts import (
    AbstractBodyChart as AbstractBodyChart,
    Known as Known,
    Mass as Mass,
    Principal as Principal,
    PrincipalRatios as PrincipalRatios,
    Ratios as Ratios,
    Tensor as Tensor,
)
from rigidjax.identify.model.free import Free as Free
from rigidjax.identify.model.model import Model as Model, Unpacked as Unpacked
from rigidjax.identify.model.moment import Moment as Moment
from rigidjax.identify.model.predict import (
    Adaptive as Adaptive,
    FixedSteps as FixedSteps,
    simulate_readings as simulate_readings,
)
from rigidjax.identify.model.priors import (
    AbstractLoss as AbstractLoss,
    Entropic as Entropic,
    Huber as Huber,
    Measured as Measured,
    SoftL1 as SoftL1,
)
from rigidjax.identify.model.scene import Scene as Scene
from rigidjax.identify.model.walks import Walk as Walk
from rigidjax.identify.search.stochastic_gradient import Descent as Descent, descend as descend
from rigidjax.identify.sensors import (
    AbstractSensor as AbstractSensor,
    Accelerometer as Accelerometer,
    AttitudeSensor as AttitudeSensor,
    Direction as Direction,
    ForceTorque as ForceTorque,
    Gyro as Gyro,
    Magnetometer as Magnetometer,
    Marker as Marker,
    Position as Position,
    Range as Range,
    SensorInput as SensorInput,
    Tolerance as Tolerance,
    Velocity as Velocity,
)

__all__ = [
    "AbstractBodyChart", "AbstractLoss", "AbstractSensor", "Accelerometer", "Adaptive",
    "AttitudeSensor", "Candidates", "Descent", "Direction", "Entropic", "Fit", "FixedSteps",
    "ForceTorque", "Free", "Gyro", "Huber", "Known", "LogDensity", "Magnetometer", "Marker", "Mass",
    "Measured", "Model", "Moment", "Nuts", "Phase", "Position", "Posterior", "Principal",
    "PrincipalRatios", "Range", "Ratios", "Recording", "Refit", "Scene", "Selection", "SensorInput",
    "SoftL1", "Tensor", "Tolerance", "Unpacked", "Velocity", "Walk", "Windows", "compare",
    "descend", "expected_quantities", "filter", "find_phases", "first_belief", "fisher", "fit",
    "log_likelihood", "posterior", "predict_windows", "read_table", "refit", "report", "sample",
    "select", "simulate_readings", "smooth", "step", "usual_terms", "windows",
]  # fmt: skip

define_dir_and_getattr(__name__)
