"""Answers with a solver, all of them diffrax's."""

from rigidjax.solve import lean as lean, solvers as solvers
from rigidjax.solve.projected import (
    GroupInterpolation as GroupInterpolation,
    Projected as Projected,
)
from rigidjax.solve.simulate import (
    Solution as Solution,
    equations_of_motion as equations_of_motion,
    simulate as simulate,
)
