"""Define explicit Runge–Kutta methods of orders 4, 5 and 8 as solvers of diffrax."""

from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, PyTree

from rigidjax import _checks
from rigidjax._types import RealLike
from rigidjax.motion.equations import project_to_group
from rigidjax.rotation.barrier import barrier
from rigidjax.solve.steps.runge_kutta import Step, dense_change, dense_rows, error_estimate, stages
from rigidjax.solve.steps.tableaus import DORMAND_PRINCE8, KUTTA4, TSITOURAS5, Tableau


class NestedInterpolation(dfx.AbstractLocalInterpolation):
    """Interpolate the state within a step by the rows F0, F1, … of `runge_kutta.dense_change`."""

    t0: Any
    t1: Any
    y0: Any
    coefficients: Any

    def evaluate(self, t0: RealLike, t1: RealLike | None = None, left: bool = True) -> PyTree:
        """Return the state at `t0`, or its change from `t0` to `t1`."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        safe = jnp.where(length == 0, jnp.ones_like(length), length)
        theta = jnp.where(length == 0, jnp.zeros_like(length), (t0 - self.t0) / safe)

        value = lambda y, rows: y + dense_change(theta.astype(y.dtype), rows)  # noqa: E731
        # A maximum has no derivative if XLA rounds its argument differently in two places.
        return barrier(project_to_group(jax.tree.map(value, self.y0, self.coefficients)))


def direction_and_length(
    terms: PyTree[dfx.AbstractTerm], t0: RealLike, t1: RealLike
) -> tuple[Array, Array]:
    """Return the direction of a step of diffrax, 1 or −1, and its length, s.

    In a run backwards diffrax uses −t as the time: `t1` > `t0`, and only `contr(t0, t1)` is
    negative. Such a step is computed forwards, with slopes of the opposite sign.
    """
    h = jnp.asarray(terms.contr(t0, t1))
    way = jnp.where(h < 0, -jnp.ones_like(h), jnp.ones_like(h))
    return way, way * h


def cubic_coefficients(
    change: Array, h: Array, left_slope: Array, right_slope: Array
) -> tuple[Array, Array, Array]:
    """Return F0, F1, F2 of `runge_kutta.dense_change` from change and slopes at both ends."""
    return change, h * left_slope - change, 2 * change - h * (left_slope + right_slope)


class AbstractExplicit(dfx.AbstractAdaptiveSolver):
    """Take the steps of an explicit Runge–Kutta method; a subclass sets its `tableau`."""

    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = NestedInterpolation
    tableau: eqx.AbstractClassVar[Tableau]

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        return self.tableau.order

    def init(
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, t1: RealLike, y0: PyTree, args: PyTree
    ) -> tuple[()]:
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
    ) -> Any:
        _checks.common_dtype(y0, "state")
        numbers, tree = ravel_pytree(y0)
        way, h = direction_and_length(terms, t0, t1)

        def field(_: Any, t: Any, y: Array) -> Array:
            return way.astype(y.dtype) * ravel_pytree(terms.vf(t, tree(y), args))[0]

        step = Step(jnp.asarray(t0), h, jnp.asarray(t1), numbers)
        there = stages(self.tableau, field, [], step)
        # The quaternion is scaled to length 1 once, after the stages: if it were scaled in each
        # stage, the method would have another order (issue 192 of jaxsim).
        y1 = project_to_group(tree(there.end))
        # Derivatives hold the lengths of steps constant, so that the error, from which the lengths
        # are chosen, needs no derivative. What this leaves out is as small as the error of a step,
        # which is below the tolerance.
        sizes = [leaf.size for leaf in jax.tree.leaves(y0)]
        error = lax.stop_gradient(error_estimate(self.tableau, sizes, h, there.slopes))
        rows = dense_rows(self.tableau, field, step, there.slopes)
        dense = dict(y0=y0, coefficients=jax.vmap(tree)(rows))
        return y1, tree(error), dense, (), dfx.RESULTS.successful

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)


class RungeKutta4(AbstractExplicit):
    """Solve by the classical Runge–Kutta method: order 4, four stages, an estimate of order 3.

    It is for coarse tolerances (1e-3). A quaternion is scaled to |q| = 1 once per step, and in the
    dense output, which is cubic and as accurate as the steps.

    Source: Kutta 1901; Hairer, Nørsett and Wanner (1993), II.1, doi:10.1007/978-3-540-78862-1.

    >>> import diffrax
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> term = diffrax.ODETerm(field)
    >>> diffrax.diffeqsolve(term, rj.solvers.RungeKutta4(), 0.0, 1.0, 0.01, start).ys.q[0, 3]
    Array(0.47942554, dtype=float64)
    """

    tableau: ClassVar[Tableau] = KUTTA4


class Tsitouras5(AbstractExplicit):
    """Solve by Tsitouras' method: order 5, six stages, an error estimate of order 4.

    It is for tolerances from about 1e-4 to 1e-6. A quaternion is scaled to |q| = 1 once per step,
    and in the dense output, which is quartic.

    Source: Tsitouras 2011, doi:10.1016/j.camwa.2011.06.002.

    >>> Tsitouras5().order(None)
    5
    """

    tableau: ClassVar[Tableau] = TSITOURAS5


class DormandPrince8(AbstractExplicit):
    """Solve by the method DOP853: order 8, twelve stages, error estimates of orders 5 and 3.

    It is for everything smooth, from tolerances of 1e-4 down to round-off. A quaternion is scaled
    to |q| = 1 once per step, and in the dense output. The dense output has degree 7. It needs three
    more stages, which are computed only if it is asked for.

    Source: Hairer, Nørsett and Wanner (1993), II.5 and II.6, doi:10.1007/978-3-540-78862-1; after
    Prince and Dormand 1981, doi:10.1016/0771-050X(81)90010-3.

    >>> DormandPrince8().order(None)
    8
    """

    tableau: ClassVar[Tableau] = DORMAND_PRINCE8


def require_explicit(solver: AbstractExplicit | None) -> AbstractExplicit:
    """Return the solver, or `DormandPrince8` for `None`; raise `TypeError` if not explicit."""
    solver = DormandPrince8() if solver is None else solver
    wanted = "an explicit method of rigidjax.solvers"
    return _checks.require_instance(solver, AbstractExplicit, "solver", requirement=wanted)
