"""Answers with a solver, all of them diffrax's."""

from rigidjax._names import own_names
from rigidjax.solve import lean as lean, solvers as solvers
from rigidjax.solve.projection import (
    GroupInterpolation as GroupInterpolation,
    Projected as Projected,
)
from rigidjax.solve.simulate import simulate as simulate
from rigidjax.solve.solution import Solution as Solution
from rigidjax.solve.vector_field import equations_of_motion as equations_of_motion

__dir__ = own_names(__name__)
