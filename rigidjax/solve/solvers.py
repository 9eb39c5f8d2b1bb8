"""Provide every solver of this package, and the adjoint that runs them, as `rigidjax.solvers`."""

from rigidjax._names import define_dir_and_getattr
from rigidjax.exact.diffrax_solver import FreeSolver as FreeSolver
from rigidjax.solve.engine.projection import Projected as Projected
from rigidjax.solve.engine.replay import ReplayAdjoint as ReplayAdjoint
from rigidjax.solve.steps.explicit import (
    DormandPrince8 as DormandPrince8,
    RungeKutta4 as RungeKutta4,
    Tsitouras5 as Tsitouras5,
)
from rigidjax.solve.steps.magnus import Magnus4 as Magnus4
from rigidjax.solve.steps.splitting import (
    Splitting2 as Splitting2,
    Splitting4 as Splitting4,
    Splitting6 as Splitting6,
)

__all__ = [
    "DormandPrince8", "FreeSolver", "Magnus4", "Projected", "ReplayAdjoint", "RungeKutta4",
    "Splitting2", "Splitting4", "Splitting6", "Tsitouras5",
]  # fmt: skip

define_dir_and_getattr(__name__)
