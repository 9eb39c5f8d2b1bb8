"""Compare models by an information criterion, and by predicting recordings that were left out."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from rigidjax import _checks
from rigidjax.identify.answer.fit import fit
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, numbers_read
from rigidjax.identify.model.charts import Known, body_places
from rigidjax.identify.model.free import with_steps
from rigidjax.identify.model.index import build_index
from rigidjax.identify.model.model import Model, require_one_kind, starting_scene
from rigidjax.identify.model.terms import (
    decorrelate,
    whiten,
)
from rigidjax.identify.search.stages import blocks_at


class Comparison(eqx.Module):
    """Hold the comparison of a model with the best one of several models of the same data.

    **Fields:**

    - `name`: the name of the model.
    - `free`: the number of parameters of the model.
    - `rms`: the root mean square error of each sensor.
    - `correlation`: the number of samples over which the errors of the model are autocorrelated.
    - `information`: the Bayesian information criterion of the model minus the criterion of the best
      model. It is 0 for the best model; 10 and more is strong evidence against the model.
    """

    name: str
    free: int
    rms: tuple[float, ...]
    correlation: float
    information: float


def compare(fits: Mapping[str, Fit]) -> tuple[Comparison, ...]:
    """Compare models of the same data by Schwarz's criterion, and return the best model first.

    The criterion is `Σ Nₛ log s² + p log N` for p parameters (Schwarz 1978,
    doi:10.1214/aos/1176344136). The sum is over the sensors. For each sensor, s² is its mean square
    error, and Nₛ its number of independent readings. Nₛ is the number of components read, divided
    by the autocorrelation time (in samples) of the model for which this time is shortest. N is the
    sum of Nₛ over the sensors.

    **Arguments:** `fits` is a dict of name → `Fit`, with fits of the same readings. **Returns** for
    each model a `Comparison` with `name`, `free`, `rms`, `correlation` and `information`.
    **Raises** `ValueError` for no fits, or for fits of different readings.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> best = compare({"one": result, "the same again": result})[0]
    >>> best.name, best.free, best.information  # free: two ratios, initial attitude and rate
    ('one', 8, 0.0)
    """
    _checks.require_instance(fits, Mapping, "fits", requirement="a dict of name → Fit")
    for name, one in fits.items():
        _checks.require_instance(one, Fit, f"fits[{name!r}]")
    if not fits:
        raise ValueError("compare: wanted at least one fit, got none")
    readings = {name: one.model.records.readings for name, one in fits.items()}
    counts = {name: tuple(map(numbers_read, of_fit)) for name, of_fit in readings.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"compare: wanted fits of the same readings, got {counts}")
    shortest = max(min(one.correlation for one in fits.values()), 1.0)
    rows = []
    for name, one in fits.items():
        independent_readings = np.array(counts[name]) / shortest
        deviance = independent_readings @ _log_mean_squares(one)
        penalty = one.x.size * np.log(max(independent_readings.sum(), 2.0))
        rows.append((deviance + penalty, name, one))
    rows.sort(key=lambda row: row[0])
    best = rows[0][0]
    return tuple(
        Comparison(name, one.x.size, one.rms, one.correlation, float(total - best))
        for total, name, one in rows
    )


def _log_mean_squares(fit: Fit) -> Float[np.ndarray, " sensors"]:
    """Return the logarithm of the mean square error of each sensor.

    Jitter (errors of time stamps) correlates errors and raises their variance. Such errors are
    whitened to the variance of the noise alone, and the mean logarithm of the factor by which
    jitter raises the variance is added: white errors of this mean square are as likely.
    """
    out, model = 2.0 * np.log(np.maximum(fit.rms, 1e-300)), fit.model
    errors, _ = blocks_at(model, fit.x)
    white = whiten(model, errors, fit.noises)
    for index, (reading, e, sigma) in enumerate(
        zip(model.records.readings, white, fit.noises, strict=True)
    ):
        if reading.jitter_error is not None:
            jitter_error = reading.jitter_error / sigma[:, None]
            _, log_variances = decorrelate(e, jitter_error)
            wider = np.asarray(log_variances)[reading.host_mask]
            squares = np.sum(np.asarray(e * sigma[:, None])[reading.host_mask] ** 2, axis=-1)
            out[index] = np.log(squares.mean()) + wider.mean()
    return out


def cross_validate(
    build: Callable[[Sequence[Recording]], Model], recordings: Sequence[Recording], **options: Any
) -> tuple[tuple[float, ...], ...]:
    """Return the errors with which the fit of all other recordings predicts each recording.

    Each recording is left out once. The body, and all numbers that recordings share, are fitted to
    the other recordings and then held fixed. A second fit, to the recording that was left out,
    changes only its initial state and the `Free`s with a value for each recording.

    **Arguments:**

    - `build`: a function that is given a sequence of recordings and returns a `Model`.
    - `recordings`: a sequence of two or more recordings.
    - `options`: keyword arguments of `fit`.

    **Returns** for each recording the root mean square error of each sensor. The model with the
    smallest errors predicts best. **Raises** `ValueError` for fewer than two recordings.

    >>> cross_validate(lambda records: None, [])
    Traceback (most recent call last):
    ValueError: cross_validate: wanted at least two recordings, got 0
    """
    _checks.require_function(build, "build", "of a sequence of recordings → Model")
    _checks.require_instance(
        recordings, Sequence, "recordings", requirement="a sequence of Recording"
    )
    for item in recordings:
        _checks.require_instance(item, Recording, "recordings")
    if len(recordings) < 2:
        raise ValueError(f"cross_validate: wanted at least two recordings, got {len(recordings)}")
    out = []
    for index, left_out in enumerate(recordings):
        others = [r for k, r in enumerate(recordings) if k != index]
        fit_of_others = fit(build(others), **options)
        test_model = _with_shared_fixed(build([left_out]), fit_of_others)
        out.append(fit(test_model, **{**options, "starts": 1}).rms)
    return tuple(out)


def _with_shared_fixed(model: Model, fit_of_others: Fit) -> Model:
    """Return a `model` of one recording whose body and shared parameters are those of a fit.

    Only its initial state is free, and each `Free` with a value for each recording.
    """
    require_one_kind(model, "cross_validate")
    x = model.start()
    for slot, fitted in zip(model.slots, fit_of_others.model.slots, strict=True):
        if slot.shared is not None and fitted.shared is not None:
            x = x.at[slot.shared].set(fit_of_others.x[fitted.shared])
    record = stacking.pick(model.records, 0)
    scene = with_steps(starting_scene(model, record), model.slots, model.index.rows(x)[0])
    sensors = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, scene.sensors)
    own = [
        slot if slot.each else dataclasses.replace(slot, each=True, prior=slot.spread, spread=None)
        for slot in model.slots
        if slot.own is not None
    ]
    charts = (Known(fit_of_others.body),)
    kinds = model.index.start.shape[1] // 3
    index, slots = build_index(body_places(charts, None, model.count), own, kinds)
    records = eqx.tree_at(
        lambda r: [reading.sensor for reading in r.readings], model.records, list(sensors)
    )
    parts: Any = dict(measured=())  # they are in the fit of the others
    parts |= dict(charts=charts, torque=scene.torque, records=records, slots=slots, index=index)
    return dataclasses.replace(model, **parts)
