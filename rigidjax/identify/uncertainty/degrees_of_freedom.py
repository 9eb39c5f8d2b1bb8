"""The degrees of freedom of the variances of a fit, where noise or widths are estimated."""

from typing import Any, cast

import equinox as eqx
import numpy as np

from rigidjax import _checks
from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.covariance import Linearised, Times

# From so many degrees on, a 95 % interval is at most 1.3 % wider than with infinitely many.
PLENTY = 100.0


class Freedom(eqx.Module):
    """What the degrees of freedom of a variance follow from.

    `covariance` (n, n) of the numbers for white errors; `places` (R, m) of those of a recording;
    `groups` (R,) of recordings with a common noise; of each sensor `blocks` (R, m, m), the
    information of its readings, and `left` (G,), its independent errors less what the fit takes,
    infinite for a given noise; `widths` of each width that is estimated the places of its
    deviations, its square, and its degrees; `considered` (n, c) the shifts of the numbers by
    considered errors, whose variances are known.
    """

    covariance: np.ndarray
    places: np.ndarray
    groups: np.ndarray
    blocks: tuple[np.ndarray, ...]
    left: tuple[np.ndarray, ...]
    widths: tuple[tuple[np.ndarray, float, float], ...]
    considered: np.ndarray

    def of(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom of the variances of functions of derivative `slope` (…, n).

        The variance of considered errors is known: of a sum of both the degrees grow with the
        square of the whole over the estimated part.
        """
        estimated = np.sum((slope @ self.covariance) * slope, axis=-1)
        known = np.sum((slope @ self.considered) ** 2, axis=-1)
        grown = (1.0 + known / np.maximum(estimated, 1e-300)) ** 2
        return np.asarray(self.of_estimated(slope) * grown)

    def of_estimated(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom of the part of a variance that noise and widths make.

        Each noise and each width counts by its share of the variance; where all noises have
        `PLENTY`, the least counts for all. Source: Satterthwaite 1946, doi:10.2307/3002019.
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


def freedom_of(
    model: Model,
    linear: Linearised,
    times: Times,
    covariance: np.ndarray,
    considered: np.ndarray,
) -> Freedom:
    """Return the `Freedom` of a fit; `covariance` is that of white errors, `considered` (n, c) the
    shifts of the numbers by considered errors.
    """
    groups, left, blocks = np.asarray(model.noise_groups), [], linear.information
    if model.clusters is not None:
        # Variances come from the scatter between stretches alone.
        degrees = np.array([max(float(np.max(np.asarray(model.clusters))), 1.0)])
        none = np.zeros_like(groups)
        return Freedom(covariance, linear.places, none, blocks[:1], (degrees,), (), considered)
    taken = leverages(linear, blocks, covariance)
    for sensor, kept, spans, lost in zip(
        model.records.sensors, linear.kept, times.spans, taken, strict=True
    ):
        found = np.bincount(groups, np.sum(kept.sum(axis=1) / np.asarray(spans), axis=1) - lost)
        given = cast(Any, sensor).noise is not None and times.longest <= 1.5
        left.append(np.full(found.shape, np.inf) if given else np.maximum(found, 1.0))
    widths = []
    for slot in model.slots:
        if slot.estimated:
            mine, size = np.ravel(slot.own).astype(int), float(cast(Any, slot.spread)) ** 2
            shown = np.eye(mine.size) - covariance[np.ix_(mine, mine)] / size
            widths.append((mine, size, max(float(np.sum(shown**2)), 1e-12)))
    return Freedom(
        covariance, linear.places, groups, blocks, tuple(left), tuple(widths), considered
    )


def leverages(
    linear: Linearised, information: tuple[np.ndarray, ...], covariance: np.ndarray
) -> list[np.ndarray]:
    """How many free numbers (R,) the readings of each sensor determine, of each recording."""
    known = linear.blocks(covariance)
    return [np.sum(block * known, axis=(1, 2)) for block in information]


def quantile(level: float, freedom: np.ndarray | float) -> np.ndarray:
    """Half-width of an interval in standard deviations: Student's, Gauss' for infinite freedom.

    **Raises** `ValueError` for a `level` outside (0, 1).
    """
    level = _checks.fraction(level, "level", "a level between 0 and 1")
    from scipy.special import ndtri, stdtrit

    tail, least = 0.5 * (1 + level), np.maximum(freedom, 1.0)
    return np.where(np.isinf(least), ndtri(tail), stdtrit(np.minimum(least, 1e300), tail))
