"""From a recording to a body, and how sure that is."""

from rigidjax.identify import report as report, toutatis as toutatis
from rigidjax.identify.bodies import (
    AbstractBodyChart as AbstractBodyChart,
    PrincipalRatios as PrincipalRatios,
    Ratios as Ratios,
)
from rigidjax.identify.files import LogError as LogError, read_gyro_csv as read_gyro_csv
from rigidjax.identify.fit import Fit as Fit, Start as Start, fit as fit
from rigidjax.identify.loss import SoftL1 as SoftL1
from rigidjax.identify.problem import Parameters as Parameters, Problem as Problem
from rigidjax.identify.recording import Reading as Reading, Recording as Recording
from rigidjax.identify.sensors import (
    AbstractSensor as AbstractSensor,
    AttitudeSensor as AttitudeSensor,
    Gyro as Gyro,
)
