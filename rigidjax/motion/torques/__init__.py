"""Provide torques and forces, each of which declares the smallest state that it acts on."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.motion.torques.base import AbstractTorque as AbstractTorque, Wrench as Wrench
from rigidjax.motion.torques.carried import (
    Carried as Carried,
    Kinematics as Kinematics,
    LoggedMotion as LoggedMotion,
)
from rigidjax.motion.torques.chebyshev import Chebyshev as Chebyshev
from rigidjax.motion.torques.composite import (
    ChangingInertia as ChangingInertia,
    Sum as Sum,
    Tide as Tide,
)
from rigidjax.motion.torques.elementary import (
    ConstantTorque as ConstantTorque,
    Damping as Damping,
    InSpace as InSpace,
    QuadraticDamping as QuadraticDamping,
)
from rigidjax.motion.torques.forces import (
    BodyDrag as BodyDrag,
    CentralGravity as CentralGravity,
    Drag as Drag,
    Rotors as Rotors,
    UniformGravity as UniformGravity,
)
from rigidjax.motion.torques.inputs import (
    Delayed as Delayed,
    Input as Input,
    Lagged as Lagged,
    bind as bind,
)
from rigidjax.motion.torques.piecewise import (
    Held as Held,
    Linear as Linear,
    Pulses as Pulses,
    Tabulated as Tabulated,
)
from rigidjax.motion.torques.potentials import (
    FromPotential as FromPotential,
    GravityGradient as GravityGradient,
    HeavyTop as HeavyTop,
    MagneticDipole as MagneticDipole,
)
from rigidjax.motion.torques.random import (
    CorrelatedTorque as CorrelatedTorque,
    RandomTorque as RandomTorque,
)
from rigidjax.motion.torques.spline import Series as Series, Wheel as Wheel
from rigidjax.motion.torques.wheels import Flywheel as Flywheel, ReactionWheels as ReactionWheels

__all__ = [
    "AbstractTorque", "BodyDrag", "Carried", "CentralGravity", "ChangingInertia", "Chebyshev",
    "ConstantTorque", "CorrelatedTorque", "Damping", "Delayed", "Drag", "Flywheel",
    "FromPotential", "GravityGradient", "HeavyTop", "Held", "InSpace", "Input", "Kinematics",
    "Lagged", "Linear", "LoggedMotion", "MagneticDipole", "Pulses", "QuadraticDamping",
    "RandomTorque", "ReactionWheels", "Rotors", "Series", "Sum", "Tabulated", "Tide",
    "UniformGravity", "Wheel", "Wrench", "bind",
]  # fmt: skip

define_dir_and_getattr(__name__)
