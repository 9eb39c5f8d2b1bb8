"""Compute the covariance of a fit of windows by a jackknife, which leaves out one stretch at a
time.

A stretch is a run of neighbouring windows. Windows are not independent: the errors of a model last
longer than a window, and windows may overlap. Therefore a whole stretch is left out (Künsch 1989,
doi:10.1214/aos/1176347265). The fit without a stretch is one Gauss–Newton step from the best point
(Miller 1974, doi:10.1093/biomet/61.1.1).
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from rigidjax.identify.model.first_order import FirstOrder
from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.covariance import (
    Covariance,
    Root,
    covariance_root,
    with_infinite_variance,
)
from rigidjax.identify.uncertainty.quantities import labels

# A quantity depends on one stretch of windows if this stretch causes more than the fraction HANGS
# of the variance of the quantity. This is not tested if there are fewer than FEWEST stretches.
HANGS, FEWEST = 0.85, 6


class Stretches(eqx.Module):
    """Hold the changes of a fit if one of its stretches (runs of neighbouring windows) is left out.

    A shared parameter is one on which several windows depend; there are s.
    """

    steps: Float[np.ndarray, "stretches s"]
    places: Int[np.ndarray, " s"]  # of the shared parameters among all n
    # For each stretch the directions that all others and the priors together do not determine.
    null: tuple[Float[np.ndarray, "_ n"], ...]

    @property
    def hidden_directions(self) -> Float[np.ndarray, "k n"]:
        """Return the directions that only one stretch determines.

        The variance along these directions is not known: a fit of windows takes variances from the
        scatter between stretches, and one stretch alone has no scatter.
        """
        return np.concatenate(self.null)


def leave_one_out(model: Model, root: Root | None) -> Stretches | None:
    """Return the changes of a fit if a stretch of windows is left out, for each stretch.

    The `root` is that of the covariance for white errors. The result is `None` without windows, or
    if the motion is not finite.
    """
    if model.clusters is None or root is None:
        return None
    clusters, places = np.asarray(model.clusters), root.shared
    count, n = int(clusters.max()) + 1, root.size.size
    if count == 1:
        # All parameters are the own ones of a single window, and no other window shows them.
        alone = np.asarray(model.index.places)[:, np.asarray(model.index.alone, int)]
        places = np.setdiff1d(np.arange(n), alone)
        null = np.eye(n)[places]
        return Stretches(np.zeros((1, places.size)), places, (null,))
    rows = [
        np.concatenate([root.left[i] for i in np.flatnonzero(clusters == k)]) for k in range(count)
    ]
    rows = [np.linalg.qr(one, mode="r") for one in rows]
    size, steps, null = root.size[places], np.zeros((count, places.size)), []
    for k in range(count):
        # All stretches but stretch k, and the priors. If the information of stretch k were
        # subtracted from that of all, round-off would remain in the directions that the other
        # stretches do not determine.
        others = np.concatenate([root.ties, *rows[:k], *rows[k + 1 :]])[:, :-1]
        half, blind = covariance_root(others)
        steps[k] = half @ (half.T @ (rows[k][:, :-1].T @ rows[k][:, -1])) / size
        null.append(np.zeros((len(blind), n)))
        null[-1][:, places] = blind / size
        null[-1] /= np.linalg.norm(null[-1], axis=1, keepdims=True)
    return Stretches(steps, places, tuple(null))


def jackknife(stretches: Stretches, white: Covariance) -> Covariance:
    """Return the jackknife's covariance of a fit of windows, by leaving out a stretch at a time.

    Parameters on which one window alone depends, such as its initial state, keep their covariance
    for `white` errors.
    """
    count, places = len(stretches.steps), stretches.places
    covariance = np.array(white.determined)
    # The covariance between shared numbers and the initial states of windows is set to zero, since
    # the jackknife does not give it.
    covariance[places], covariance[:, places] = 0.0, 0.0
    square = (count - 1) / count * stretches.steps.T @ stretches.steps
    covariance[np.ix_(places, places)] = square
    null = np.concatenate([white.null_directions, stretches.hidden_directions])
    shown = with_infinite_variance(null, covariance)
    kind = f"jackknife: one of {count} stretches of windows left out"
    return dataclasses.replace(white, covariance=shown, determined=covariance, kind=kind)


def stretch_remarks(
    stretches: Stretches, model: Model, quantities: FirstOrder, white: Covariance
) -> list[str]:
    """Return a remark on each quantity whose value or deviation depends on a single stretch."""
    count, names = len(stretches.steps), labels(model)
    if count == 1:
        return ["deviations come from the differences between windows, and there is one"]
    values, slopes = (part[: len(names)] for part in quantities)
    steps = stretches.steps @ slopes[:, stretches.places].T
    squares = steps**2
    hanging = squares.max(axis=0) > HANGS * np.maximum(squares.sum(axis=0), 1e-300)
    unseen = _change_along(white.null_directions, slopes)
    alone = np.stack([_change_along(null, slopes) & ~unseen for null in stretches.null])
    edges = -(-np.arange(count + 1) * model.count // count)
    out = []
    for index, (name, _, positive) in enumerate(names):
        for stretch in np.flatnonzero(alone[:, index]):
            out.append(f"only windows {edges[stretch]} … {edges[stretch + 1] - 1} show {name}")
        if hanging[index] and not alone[:, index].any() and count >= FEWEST:
            stretch = int(squares[:, index].argmax())
            value = float(values[index] + steps[stretch, index])
            out.append(
                f"{name} hangs on one stretch (without windows {edges[stretch]} … "
                f"{edges[stretch + 1] - 1} it is {np.exp(value) if positive else value:.3g})"
            )
    return out


def _change_along(
    directions: Float[np.ndarray, "k n"], slopes: Float[np.ndarray, "q n"]
) -> Bool[np.ndarray, " q"]:
    """Return which quantities with the derivatives `slopes` change along any of the directions."""
    size = np.abs(slopes).max(axis=-1, initial=1e-300)
    return np.abs(slopes @ directions.T).max(axis=-1, initial=0.0) > 1e-6 * size
