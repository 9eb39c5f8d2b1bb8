"""Compute derivatives and intervals at flat bodies, the limit of real bodies.

The principal moments of a flat body are I1 + I2 = I3.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.symmetric3 import to_inertia
from rigidjax.identify.model.charts import (
    AbstractBodyChart,
    body_list,
    chart_list,
    split_numbers,
)
from rigidjax.identify.model.model import Model

# Derivatives are computed at a body whose smallest second moment is at least this fraction of the
# sum of its three second moments.
THIN = 1e-4
# A one-sided bound of 95 % lies this many standard deviations away.
ONE_SIDED = 1.645


class Limit(eqx.Module):
    """Hold the distance of a body from a flat body, `(I1 + I2 − I3) / I3`, called its flatness.

    The principal moments of the body are I1 ≤ I2 ≤ I3. The flatness of a flat body is zero.

    **Fields:**

    - `where`: the suffix of the names of this body's quantities, such as " [moon]".
    - `flatness`: the flatness at the best point of the fit.
    - `free`: the flatness at the minimum of the linearised model, or `flatness` if that is smaller.
      It is negative if the minimum lies beyond the limit of real bodies.
    - `slope`: (n,) the derivative of the flatness with respect to the n free numbers.
    """

    where: str
    flatness: float
    free: float
    slope: np.ndarray

    def flatness_deviation(self, covariance: np.ndarray) -> float:
        """Return the standard deviation of the flatness `(I1 + I2 − I3) / I3` of this body, or NaN
        if the variance of the flatness is negative.

        The argument `covariance` (n, n) is the covariance of the n free numbers.
        """
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(self.slope @ covariance @ self.slope))

    def flatness_upper_bound(self, covariance: np.ndarray) -> float:
        """Return the one-sided 95 % upper bound of the flatness `(I1 + I2 − I3) / I3` of this body.

        The bound is `z + √((1.645 σ)² + min(z, 0)²)`, where z is the field `free` (the flatness at
        the minimum of the linearised model, or at the best point if it is smaller there), and σ is
        the standard deviation of the flatness. The argument `covariance` (n, n) is the covariance
        of the n free numbers.
        """
        wide = self.flatness_deviation(covariance)
        return self.free + float(np.hypot(ONE_SIDED * wide, min(self.free, 0.0)))

    def is_flat_within(self, covariance: np.ndarray, deviations: float) -> bool:
        """Return whether the data allow that this body is flat (I1 + I2 = I3).

        They do if the field `free` (the flatness at the minimum of the linearised model, or at the
        best point if it is smaller there) is less than `deviations` standard deviations of the
        flatness. The argument `covariance` (n, n) is the covariance of the n free numbers.
        """
        return bool(self.free < deviations * self.flatness_deviation(covariance))


def interval_ends_at_flat_body(
    half_width: np.ndarray | float, correlation: np.ndarray | float, flatness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (low, high) of an interval that stops at a flat body, in standard deviations.

    The interval is for a number y that is correlated with the flatness z of a body. An end is the
    difference from the best value of y, divided by the standard deviation of y.

    The ends follow from a likelihood ratio. Both y and z are taken as normally distributed, and
    m²(y, z) is their squared Mahalanobis distance from the minimum of the linearised model. Since a
    real body has z ≥ 0, the distance for one number y is `m²(y) = min over z ≥ 0 of m²(y, z)`.

    **Arguments:**

    - `half_width`: the half-width of the interval without the limit z ≥ 0, in standard deviations.
    - `correlation`: the correlation of y with z.
    - `flatness`: the value of z at the minimum of the linearised model, divided by the standard
      deviation of z.
    """
    rho = np.clip(np.asarray(correlation), -1.0, 1.0)
    past = min(flatness, 0.0)
    middle, square = rho * past, half_width**2 + past**2

    def end(side: float) -> np.ndarray:
        free = middle + side * np.sqrt(square)
        held = middle - rho * flatness
        held = held + side * np.sqrt((1.0 - rho**2) * np.maximum(square - flatness**2, 0.0))
        return np.where(flatness + rho * (free - middle) >= 0, free, held)

    return end(-1.0), end(1.0)


def thicken_flat_bodies(model: Model, x: Float[Array, " n"]) -> Float[Array, " n"] | None:
    """Return the free numbers x (n,) with each flat body made thicker; `None` if no body is flat.

    A flat body has the principal moments I1 + I2 = I3, or nearly so. The numbers x describe a
    square root of the second moments of the body, so that the derivative of its thickness with
    respect to x is zero at a flat body. Therefore derivatives are computed at a slightly thicker
    body. The information on the inertia tensor itself is hardly different there. The `model` gives
    the chart of each body, which is its parametrisation by free numbers.
    """
    thick = list(map(_numbers_of_thicker_body, chart_list(model.chart), bodies_at(model, x)))
    if all(one is None for one in thick):
        return None
    pairs = zip(split_numbers(model.chart, x[: model.index.bodies]), thick, strict=True)
    vectors = [old if new is None else new for old, new in pairs]
    return jnp.concatenate([*vectors, x[model.index.bodies :]])


def bodies_at(model: Model, x: Float[Array, " n"]) -> list[Any]:
    """Return the bodies of a `model` at its free numbers x (n,), in the order of the model's
    charts.

    A chart is the parametrisation of one body by free numbers.
    """
    return body_list(model.unpack(x).body)


def _numbers_of_thicker_body(
    chart: AbstractBodyChart, body: Inertia | MassProperties
) -> Array | None:
    """Return the free numbers of a slightly thicker body, or `None` for a body that is not flat.

    A flat body has the principal moments I1 + I2 = I3, or nearly so. The result is also `None` for
    a `body` with NaN, for a `chart` that leaves the moments fixed, and for a chart that a user
    wrote, since it is not known how such a chart describes flat bodies.

    **Arguments:**

    - `chart`: the chart, a map from free numbers to a possible body. The free numbers are those of
      this chart.
    - `body`: the body that may be flat.
    """
    # Use NumPy: single operations of JAX are slow outside of a compiled program.
    if isinstance(body, MassProperties):
        second = np.asarray(body.second_moment)
    else:
        tensor = np.asarray(body.tensor)
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    if not _is_bounded_by_flat_bodies(chart) or not np.isfinite(second).all():
        return None
    values, axes = np.linalg.eigh(second)
    least = THIN * values.sum()
    if values[0] >= least:
        return None
    second = jnp.asarray((axes * np.maximum(values, least)) @ axes.T)
    if isinstance(body, MassProperties):
        return chart.vector(MassProperties(body.mass, body.com, second))
    return chart.vector(Inertia(to_inertia(second)))


def _is_bounded_by_flat_bodies(chart: AbstractBodyChart) -> bool:
    """Return whether flat bodies are the limit of the bodies that a `chart` can describe.

    A chart is a map from free numbers to a possible body. A flat body has the principal moments
    `I1 + I2 = I3`. The result is true if the chart is one of rigidjax, not of a user, and
    changes moments of inertia, not the mass alone.
    """
    return type(chart).__module__ == AbstractBodyChart.__module__ and any(
        name != "mass" for name in chart.log_names
    )


def flatness(model: Model, x: Float[Array, " n"]) -> Float[Array, " bodies"]:
    """Return the flatness (I1 + I2 − I3) / I3 of each body of a `model` at the free numbers x (n,).

    Here I1 ≤ I2 ≤ I3 are the principal moments of the body. A flat body has the flatness 0. For a
    body whose moments are not free the result is 1.
    """
    out = []
    bodies = body_list(model.bodies(x))
    for chart, body in zip(chart_list(model.chart), bodies, strict=True):
        if not _is_bounded_by_flat_bodies(chart):
            out.append(jnp.ones((), x.dtype))
            continue
        # `chart.logs` returns the logarithms of the positive numbers that a fit reports. The last
        # ones belong to the three moments or, for a chart of ratios, to the ratios of two moments
        # to the third moment; the logarithm 0 of the third ratio, which is one, is then added.
        logs = chart.logs(body)[-3:]
        logs = logs if logs.size == 3 else jnp.append(logs, 0.0)
        low, middle, high = jnp.sort(jnp.exp(logs - jnp.max(logs)))
        # Round-off may make the flatness of a flat body negative.
        out.append(jnp.maximum(low + middle - high, 0.0) / high)
    return jnp.stack(out)


def distances_from_flat_bodies(
    model: Model,
    values_and_slopes: tuple[np.ndarray, np.ndarray],
    step_to_minimum: np.ndarray,
    body_suffixes: list[str],
) -> tuple[Limit, ...]:
    """Return how far each body with free moments is from a flat body.

    A flat body has the principal moments I1 + I2 = I3.

    **Arguments:**

    - `model`: the fitted model.
    - `values_and_slopes`: two arrays, as `quantities_and_derivatives_in_numpy` returns them: the
      reported numbers, with the flatness of each body at the end; and their derivatives with
      respect to the n free numbers.
    - `step_to_minimum`: (n,) the step of the free numbers from the best point to the minimum of the
      linearised model.
    - `body_suffixes`: for each body the suffix of the names of its quantities.
    """
    rows = zip(
        body_suffixes, *(part[-len(body_suffixes) :] for part in values_and_slopes), strict=True
    )
    have_limits = [_is_bounded_by_flat_bodies(chart) for chart in chart_list(model.chart)]
    return tuple(
        Limit(name, float(value), float(value + min(slope @ step_to_minimum, 0.0)), slope)
        for (name, value, slope), has_limit in zip(rows, have_limits, strict=True)
        if has_limit
    )


def why_unreal(body: PyTree) -> str | None:
    """Return in words why the numbers of `body`, an `Inertia` or a `MassProperties`, are physically
    impossible; `None` if they are possible.
    """
    try:
        if isinstance(body, MassProperties):
            MassProperties(body.mass, body.com, body.second_moment)
        else:
            Inertia.from_tensor(body.tensor)
    except ValueError as refused:
        return f"no real body has these numbers: {refused}"
    return None


def describe_unreal_bodies(
    charts: list[tuple[str, AbstractBodyChart]], bodies: list[Any]
) -> list[str]:
    """Return one line of text for each body that is physically impossible, with the reason.

    Only bodies of charts that a user wrote are checked, since all points of the charts of rigidjax
    are possible bodies. **Arguments:** `charts` the name and the chart of each body;
    `bodies` the bodies in the same order.
    """
    ours = AbstractBodyChart.__module__
    theirs = [
        (n, b) for (n, c), b in zip(charts, bodies, strict=True) if type(c).__module__ != ours
    ]
    return [wrong + name for name, body in theirs if (wrong := why_unreal(body))]
