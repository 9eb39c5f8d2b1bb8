"""Compute derivatives and intervals at flat bodies, the limit of real bodies.

The principal moments of a flat body are I1 + I2 = I3.
"""

from collections.abc import Sequence
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
    - `slope`: (n,) the derivative of the flatness with respect to the n parameters.
    """

    where: str
    flatness: float
    free: float
    slope: np.ndarray

    def flatness_deviation(self, covariance: np.ndarray) -> float:
        """Return the standard deviation of the flatness, NaN if its variance is negative, for a
        `covariance` (n, n) of the parameters.
        """
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(self.slope @ covariance @ self.slope))

    def flatness_upper_bound(self, covariance: np.ndarray) -> float:
        """Return the one-sided 95 % upper bound of the flatness, `z + √((1.645 σ)² + min(z, 0)²)`,
        where z is the field `free`, and σ the deviation for the `covariance` (n, n).
        """
        wide = self.flatness_deviation(covariance)
        return self.free + float(np.hypot(ONE_SIDED * wide, min(self.free, 0.0)))

    def is_flat_within(self, covariance: np.ndarray, deviations: float) -> bool:
        """Return whether the field `free` is less than `deviations` standard deviations of the
        flatness, for a `covariance` (n, n): the data then allow that this body is flat.
        """
        return bool(self.free < deviations * self.flatness_deviation(covariance))


def cut_interval(
    half_width: np.ndarray | float, correlation: np.ndarray | float, flatness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (low, high) of the interval of a number y, cut at a flat body, as differences
    from the best value in standard deviations of y.

    The ends follow from a likelihood ratio. Both y and the flatness z are taken as normal, and
    m²(y, z) is their squared Mahalanobis distance from the minimum of the linearised model. Since a
    real body has z ≥ 0, the distance for one number y is `m²(y) = min over z ≥ 0 of m²(y, z)`. The
    `half_width` is that without the limit, `correlation` is that of y with z, and `flatness` is z
    at the minimum, divided by its deviation.
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


def thicken(model: Model, x: Float[Array, " n"]) -> Float[Array, " n"] | None:
    """Return the parameters x with each flat body made thicker; `None` if no body is flat.

    The parameters describe a square root of the second moments of the body, so that the derivative
    of its thickness with respect to x is zero at a flat body: derivatives are computed at a
    slightly thicker one. The information on the inertia tensor itself is hardly different there.
    """
    thick = list(map(_thicker_body, model.charts, bodies_at(model, x)))
    if all(one is None for one in thick):
        return None
    pairs = zip(split_numbers(model.charts, x[: model.index.bodies]), thick, strict=True)
    vectors = [old if new is None else new for old, new in pairs]
    return jnp.concatenate([*vectors, x[model.index.bodies :]])


def bodies_at(model: Model, x: Float[Array, " n"]) -> list[Any]:
    """Return the bodies of a `model` in the order of its charts."""
    return body_list(model.unpack(x).body)


def _thicker_body(chart: AbstractBodyChart, body: Inertia | MassProperties) -> Array | None:
    """Return the parameters of a slightly thicker body, or `None` if `body` is not flat.

    The result is `None` as well for NaN, and for a `chart` without a limit at flat bodies.
    """
    # Use NumPy: single operations of JAX are slow outside of a compiled program.
    if isinstance(body, MassProperties):
        second = np.asarray(body.second_moment)
    else:
        tensor = np.asarray(body.tensor)
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    if not _has_limit(chart) or not np.isfinite(second).all():
        return None
    values, axes = np.linalg.eigh(second)
    least = THIN * values.sum()
    # A body whose best size is zero, a point, has no shape to make thicker.
    if values[0] >= least or not least > np.finfo(float).tiny:
        return None
    second = jnp.asarray((axes * np.maximum(values, least)) @ axes.T)
    if isinstance(body, MassProperties):
        thicker = MassProperties(body.mass, body.com, second)
    else:
        thicker = Inertia(to_inertia(second))
    return eqx.filter_jit(chart.vector)(thicker)


def _has_limit(chart: AbstractBodyChart) -> bool:
    """Return whether flat bodies are the limit of the bodies that a `chart` can describe: one of
    rigidjax, not of a user, that changes moments of inertia.
    """
    return type(chart).__module__ == AbstractBodyChart.__module__ and any(
        name != "mass" for name in chart.log_names
    )


def flatness(model: Model, x: Float[Array, " n"]) -> Float[Array, " bodies"]:
    """Return the flatness (I1 + I2 − I3) / I3 of each body at x; 1 if the moments are known."""
    out = []
    bodies = body_list(model.bodies(x))
    for chart, body in zip(model.charts, bodies, strict=True):
        if not _has_limit(chart):
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


def limits(
    model: Model,
    quantities: tuple[np.ndarray, np.ndarray],
    step_to_minimum: Float[np.ndarray, " n"],
    body_suffixes: list[str],
) -> tuple[Limit, ...]:
    """Return the `Limit` of each body with free moments.

    The rows of `quantities`, as `quantities_on_host` returns them, end with the flatness of each
    body; `step_to_minimum` leads from the best point to the minimum of the linearised model.
    """
    last = (part[-len(body_suffixes) :] for part in quantities)
    rows = zip(model.charts, body_suffixes, *last, strict=True)
    return tuple(
        Limit(name, float(value), float(value + min(slope @ step_to_minimum, 0.0)), slope)
        for chart, name, value, slope in rows
        if _has_limit(chart)
    )


def why_unreal(body: PyTree) -> str | None:
    """Return in words why no real body has the numbers of an `Inertia` or a `MassProperties`."""
    try:
        if isinstance(body, MassProperties):
            MassProperties(body.mass, body.com, body.second_moment)
        else:
            Inertia.from_tensor(body.tensor)
    except ValueError as refused:
        return f"no real body has these numbers: {refused}"
    return None


def describe_unreal(
    charts: Sequence[tuple[str, AbstractBodyChart]], bodies: list[Any]
) -> list[str]:
    """Return one line of text for each body that is physically impossible, with the reason.

    Only bodies of charts that a user wrote are checked: those of rigidjax are always possible.
    """
    ours = AbstractBodyChart.__module__
    theirs = [
        (n, b) for (n, c), b in zip(charts, bodies, strict=True) if type(c).__module__ != ours
    ]
    return [wrong + name for name, body in theirs if (wrong := why_unreal(body))]
