"""Solve for the motion of a body: with adaptive steps, with equal steps, or in closed form."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.solve.answer.crossings import Event as Event, crossings as crossings
from rigidjax.solve.answer.exponents import lyapunov_exponents as lyapunov_exponents
from rigidjax.solve.answer.run import equations_of_motion as equations_of_motion
from rigidjax.solve.answer.simulate import simulate as simulate
from rigidjax.solve.answer.solution import Solution as Solution
from rigidjax.solve.engine.adaptive import adaptive as adaptive
from rigidjax.solve.steps.fixed import fixed as fixed

__all__ = [
    "Event", "Solution", "adaptive", "crossings", "equations_of_motion", "fixed",
    "lyapunov_exponents", "simulate",
]  # fmt: skip

define_dir_and_getattr(__name__)
