"""Compute profile intervals, in which the least misfit for each value of a quantity stays small."""

import functools
from collections.abc import Callable

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
        def growth_and_value_at(steps: float, side: float = side) -> tuple[float, float]:
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
            return grown, float(_value(model, point)[index])

        ends.append(_profile_interval_end(growth_and_value_at, reach, wide / deviation, side))
    low, high = (np.exp(end) if quantity.positive else end for end in ends)
    return float(low), float(high)


_value = eqx.filter_jit(quantities.quantity_vector)


def _profile_interval_end(
    growth_and_value_at: Callable[[float], tuple[float, float]],
    first_distance: float,
    largest_distance: float,
    side: float,
) -> float:
    """Return one end of a profile interval of a quantity, or infinity if the search finds no end.

    The misfit is minimised over all other numbers here. Its growth is twice its difference from the
    least misfit, divided by the number of samples over which errors are autocorrelated. At an end
    of the interval the growth is the square of `first_distance`. An infinite end has the sign of
    `side`.

    **Arguments:**

    - `growth_and_value_at`: a function that fits the model with the quantity pulled towards a
      target. Given the distance of the target from the best value, in standard deviations, it
      returns two numbers: the growth of the misfit minus the square of `first_distance`; and the
      value of the quantity (its logarithm, if the quantity is positive).
    - `first_distance`: the first distance to try, in standard deviations.
    - `largest_distance`: the search is given up beyond this distance or four times
      `first_distance`, whichever is larger, in standard deviations.
    - `side`: −1 for the lower end of the interval, 1 for the upper end.
    """
    from scipy.optimize import brentq

    inner, outer = 0.0, first_distance
    while growth_and_value_at(outer)[0] < 0:
        inner, outer = outer, 2.0 * outer
        if outer > max(largest_distance, 4.0 * first_distance):
            return side * np.inf

    def misfit_excess(steps: float) -> float:
        return growth_and_value_at(steps)[0] if steps > 0 else -(first_distance**2)

    return growth_and_value_at(brentq(misfit_excess, inner, outer, xtol=1e-2 * first_distance))[1]  # pyright: ignore
