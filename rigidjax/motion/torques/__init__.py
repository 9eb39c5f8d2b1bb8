"""Torques and forces. Each names the lowest state that it acts on."""

from typing import TYPE_CHECKING

from rigidjax._names import own_names, suggests
from rigidjax.motion.torques.base import (
    AbstractForce as AbstractForce,
    AbstractTorque as AbstractTorque,
    Torque as Torque,
    Wrench as Wrench,
    jumps_of as jumps_of,
)
from rigidjax.motion.torques.changing_inertia import ChangingInertia as ChangingInertia
from rigidjax.motion.torques.composite import FromPotential as FromPotential, Sum as Sum
from rigidjax.motion.torques.constant import ConstantTorque as ConstantTorque, InSpace as InSpace
from rigidjax.motion.torques.damping import (
    Damping as Damping,
    QuadraticDamping as QuadraticDamping,
)
from rigidjax.motion.torques.flywheel import Flywheel as Flywheel
from rigidjax.motion.torques.forces import (
    CentralGravity as CentralGravity,
    Drag as Drag,
    UniformGravity as UniformGravity,
)
from rigidjax.motion.torques.gravity import (
    GravityGradient as GravityGradient,
    HeavyTop as HeavyTop,
)
from rigidjax.motion.torques.inputs import Delayed as Delayed, Input as Input, bind as bind
from rigidjax.motion.torques.magnetic import MagneticDipole as MagneticDipole
from rigidjax.motion.torques.piecewise import (
    Held as Held,
    Linear as Linear,
    Pulses as Pulses,
    Tabulated as Tabulated,
)
from rigidjax.motion.torques.random import (
    CorrelatedTorque as CorrelatedTorque,
    RandomTorque as RandomTorque,
)
from rigidjax.motion.torques.rotorcraft import BodyDrag as BodyDrag, Rotors as Rotors
from rigidjax.motion.torques.signals import Lagged as Lagged
from rigidjax.motion.torques.spline import Series as Series, Wheel as Wheel
from rigidjax.motion.torques.states import freeze as freeze
from rigidjax.motion.torques.wheels import ReactionWheels as ReactionWheels

if not TYPE_CHECKING:
    __getattr__ = suggests(__name__)
__dir__ = own_names(__name__)
