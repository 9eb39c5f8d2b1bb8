"""Deviations of a fit of windows, by leaving out one stretch of them after the other (jackknife).

Errors of a model last longer than a window, and windows may overlap: they are no independent draws.
One step of Gauss and Newton's from the best point without each stretch: Miller 1974,
doi:10.1093/biomet/61.1.1; of neighbours in one block: Künsch 1989, doi:10.1214/aos/1176347265.
"""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rigidjax.identify.model.model import Model, values_of
from rigidjax.identify.uncertainty.covariance import Linearised, Spread, blinded, inverted

# A number hangs on one stretch, of so many at least, if that makes this part of its variance.
HANGS, FEWEST = 0.85, 6


class Stretches(eqx.Module):
    """The steps (C, s) of the s shared numbers if one of C stretches of windows is left out.

    `places` (s,) are the places of the shared numbers among all n; `null` of each stretch the
    directions (k, n) that the others do not show; all of them if there is one stretch.
    """

    steps: Float[np.ndarray, "stretches s"]
    places: Int[np.ndarray, " s"]
    null: tuple[Float[np.ndarray, "k n"], ...]

    @property
    def hidden(self) -> Float[np.ndarray, "k n"]:
        """The directions whose scatter between stretches is not known."""
        return np.concatenate(self.null)

    @property
    def hanging(self) -> list[tuple[int, int]]:
        """The place of each number that hangs on one stretch, and that stretch."""
        if len(self.steps) < FEWEST:
            return []
        squares = self.steps**2
        most = squares.argmax(axis=0)
        far = squares.max(axis=0) > HANGS * np.maximum(squares.sum(axis=0), 1e-300)
        return [(int(self.places[k]), int(most[k])) for k in np.flatnonzero(far)]


def stretches_of(model: Model, linear: Linearised) -> Stretches | None:
    """Return the steps of a fit of windows; `None` for other recordings.

    The numbers of one window alone are eliminated window by window.
    """
    if model.clusters is None:
        return None
    clusters = np.asarray(model.clusters)
    count, alone = int(clusters.max()) + 1, np.asarray(model.index.alone, int)
    dense = linear.dense
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
        held = linear.firm[at]
        inner = own.swapaxes(1, 2) @ own + held[:, :, None] ** 2 * np.eye(alone.size)
        sides = own.swapaxes(1, 2) @ rest
        pull = np.einsum("rnk,rn->rk", own, e) + held * linear.pulls[at]
        both = np.linalg.solve(inner, np.concatenate([sides, pull[..., None]], axis=2))
        gram = gram - sides.swapaxes(1, 2) @ both[..., :-1]
        slope = slope - np.einsum("rks,rk->rs", sides, both[..., -1])
    # Groups of windows may have values of their own: a column is then a number of each group.
    places, columns = np.unique(linear.places[:, shared], return_inverse=True)
    columns = columns.reshape(len(gram), shared.size)
    grams, slopes = np.zeros((count, places.size, places.size)), np.zeros((count, places.size))
    np.add.at(grams, (clusters[:, None, None], columns[:, :, None], columns[:, None, :]), gram)
    np.add.at(slopes, (clusters[:, None], columns), slope)
    known = np.diag(linear.firm[places] ** 2)
    steps, null = np.zeros_like(slopes), []
    for k in range(count):
        # The sum of the others: a difference would leave round-off where they show nothing.
        rest = np.delete(grams, k, axis=0).sum(axis=0) + known
        blind = np.eye(places.size)
        if rest.any():
            half, blind = inverted(rest)
            steps[k] = half @ (half.T @ slopes[k])
        null.append(np.zeros((len(blind), linear.size)))
        null[-1][:, places] = blind
    return Stretches(steps, places, tuple(null))


def by_stretches(stretches: Stretches, white: Spread) -> Spread:
    """Return the covariance of the shared numbers by the scatter of the steps."""
    count, places = len(stretches.steps), stretches.places
    covariance = np.array(white.seen)
    # What the starts of windows have in common with the shared numbers is not known in this way.
    covariance[places], covariance[:, places] = 0.0, 0.0
    square = (count - 1) / count * stretches.steps.T @ stretches.steps
    covariance[np.ix_(places, places)] = square
    shown = blinded(covariance, np.concatenate([white.null_directions, stretches.hidden]))
    kind = f"jackknife: one of {count} stretches of windows left out"
    return dataclasses.replace(white, covariance=shown, seen=covariance, kind=kind)


def remarks(stretches: Stretches, model: Model, x: Float[Array, " n"], white: Spread) -> list[str]:
    """Return a remark on each number that hangs on one stretch, with its value without that one."""
    count = len(stretches.steps)
    if count == 1:
        return ["deviations come from the differences between windows, and there is one"]
    edges = -(-np.arange(count + 1) * model.count // count)
    names, out = _names_of_places(model), []
    unseen = _touched(white.null_directions)
    for stretch, null in enumerate(stretches.null):
        for place in np.flatnonzero(_touched(null) & ~unseen):
            shown = names.get(int(place), ((f"number {place} of the body", ""), ()))[0]
            out.append(
                f"only windows {edges[stretch]} … {edges[stretch + 1] - 1} show {''.join(shown)}"
            )
    hidden = _touched(stretches.hidden)
    for place, stretch in stretches.hanging:
        if hidden[place]:
            continue
        step = stretches.steps[stretch, list(stretches.places).index(place)]
        name, index = names.get(place, (f"number {place} of the body", None))
        without = x.at[place].add(step)
        value = without[place] if index is None else values_of(model, without)[name[0]][index]
        shown = name if index is None else name[0] + name[1]
        first, last = edges[stretch], edges[stretch + 1] - 1
        out.append(
            f"{shown} hangs on one stretch (without windows {first} … {last} it is "
            f"{float(value):.3g})"
        )
    return out


def _touched(null: Float[np.ndarray, "k n"]) -> Bool[np.ndarray, " n"]:
    return np.abs(null).max(axis=0, initial=0.0) > 1e-6


def _names_of_places(model: Model) -> dict[int, tuple[Any, Any]]:
    """Return the name of each shared number, and its index in the value, by its place."""
    names: dict[int, tuple[Any, Any]] = {}
    for slot in model.slots:
        if slot.shared is None:
            continue
        for index, place in np.ndenumerate(np.asarray(slot.shared)):
            inner = "".join(f" {'xyz'[i] if i < 3 else i}" for i in index[1:])
            names[int(place)] = (slot.name, inner), index if slot.labels else index[1:]
    return names
