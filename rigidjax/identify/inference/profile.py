"""Profile intervals: the range of a quantity in which the best misfit grows little."""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax._types import Scalar
from rigidjax.identify.answer.result import Fit, one_fit
from rigidjax.identify.data import stacking
from rigidjax.identify.model.model import AbstractPull, Model
from rigidjax.identify.search.stages import Attempt, Task, cost_of, polish
from rigidjax.identify.uncertainty import quantities
from rigidjax.identify.uncertainty.degrees_of_freedom import quantile

# The width of a pull, in standard deviations: a stiff one makes the search slow.
PULL = 0.3


class Pull(AbstractPull):
    """The residual that pulls a quantity (number `index`) to a `target`, of deviation `width`."""

    index: Int[Array, ""]
    target: Scalar
    width: Scalar

    def __call__(self, model: Model, x: Float[Array, " n"]) -> Float[Array, "1"]:
        value = quantities.vector(model, x)[self.index]
        return ((value - self.target) / self.width)[None]


def profile(fit: Fit, name: str, level: float = 0.95) -> tuple[float, float]:
    """The profile interval (low, high) of one reported quantity.

    The other numbers are fitted again with the quantity at other values; at the ends twice the
    misfit has grown by the square of the quantile, `t²`, times the samples over which errors are
    autocorrelated. Trust it if the misfit is not quadratic (a weakly determined quantity, or one
    near a boundary). **Arguments:** `fit`; `name` as in `fit.interval()`; `level` the probability.
    **Returns** the interval, infinite or 0 on a side where the misfit never grows that far within a
    factor of 1e3 (or 1e3 standard deviations).

    **Raises:** `ValueError` for a name that is not reported, a level outside (0, 1). Source: Raue
    et al. 2009, doi:10.1093/bioinformatics/btp358.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model())
    >>> low, high = profile(found, "Ix/Iz")
    >>> low < 3.1 < high
    True
    """
    one_fit(fit)
    names = [quantity.name for quantity in fit.quantities]
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"profile: no quantity {name!r}; wanted one of {', '.join(names)}")
    index = names.index(name)
    quantity = fit.quantities[index]
    reach = float(quantile(level, quantity.freedom))
    middle = np.log(quantity.value) if quantity.positive else quantity.value
    deviation = quantities.reported_deviation(quantity)
    wide = np.log(1e3) if quantity.positive else 1e3 * max(abs(middle), 1e-12)
    if not np.isfinite(deviation) or deviation <= 0:
        deviation = wide / 10
    model, kind = stacking.of_few_lengths(fit.model), fit.model.records.t.dtype
    bottom = 2.0 * cost_of(model, fit.x, fit.noises)
    shares = max(fit.correlation, 1.0)
    ends = []
    for side in (-1.0, 1.0):
        point = fit.x

        @functools.cache
        def pulled(steps: float, side: float = side) -> tuple[float, float]:
            # A weak pull: its best point has the least misfit of its own value, wherever that is.
            nonlocal point
            size = middle + side * steps * deviation, PULL * deviation
            target, width = (jnp.asarray(x, kind) for x in size)
            pull = Pull(jnp.asarray(index, jnp.int32), target, width)
            pulled_model = eqx.tree_at(
                lambda m: m.pull, model, pull, is_leaf=lambda node: node is None
            )
            point = polish(Attempt(point), Task(pulled_model, fit.noises, 1e-4, 100)).x
            grown = (2.0 * cost_of(model, point, fit.noises) - bottom) / shares - reach**2
            return grown, float(_value(model, point)[index])

        ends.append(_end(pulled, reach, wide / deviation, side))
    low, high = (np.exp(end) if quantity.positive else end for end in ends)
    return float(low), float(high)


_value = eqx.filter_jit(quantities.vector)


def _end(pulled: Any, reach: float, most: float, side: float) -> float:
    from scipy.optimize import brentq

    inner, outer = 0.0, reach
    while pulled(outer)[0] < 0:
        inner, outer = outer, 2.0 * outer
        if outer > max(most, 4.0 * reach):
            return side * np.inf

    def grown(steps: float) -> float:
        return pulled(steps)[0] if steps > 0 else -(reach**2)

    return pulled(brentq(grown, inner, outer, xtol=1e-2 * reach))[1]  # pyright: ignore
