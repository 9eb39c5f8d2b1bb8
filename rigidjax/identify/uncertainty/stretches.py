"""Deviations of a fit of windows, by leaving out one stretch of them after the other (jackknife).

Errors of a model last longer than a window, and windows may overlap: they are no independent draws.
One step of Gauss and Newton's from the best point without each stretch: Miller 1974,
doi:10.1093/biomet/61.1.1; of neighbours in one block: Künsch 1989, doi:10.1214/aos/1176347265.
"""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax.identify.model.model import Model, values_of
from rigidjax.identify.uncertainty.covariance import Linearised, Spread, blinded, inverted

# A number hangs on one stretch, of so many at least, if that makes this part of its variance.
HANGS, FEWEST = 0.85, 6


class Stretches(eqx.Module):
    """The steps (C, s) of the s shared numbers if one of C stretches of windows is left out.

    `places` (s,) are the places of the shared numbers among all n.
    """

    steps: Float[np.ndarray, "stretches s"]
    places: Int[np.ndarray, " s"]

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
    """Return the steps of a fit of windows; `None` for other recordings, or for one stretch.

    The starts of windows are eliminated window by window.
    """
    if model.clusters is None:
        return None
    clusters = np.asarray(model.clusters)
    count, alone = int(clusters.max()) + 1, np.asarray(model.index.alone, int)
    dense = linear.dense
    if count == 1 or not np.isfinite(dense).all():
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
    places = linear.places[0, shared]
    grams, slopes = np.zeros((count, *gram.shape[1:])), np.zeros((count, shared.size))
    np.add.at(grams, clusters, gram)
    np.add.at(slopes, clusters, slope)
    whole = grams.sum(axis=0) + np.diag(linear.firm[places] ** 2)
    steps = np.zeros_like(slopes)
    for k in range(count):
        half, _ = inverted(whole - grams[k])
        steps[k] = half @ (half.T @ slopes[k])
    return Stretches(steps, places)


def by_stretches(stretches: Stretches, white: Spread) -> Spread:
    """Return the covariance of the shared numbers by the scatter of the steps."""
    count, places = len(stretches.steps), stretches.places
    covariance = np.array(white.seen)
    # What the starts of windows have in common with the shared numbers is not known in this way.
    covariance[places], covariance[:, places] = 0.0, 0.0
    square = (count - 1) / count * stretches.steps.T @ stretches.steps
    covariance[np.ix_(places, places)] = square
    shown = blinded(covariance, white.null_directions)
    kind = f"jackknife: one of {count} stretches of windows left out"
    return dataclasses.replace(white, covariance=shown, seen=covariance, kind=kind)


def remarks(stretches: Stretches, model: Model, x: Float[Array, " n"]) -> list[str]:
    """Return a remark on each number that hangs on one stretch, with its value without that one."""
    count = len(stretches.steps)
    edges = -(-np.arange(count + 1) * model.count // count)
    names, out = _names_of_places(model), []
    for place, stretch in stretches.hanging:
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
