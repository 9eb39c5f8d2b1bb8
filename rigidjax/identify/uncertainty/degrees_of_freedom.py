"""Compute the degrees of freedom of the variances of a fit that estimates noise or spreads."""

from typing import Any, NamedTuple, cast

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from rigidjax import _checks
from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.covariance import CorrelationTimes, Linearisation


class _Width(NamedTuple):
    """Hold an estimated `spread` of a `Free`: the deviation of its values in single recordings."""

    places: Int[np.ndarray, " k"]  # of the recordings' deviations from the shared value
    variance: float  # the square of the `spread`
    freedom: float  # of this variance


class Freedom(eqx.Module):
    """Hold the degrees of freedom of noise and widths, and the covariance that weighs them.

    **Fields:**

    - `covariance`: (n, n) the covariance of the n parameters, for white errors.
    - `of_noise`: the degrees of freedom of the noise that is known worst, of any sensor in any
      group of recordings: the number of its independent errors minus the number of parameters that
      they determine; infinite if all noise is given.
    - `widths`: each estimated `spread` of a `Free`, with its degrees of freedom.
    """

    covariance: np.ndarray
    of_noise: float
    widths: tuple[_Width, ...]

    def of_variance(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom (…,) of the variance of functions with the derivatives
        `slope` (…, n).

        The variance is a sum of parts: one for all noise, and one for each width (Satterthwaite
        1946, doi:10.2307/3002019).
        """
        along = slope @ self.covariance
        variance = np.maximum(np.sum(along * slope, axis=-1), 1e-300)
        rest, inverse = np.ones(variance.shape), np.zeros(variance.shape)
        for mine, size, degrees in self.widths:
            share = np.sum(along[..., mine] ** 2, axis=-1) / (size * variance)
            rest, inverse = rest - share, inverse + share**2 / degrees
        return np.asarray(1.0 / np.maximum(inverse + rest**2 / self.of_noise, 1e-300))


def prepare_freedom(
    model: Model,
    linear: Linearisation,
    times: CorrelationTimes,
    covariance: Float[np.ndarray, "n n"],
) -> Freedom:
    """Return the `Freedom` of a fit, where correlated errors count as fewer independent ones."""
    if model.clusters is not None:
        # The variances of a fit of windows come only from the scatter between C stretches (runs of
        # neighbouring windows), so that they have C − 1 degrees of freedom.
        return Freedom(covariance, max(float(np.max(np.asarray(model.clusters))), 1.0), ())
    groups, least = np.asarray(model.noise_groups), np.inf
    taken = effective_parameters(linear, covariance)
    for sensor, mask, spans, lost in zip(
        model.records.sensors, linear.mask, times.spans, taken, strict=True
    ):
        if sensor.noise is None or times.longest_span > 1.5:
            counts = np.sum(mask.sum(axis=1) / np.asarray(spans), axis=1) - lost
            least = min(least, max(float(np.bincount(groups, counts).min()), 1.0))
    widths = []
    for slot in model.slots:
        if slot.estimated:
            mine, size = np.ravel(slot.own).astype(int), float(cast(Any, slot.spread)) ** 2
            shown = np.eye(mine.size) - covariance[np.ix_(mine, mine)] / size
            widths.append(_Width(mine, size, max(float(np.sum(shown**2)), 1e-12)))
    return Freedom(covariance, least, tuple(widths))


def effective_parameters(
    linear: Linearisation, covariance: np.ndarray
) -> list[Float[np.ndarray, " records"]]:
    """Return for each sensor how many parameters its readings determine in each recording.

    This is the sum of the leverages of the readings: a parameter that they determine together with
    priors, other sensors or other recordings counts as a fraction.
    """
    known = linear.covariance_by_recording(covariance)
    # The information of the readings of a sensor in a recording is JᵀWJ (m, m).
    return [
        np.sum((rows.swapaxes(1, 2) @ rows) * known, axis=(1, 2))
        for rows in linear.weighted_jacobians_by_sensor
    ]


def student_quantile(level: float, degrees_of_freedom: np.ndarray | float) -> np.ndarray:
    """Return the half-width, in standard deviations, of a two-sided interval of the probability
    `level`; `ValueError` for a level outside (0, 1).
    """
    level = _checks.fraction(level, "level", "a level between 0 and 1")
    from scipy.special import ndtri, stdtrit

    tail, least = 0.5 * (1 + level), np.maximum(degrees_of_freedom, 1.0)
    return np.where(np.isinf(least), ndtri(tail), stdtrit(np.minimum(least, 1e300), tail))
