"""Motions in closed form, without a solver."""

from typing import TYPE_CHECKING

from rigidjax._names import own_names, suggests
from rigidjax.exact.diffrax_solver import FreeSolver as FreeSolver
from rigidjax.exact.free_body import FreeBody as FreeBody, free_body as free_body
from rigidjax.exact.periods import (
    body_period as body_period,
    precession_period as precession_period,
)

if not TYPE_CHECKING:
    __getattr__ = suggests(__name__)
__dir__ = own_names(__name__)
