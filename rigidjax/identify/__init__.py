"""Identification: from recordings to a body, with its uncertainty."""

from rigidjax._names import show
from rigidjax.cli.logs.table import read_table as read_table
from rigidjax.identify import report as report
from rigidjax.identify.body_charts import (
    AbstractBodyChart as AbstractBodyChart,
    Known as Known,
    Mass as Mass,
    Principal as Principal,
    PrincipalRatios as PrincipalRatios,
    Ratios as Ratios,
    Tensor as Tensor,
)
from rigidjax.identify.compare import compare as compare, cross_validate as cross_validate
from rigidjax.identify.design import (
    best_first_rate as best_first_rate,
    expected as expected,
    fisher as fisher,
)
from rigidjax.identify.fit import fit as fit
from rigidjax.identify.loss import (
    AbstractLoss as AbstractLoss,
    Entropic as Entropic,
    Huber as Huber,
    SoftL1 as SoftL1,
)
from rigidjax.identify.parameters import (
    Free as Free,
    Parameters as Parameters,
    Unpacked as Unpacked,
)
from rigidjax.identify.problem import Problem as Problem
from rigidjax.identify.profile import profile as profile
from rigidjax.identify.propagation import (
    Adaptive as Adaptive,
    FixedSteps as FixedSteps,
    simulate_readings as simulate_readings,
)
from rigidjax.identify.recording import Recording as Recording
from rigidjax.identify.result import Fit as Fit
from rigidjax.identify.sensors import (
    AbstractSensor as AbstractSensor,
    Accelerometer as Accelerometer,
    AttitudeSensor as AttitudeSensor,
    Direction as Direction,
    Gyro as Gyro,
    LowPass as LowPass,
    Magnetometer as Magnetometer,
    Marker as Marker,
    Position as Position,
    Range as Range,
    SensorInput as SensorInput,
    Velocity as Velocity,
)
from rigidjax.identify.stochastic_gradient import Descent as Descent
from rigidjax.identify.window_fit import WindowFit as WindowFit, fit_windows as fit_windows
from rigidjax.identify.windows import Windows as Windows, windows as windows

show(__name__)
