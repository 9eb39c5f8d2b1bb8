"""Compute the degrees of freedom of the variances of a fit that estimates noise or spreads."""

from typing import Any, NamedTuple, cast

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from rigidjax import _checks
from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.covariance import CorrelationTimes, Linearisation

# With more degrees of freedom than this, a 95 % interval is at most 1.3 % wider than with
# infinitely many degrees of freedom.
PLENTY = 100.0


class _Width(NamedTuple):
    """Hold an estimated `spread` of a `Free`: the deviation of its values in single recordings."""

    places: Int[np.ndarray, " k"]  # of the recordings' deviations from the shared value
    square: float
    freedom: float


class Freedom(eqx.Module):
    """Hold what gives the degrees of freedom of the variance of any function of the parameters.

    **Fields:**

    - `covariance`: (n, n) the covariance of the n parameters, for white errors.
    - `places`: (R, m) the indices, among the n, of the m parameters of each of R recordings.
    - `groups`: (R,) the index of the group of each recording. In the recordings of one group a
      sensor has the same standard deviation of its noise.
    - `blocks`: for each sensor the information matrices (R, m, m) of its readings.
    - `left`: for each sensor the degrees of freedom (G,) of its noise in each of G groups: the
      number of its independent errors minus the number of parameters that these errors determine.
      They are infinite if the noise is given.
    - `widths`: each estimated `spread` of a `Free`, with its degrees of freedom.
    - `considered`: (n, c) the changes of the parameters by one standard deviation of each error
      that a sensor may have and that the fit does not estimate (`Consideration.shifts`).
    """

    covariance: np.ndarray
    places: np.ndarray
    groups: np.ndarray
    blocks: tuple[np.ndarray, ...]
    left: tuple[np.ndarray, ...]
    widths: tuple[_Width, ...]
    considered: np.ndarray

    def of_variance(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom (…,) of the variance of functions with the derivatives
        `slope` (…, n).

        Considered errors add a known variance to the estimated one: the degrees of freedom of the
        estimated variance are multiplied by the square of the ratio of the sum to it.
        """
        estimated = np.sum((slope @ self.covariance) * slope, axis=-1)
        known = np.sum((slope @ self.considered) ** 2, axis=-1)
        grown = (1.0 + known / np.maximum(estimated, 1e-300)) ** 2
        return np.asarray(self.of_estimated_variance(slope) * grown)

    def of_estimated_variance(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom (…,) of the estimated part of the variance of functions
        with the derivatives `slope` (…, n).

        The variance is a sum of parts: one for the noise of each sensor in each group of
        recordings, and one for each width (Satterthwaite 1946, doi:10.2307/3002019). If every noise
        has more than `PLENTY` degrees of freedom, the smallest number is used for all noises.
        """
        along = slope @ self.covariance
        variance = np.maximum(np.sum(along * slope, axis=-1), 1e-300)
        along = along / np.sqrt(variance)[..., None]
        rest, inverse = np.ones(variance.shape), np.zeros(variance.shape)
        for mine, size, degrees in self.widths:
            share = np.sum(along[..., mine] ** 2, axis=-1) / size
            rest, inverse = rest - share, inverse + share**2 / degrees
        least = min(left.min() for left in self.left)
        if least > PLENTY or len(self.left) * self.left[0].size == 1:
            return np.asarray(1.0 / np.maximum(inverse + rest**2 / least, 1e-300))
        wide = np.concatenate([along, np.zeros((*variance.shape, 1))], axis=-1)
        for block, left in zip(self.blocks, self.left, strict=True):
            share = np.zeros((left.size, *variance.shape))
            for group, own, columns in zip(self.groups, block, self.places, strict=True):
                read = wide[..., columns]
                share[group] += np.sum((read @ own) * read, axis=-1)
            inverse = inverse + np.tensordot(1.0 / left, share**2, 1)
        return np.asarray(1.0 / np.maximum(inverse, 1e-300))


def prepare_freedom(
    model: Model,
    linear: Linearisation,
    times: CorrelationTimes,
    covariance: Float[np.ndarray, "n n"],
    considered: Float[np.ndarray, "n ways"],
) -> Freedom:
    """Return the `Freedom` of a fit, where correlated errors count as fewer independent ones."""
    groups, left, blocks = np.asarray(model.noise_groups), [], linear.information_by_sensor
    if model.clusters is not None:
        # The variances of a fit of windows come only from the scatter between C stretches (runs of
        # neighbouring windows), so that they have C − 1 degrees of freedom.
        degrees = np.array([max(float(np.max(np.asarray(model.clusters))), 1.0)])
        none = np.zeros_like(groups)
        return Freedom(covariance, linear.places, none, blocks[:1], (degrees,), (), considered)
    taken = effective_parameters(linear, blocks, covariance)
    for sensor, mask, spans, lost in zip(
        model.records.sensors, linear.mask, times.spans, taken, strict=True
    ):
        counts = np.bincount(groups, np.sum(mask.sum(axis=1) / np.asarray(spans), axis=1) - lost)
        has_noise = cast(Any, sensor).noise is not None and times.longest_span <= 1.5
        left.append(np.full(counts.shape, np.inf) if has_noise else np.maximum(counts, 1.0))
    widths = []
    for slot in model.slots:
        if slot.estimated:
            mine, size = np.ravel(slot.own).astype(int), float(cast(Any, slot.spread)) ** 2
            shown = np.eye(mine.size) - covariance[np.ix_(mine, mine)] / size
            widths.append(_Width(mine, size, max(float(np.sum(shown**2)), 1e-12)))
    return Freedom(
        covariance, linear.places, groups, blocks, tuple(left), tuple(widths), considered
    )


def effective_parameters(
    linear: Linearisation, information: tuple[np.ndarray, ...], covariance: np.ndarray
) -> list[Float[np.ndarray, " records"]]:
    """Return for each sensor how many parameters its readings determine in each recording.

    This is the sum of the leverages of the readings: a parameter that they determine together with
    priors, other sensors or other recordings counts as a fraction.
    """
    known = linear.covariance_by_recording(covariance)
    return [np.sum(block * known, axis=(1, 2)) for block in information]


def student_quantile(level: float, degrees_of_freedom: np.ndarray | float) -> np.ndarray:
    """Return the half-width, in standard deviations, of a two-sided interval of the probability
    `level`; `ValueError` for a level outside (0, 1).
    """
    level = _checks.fraction(level, "level", "a level between 0 and 1")
    from scipy.special import ndtri, stdtrit

    tail, least = 0.5 * (1 + level), np.maximum(degrees_of_freedom, 1.0)
    return np.where(np.isinf(least), ndtri(tail), stdtrit(np.minimum(least, 1e300), tail))
