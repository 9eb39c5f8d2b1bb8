"""Steps of equal length whose stages are a loop, for derivatives in forward mode.

With many tangents, as fits take them, the stages written out take two to three times as long to
compile as these, and run as fast. Values alone take a tenth longer here, reverse mode a third.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.rotation.barrier import barrier
from rigidjax.solve.explicit import AbstractExplicit, Atoms, RungeKutta4, Tsitouras5, advance, plus
from rigidjax.solve.tableaus import KUTTA4, TSITOURAS5, Tableau

# field(t, y) on tuples of arrays.
Field = Callable[[Any, Atoms], Atoms]


class AbstractRolled(AbstractExplicit):
    """The same steps as the method of the tableau takes."""

    @abc.abstractmethod
    def end(self, field: Field, t: Any, h: Array, y: Atoms, end: Any) -> Atoms:
        """The end of a step from `t` to `end`, of length `h`, not projected."""


class RolledKutta4(AbstractRolled):
    """`RungeKutta4`: each stage needs the slope of the one before, and no other."""

    tableau: ClassVar[Tableau] = KUTTA4

    def end(self, field: Field, t: Any, h: Array, y: Atoms, end: Any) -> Atoms:
        def stage(before: tuple[Atoms, Atoms], now: Any) -> tuple[tuple[Atoms, Atoms], None]:
            (total, slope), (time, node, share) = before, now
            slope = barrier(field(time, barrier(plus(y, node * h, slope))))
            return (plus(total, share * h, slope), slope), None

        shares = jnp.array(list(KUTTA4.b.values()), h.dtype)
        rest = tuple(jnp.zeros_like(a) for a in y)
        times, nodes = _times(KUTTA4, t, h, end)
        return lax.scan(stage, (y, rest), (times, nodes, shares))[0][0]


class RolledTsitouras5(AbstractRolled):
    """`Tsitouras5`: all slopes are carried, each stage puts in its own."""

    tableau: ClassVar[Tableau] = TSITOURAS5

    def end(self, field: Field, t: Any, h: Array, y: Atoms, end: Any) -> Atoms:
        count = len(TSITOURAS5.a) + 1
        rows = np.zeros((count, count))
        for i, row in enumerate(TSITOURAS5.a, 1):
            rows[i, list(row)] = list(row.values())

        def stage(slopes: tuple[Atoms, ...], now: Any) -> tuple[tuple[Atoms, ...], None]:
            time, row, mine = now
            place = y
            for j, slope in enumerate(slopes[:-1]):
                place = plus(place, row[j] * h, slope)
            new = barrier(field(time, barrier(place)))
            return tuple(
                tuple(jnp.where(mine[j], a, b) for a, b in zip(new, slope, strict=True))
                for j, slope in enumerate(slopes)
            ), None

        rest = tuple(tuple(jnp.zeros_like(a) for a in y) for _ in range(count))
        times, _ = _times(TSITOURAS5, t, h, end)
        each = (times, jnp.asarray(rows, h.dtype), jnp.eye(count, dtype=bool))
        slopes, _ = lax.scan(stage, rest, each)
        for j, share in TSITOURAS5.b.items():
            y = plus(y, share * h, slopes[j])
        return y


def in_a_loop(solver: Any) -> Any:
    """The method with its stages in a loop; another, if it is none of order 4 or 5, as it is.

    >>> from rigidjax import solvers
    >>> type(in_a_loop(solvers.Tsitouras5())).__name__
    'RolledTsitouras5'
    """
    if isinstance(solver, RungeKutta4):
        return RolledKutta4()
    return RolledTsitouras5() if isinstance(solver, Tsitouras5) else solver


def end_of_step(
    solver: AbstractExplicit, field: Field, t: Any, h: Array, y: Atoms, end: Any
) -> Atoms:
    """The end of a step of any method, not projected; arguments as for `advance`."""
    if isinstance(solver, AbstractRolled):
        return solver.end(field, t, h, y, end)
    return advance(solver.tableau, field, t, h, y, end)[0]


def _times(tableau: Tableau, t: Any, h: Array, end: Any) -> tuple[Array, Array]:
    """The times of the stages, the last ones exactly at the end; and the nodes."""
    times = [t] + [end if node == 1 else t + node * h for node in tableau.c]
    return jnp.stack([jnp.asarray(a, h.dtype) for a in times]), jnp.array(
        [0.0, *tableau.c], h.dtype
    )
