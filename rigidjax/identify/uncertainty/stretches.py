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

from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.covariance import (
    Covariance,
    Linearisation,
    covariance_root,
    with_infinite_variance,
)
from rigidjax.identify.uncertainty.quantities import names_units_and_signs

# A quantity depends on one stretch of windows if this stretch causes more than the fraction HANGS
# of the variance of the quantity. This is not tested if there are fewer than FEWEST stretches.
HANGS, FEWEST = 0.85, 6


class Stretches(eqx.Module):
    """Hold the changes of a fit if one of its C stretches of windows is left out.

    A window is a short part of a record, and a stretch is a run of neighbouring windows. A shared
    number is a free number on which several windows depend.

    **Fields:**

    - `steps`: (C, s) the changes of the s shared numbers, in row c if stretch c is left out.
    - `places`: (s,) the indices of the shared numbers among all n free numbers.
    - `null`: for each stretch the directions (k, n) of the shared numbers that all other stretches
      and the priors together do not determine.
    """

    steps: Float[np.ndarray, "stretches s"]
    places: Int[np.ndarray, " s"]
    null: tuple[Float[np.ndarray, "_ n"], ...]

    @property
    def directions_shown_by_one_stretch(self) -> Float[np.ndarray, "k n"]:
        """Return the directions (k, n) of the n free numbers that only one stretch (a run of
        neighbouring windows) determines.

        The variance along these directions is not known: a fit of windows takes variances from the
        scatter between stretches, and one stretch alone has no scatter.
        """
        return np.concatenate(self.null)


def leave_out_each_stretch(model: Model, linear: Linearisation) -> Stretches | None:
    """Return, for each stretch of windows, the changes of a fit if this stretch is left out.

    A stretch is a run of neighbouring windows. The result is `None` if the model is not one of
    windows, or if the motion is not finite. The numbers on which one window alone depends are
    eliminated window by window (Schur complement).

    **Arguments:** `model` the fitted model; `linear` the errors at the best point, with their
    derivatives and weights.
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
    # A free number may have one value for each group of windows. One column of the derivatives then
    # stands for another number in each group of windows: the indices in `linear.places` tell which.
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


def jackknife_covariance(stretches: Stretches, white: Covariance) -> Covariance:
    """Return the covariance of a fit of windows, computed from the changes of the fit if one
    stretch of windows is left out.

    The jackknife gives the covariance of the numbers that windows share. Numbers on which one
    window alone depends, such as its initial state, keep their covariance for white errors.

    **Arguments:** `stretches` for each stretch (a run of neighbouring windows) the changes of the
    shared numbers if this stretch is left out; `white` the covariance for white errors.
    """
    count, places = len(stretches.steps), stretches.places
    covariance = np.array(white.determined)
    # The covariance between shared numbers and the initial states of windows is set to zero, since
    # the jackknife does not give it.
    covariance[places], covariance[:, places] = 0.0, 0.0
    square = (count - 1) / count * stretches.steps.T @ stretches.steps
    covariance[np.ix_(places, places)] = square
    null = np.concatenate([white.null_directions, stretches.directions_shown_by_one_stretch])
    shown = with_infinite_variance(null, covariance)
    kind = f"jackknife: one of {count} stretches of windows left out"
    return dataclasses.replace(white, covariance=shown, determined=covariance, kind=kind)


def remarks_on_dependence_on_one_stretch(
    stretches: Stretches,
    model: Model,
    values_and_slopes: tuple[np.ndarray, np.ndarray],
    white: Covariance,
) -> list[str]:
    """Return a remark on each reported quantity whose value or standard deviation depends on a
    single stretch (a run of neighbouring windows).

    **Arguments:**

    - `stretches`: for each stretch the changes of a fit if this stretch is left out.
    - `model`: the fitted model.
    - `values_and_slopes`: the reported quantities and their derivatives, as
      `quantities.quantities_and_derivatives_in_numpy` returns them.
    - `white`: the covariance for white errors.
    """
    count, names = len(stretches.steps), names_units_and_signs(model)
    if count == 1:
        return ["deviations come from the differences between windows, and there is one"]
    values, slopes = (part[: len(names)] for part in values_and_slopes)
    steps = stretches.steps @ slopes[:, stretches.places].T
    squares = steps**2
    hanging = squares.max(axis=0) > HANGS * np.maximum(squares.sum(axis=0), 1e-300)
    unseen = _quantities_change_along(white.null_directions, slopes)
    alone = np.stack([_quantities_change_along(null, slopes) & ~unseen for null in stretches.null])
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


def _quantities_change_along(
    directions: Float[np.ndarray, "k n"], slopes: Float[np.ndarray, "q n"]
) -> Bool[np.ndarray, " q"]:
    """Return a mask (q,), true for each of q quantities that changes along one or more of the
    `directions` (k, n).

    A direction is a change of the n free numbers of a fit. The argument `slopes` (q, n) holds the
    derivatives of the quantities with respect to these numbers.
    """
    size = np.abs(slopes).max(axis=-1, initial=1e-300)
    return np.abs(slopes @ directions.T).max(axis=-1, initial=0.0) > 1e-6 * size
