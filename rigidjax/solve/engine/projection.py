"""Wrap a solver of diffrax so that attitudes stay unit quaternions."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import ArrayLike, Bool, PyTree

from rigidjax import _checks
from rigidjax._types import RealLike
from rigidjax.motion.equations import project_to_group
from rigidjax.solve.engine.loop import NONFINITE, is_finite


class GroupInterpolation(dfx.AbstractLocalInterpolation):
    """Interpolate the state within a step by `inner`, and scale the quaternion to length 1."""

    t0: Any
    t1: Any
    inner: dfx.AbstractLocalInterpolation

    def evaluate(self, t0: RealLike, t1: RealLike | None = None, left: bool = True) -> Any:
        if t1 is None:
            return project_to_group(self.inner.evaluate(t0, left=left))
        end, start = self.evaluate(t1, left=left), self.evaluate(t0, left=left)
        return jtu.tree_map(lambda a, b: a - b, end, start)


class _GroupInterpolationOf(eqx.Module):
    """Make a `GroupInterpolation` from what the solver has stored for a step."""

    inner_cls: Any = eqx.field(static=True)  # the class of the solver's own interpolation

    def __call__(self, *, t0: RealLike, t1: RealLike, **dense_info: Any) -> GroupInterpolation:
        return GroupInterpolation(t0, t1, self.inner_cls(t0=t0, t1=t1, **dense_info))


def _of_solver(attribute: str) -> Any:
    """Define a property that reads an attribute of the wrapped solver."""
    return property(lambda self: getattr(self.solver, attribute))


class Projected(dfx.AbstractWrappedSolver):
    """Wrap a diffrax solver so that attitudes stay unit quaternions.

    The quaternion q at the end of each accepted step, and in every value of the dense output, is
    divided by its length |q|. The stages of a step are left as they are, because a change of q
    inside a step alters the order of the method (jaxsim#192). A state without a quaternion is not
    changed. A step that gives NaN or infinity ends the run with `RESULTS.nonfinite`.

    **Arguments:** `solver` is any `diffrax.AbstractSolver` on `Spin`, `Attitude` or `Rigid` states.

    >>> import diffrax
    >>> Projected(diffrax.Tsit5()).order(None)
    5
    """

    solver: dfx.AbstractSolver

    def __check_init__(self) -> None:
        _checks.require_instance(self.solver, dfx.AbstractSolver, "solver")

    term_structure = _of_solver("term_structure")
    term_compatible_contr_kwargs = _of_solver("term_compatible_contr_kwargs")
    # Adjoints of diffrax set `scan_kind` on a Runge–Kutta method, and step controllers set the
    # members of the root finder on an implicit method. They look for these members on the
    # `Projected`, which therefore passes on those of the solver inside it.
    scan_kind = _of_solver("scan_kind")
    root_finder = _of_solver("root_finder")
    root_find_max_steps = _of_solver("root_find_max_steps")

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _GroupInterpolationOf(self.solver.interpolation_cls)

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> Any:
        return self.solver.strong_order(terms)

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> Any:
        return self.solver.error_order(terms)

    def init(
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, t1: RealLike, y0: PyTree, args: PyTree
    ) -> Any:
        return self.solver.init(terms, t0, t1, y0, args)

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Bool[ArrayLike, ""],
    ) -> Any:
        # Some solvers keep the slope dy/dt at the end of a step for the next step. This slope
        # belongs to the state before the quaternion was scaled. Also, if one body of a batch needs
        # a new slope, diffrax computes it for all bodies, so that the result of one body would
        # depend on the other bodies. The solver inside therefore always gets `made_jump=True`, with
        # which it computes the slope anew in every step.
        del made_jump
        y1, error, dense, state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, True
        )
        ill = (result == dfx.RESULTS.successful) & ~is_finite(y1)
        result = dfx.RESULTS.where(ill, NONFINITE, result)
        return project_to_group(y1), error, dense, state, result

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return self.solver.func(terms, t0, y0, args)
