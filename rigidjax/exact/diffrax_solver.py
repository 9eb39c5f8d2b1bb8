"""Solve a free motion in diffrax by the closed form, exact at any step size, with dense output."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, PyTree

from rigidjax._types import RealLike
from rigidjax.body.inertia import Inertia
from rigidjax.exact.free_body import FreeBody
from rigidjax.motion.equations import AttitudeEquations, EulerEquations


class FreeInterpolation(dfx.AbstractLocalInterpolation):
    """Evaluate the motion of a free body between the two ends of a diffrax step in closed form."""

    t0: Any  # as diffrax counts the time: −t if it integrates backwards in the time t
    t1: Any
    y0: Any  # the `Spin` or `Attitude` at t0
    inertia: Inertia
    direction: Any  # −1 if diffrax integrates backwards, else 1

    def evaluate(
        self, t0: RealLike, t1: RealLike | None = None, left: bool = True
    ) -> PyTree[Array]:
        """Return the state at the time `t0`, or the state at `t1` minus the state at `t0`; `left`,
        the side of a jump, is not used, because there is no jump.
        """
        motion = FreeBody(self.inertia, self.y0)
        state = motion(self.direction * (t0 - self.t0))
        if t1 is None:
            return state
        return jax.tree.map(lambda b, a: b - a, motion(self.direction * (t1 - self.t0)), state)


class FreeSolver(dfx.AbstractSolver):
    """Solve the equations of a torque-free body in diffrax, where each step evaluates the closed
    form.

    Use it with the term `diffrax.ODETerm(rigidjax.equations_of_motion(inertia, y0))`, where the
    state `y0` is a `Spin` (a body rate) or an `Attitude` (a quaternion and a body rate), and no
    torque is given. One step over the whole interval is enough. Events, dense output and every
    adjoint (diffrax's ways to differentiate a solution) work as with any solver.

    **Raises:** `ValueError` for another term, or for equations with a torque.

    >>> import diffrax
    >>> y0 = rj.Spin([0.0, 1.0, 1e-4])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), y0)
    >>> solver = FreeSolver()
    >>> sol = diffrax.diffeqsolve(diffrax.ODETerm(field), solver, 0.0, 20.0, 20.0, y0)
    >>> sol.ys.omega[0]
    Array([-0.42522037, -0.90508985,  0.24550111], dtype=float64)
    """

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., FreeInterpolation]] = FreeInterpolation

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        """Return 1 as the order of this solver: its steps are exact and have no order, but some
        step size controllers of diffrax ask for one.
        """
        return 1

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> float | None:
        """Return 1 as the order of the error of a step, which diffrax asks for; the error of this
        solver is zero.
        """
        return 1.0

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
    ) -> tuple[()]:
        """Return an empty solver state; raise a `ValueError` unless `terms` are the equations of a
        free body.
        """
        _free_equations(terms)
        return ()

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Bool[ArrayLike, ""],
    ) -> tuple[Any, Any, dict[str, Any], tuple[()], dfx.RESULTS]:
        """Return the five results of a step from `t0` to `t1`, as diffrax asks for them: the exact
        state at `t1`, an error of zero, the numbers for the dense output, an empty solver state,
        and success.
        """
        # The direction is −1 if diffrax integrates backwards, in which case its times are −t.
        inertia = _free_equations(terms).inertia
        direction = jnp.asarray(field_and_direction(terms).direction, jnp.result_type(t0))
        y1 = FreeBody(inertia, y0)(direction * (t1 - t0))
        error = jax.tree.map(jnp.zeros_like, y0)
        dense = dict(y0=y0, inertia=inertia, direction=direction)
        return y1, error, dense, (), dfx.RESULTS.successful

    def func(
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree
    ) -> PyTree:
        """Return the rate of change of the state `y0` at the time `t0`, from the equations in
        `terms`.
        """
        return terms.vf(t0, y0, args)


class FieldAndDirection(NamedTuple):
    """Hold vector field and direction of time of the terms that diffrax gives to a solver."""

    field: Any  # the vector field, or None
    direction: Any  # −1 if diffrax integrates backwards, else 1


def field_and_direction(terms: PyTree[dfx.AbstractTerm]) -> FieldAndDirection:
    """Return both of an `ODETerm`, or of diffrax's object around it."""
    # Read the attributes of the term and of the object around it: the public methods of a term,
    # `vf` and `contr`, return numbers only, but the solver needs the inertia in the vector field.
    term = getattr(terms, "term", terms)
    return FieldAndDirection(getattr(term, "vector_field", None), getattr(terms, "direction", 1))


def _free_equations(terms: PyTree[dfx.AbstractTerm]) -> EulerEquations:
    """Return Euler's equations of a free body from inside the terms of a diffrax solver; raise a
    `ValueError` for any other terms.
    """
    field, _ = field_and_direction(terms)
    euler = field.euler if isinstance(field, AttitudeEquations) else field
    term = getattr(terms, "term", terms)
    if not isinstance(term, dfx.ODETerm) or not isinstance(euler, EulerEquations):
        raise ValueError(
            "FreeSolver: wanted ODETerm(equations_of_motion(inertia, y0)) of a Spin or an "
            f"Attitude, got {type(term).__name__} of {type(field).__name__}"
        )
    if euler.torque is not None:
        raise ValueError(
            f"FreeSolver: the body is not free, {type(euler.torque).__name__} acts on it; use a "
            "solver that steps"
        )
    return euler
