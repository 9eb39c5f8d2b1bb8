"""Comparison of models: information criteria, and prediction of the recording left out."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from rigidjax import _checks
from rigidjax.identify.answer.fit import fit
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, count_of
from rigidjax.identify.model.charts import Known, places_of
from rigidjax.identify.model.free import put
from rigidjax.identify.model.index import index_of
from rigidjax.identify.model.model import Model, with_parts
from rigidjax.identify.model.terms import independent, template, whitened
from rigidjax.identify.search.stages import errors_and_slopes


class Comparison(eqx.Module):
    """One of several models of the same data.

    **Fields:** `name`; `free` the number of free numbers; `rms` of each sensor; `correlation` the
    samples over which its errors are autocorrelated; `information` its Bayesian information
    criterion minus that of the best: 0 for the best, 10 and more is strong evidence against the
    model.
    """

    name: str
    free: int
    rms: tuple[float, ...]
    correlation: float
    information: float


def compare(fits: Mapping[str, Fit]) -> tuple[Comparison, ...]:
    """Models of the same data, best first, by Schwarz's criterion (1978,
    doi:10.1214/aos/1176344136).

    `N log s² + p log N` with s² the mean square of each sensor's errors and N the number of
    independent readings, those read divided by the samples over which the errors of the best model
    are autocorrelated. **Arguments:** `fits` name → `Fit`, all of the same readings. **Returns**
    for each `name`, `free`, `rms`, `correlation` and `information` (`Comparison`). **Raises**
    `ValueError` for none, or for fits of other readings.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model())
    >>> best = compare({"one": found, "the same again": found})[0]
    >>> best.name, best.free, best.information  # free: two ratios, initial attitude and rate
    ('one', 8, 0.0)
    """
    _checks.instance(fits, Mapping, "fits", wanted="a dict of name → Fit")
    for name, found in fits.items():
        _checks.instance(found, Fit, f"fits[{name!r}]")
    if not fits:
        raise ValueError("compare: wanted at least one fit")
    readings = {name: found.model.records.readings for name, found in fits.items()}
    counts = {name: tuple(map(count_of, some)) for name, some in readings.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"compare: wanted fits of the same readings, got {counts}")
    shortest = max(min(found.correlation for found in fits.values()), 1.0)
    rows = []
    for name, found in fits.items():
        jitters = [getattr(s, "jitter", None) for s in found.model.records.sensors]
        several = int(np.max(found.model.noise_groups)) + 1
        size = found.x.size
        size += several * sum(jitter is not None and jitter.estimated for jitter in jitters)
        many = np.array(counts[name]) / shortest
        misfit = many @ _log_squares(found)
        rows.append((misfit + size * np.log(max(many.sum(), 2.0)), name, size, found))
    rows.sort(key=lambda row: row[0])
    best = rows[0][0]
    return tuple(
        Comparison(name, size, found.rms, found.correlation, float(total - best))
        for total, name, size, found in rows
    )


def _log_squares(found: Fit) -> np.ndarray:
    """The logarithm of each sensor's mean square error; with jitter, of white errors that are as
    likely as these.
    """
    out, model = 2.0 * np.log(np.maximum(found.rms, 1e-300)), found.model
    errors, _ = errors_and_slopes(model, found.x)
    white = whitened(model, errors, found.noises)
    for index, (reading, e, sigma) in enumerate(
        zip(model.records.readings, white, found.noises, strict=True)
    ):
        if reading.late is not None:
            wider = np.asarray(independent(e, reading.late / sigma[:, None])[1])[reading.seen]
            squares = np.sum(np.asarray(e * sigma[:, None])[reading.seen] ** 2, axis=-1)
            out[index] = np.log(squares.mean()) + wider.mean()
    return out


def cross_validate(
    build: Callable[[Sequence[Recording]], Model], recordings: Sequence[Recording], **options: Any
) -> tuple[tuple[float, ...], ...]:
    """The errors of each recording under a body fitted to all other recordings.

    The body and all shared numbers come from the others; the fit to the recording left out moves
    only its initial state and the `Free`s with one value for each. **Arguments:** `build` the
    model of a sequence of recordings; `recordings` two at least; `options` for `fit`. **Returns**
    for each recording the root mean square error of each sensor: the model with the smallest
    predicts best. **Raises** `ValueError` for fewer than two recordings.

    >>> cross_validate(lambda records: None, [])
    Traceback (most recent call last):
    ValueError: cross_validate: wanted at least two recordings, got 0
    """
    _checks.function(build, "build", "of a sequence of recordings → Model")
    _checks.instance(recordings, Sequence, "recordings", wanted="a sequence of Recording")
    for item in recordings:
        _checks.instance(item, Recording, "recordings")
    if len(recordings) < 2:
        raise ValueError(f"cross_validate: wanted at least two recordings, got {len(recordings)}")
    out = []
    for index, left_out in enumerate(recordings):
        others = [r for k, r in enumerate(recordings) if k != index]
        found = fit(build(others), **options)
        out.append(fit(_with_shared(build([left_out]), found), **{**options, "starts": 1}).rms)
    return tuple(out)


def _with_shared(model: Model, found: Fit) -> Model:
    """Return the model with the body and all shared values of a fit, no longer free."""
    x = model.start()
    for slot, fitted in zip(model.slots, found.model.slots, strict=True):
        if slot.shared is not None and fitted.shared is not None:
            x = x.at[slot.shared].set(found.x[fitted.shared])
    record = stacking.one(model.records, 0)
    scene = put(template(model, record), model.slots, model.index.rows(x)[0])
    sensors = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, scene.sensors)
    own = [
        slot if slot.each else dataclasses.replace(slot, each=True, prior=slot.spread, spread=None)
        for slot in model.slots
        if slot.own is not None
    ]
    chart = Known(found.body)
    kinds = model.index.start.shape[1] // 3
    index, slots = index_of(places_of(chart, None, model.count), chart.size, own, kinds)
    records = eqx.tree_at(
        lambda r: [reading.sensor for reading in r.readings], model.records, list(sensors)
    )
    parts = dict(chart=chart, torque=scene.torque, records=records, slots=slots, index=index)
    return with_parts(model, **parts)
