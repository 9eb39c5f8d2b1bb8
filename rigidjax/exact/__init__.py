"""Solve the motion of a torque-free body in closed form, without a solver."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.exact.free_body import FreeBody as FreeBody, free_body as free_body
from rigidjax.exact.periods import (
    body_period as body_period,
    precession_period as precession_period,
)

__all__ = ["FreeBody", "body_period", "free_body", "precession_period"]

define_dir_and_getattr(__name__)
