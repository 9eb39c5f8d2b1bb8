"""Solve for the motion of a body: with adaptive steps, with equal steps, or in closed form."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.solve.adaptive import adaptive as adaptive
from rigidjax.solve.crossings import Event as Event, crossings as crossings
from rigidjax.solve.exponents import lyapunov_exponents as lyapunov_exponents
from rigidjax.solve.fixed_loop import fixed as fixed
from rigidjax.solve.run import equations_of_motion as equations_of_motion
from rigidjax.solve.simulate import simulate as simulate
from rigidjax.solve.solution import Solution as Solution

__all__ = [
    "Event", "Solution", "adaptive", "crossings", "equations_of_motion", "fixed",
    "lyapunov_exponents", "simulate",
]  # fmt: skip

define_dir_and_getattr(__name__)
