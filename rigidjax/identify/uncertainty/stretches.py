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
    Linearisation,
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


def leave_one_out(model: Model, linear: Linearisation) -> Stretches | None:
    """Return the changes of a fit if a stretch of windows is left out, for each stretch.

    The result is `None` without windows, or if the motion is not finite. The parameters of one
    window alone are eliminated window by window (Schur complement).
    """
    if model.clusters is None:
        return None
    clusters = np.asarray(model.clusters)
    count, alone = int(clusters.max()) + 1, np.asarray(model.index.alone, int)
    dense = linear.weighted_jacobian
    if not np.isfinite(dense).all():
        return None
    shared = np.setdiff1d(np.arange(dense.shape[-1]), alone)
    errors = [e * np.sqrt(w)[..., None] for e, w in zip(linear.errors, linear.weights, strict=True)]
    e = np.concatenate([one.reshape(len(one), -1) for one in errors], axis=1)
    own, rest = dense[..., alone], dense[..., shared]
    gram = rest.swapaxes(1, 2) @ rest
    slope = np.einsum("rns,rn->rs", rest, e)
    if alone.size:
        at = linear.places[:, alone]
        held = linear.prior_weights[at]
        inner = own.swapaxes(1, 2) @ own + held[:, :, None] ** 2 * np.eye(alone.size)
        sides = own.swapaxes(1, 2) @ rest
        pull = np.einsum("rnk,rn->rk", own, e) + held * linear.prior_residuals[at]
        both = np.linalg.solve(inner, np.concatenate([sides, pull[..., None]], axis=2))
        gram = gram - sides.swapaxes(1, 2) @ both[..., :-1]
        slope = slope - np.einsum("rks,rk->rs", sides, both[..., -1])
    # A parameter may have one value for each group of windows. One column of the derivatives then
    # stands for another parameter in each group: the indices in `linear.places` tell which.
    places, columns = np.unique(linear.places[:, shared], return_inverse=True)
    columns = columns.reshape(len(gram), shared.size)
    grams, slopes = np.zeros((count, places.size, places.size)), np.zeros((count, places.size))
    np.add.at(grams, (clusters[:, None, None], columns[:, :, None], columns[:, None, :]), gram)
    np.add.at(slopes, (clusters[:, None], columns), slope)
    known = np.diag(linear.prior_weights[places] ** 2)
    steps, null = np.zeros_like(slopes), []
    for k in range(count):
        # Add up the information matrices (`grams`) of all stretches but stretch k. If the matrix of
        # stretch k were subtracted from the sum of all, round-off would remain in the directions
        # that the other stretches do not determine.
        rest = np.delete(grams, k, axis=0).sum(axis=0) + known
        blind = np.eye(places.size)
        if rest.any():
            half, blind = covariance_root(rest)
            steps[k] = half @ (half.T @ slopes[k])
        null.append(np.zeros((len(blind), linear.free_count)))
        null[-1][:, places] = blind
    return Stretches(steps, places, tuple(null))


def jackknife(stretches: Stretches, white: Covariance) -> Covariance:
    """Return the jackknife's covariance of a fit of windows.

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
