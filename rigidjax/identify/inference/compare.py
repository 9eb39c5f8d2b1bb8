"""Compare models by an information criterion."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np

from rigidjax import _checks
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data.recording import numbers_read
from rigidjax.identify.model.terms import decorrelate, whiten
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
    rows = [(criterion(one, one.x.size, shortest), name, one) for name, one in fits.items()]
    rows.sort(key=lambda row: row[0])
    best = rows[0][0]
    return tuple(
        Comparison(name, one.x.size, one.rms, one.correlation, float(total - best))
        for total, name, one in rows
    )


def criterion(fit: Fit, free: int, correlation: float) -> float:
    """Return Schwarz's criterion of a fit with `free` parameters, if one in `correlation` readings
    is independent.

    Jitter (errors of time stamps) correlates errors and raises their variance. Such errors are
    whitened to the variance of the noise alone, and the mean logarithm of the factor by which
    jitter raises the variance is added: white errors of this mean square are as likely.
    """
    # The logarithm of the mean square error of each sensor.
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
    many = np.array(list(map(numbers_read, model.records.readings))) / correlation
    return float(many @ out + free * np.log(max(many.sum(), 2.0)))
