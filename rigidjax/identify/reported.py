"""The quantities that a fit reports by name, their values, deviations and intervals."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.identify.problem import Parameters, Problem

if TYPE_CHECKING:
    from rigidjax.identify.fit import Fit


class Quantity(eqx.Module):
    """A number with a name: its value, standard deviation (of the log where positive), unit."""

    name: str
    value: float
    deviation: float
    unit: str
    positive: bool

    def interval(self, reach: float) -> tuple[float, float]:
        """Low and high, `reach` standard deviations away; through the log where positive."""
        if self.positive:
            with np.errstate(over="ignore"):
                low, high = self.value * np.exp(np.array([-1.0, 1.0]) * reach * self.deviation)
        else:
            low, high = self.value - reach * self.deviation, self.value + reach * self.deviation
        return float(low), float(high)


def labels(problem: Problem) -> list[tuple[str, str, bool]]:
    """Name, unit and whether positive, in the order of `vector`."""
    chart = problem.body
    out = [(name, chart.unit, True) for name in chart.log_names]
    out += [(name, chart.unit, False) for name in chart.plain_names]
    for record in range(problem.count):
        where = "" if problem.count == 1 else f" [{record}]"
        out += [(f"Ω{axis}{where}", "rad/s", False) for axis in "xyz"]
    for slot in problem.slots:
        shape = np.shape(slot.read(problem.records))[1:]
        parts = [""] if not shape else [f" {_place(i)}" for i in np.ndindex(shape)]
        for record in range(problem.count if slot.each else 1):
            where = f" [{record}]" if slot.each and problem.count > 1 else ""
            out += [(f"{slot.name}{part}{where}", "", slot.positive) for part in parts]
    return out


def _place(index: tuple[int, ...]) -> str:
    return "xyz"[index[0]] if len(index) == 1 and index[0] < 3 else str(index)


def vector(problem: Problem, parameters: Parameters) -> Array:
    """The reported quantities, logarithms of those that are positive."""
    chart = problem.body
    body = chart.body(parameters.body)
    rates = parameters.own.spin * problem.reference.rate[:, None]
    parts = [chart.logs(body), chart.plain(body), rates.reshape(-1)]
    values = problem.values(parameters)
    for slot in problem.slots:
        value = values[slot.name].reshape(-1)
        parts.append(jnp.log(value) if slot.positive else value)
    return jnp.concatenate([part.astype(rates.dtype) for part in parts])


@eqx.filter_jit
def _value_and_slope(problem: Problem, parameters: Parameters) -> tuple[Array, Array]:
    flat, restore = ravel_pytree(parameters)

    def value(x: Array) -> Array:
        return vector(problem, restore(x))

    return value(flat), jax.jacfwd(value)(flat)


def quantities(
    problem: Problem, parameters: Parameters, covariance: np.ndarray, null: np.ndarray
) -> tuple[Quantity, ...]:
    """Every reported quantity with its standard deviation.

    **Arguments:** `covariance` (n, n) within what is seen; `null` (k, n) what is not.
    """
    values, slope = (np.asarray(x) for x in _value_and_slope(problem, parameters))
    deviations = carried(slope, covariance, null)
    out = []
    for (name, unit, positive), value, deviation in zip(
        labels(problem), values, deviations, strict=True
    ):
        shown = float(np.exp(value)) if positive else float(value)
        out.append(Quantity(name, shown, float(deviation), unit, positive))
    return tuple(out)


def carried(slope: np.ndarray, covariance: np.ndarray, null: np.ndarray) -> np.ndarray:
    """Standard deviations of functions with this derivative (…, n).

    Infinite where the function changes along a direction of `null` (k, n).
    """
    size = np.abs(slope).max(axis=-1, initial=1e-300)
    along = np.abs(slope @ null.T).max(axis=-1, initial=0.0)
    touched = along > 1e-6 * size
    variance = np.einsum("...i,ij,...j->...", slope, covariance, slope)
    return np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def interval_of(
    fit: "Fit", of: Callable[[Any, Any], Any], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """See `Fit.interval_of`."""
    _checks.function(of, "of", "(body, state0) → array")
    flat, restore = ravel_pytree(fit.parameters)

    def value(x: Array) -> Array:
        return _checks.numbers(of(*fit.problem.unpack(restore(x))), "of(body, state0)")

    middle = np.asarray(_checks.finite(value(flat), "of(body, state0)"))
    slope = np.asarray(jax.jacfwd(value)(flat))
    found = carried(slope, np.asarray(fit.seen), np.asarray(fit.null_directions))
    reach = quantile(fit, level) * found
    return np.asarray(middle - reach), np.asarray(middle + reach)


def quantile(fit: "Fit", level: float) -> float:
    """Half-width of an interval in standard deviations: Student's where the noise is estimated.

    Errors that hang together count as the fewer they are.
    """
    level = _checks.positive(level, "level", "a level between 0 and 1")
    if not level < 1:
        raise ValueError(f"interval: wanted a level between 0 and 1, got {level}")
    from scipy.special import ndtri, stdtrit

    tail = 0.5 * (1 + level)
    sensors = fit.problem.records.sensors
    if all(sensor.noise is not None for sensor in sensors) and fit.correlation <= 1.5:
        return float(ndtri(tail))
    return float(stdtrit(max(fit.independent - fit.covariance.shape[0], 2.0), tail))
