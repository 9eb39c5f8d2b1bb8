"""The quality of a fit: covariance, status, and whether other starts explain the data as well."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _show
from rigidjax.identify.answer.allowance import allowance
from rigidjax.identify.answer.answers import (
    EXPLAINS,
    FAILS,
    FOUND,
    LEAVES,
    NOT_ALONE,
    NOT_ENDED,
    Answer,
)
from rigidjax.identify.answer.causes import clock
from rigidjax.identify.answer.result import Fit, Start
from rigidjax.identify.model.model import Model, words_on_delays
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.search.noise import median_of_chi2
from rigidjax.identify.search.stages import (
    Attempt,
    errors_and_slopes,
    nominal,
    nominal_count,
)
from rigidjax.identify.uncertainty import considered, covariance as uncertainty, flat_limit
from rigidjax.identify.uncertainty.covariance import Linearised, Times, scatter
from rigidjax.identify.uncertainty.degrees_of_freedom import freedom_of
from rigidjax.identify.uncertainty.flat_limit import of_charts
from rigidjax.identify.uncertainty.quantities import (
    Quantity,
    charts,
    quantities as quantities_of,
    values_and_slopes,
)
from rigidjax.identify.uncertainty.stretches import (
    by_stretches,
    remarks as remarks_on,
    stretches_of,
)

# The false-alarm rate of the test for autocorrelated errors.
RARE = 1e-5
# Lags in the test for whiteness.
LAGS = 10
# A model explains too little if its errors exceed this share of the readings' variance.
HALF, QUARTER, TENTH = 0.5, 0.25, 0.1


def goodness(
    model: Model, noise: Noise, linear: Linearised, times: Times, covariance: np.ndarray
) -> tuple[float, int, Answer, tuple[int, ...]]:
    """χ² and its degrees of freedom (sensors of given noise), the answer, the sensors left over.

    The size of the errors is compared with a given noise (five standard deviations of χ², or of the
    median of the squares under a robust loss) and with the variance of the readings; Ljung and
    Box's test (1978, doi:10.1093/biomet/65.2.297) says whether they are white. Readings at full
    scale take no part. `covariance` (n, n) is that of white errors.
    """
    chi2, count, word, free = 0.0, 0, EXPLAINS, linear.size
    words: list[str] = []
    sensors: list[int] = []
    own, readings = linear.blocks(covariance), model.records.readings
    parts = zip(readings, linear.raw, linear.errors, linear.weights, linear.kept, strict=True)
    for index, (reading, error, e, weight, kept) in enumerate(parts):
        given = reading.sensor.noise is not None
        left, varies, tiny = _sizes(reading, error, kept)
        factor = 1.0
        if given:
            total, many = float(np.sum((weight[..., None] * e**2)[kept])), int(kept.sum())
            chi2, count = chi2 + total, count + many
            dof = max(many - free, 1)
            factor = float(np.sqrt(total / dof)) if total > dof + 5 * np.sqrt(2 * dof) else 1.0
            if model.loss is not None and many:
                squares = np.sum(e[kept.all(axis=-1)] ** 2, axis=-1)
                factor = _median_above(squares, e.shape[-1])
        root = np.sqrt(weight)[..., None]
        slope = linear.slopes[index] * root[..., None]
        white = left <= tiny or _white(e * root, kept, slope, own, given)
        late = left > tiny and clock(model, noise, linear, index) is not None
        # Errors below a given noise cannot hide a missing part of the model.
        small = given or left <= QUARTER * varies + tiny
        if factor == 1.0 and white and small and not late:
            continue
        lasting = max(times.closeness, 0.0) * left
        missed = left > HALF * varies + tiny or lasting > TENTH * varies + tiny
        if missed and (factor > 1.0 or not given):
            word = FAILS
        word = LEAVES if word == EXPLAINS else word
        sensors.append(index)
        # An error with as many numbers as a reading has its unit.
        alike = int(np.prod(reading.sensor.reading_shape)) == reading.sensor.components
        share = left / varies if varies > tiny and alike else None
        span = None if white else times.longest
        words.append(_in_words(model, reading, error, kept, factor, share, span))
    return chi2, max(count - free, 1), Answer(word, tuple(words)), tuple(sensors)


def _in_words(
    model: Model,
    reading: Any,
    error: np.ndarray,
    kept: np.ndarray,
    factor: float,
    share: float | None,
    span: float | None,
) -> str:
    """Size and place of errors in words; `share` of the variance, `span` of samples or `None`."""
    sensor, many = reading.sensor, max(int(kept.any(axis=-1).sum()), 1)
    size = np.sqrt(np.sum(error[kept] ** 2) / many)
    words = [f"the errors of the {type(sensor).__name__} are {size:.3g} {sensor.unit}"]
    if share is not None:
        words.append(f"{100 * np.sqrt(share):.2g} % of what varies in its readings")
    if factor > 1.0:
        words.append(f"{factor:.3g} times the noise")
    if span is not None:
        channels = [np.moveaxis(x, -1, 0).reshape(-1, x.shape[1]) for x in (error, kept)]
        rows = [row[seen] for row, seen in zip(*channels, strict=True)]
        apart = scatter(rows)
        over = np.sqrt(np.mean(np.concatenate(rows) ** 2) / apart) if apart > 0 else np.inf
        words.append(f"{over:.3g} times their scatter between neighbours")
        words.append(f"autocorrelated over {span:.0f} samples")
    return f"{', '.join(words)}, {_where(model, error, kept)}"


def _where(model: Model, error: np.ndarray, kept: np.ndarray) -> str:
    """The shortest time in which half of the squared errors are."""
    squares = np.sum(np.where(kept, error, 0.0) ** 2, axis=-1)
    row = int(np.argmax(squares.sum(axis=1)))
    count = int(model.counts[row])
    t, total = np.asarray(model.records.t)[row, :count], np.cumsum(squares[row, :count])
    last = np.searchsorted(total, total - squares[row, :count] + 0.5 * total[-1])
    first = int(np.argmin(np.where(last < count, t[np.minimum(last, count - 1)] - t, np.inf)))
    begin, end = t[first], t[min(last[first], count - 1)]
    if end - begin > 0.4 * (t[-1] - t[0]):
        return "all along"
    of = f" of recording {row}" if model.count > 1 else ""
    times = " to ".join(_show.time(when, t[-1] - t[0], 4) for when in (begin, end))
    return f"half of the squared ones from {times} s{of}"


def _sizes(reading: Any, error: np.ndarray, kept: np.ndarray) -> tuple[float, float, float]:
    """Sums of squares: of the errors, of the readings about their mean, and of round-off."""
    values = np.asarray(reading.values)[reading.seen]
    varies = float(np.sum((values - values.mean(axis=0)) ** 2))
    return float(np.sum(error[kept] ** 2)), varies, 1e-12 * float(np.sum(values**2))


def _median_above(squares: np.ndarray, size: int) -> float:
    """The same by the median: outliers are expected, and dominate χ²."""
    if not squares.size:
        return 1.0
    middle = float(np.median(squares))
    half, density = median_of_chi2(size)
    # The deviation of a sample's median is 1 / (2 f √n), f the density there.
    wide = 0.5 / (density * np.sqrt(squares.size))
    return float(np.sqrt(middle / half)) if middle > half + 5 * wide else 1.0


def _white(
    e: np.ndarray, kept: np.ndarray, slope: np.ndarray, covariance: np.ndarray, given: bool
) -> bool:
    """Whether whitened errors (R, T, k) are white; errors far below a `given` noise are no
    evidence.

    Fitted numbers take `slope covariance slopeᵀ` of white errors away, and leave them correlated,
    which shows in many short recordings (Box and Pierce 1970, doi:10.1080/01621459.1970.10481180).
    """
    from scipy.special import chdtrc

    total, degrees = 0.0, 0
    for channel in range(e.shape[-1]):
        long = kept[..., channel].sum(axis=1) >= 2 * LAGS
        seen = kept[long, :, channel]
        x = _gathered(e[long, :, channel, None], seen)[..., 0]
        j = _gathered(slope[long, :, channel], seen)
        taken, count = j @ covariance[long], len(seen)
        size, own = int(seen.sum()), float(np.sum(x * x))
        squares = max(own, float(size)) if given else own
        if not squares > 0:
            continue
        for lag in range(1, LAGS + 1):
            pairs = size - lag * count
            lost = pairs / size * count + np.sum(taken[:, lag:] * j[:, :-lag])
            rho = (float(np.sum(x[:, lag:] * x[:, :-lag])) + lost * own / size) / squares
            total += size * (size + 2.0) * rho**2 / pairs
            degrees += 1
    return degrees == 0 or bool(chdtrc(degrees, total) > RARE)


def _gathered(rows: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return rows (R, T, m) about their mean: first those of `seen` (R, T), then zeros."""
    order = np.argsort(~seen, axis=1, kind="stable")
    shown = np.take_along_axis(seen, order, axis=1)[..., None]
    moved = np.where(shown, np.take_along_axis(rows, order[..., None], axis=1), 0.0)
    mean = moved.sum(axis=1, keepdims=True) / shown.sum(axis=1, keepdims=True)
    return np.where(shown, moved - mean, 0.0)


# A search may end so near to the least misfit, in standard deviations.
AT_THE_END = 0.05


def _search(
    best_cost: float, done: bool, rivals: str, interrupted: Sequence[str], remarks: Sequence[str]
) -> Answer:
    """The end of the search in words; `rivals` are the starts that fit as well elsewhere."""
    if not np.isfinite(best_cost):
        return Answer(NOT_ENDED, ("no start gave a finite misfit",))
    if not done:
        why = interrupted or ("max_steps reached",)
        return Answer(NOT_ENDED, (*why, *remarks, "this is the best point found"))
    if rivals:
        return Answer(NOT_ALONE, (rivals, *interrupted, *remarks))
    return Answer(FOUND, (*interrupted, *remarks))


def _rivals(
    good: Sequence[Start], best_cost: float, margin: float, linear: Linearised, x: Array
) -> int:
    """How many of the starts that fit as well ended elsewhere."""
    count = 0
    for item in good:
        if item.converged and item.cost > best_cost + 0.01 * margin:
            away = item.x - x
            # In a flat valley readings do not tell two points apart.
            count += linear.along(np.asarray(away)) > 2 * margin
    return count


def assess(
    model: Model,
    best: Attempt,
    noise: Noise,
    attempts: list[Attempt],
    best_cost: float,
    shown: Model,
    interrupted: Sequence[str],
    remarks: Sequence[str],
) -> Fit:
    """The `Fit` of the best point of all starts, converged or not, with the model `shown`."""
    x = best.x
    near = flat_limit.thickened(model, x)
    thickened = None if near is None else (near, errors_and_slopes(model, near))
    linear = uncertainty.linearise(model, x, noise, best.blocks, thickened)
    times = uncertainty.correlation_times(linear)
    white = uncertainty.of_white(linear)
    stretches = stretches_of(model, linear)
    numbers, of = values_and_slopes(model, x, near), charts(model)
    hidden = np.zeros((0, linear.size))
    if stretches is None:
        spread = uncertainty.spread(linear, times, white)
    else:
        spread, hidden = by_stretches(stretches, white), stretches.hidden
        remarks = (*remarks, *remarks_on(stretches, model, numbers, white))
    remarks = (*remarks, *words_on_delays(model, x))
    parts = considered.considerations(model, linear, noise, white.seen)
    spread = _with_considered(spread, parts, model)
    shifts = considered.stacked_shifts(parts, linear.size)
    freedom = freedom_of(model, linear, times, white.seen, shifts)
    limits = flat_limit.limits(model, numbers, -white.seen @ linear.slope, [n for n, _ in of])
    # Steps stay short in a long curved valley, although hardly anything is left to gain.
    held = [limit.slope for limit in limits if limit.free < 0]
    near_end = AT_THE_END
    if count := nominal_count(model):
        near_end *= float(np.sqrt(2.0 * best_cost / count))
    done = bool(best.converged) or uncertainty.distance(linear, white, held) < near_end
    chi2, dof, explanation, left = goodness(model, noise, linear, times, white.seen)
    believable = explanation.word != FAILS
    # Ten units of log-likelihood, of the noise as estimated; autocorrelated errors count as fewer.
    guessed = not all(r.known_noise and not nominal(r) for r in model.records.readings)
    unit = 2 * best_cost / model.records.size if guessed else 1.0
    margin = 10.0 * unit * max(times.longest, 1.0)

    level = best_cost + margin if believable else -np.inf
    ends = [(one.x, float(one.cost), bool(one.converged)) for one in attempts]
    starts = [Start(*end, end[1] <= level) for end in ends]
    rivals = _rivals([s for s in starts if s.fits], best_cost, margin, linear, x)
    rival = f"{rivals} of {len(starts)} starts fit as well elsewhere" if rivals else ""
    if believable and not any(start.fits for start in starts):
        remarks = ("no single start came near the best point", *remarks)
    unreal = of_charts(of, flat_limit.bodies_of(model, x))
    reasons = (*unreal, *explanation.reasons)
    explanation = Answer(explanation.word, reasons) if best_cost < np.inf else Answer(FAILS)
    quantities = quantities_of(
        model,
        numbers,
        spread.seen,
        np.concatenate([spread.null_directions, hidden]),
        limits,
        freedom.of(numbers[1]),
    )
    words = _allowance(model, linear, noise, white.seen, parts, quantities, numbers[1])
    return Fit(
        shown,
        x,
        jnp.asarray(spread.covariance),
        jnp.asarray(spread.seen),
        spread.kind,
        noise,
        tuple(starts),
        chi2,
        dof,
        times.longest,
        times.independent,
        jnp.asarray(spread.singular_values),
        jnp.asarray(spread.null_directions),
        quantities,
        _search(best_cost, done, rival, interrupted, remarks),
        explanation,
        left,
        limits,
        near,
        freedom,
        linear.first_times(shown.records.t.shape[1]),
        parts,
        words,
        jnp.asarray(hidden),
    )


def _allowance(
    model: Model,
    linear: Linearised,
    noise: Noise,
    covariance: np.ndarray,
    parts: tuple[considered.Consideration, ...],
    quantities: Sequence[Quantity],
    slopes: np.ndarray,
) -> str:
    """Return what the intervals allow for, of moments and ratios, else of the `Free`s."""
    bodies = {log + name for name, chart in charts(model) for log in chart.log_names}
    free = {slot.name for slot in model.slots}
    rows = [i for i, one in enumerate(quantities) if one.name in bodies and one.name != "mass"]
    rows = rows or [i for i, one in enumerate(quantities) if one.name.split(" ")[0] in free]
    rows = [i for i in rows if np.isfinite(quantities[i].deviation)]
    known = rows if np.isfinite(linear.dense).all() and np.isfinite(covariance).all() else []
    moves = considered.unit_moves(model, linear, noise, covariance, slopes[known]) if known else []
    return allowance(model, parts, moves, [quantities[i] for i in known])


def _with_considered(
    spread: uncertainty.Spread, parts: tuple[considered.Consideration, ...], model: Model
) -> uncertainty.Spread:
    """Return the covariance with that of considered errors added."""
    if not parts:
        return spread
    root = considered.stacked_shifts(parts, len(spread.seen))
    added, words = root @ root.T, considered.in_words(parts, model.records.sensors)
    return dataclasses.replace(
        spread,
        covariance=spread.covariance + added,
        seen=spread.seen + added,
        kind=f"{spread.kind}; considered: {words}",
    )
