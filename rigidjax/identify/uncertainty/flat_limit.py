"""Flat bodies, I1 + I2 = I3: the limit of real bodies, with derivatives and intervals near it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.symmetric3 import swap_trace
from rigidjax.identify.model.charts import AbstractBodyChart, as_list, charts_of, numbers_of
from rigidjax.identify.model.model import Model

# Derivatives are taken where the least second moment is at least this share of the trace.
THIN = 1e-4
# The quantile of a one-sided bound of 95 %.
ONE_SIDED = 1.645


class Limit(eqx.Module):
    """The distance of a body from a flat one: `flatness = (I1 + I2 − I3) / I3` at the best point,
    `free` its value in the linear model, which may be negative, `slope` (n,) its derivative;
    `where` is the suffix of the names of the body's quantities.
    """

    where: str
    flatness: float
    free: float
    slope: np.ndarray

    def deviation(self, covariance: np.ndarray) -> float:
        """The standard deviation of the flatness; NaN where there is none."""
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(self.slope @ covariance @ self.slope))

    def bound(self, covariance: np.ndarray) -> float:
        """The flatness is at most this (95 %, one-sided)."""
        wide = self.deviation(covariance)
        return self.free + float(np.hypot(ONE_SIDED * wide, min(self.free, 0.0)))

    def is_near(self, covariance: np.ndarray, reach: float) -> bool:
        """Whether a flat body is within `reach` standard deviations."""
        return bool(self.free < reach * self.deviation(covariance))


def ends(
    reach: np.ndarray | float, correlation: np.ndarray | float, away: float
) -> tuple[np.ndarray, np.ndarray]:
    """The ends of an interval from its middle, in standard deviations, cut at a flat body.

    They follow from the likelihood ratio of two Gaussian numbers, one of them not negative:
    `m²(y) = min over z ≥ 0`. **Arguments:** `reach` the quantile; `correlation` of the number y
    with the flatness z; `away` the free flatness over its standard deviation.
    """
    rho = np.clip(np.asarray(correlation), -1.0, 1.0)
    past = min(away, 0.0)
    middle, square = rho * past, reach**2 + past**2

    def end(side: float) -> np.ndarray:
        free = middle + side * np.sqrt(square)
        held = middle - rho * away
        held = held + side * np.sqrt((1.0 - rho**2) * np.maximum(square - away**2, 0.0))
        return np.where(away + rho * (free - middle) >= 0, free, held)

    return end(-1.0), end(1.0)


def thickened(model: Model, x: Float[Array, " n"]) -> Float[Array, " n"] | None:
    """Return the free numbers x with flat bodies a little thicker; `None` if no body is flat.

    The chart has a derivative of zero at a flat body; the information about the tensor itself is
    regular there and hardly changes over such a small thickness.
    """
    thick = list(map(_thicker, charts_of(model.chart), bodies_of(model, x)))
    if all(one is None for one in thick):
        return None
    pairs = zip(numbers_of(model.chart, x[: model.index.bodies]), thick, strict=True)
    vectors = [old if new is None else new for old, new in pairs]
    return jnp.concatenate([*vectors, x[model.index.bodies :]])


@eqx.filter_jit
def bodies_of(model: Model, x: Float[Array, " n"]) -> list[Any]:
    """Return the bodies of a fit, in the order of their charts."""
    # As one program: outside of a trace each operation of JAX costs as much as a run of 100 steps.
    return as_list(model.bodies(x))


def _thicker(chart: AbstractBodyChart, body: Inertia | MassProperties) -> Array | None:
    """The chart's numbers of a thicker body, if it is flat and the chart is one of ours."""
    # By NumPy, for an operation of JAX outside of a trace costs as much as a run of 100 steps.
    if isinstance(body, MassProperties):
        second = np.asarray(body.second_moment)
    else:
        tensor = np.asarray(body.tensor)
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    if not _has_limit(chart) or not np.isfinite(second).all():
        return None
    values, axes = np.linalg.eigh(second)
    least = THIN * values.sum()
    if values[0] >= least:
        return None
    second = jnp.asarray((axes * np.maximum(values, least)) @ axes.T)
    if isinstance(body, MassProperties):
        return chart.vector(MassProperties(body.mass, body.com, second))
    return chart.vector(Inertia(swap_trace(second)))


def _has_limit(chart: AbstractBodyChart) -> bool:
    return type(chart).__module__ == AbstractBodyChart.__module__ and any(
        name != "mass" for name in chart.log_names
    )


def flatness(model: Model, x: Float[Array, " n"]) -> Float[Array, " bodies"]:
    """Return (I1 + I2 − I3) / I3 of each body; 1 of one whose moments are not free."""
    out = []
    bodies = as_list(model.bodies(x))
    for chart, body in zip(charts_of(model.chart), bodies, strict=True):
        if not _has_limit(chart):
            out.append(jnp.ones((), x.dtype))
            continue
        # Up to scale, as they are reported: two ratios, or three moments after a mass.
        logs = chart.logs(body)[-3:]
        logs = logs if logs.size == 3 else jnp.append(logs, 0.0)
        low, middle, high = jnp.sort(jnp.exp(logs - jnp.max(logs)))
        # Round-off may make the flatness of a flat body negative.
        out.append(jnp.maximum(low + middle - high, 0.0) / high)
    return jnp.stack(out)


def limits(
    model: Model, found: tuple[np.ndarray, np.ndarray], step: np.ndarray, names: list[str]
) -> tuple[Limit, ...]:
    """The limit of each body whose moments are free.

    `found` are numbers and derivatives, the flatness of each body last; `step` (n,) leads to the
    least misfit of the linear model; `names` are the suffixes of the bodies' quantities.
    """
    rows = zip(names, *(part[-len(names) :] for part in found), strict=True)
    kept = [_has_limit(chart) for chart in charts_of(model.chart)]
    return tuple(
        Limit(name, float(value), float(value + min(slope @ step, 0.0)), slope)
        for (name, value, slope), one in zip(rows, kept, strict=True)
        if one
    )


def unreal(body: Any) -> str | None:
    """The error in a body's numbers, in words; `None` for a real body."""
    try:
        if isinstance(body, MassProperties):
            MassProperties(body.mass, body.com, body.second_moment)
        else:
            Inertia.from_tensor(body.tensor)
    except ValueError as refused:
        return f"no real body has these numbers: {refused}"
    return None


def of_charts(charts: list[tuple[str, AbstractBodyChart]], bodies: list[Any]) -> list[str]:
    """`unreal` for the bodies of charts by users: every point of our charts is a real body."""
    ours = AbstractBodyChart.__module__
    theirs = [
        (n, b) for (n, c), b in zip(charts, bodies, strict=True) if type(c).__module__ != ours
    ]
    return [wrong + name for name, body in theirs if (wrong := unreal(body))]
