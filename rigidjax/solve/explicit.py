"""Explicit Runge–Kutta methods of orders 4, 5 and 8, every stage on scalar components."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.motion import on_the_group
from rigidjax.solve.components import join, leaf_sizes, split
from rigidjax.solve.scalarise import scalarise
from rigidjax.solve.tableaus import DORMAND_PRINCE8, KUTTA4, TSITOURAS5, Row, Tableau

Atoms = tuple[Array, ...]


class NestedInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output of a Runge–Kutta step, its quaternion scaled to length 1.

    `y0 + θ(F0 + (1−θ)(F1 + θ(F2 + (1−θ)(F3 + …))))`, θ from 0 to 1 along the step; the rows of
    `coefficients` are F0, F1, … Source: Hairer, Nørsett and Wanner (1993), II.6.
    """

    t0: Any
    t1: Any
    y0: Any
    coefficients: Any

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        safe = jnp.where(length == 0, jnp.ones_like(length), length)
        theta = jnp.where(length == 0, jnp.zeros_like(length), (t0 - self.t0) / safe)

        def value(y: Array, rows: Array) -> Array:
            along = theta.astype(y.dtype)
            total = jnp.zeros_like(y)
            for i in reversed(range(rows.shape[0])):
                total = (total + rows[i]) * (along if i % 2 == 0 else 1 - along)
            return y + total

        return on_the_group(jax.tree.map(value, self.y0, self.coefficients))


def cubic_rows(rise: Any, h: Any, left: Any, right: Any) -> tuple[Any, Any, Any]:
    """F0, F1, F2 of the cubic with this `rise` over a step `h` and slopes `left` and `right`."""
    return rise, h * left - rise, 2 * rise - h * (left + right)


class AbstractExplicit(dfx.AbstractAdaptiveSolver):
    """All stages of `tableau` inside one step, on scalars; subclasses name the tableau."""

    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = NestedInterpolation
    tableau: eqx.AbstractClassVar[Tableau]

    def order(self, terms: Any) -> int:
        return self.tableau.order

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Any:
        return _diffrax_step(self.tableau, terms, t0, t1, y0, args)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)


class RungeKutta4(AbstractExplicit):
    """The classical Runge–Kutta method: order 4, four stages, an estimate of order 3.

    For coarse tolerances (1e-3) and torques known to few digits. Every stage of a step is written
    out on scalars, and a state with a quaternion `q` is scaled to |q| = 1 once per step, in dense
    output too (cubic, as accurate as the steps themselves).

    Source: Kutta 1901; Hairer, Nørsett and Wanner (1993), II.1, doi:10.1007/978-3-540-78862-1.

    >>> import diffrax, rigidjax as rj
    >>> field = rj.AttitudeEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> term = diffrax.ODETerm(field)
    >>> diffrax.diffeqsolve(term, rj.solvers.RungeKutta4(), 0.0, 1.0, 0.01, start).ys.q[0, 3]
    Array(0.47942554, dtype=float64)
    """

    tableau: ClassVar[Tableau] = KUTTA4


class Tsitouras5(AbstractExplicit):
    """Tsitouras' method of order 5, six stages, with an estimate of order 4.

    For tolerances about 1e-4 to 1e-6. Stages, projection and dense output (quartic) as for
    `RungeKutta4`.

    Source: Tsitouras 2011, doi:10.1016/j.camwa.2011.06.002.

    >>> Tsitouras5().order(None)
    5
    """

    tableau: ClassVar[Tableau] = TSITOURAS5


class DormandPrince8(AbstractExplicit):
    """The method DOP853 of order 8: twelve stages, estimates of orders 5 and 3.

    For everything smooth, from 1e-4 to round-off. Stages and projection as for `RungeKutta4`;
    dense output of degree 7, whose three more stages are computed only where it is asked for.

    Source: Hairer, Nørsett and Wanner (1993), II.5 and II.6, doi:10.1007/978-3-540-78862-1; after
    Prince and Dormand 1981, doi:10.1016/0771-050X(81)90010-3.

    >>> DormandPrince8().order(None)
    8
    """

    tableau: ClassVar[Tableau] = DORMAND_PRINCE8


def advance(
    tableau: Tableau,
    field: Callable[[Any, Atoms], Atoms],
    t: Any,
    h: Any,
    y: Atoms,
    end: Any = None,
) -> tuple[Atoms, list[Atoms], list[Atoms]]:
    """One step from `y`, not projected; the slopes at its stages, and the states there.

    **Arguments:** `field(t, y)` on tuples of arrays, which `y` is; `t`, `h` scalars; `end` the time
    of the stages at the end of the step, where it is not to be `t + h` rounded.
    """
    end = t + h if end is None else end
    places, slopes = [y], [_fence(field(t, y))]
    for node, row in zip(tableau.c, tableau.a, strict=True):
        place = _fence(_along(y, h, row, slopes))
        places.append(place)
        slopes.append(_fence(field(end if node == 1 else t + node * h, place)))
    return _along(y, h, tableau.b, slopes), slopes, places


def _fence(numbers: Atoms) -> Atoms:
    """The same numbers, not to be computed again in each place that reads them.

    Without it XLA makes of each result of a step one kernel, which repeats all stages before it. On
    one trajectory LLVM finds the copies; in a batch, or beside tangents, it cannot.
    """
    return lax.optimization_barrier(numbers)


def error_estimate(tableau: Tableau, h: Any, slopes: Sequence[Atoms], like: Any) -> Atoms:
    """The error of a step, component by component.

    Two estimates e5, e3 make e5 |e5|/√(|e5|² + 0.01 |e3|²), which falls as h⁸ (Hairer, Nørsett and
    Wanner 1993, II.10). The lengths are those of one leaf of the state `like`, so that no scale is
    mixed with another's.
    """
    first = [_as(h, k) * k for k in _weighted(tableau.errors[0], slopes)]
    if len(tableau.errors) == 1:
        return tuple(first)
    other = [_as(h, k) * k for k in _weighted(tableau.errors[1], slopes)]
    out: list[Array] = []
    for size in leaf_sizes(like):
        here = slice(len(out), len(out) + size)
        high = sum(jnp.sum(a * a) for a in first[here])
        low = sum(jnp.sum(b * b) for b in other[here])
        # The smallest normal number keeps 0/0 out; no real estimate is as small as its root.
        tiny = float(jnp.finfo(first[here][0].dtype).tiny)
        ratio = jnp.sqrt(high / (high + 0.01 * low + tiny))
        out.extend(a * ratio for a in first[here])
    return tuple(out)


def _diffrax_step(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, args: Any
) -> tuple[Any, Any, Any, None, dfx.RESULTS]:
    numbers = scalarise(lambda t, y: terms.vf(t, y, args), t0, y0)

    def field(t: Any, atoms: Atoms) -> Atoms:
        return numbers(t, *atoms)

    h = terms.contr(t0, t1)
    start = split(y0)
    end, slopes, _ = advance(tableau, field, t0, h, start)
    # Once, after the stages: inside them it changes the order (jaxsim#192).
    end = split(on_the_group(join(end, y0)))
    rows, slopes = _dense_rows(tableau, field, t0, t1, h, start, end, slopes)
    # Which steps are taken is not a thing to differentiate: their error is below the tolerance.
    error = lax.stop_gradient(error_estimate(tableau, h, slopes, y0))
    # Without a barrier XLA computes all stages again for each number that it stacks below. None for
    # the rows: a barrier is kept, with all that it needs, even where nobody asks for its result.
    end = lax.optimization_barrier(end)
    error = lax.optimization_barrier(error)
    coefficients = jax.tree.map(lambda *r: jnp.stack(r), *[join(row, y0) for row in rows])
    dense = dict(y0=y0, coefficients=coefficients)
    return join(end, y0), join(error, y0), dense, None, dfx.RESULTS.successful


def _dense_rows(
    tableau: Tableau,
    field: Callable[[Any, Atoms], Atoms],
    t0: Any,
    t1: Any,
    h: Any,
    start: Atoms,
    end: Atoms,
    slopes: list[Atoms],
) -> tuple[list[Atoms], list[Atoms]]:
    """The rows of `NestedInterpolation`, and the slopes with the one at the end of the step."""
    slopes = [*slopes, field(t1, end)]
    main = slopes
    for node, row in zip(tableau.extra_c, tableau.extra_a, strict=True):
        slopes = [*slopes, field(t0 + node * (t1 - t0), _along(start, h, row, slopes))]
    left, right = slopes[0], slopes[len(tableau.a) + 1]
    rise = tuple(b - a for a, b in zip(start, end, strict=True))
    cubic = (cubic_rows(d, _as(h, d), k, m) for k, m, d in zip(left, right, rise, strict=True))
    rows: list[Atoms] = list(zip(*cubic, strict=True))
    for row in tableau.dense:
        rows.append(tuple(_as(h, k) * k for k in _weighted(row, slopes)))
    return rows, main


def _along(y: Atoms, h: Any, row: Row, slopes: Sequence[Atoms]) -> Atoms:
    rise = _weighted(row, slopes)
    return tuple(a + _as(h, a) * k for a, k in zip(y, rise, strict=True))


def _weighted(row: Row, slopes: Sequence[Atoms]) -> Atoms:
    out = []
    for i in range(len(slopes[0])):
        total = None
        for stage, weight in row.items():
            part = weight * slopes[stage][i]
            total = part if total is None else total + part
        out.append(total)
    return tuple(out)


def _as(h: Any, like: Array) -> Array:
    return jnp.asarray(h, like.dtype)
