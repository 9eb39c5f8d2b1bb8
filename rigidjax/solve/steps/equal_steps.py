"""Take steps of explicit Runge–Kutta methods, if the lengths of the steps are known in advance.

The stages of a step are either written out one after the other, or computed in a loop. With many
tangents, as in a fit, the program with the loop compiles two to three times faster than the program
without it, and runs as fast. Without derivatives the program with the loop takes a tenth more time
to run, and in reverse mode a third more.
"""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from rigidjax.rotation.barrier import barrier
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.tableaus import Row, Tableau, round_weights

# field(t, y) returns dy/dt for any tree of arrays y; it is fastest if y is a tuple of scalars (see
# the module `components`).
Field = Callable[[Any, Any], Any]


class StepWithLoopedStages(eqx.Module):
    """Wrap an explicit method, so that the stages of its steps are computed in a loop."""

    solver: AbstractExplicit


def loop_low_order(solver: dfx.AbstractSolver) -> Any:
    """Return an explicit method of order 4 or 5 with its stages in a loop; others unchanged."""
    if isinstance(solver, AbstractExplicit) and solver.tableau.order <= 5:
        return StepWithLoopedStages(solver)
    return solver


def change_in_step(
    solver: AbstractExplicit | StepWithLoopedStages,
    field: Field,
    t: Any,
    h: Array,
    y: PyTree,
    end: Any,
) -> PyTree:
    """Return the change of a state in one step; its quaternion is not scaled to length 1."""
    if isinstance(solver, StepWithLoopedStages):
        return _looped_change(solver.solver.tableau, field, t, h, y, end)
    return change_and_slope(solver.tableau, field, t, h, y, end)[0]


def state_after_step(tableau: Tableau, field: Field, t: Any, h: Array, y: PyTree) -> PyTree:
    """Return the state after one step; its quaternion is not scaled to length 1."""
    return jax.tree.map(jnp.add, y, change_and_slope(tableau, field, t, h, y)[0])


def change_and_slope(
    tableau: Tableau, field: Field, t: Any, h: Array, y: PyTree, end: Any = None
) -> tuple[PyTree, PyTree]:
    """Return the change of a state in one step, and the slope at its start.

    The stages are written out one after the other. If `end` is `None`, it is the rounded `t + h`.
    """
    # Without `barrier` around each stage XLA makes one kernel for each array of the result, and
    # each of these kernels computes all stages before it once more.
    end, tableau = t + h if end is None else end, round_weights(tableau, h.dtype)
    slopes = [barrier(field(t, y))]
    for node, row in zip(tableau.c, tableau.a, strict=True):
        place = barrier(jax.tree.map(jnp.add, y, _weighted_sum(h, row, slopes)))
        slopes.append(barrier(field(end if node == 1 else t + node * h, place)))
    return _weighted_sum(h, tableau.b, slopes), slopes[0]


def _weighted_sum(h: Array, row: Row, slopes: list[PyTree]) -> PyTree:
    """Return `h` times the weighted sum of the slopes of some stages."""

    def moved(*slopes: Array) -> Array:
        first, *rest = [w * k for w, k in zip(row.values(), slopes, strict=True)]
        return h.astype(first.dtype) * sum(rest, first)

    return jax.tree.map(moved, *[slopes[i] for i in row])


def _looped_change(tableau: Tableau, field: Field, t: Any, h: Array, y: PyTree, end: Any) -> PyTree:
    """Return the change of a state in one step, with the stages in a loop.

    It carries the slopes of the last few stages, as many as any later stage reads.
    """
    count, tableau = len(tableau.a) + 1, round_weights(tableau, h.dtype)
    rows = np.zeros((count, max(i - min(row) for i, row in enumerate(tableau.a, 1))))
    for i, row in enumerate(tableau.a, 1):
        rows[i, [i - 1 - j for j in row]] = list(row.values())
    shares = [tableau.b.get(i, 0.0) for i in range(count)]
    times = [t] + [end if node == 1 else t + node * h for node in tableau.c]

    def stage(now: tuple[Any, list[Any]], given: Any) -> tuple[Any, None]:
        (total, before), (time, row, share) = now, given
        place = y
        for i, slope in enumerate(before):
            place = _add_multiple(place, row[i] * h, slope)
        slope = barrier(field(time, barrier(place)))
        return (_add_multiple(total, share * h, slope), [slope, *before[:-1]]), None

    rest = [jax.tree.map(jnp.zeros_like, y)] * rows.shape[1]
    each = [jnp.stack([jnp.asarray(time, h.dtype) for time in times])]
    each += [jnp.asarray(part, h.dtype) for part in (rows, shares)]
    return lax.scan(stage, (jax.tree.map(jnp.zeros_like, y), rest), each)[0][0]


def _add_multiple(y: PyTree, factor: Array, slope: PyTree) -> PyTree:
    return jax.tree.map(lambda a, k: a + factor.astype(a.dtype) * k, y, slope)
