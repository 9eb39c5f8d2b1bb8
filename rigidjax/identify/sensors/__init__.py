"""Provide the sensors of a recording, each of which predicts its readings from a motion."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.identify.sensors.attitude import (
    AttitudeSensor as AttitudeSensor,
    Direction as Direction,
    Marker as Marker,
    Position as Position,
    Range as Range,
    Velocity as Velocity,
)
from rigidjax.identify.sensors.base import (
    AbstractSensor as AbstractSensor,
    SensorInput as SensorInput,
)
from rigidjax.identify.sensors.force_torque import ForceTorque as ForceTorque
from rigidjax.identify.sensors.tolerance import Tolerance as Tolerance
from rigidjax.identify.sensors.vectors import (
    Accelerometer as Accelerometer,
    Gyro as Gyro,
    Magnetometer as Magnetometer,
)

__all__ = [
    "AbstractSensor", "Accelerometer", "AttitudeSensor", "Direction", "ForceTorque", "Gyro",
    "Magnetometer", "Marker", "Position", "Range", "SensorInput", "Tolerance",
    "Velocity",
]  # fmt: skip

define_dir_and_getattr(__name__)
