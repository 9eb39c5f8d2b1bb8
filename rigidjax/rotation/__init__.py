"""Rotations: matrices, quaternions, Euler angles, Rodrigues parameters."""

from rigidjax._names import show
from rigidjax.rotation import (
    euler as euler,
    mrp as mrp,
    quaternion as quaternion,
    rodrigues as rodrigues,
    so3 as so3,
)
from rigidjax.rotation.interpolant import AttitudeInterpolant as AttitudeInterpolant

show(__name__)
