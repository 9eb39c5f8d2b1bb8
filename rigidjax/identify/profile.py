"""Profile intervals: the range of a quantity in which the best misfit grows little."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from rigidjax.identify import quantities
from rigidjax.identify.parameters import Parameters
from rigidjax.identify.result import Fit, one_fit
from rigidjax.identify.search import cost_of, misfit
from rigidjax.identify.terms import residuals


def profile(fit: Fit, name: str, level: float = 0.95) -> tuple[float, float]:
    """The profile interval (low, high) of one reported quantity.

    The other numbers are fitted again with the quantity held at a value; at the ends twice the
    misfit has grown by the square of the quantile, `t²`, times the samples over which errors are
    autocorrelated. Trust it if the misfit is not quadratic (a weakly determined quantity, or one
    near a boundary). **Arguments:** `fit`; `name` as in `fit.interval()`; `level` the probability.
    **Returns** the interval, infinite or 0 on a side where the misfit never grows that far within a
    factor of 1e3 (or 1e3 standard deviations).

    **Raises:** `ValueError` for a name that is not reported, a level outside (0, 1). Source: Raue
    et al. 2009, doi:10.1093/bioinformatics/btp358.

    >>> found = rj.identify.fit(rj.datasets.toutatis.problem())
    >>> low, high = profile(found, "Ix/Iz")
    >>> low < 3.1 < high
    True
    """
    one_fit(fit)
    names = [quantity.name for quantity in fit.quantities]
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"profile: no quantity {name!r}; wanted one of {', '.join(names)}")
    reach = quantities.quantile(fit, level)
    index = names.index(name)
    quantity = fit.quantities[index]
    middle = np.log(quantity.value) if quantity.positive else quantity.value
    deviation = quantity.deviation
    wide = np.log(1e3) if quantity.positive else 1e3 * max(abs(middle), 1e-12)
    if not np.isfinite(deviation) or deviation <= 0:
        deviation = wide / 10
    # Arrays, so as not to compile again.
    solver = optx.LevenbergMarquardt(jnp.asarray(1e-12), jnp.asarray(1e-4))  # pyright: ignore
    bottom = 2.0 * cost_of(fit.parameters, fit.problem, fit.noises)
    shares = max(fit.correlation, 1.0)
    ends = []
    for side in (-1.0, 1.0):
        point = fit.parameters

        def growth(steps: float, side: float = side) -> float:
            nonlocal point
            target = jnp.asarray(middle + side * steps * deviation)
            point, cost = _held(point, fit, index, target, jnp.asarray(1e-3 * deviation), solver)
            return (2.0 * float(cost) - bottom) / shares - reach**2

        ends.append(middle + side * deviation * _steps(growth, reach, wide / deviation))
    low, high = (np.exp(end) if quantity.positive else end for end in ends)
    return float(low), float(high)


def _steps(growth: Any, reach: float, most: float) -> float:
    """The deviations after which `growth` is zero, infinite if it never is."""
    from scipy.optimize import brentq

    inner, outer = 0.0, reach
    while growth(outer) < 0:
        inner, outer = outer, 2.0 * outer
        if outer > max(most, 4.0 * reach):
            return np.inf

    def known(steps: float) -> float:
        return growth(steps) if steps > 0 else -(reach**2)

    steps: Any = brentq(known, inner, outer, xtol=1e-2 * reach)
    return float(steps)


@eqx.filter_jit
def _held(
    start: Parameters, fit: Fit, index: int, target: Array, width: Array, solver: Any
) -> tuple[Parameters, Array]:
    """The best point with a reported quantity held at `target`, and its misfit without the hold."""
    args = (fit.problem, fit.noises, jnp.ones_like(fit.problem.records.t))

    def held(parameters: Parameters, _: Any) -> Any:
        value = quantities.vector(fit.problem, parameters)[index]
        return residuals(parameters, args), (value - target) / width

    least: Any = optx.least_squares
    out = least(held, solver, start, None, options={"jac": "fwd"}, max_steps=100, throw=False)
    return out.value, misfit(out.value, args)
