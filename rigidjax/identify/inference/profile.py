"""Compute profile intervals, in which the least misfit for each value of a quantity stays small."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax._types import Scalar
from rigidjax.identify.answer.result import Fit, require_one_fit
from rigidjax.identify.data import stacking
from rigidjax.identify.model.model import AbstractPull, Model
from rigidjax.identify.search.stages import Attempt, Task, cost_of, search_whole
from rigidjax.identify.uncertainty import quantities
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile

# The residual of a `Pull` has this standard deviation, in units of the standard deviation of the
# quantity. A smaller standard deviation would slow the search down.
PULL = 0.3


class Pull(AbstractPull):
    """Hold an additional residual, by which a fit pulls a reported quantity towards a target.

    The residual is (value − `target`) / `width`.

    **Fields:**

    - `index`: the index of the quantity among all reported quantities.
    - `target`: the value to which the quantity is pulled (for a positive quantity, its logarithm).
    - `width`: the standard deviation of value − `target`.
    """

    index: Int[Array, ""]
    target: Scalar
    width: Scalar

    def __call__(self, model: Model, x: Float[Array, " n"]) -> Float[Array, "1"]:
        value = quantities.quantity_vector(model, x)[self.index]
        return ((value - self.target) / self.width)[None]


class _Point(NamedTuple):
    """Hold the end of a fit with a quantity pulled away from its best value."""

    excess: float  # of the growth of twice the misfit over that at the end of the interval
    value: float  # of the quantity, or its logarithm if it is positive


_value = eqx.filter_jit(quantities.quantity_vector)


def profile(fit: Fit, name: str, level: float = 0.95) -> tuple[float, float]:
    """Return the profile interval (low, high) of one reported quantity.

    The quantity is moved to other values, and all other numbers are fitted again at each value. The
    interval ends where twice the misfit has grown by t² times the number of samples over which
    errors are autocorrelated. Here t is the quantile of Student's distribution for the `level`.
    The profile interval is better than the interval of `fit.interval()` if the misfit is not a
    quadratic function, as for a quantity that is weakly determined or near a boundary. Source: Raue
    et al. 2009, doi:10.1093/bioinformatics/btp358.

    **Arguments:**

    - `fit`: a result of `identify.fit`.
    - `name`: the name of the quantity, as in `fit.interval()`.
    - `level`: the probability that the interval holds the true value.

    **Returns** the interval. If the misfit does not grow enough, the upper end is infinite, and the
    lower end is −infinity, or 0 for a positive quantity. The search for an end stops at a factor of
    1e3 for a positive quantity, and at a change of 1e3 times the value for another quantity.
    **Raises:** `ValueError` for a name that is not reported, and for a level outside (0, 1).

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> low, high = profile(result, "Ix/Iz")
    >>> low < 3.1 < high
    True
    """
    from scipy.optimize import brentq

    require_one_fit(fit)
    names = [quantity.name for quantity in fit.quantities]
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"profile: wanted one of {', '.join(names)}, got {name!r}")
    index = names.index(name)
    quantity = fit.quantities[index]
    reach = float(student_quantile(level, quantity.freedom))
    middle = np.log(quantity.value) if quantity.positive else quantity.value
    deviation = quantities.log_deviation(quantity)
    wide = np.log(1e3) if quantity.positive else 1e3 * max(abs(middle), 1e-12)
    if not np.isfinite(deviation) or deviation <= 0:
        deviation = wide / 10
    model, kind = stacking.pad_to_few(fit.model), fit.model.records.t.dtype
    bottom = 2.0 * cost_of(model, fit.x, fit.noises)
    shares = max(fit.correlation, 1.0)
    ends = []
    for side in (-1.0, 1.0):
        point = fit.x

        @functools.cache
        def at(steps: float, side: float = side) -> _Point:
            if steps == 0:
                return _Point(-(reach**2), float(middle))
            # The pull is weak: after the fit the quantity lies between its best value and the
            # target. This makes no error in the profile, because the fitted point has the least
            # misfit of all points with the same value of the quantity.
            nonlocal point
            size = middle + side * steps * deviation, PULL * deviation
            target, width = (jnp.asarray(x, kind) for x in size)
            pull = Pull(jnp.asarray(index, jnp.int32), target, width)
            pulled_model = eqx.tree_at(
                lambda m: m.pull, model, pull, is_leaf=lambda node: node is None
            )
            point = search_whole(Attempt(point), Task(pulled_model, fit.noises, 1e-4, 100)).x
            grown = (2.0 * cost_of(model, point, fit.noises) - bottom) / shares - reach**2
            return _Point(grown, float(_value(model, point)[index]))

        inner, outer, farthest = 0.0, reach, max(wide / deviation, 4.0 * reach)
        while at(outer).excess < 0:
            inner, outer = outer, 2.0 * outer
            if outer > farthest:
                ends.append(side * np.inf)
                break
        else:
            end: Any = brentq(lambda x, at=at: at(x).excess, inner, outer, xtol=1e-2 * reach)
            ends.append(at(end).value)
    low, high = (np.exp(end) if quantity.positive else end for end in ends)
    return float(low), float(high)
