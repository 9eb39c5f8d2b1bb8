"""Measure the quality of a fit.

The measures are the covariance of the fit, the answer on its search, the answer on its model, and
the number of searches that ended at another point but fit as well.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _show
from rigidjax.identify.answer.allowance import describe_allowed_sensor_errors, describe_large_biases
from rigidjax.identify.answer.answers import (
    EXPLAINS,
    FAILS,
    FOUND,
    LEAVES,
    NOT_ALONE,
    NOT_ENDED,
    Answer,
)
from rigidjax.identify.answer.causes import time_stamp_cause
from rigidjax.identify.answer.result import Fit, Start
from rigidjax.identify.data.recording import Reading
from rigidjax.identify.model.model import Model, late_delays
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.search.noise import chi2_median
from rigidjax.identify.search.stages import (
    Attempt,
    blocks_at,
    has_unit_noise,
    unit_noise_count,
)
from rigidjax.identify.uncertainty import considered, covariance as uncertainty, flat_limit
from rigidjax.identify.uncertainty.covariance import (
    CorrelationTimes,
    Linearisation,
    white_noise_variance,
)
from rigidjax.identify.uncertainty.degrees_of_freedom import prepare_freedom
from rigidjax.identify.uncertainty.flat_limit import describe_unreal
from rigidjax.identify.uncertainty.quantities import (
    Quantity,
    named_charts,
    quantities_on_host,
    reported_quantities,
)
from rigidjax.identify.uncertainty.stretches import (
    jackknife,
    leave_one_out,
    stretch_remarks,
)

# The test for autocorrelated errors has this rate of false alarms. The rate is low because one fit
# tests many sensors and channels.
RARE = 1e-5
# The test for autocorrelated errors uses the autocorrelations at lags of 1 to this number of
# samples.
LAGS = 10
# These numbers are fractions of the variance of the readings. A model fails if the mean square of
# its errors exceeds HALF of the variance, or if the autocorrelated part of this mean square exceeds
# a TENTH of the variance; but it does not fail if the errors are as small as a given noise. Errors
# whose mean square is at most a QUARTER of the variance are small.
HALF, QUARTER, TENTH = 0.5, 0.25, 0.1


def goodness_of_fit(
    model: Model,
    noise: Noise,
    linear: Linearisation,
    times: CorrelationTimes,
    covariance: np.ndarray,
) -> tuple[float, int, Answer, tuple[int, ...]]:
    """Return the χ² of a fit, and an answer that says whether its model explains the readings.

    The errors of a sensor count as larger than its given noise if their χ² exceeds the expected χ²
    by more than five standard deviations of χ². Under a robust loss the median of the squared
    errors takes the place of χ². The errors are also compared with the variance of the readings.
    Ljung and Box's test (1978, doi:10.1093/biomet/65.2.297) says whether the errors are white.
    Readings at full scale are left out.

    **Arguments:**

    - `model`, `noise`: the fitted model, and the standard deviations of the errors of its sensors.
    - `linear`: the errors and their derivatives at the best point.
    - `times`: the autocorrelation times of the errors.
    - `covariance`: (n, n) the covariance of the free numbers for white errors.

    **Returns** four things:

    - χ², summed over the sensors whose noise is given;
    - the degrees of freedom of χ²;
    - the answer on the model;
    - the indices of the sensors whose errors the model does not explain.
    """
    chi2, count, word, free = 0.0, 0, EXPLAINS, linear.free_count
    words: list[str] = []
    sensors: list[int] = []
    own, readings = linear.covariance_by_recording(covariance), model.records.readings
    parts = zip(readings, linear.raw, linear.errors, linear.weights, linear.mask, strict=True)
    for index, (reading, error, e, weight, mask) in enumerate(parts):
        has_noise = reading.sensor.noise is not None
        left, varies, tiny = _sums_of_squares_of_errors_readings_round_off(reading, error, mask)
        factor = 1.0
        if has_noise:
            total, many = float(np.sum((weight[..., None] * e**2)[mask])), int(mask.sum())
            chi2, count = chi2 + total, count + many
            dof = max(many - free, 1)
            factor = float(np.sqrt(total / dof)) if total > dof + 5 * np.sqrt(2 * dof) else 1.0
            if model.loss is not None and many:
                squares = np.sum(e[mask.all(axis=-1)] ** 2, axis=-1)
                factor = _noise_ratio_by_median(squares, e.shape[-1])
        root = np.sqrt(weight)[..., None]
        slope = linear.slopes[index] * root[..., None]
        white = left <= tiny or _is_white(e * root, mask, slope, own, has_noise)
        has_clock_error = left > tiny and time_stamp_cause(model, noise, linear, index) is not None
        # Errors cannot hide a missing part of the model in two cases: a noise is given and they are
        # no larger (`factor` is 1); or they are small beside the readings, with at most a QUARTER
        # of the variance of the readings.
        small = has_noise or left <= QUARTER * varies + tiny
        if factor == 1.0 and white and small and not has_clock_error:
            continue
        lasting = max(times.closeness, 0.0) * left
        missed = left > HALF * varies + tiny or lasting > TENTH * varies + tiny
        if missed and (factor > 1.0 or not has_noise):
            word = FAILS
        word = LEAVES if word == EXPLAINS else word
        sensors.append(index)
        # An error has the unit of the reading only if both have the same number of components: an
        # attitude is read as a quaternion, for example, but its error is a rotation vector.
        alike = int(np.prod(reading.sensor.reading_shape)) == reading.sensor.components
        share = left / varies if varies > tiny and alike else None
        span = None if white else times.longest_span
        words.append(_describe_errors(model, reading, error, mask, factor, share, span))
    return chi2, max(count - free, 1), Answer(word, tuple(words)), tuple(sensors)


def _describe_errors(
    model: Model,
    reading: Reading,
    error: np.ndarray,
    mask: np.ndarray,
    factor: float,
    share: float | None,
    span: float | None,
) -> str:
    """Describe in words how large the errors of a sensor are, and at which times.

    **Arguments:**

    - `model`, `reading`: the fitted model, and the readings of the sensor.
    - `error`: (R, T, k) reading minus prediction in the unit of the sensor, for R recordings, T
      times and k components.
    - `mask`: (R, T, k) true for the errors to use: those of readings that are neither masked nor at
      full scale.
    - `factor`: the size of the errors divided by the known noise. It is written only if it is above
      1.
    - `share`: the sum of squared errors divided by the sum of squared differences of the readings
      from their mean. It is `None` if the readings are constant, or if they have another unit than
      the errors.
    - `span`: the number of samples over which the errors are autocorrelated, or `None` for white
      errors.
    """
    sensor, many = reading.sensor, max(int(mask.any(axis=-1).sum()), 1)
    size = np.sqrt(np.sum(error[mask] ** 2) / many)
    words = [f"the errors of the {type(sensor).__name__} are {size:.3g} {sensor.unit}"]
    if share is not None:
        words.append(f"{100 * np.sqrt(share):.2g} % of what varies in its readings")
    if factor > 1.0:
        words.append(f"{factor:.3g} times the noise")
    if span is not None:
        channels = [np.moveaxis(x, -1, 0).reshape(-1, x.shape[1]) for x in (error, mask)]
        rows = [row[mask] for row, mask in zip(*channels, strict=True)]
        apart = white_noise_variance(rows)
        over = np.sqrt(np.mean(np.concatenate(rows) ** 2) / apart) if apart > 0 else np.inf
        words.append(f"{over:.3g} times their scatter between neighbours")
        words.append(f"autocorrelated over {span:.0f} samples")
    return f"{', '.join(words)}, {_describe_time_of_largest_errors(model, error, mask)}"


def _describe_time_of_largest_errors(model: Model, error: np.ndarray, mask: np.ndarray) -> str:
    """Describe in words at which times the errors of a sensor are largest.

    The words give the shortest interval of time that contains half of the sum of squared errors of
    one recording: the recording in which this sum is largest. If the interval is longer than 40 %
    of the recording, the words are "all along".

    **Arguments:**

    - `model`: the fitted model, which holds the times of R recordings.
    - `error`: (R, T, k) the errors of the sensor at T times, in k components.
    - `mask`: (R, T, k) true for the errors to use: those of readings that are neither masked nor at
      full scale.
    """
    squares = np.sum(np.where(mask, error, 0.0) ** 2, axis=-1)
    row = int(np.argmax(squares.sum(axis=1)))
    count = int(model.counts[row])
    t, total = np.asarray(model.records.t)[row, :count], np.cumsum(squares[row, :count])
    last = np.searchsorted(total, total - squares[row, :count] + 0.5 * total[-1])
    first = int(np.argmin(np.where(last < count, t[np.minimum(last, count - 1)] - t, np.inf)))
    begin, end = t[first], t[min(last[first], count - 1)]
    if end - begin > 0.4 * (t[-1] - t[0]):
        return "all along"
    of_recording = f" of recording {row}" if model.count > 1 else ""
    times = " to ".join(_show.time_as_text(when, t[-1] - t[0], 4) for when in (begin, end))
    return f"half of the squared ones from {times} s{of_recording}"


def _sums_of_squares_of_errors_readings_round_off(
    reading: Reading, error: np.ndarray, mask: np.ndarray
) -> tuple[float, float, float]:
    """Return three sums of squares for one sensor, which are compared with each other.

    They are the sum of its squared errors; the sum of the squared differences of its readings from
    their mean; and 1e-12 times the sum of its squared readings. The last one is a bound of
    round-off: the other two sums count as zero if they are not larger.

    **Arguments:**

    - `reading`: the readings of the sensor, with their mask.
    - `error`: (R, T, k) reading minus prediction, for R recordings, T times and k components.
    - `mask`: (R, T, k) true for the errors to use: those of readings that are neither masked nor at
      full scale.
    """
    values = np.asarray(reading.values)[reading.host_mask]
    varies = float(np.sum((values - values.mean(axis=0)) ** 2))
    return float(np.sum(error[mask] ** 2)), varies, 1e-12 * float(np.sum(values**2))


def _noise_ratio_by_median(squared_lengths: np.ndarray, components: int) -> float:
    """Return the factor by which errors are larger than their given noise.

    The errors are given in standard deviations of the noise. The factor is √(m/m₁), where m is the
    median of the squared lengths of the errors, and m₁ is the expected median for errors that are
    as large as the noise. The factor is 1 if m − m₁ is at most five standard deviations of m, since
    so small an excess may be chance. The median takes the place of χ² under a robust loss, because
    a robust loss is chosen where outliers are expected, and outliers would dominate χ².

    **Arguments:**

    - `squared_lengths`: (N,) the squared length of each of N errors.
    - `components`: the number of components of an error.
    """
    if not squared_lengths.size:
        return 1.0
    middle = float(np.median(squared_lengths))
    half, density = chi2_median(components)
    # The standard deviation of the median of n samples is 1 / (2 f √n), with f the density at the
    # median.
    wide = 0.5 / (density * np.sqrt(squared_lengths.size))
    return float(np.sqrt(middle / half)) if middle > half + 5 * wide else 1.0


def _is_white(
    errors: np.ndarray,
    mask_of_used: np.ndarray,
    slope: np.ndarray,
    covariance: np.ndarray,
    has_noise: bool,
) -> bool:
    """Return whether the errors of a sensor are white (not autocorrelated), by Ljung and Box's
    test.

    A fit makes white errors correlated: it subtracts `slope covariance slopeᵀ` from the covariance
    of the errors (Box and Pierce 1970, doi:10.1080/01621459.1970.10481180). This correlation is
    noticeable if there are many short recordings. The test allows for it.

    **Arguments:**

    - `errors`: (R, T, k) the whitened errors (in standard deviations) in R recordings, at T times,
      of k components.
    - `mask_of_used`: (R, T, k) true for the errors to use: those of readings that are neither
      masked nor at full scale.
    - `slope`: (R, T, k, m) the derivatives of the errors with respect to the m free numbers of each
      recording.
    - `covariance`: (R, m, m) the covariance of the free numbers of each recording, computed as if
      the errors were white.
    - `has_noise`: whether the noise is known. If the noise is known, errors that are far smaller
      than the noise are no evidence of autocorrelation.
    """
    from scipy.special import chdtrc

    total, degrees = 0.0, 0
    for channel in range(errors.shape[-1]):
        long = mask_of_used[..., channel].sum(axis=1) >= 2 * LAGS
        mask = mask_of_used[long, :, channel]
        x = _masked_entries_about_mean(errors[long, :, channel, None], mask)[..., 0]
        j = _masked_entries_about_mean(slope[long, :, channel], mask)
        taken, count = j @ covariance[long], len(mask)
        size, own = int(mask.sum()), float(np.sum(x * x))
        squares = max(own, float(size)) if has_noise else own
        if not squares > 0:
            continue
        for lag in range(1, LAGS + 1):
            pairs = size - lag * count
            lost = pairs / size * count + np.sum(taken[:, lag:] * j[:, :-lag])
            rho = (float(np.sum(x[:, lag:] * x[:, :-lag])) + lost * own / size) / squares
            total += size * (size + 2.0) * rho**2 / pairs
            degrees += 1
    return degrees == 0 or bool(chdtrc(degrees, total) > RARE)


def _masked_entries_about_mean(rows: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the selected entries of each row minus their mean, moved to the front of the row.

    The argument `rows` (R, T, m) holds R rows of T entries, and each entry has m numbers. An entry
    is selected where `mask` (R, T) is true. The mean is that of the selected entries of the row.
    The selected entries keep their order, and zeros follow them, so that the result has the shape
    (R, T, m), too.
    """
    order = np.argsort(~mask, axis=1, kind="stable")
    valid = np.take_along_axis(mask, order, axis=1)[..., None]
    packed = np.where(valid, np.take_along_axis(rows, order[..., None], axis=1), 0.0)
    mean = packed.sum(axis=1, keepdims=True) / valid.sum(axis=1, keepdims=True)
    return np.where(valid, packed - mean, 0.0)


# A search has ended if the distance to the minimum of the linearised problem, in standard
# deviations, is below this number.
AT_THE_END = 0.05


def _answer_on_search(
    best_cost: float, ended: bool, rivals: str, interrupted: Sequence[str], remarks: Sequence[str]
) -> Answer:
    """Return an answer that says whether the search of a fit found the best point.

    The word of the answer is `found`, `not alone` (another motion fits as well) or `not ended`.

    **Arguments:**

    - `best_cost`: the least cost (half the sum of squared residuals) of all starts.
    - `ended`: whether the search reached a minimum.
    - `rivals`: a sentence on the starts that ended at other points and fit as well, or "".
    - `interrupted`: one text for each interrupt (Ctrl-C) of the search; empty if there was none.
    - `remarks`: other reasons for the answer, in words.
    """
    if not np.isfinite(best_cost):
        return Answer(NOT_ENDED, ("no start gave a finite misfit",))
    if not ended:
        why = interrupted or ("max_steps reached",)
        return Answer(NOT_ENDED, (*why, *remarks, "this is the best point found"))
    if rivals:
        return Answer(NOT_ALONE, (rivals, *interrupted, *remarks))
    return Answer(FOUND, (*interrupted, *remarks))


def _count_rivals(
    starts: Sequence[Start], best_cost: float, margin: float, linear: Linearisation, x: Array
) -> int:
    """Return how many searches converged to another point than the best one and fit the readings as
    well.

    An end of a search is counted as another point if two conditions hold:

    - Its cost exceeds `best_cost` by more than a hundredth of `margin`. Two searches that reach the
      same minimum end at slightly different costs.
    - The step from the best point x to this end changes the errors, by the linearisation at x, by a
      sum of squares of more than twice `margin`. Distant points of a flat valley predict the same
      readings and are therefore not counted.

    **Arguments:**

    - `starts`: the ends of the searches that fit as well as the best one.
    - `best_cost`: the least cost (half the sum of squared residuals) of all searches.
    - `margin`: the largest difference of cost with which two points fit equally well.
    - `linear`: the errors at the best point, with their derivatives.
    - `x`: (n,) the free numbers at the best point.
    """
    count = 0
    for item in starts:
        if item.converged and item.cost > best_cost + 0.01 * margin:
            away = item.x - x
            # Two points of a flat valley differ, but predict the same readings: such points are not
            # counted as different.
            count += linear.squared_residual_change(np.asarray(away)) > 2 * margin
    return count


def assess(
    model: Model,
    best: Attempt,
    noise: Noise,
    attempts: list[Attempt],
    best_cost: float,
    original: Model,
    interrupted: Sequence[str],
    remarks: Sequence[str],
) -> Fit:
    """Return the `Fit` of the best point of all starts, whether or not the search converged there.

    **Arguments:**

    - `model`: the model that was fitted, whose recordings may be padded with masked readings.
    - `best`: the best point, with the errors at this point and their derivatives.
    - `noise`: the standard deviations of the errors of each sensor.
    - `attempts`: the ends of the searches from all starts.
    - `best_cost`: the least cost of the `attempts`.
    - `original`: the model that the `Fit` holds, with the readings as the user gave them.
    - `interrupted`, `remarks`: reasons for the answer on the search, in words.
    """
    x = best.x
    near = flat_limit.thicken(model, x)
    thickened = None if near is None else (near, errors_and_slopes(model, near))
    linear = uncertainty.linearise(model, x, noise, best.blocks, thickened)
    times = uncertainty.correlation_times(linear)
    white = uncertainty.white_covariance(linear)
    stretches = leave_one_out(model, linear)
    numbers, of = (
        quantities_on_host(model, x, near),
        named_charts(model),
    )
    hidden = np.zeros((0, linear.free_count))
    if stretches is None:
        covariance = uncertainty.robust_covariance(linear, times, white)
    else:
        covariance, hidden = (
            jackknife(stretches, white),
            stretches.hidden_directions,
        )
        remarks = (
            *remarks,
            *stretch_remarks(stretches, model, numbers, white),
        )
    remarks = (*remarks, *describe_delays_outside_windows(model, x))
    considered_errors = considered.considerations(model, linear, noise, white.determined)
    covariance = _covariance_with_considered_errors(covariance, considered_errors, model)
    shifts = considered.shift_matrix(considered_errors, linear.free_count)
    freedom = prepare_freedom(model, linear, times, white.determined, shifts)
    limits = flat_limit.limits(
        model, numbers, -white.determined @ linear.misfit_gradient, [n for n, _ in of]
    )
    # A search has ended if it converged, or if the minimum of the linearised problem is near: in a
    # long curved valley the steps of a search stay short, although the misfit can hardly fall any
    # more. If a body would be unreal at this minimum (`limit.free` is negative), the distance to
    # the minimum is measured with the flatness of the body held constant.
    held = [limit.slope for limit in limits if limit.free < 0]
    near_end = AT_THE_END
    if count := unit_noise_count(model):
        near_end *= float(np.sqrt(2.0 * best_cost / count))
    done = bool(best.converged) or uncertainty.distance_to_minimum(linear, white, held) < near_end
    chi2, dof, explanation, left = goodness_of_fit(model, noise, linear, times, white.determined)
    believable = explanation.word != FAILS
    # A start fits as well as the best one if its log-likelihood is at most ten lower, so that its
    # cost (half the sum of squared residuals) is at most `margin` higher. If some noise is not
    # known, the mean squared residual at the best point is the unit of the cost. Autocorrelated
    # errors count as fewer independent errors, which makes `margin` larger.
    guessed = not all(r.has_known_noise and not has_unit_noise(r) for r in model.records.readings)
    unit = 2 * best_cost / model.records.size if guessed else 1.0
    margin = 10.0 * unit * max(times.longest_span, 1.0)

    level = best_cost + margin if believable else -np.inf
    ends = [(one.x, float(one.cost), bool(one.converged)) for one in attempts]
    starts = [Start(*end, end[1] <= level) for end in ends]
    rivals = _count_rivals([s for s in starts if s.fits], best_cost, margin, linear, x)
    rival = f"{rivals} of {len(starts)} starts fit as well elsewhere" if rivals else ""
    if believable and not any(start.fits for start in starts):
        remarks = ("no single start came near the best point", *remarks)
    unreal = describe_unreal(of, flat_limit.bodies_at(model, x))
    reasons = (*unreal, *explanation.reasons)
    explanation = Answer(explanation.word, reasons) if best_cost < np.inf else Answer(FAILS)
    quantities = reported_quantities(
        model,
        numbers,
        covariance.determined,
        np.concatenate([covariance.null_directions, hidden]),
        limits,
        freedom.of_variance(numbers[1]),
    )
    words = _describe_constant_sensor_errors(
        model, linear, noise, white.determined, considered_errors, quantities, numbers[1]
    )
    words = f"{words} {describe_large_biases(model, quantities)}".rstrip()
    return Fit(
        original,
        x,
        jnp.asarray(covariance.covariance),
        jnp.asarray(covariance.determined),
        covariance.kind,
        noise,
        tuple(starts),
        chi2,
        dof,
        times.longest_span,
        times.independent,
        jnp.asarray(covariance.singular_values),
        jnp.asarray(covariance.null_directions),
        quantities,
        _answer_on_search(best_cost, done, rival, interrupted, remarks),
        explanation,
        left,
        limits,
        near,
        freedom,
        linear.first_times(original.records.t.shape[1]),
        considered_errors,
        words,
        jnp.asarray(hidden),
    )


def _describe_constant_sensor_errors(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: np.ndarray,
    considered_errors: tuple[considered.Consideration, ...],
    quantities: Sequence[Quantity],
    slopes: np.ndarray,
) -> str:
    """Return sentences that say which constant errors of sensors, such as an error of scale, the
    intervals of a fit allow for.

    The intervals allow for the errors of a sensor that has a `Tolerance`. For a sensor without a
    tolerance, the sentences say how far a small error of its scale or of its axes would move the
    moments of the body or their ratios. If the fit reports none of these, the sentences say how far
    the values of the `Free`s (numbers that a fit may move) would move.

    **Arguments:**

    - `model`, `noise`: the fitted model, and the standard deviations of the errors of its sensors.
    - `linear`: the errors and their derivatives at the best point.
    - `covariance`: (n, n) the covariance of the free numbers, computed as if the errors were white.
    - `considered_errors`: the constant errors, within the `Tolerance` of a sensor, that the
      intervals allow for.
    - `quantities`: the q reported quantities.
    - `slopes`: the derivatives (q, n) of the quantities with respect to the n free numbers. Further
      rows at the end, for the flatness of bodies, are not used.
    """
    bodies = {log + name for name, chart in named_charts(model) for log in chart.log_names}
    free = {slot.name for slot in model.slots}
    rows = [i for i, one in enumerate(quantities) if one.name in bodies and one.name != "mass"]
    rows = rows or [i for i, one in enumerate(quantities) if one.name.split(" ")[0] in free]
    rows = [i for i in rows if np.isfinite(quantities[i].deviation)]
    known = (
        rows
        if np.isfinite(linear.weighted_jacobian).all() and np.isfinite(covariance).all()
        else []
    )
    usual_shifts = (
        considered.usual_shifts(model, linear, noise, covariance, slopes[known]) if known else []
    )
    return describe_allowed_sensor_errors(
        model, considered_errors, usual_shifts, [quantities[i] for i in known]
    )


def _covariance_with_considered_errors(
    covariance: uncertainty.Covariance,
    considered_errors: tuple[considered.Consideration, ...],
    model: Model,
) -> uncertainty.Covariance:
    """Return the `covariance` of a fit plus the covariance that considered errors of its sensors
    cause.

    A considered error is a constant error of a sensor, such as an error of scale. Its size is
    limited by the `Tolerance` of the sensor. The fit does not estimate it, but the intervals allow
    for it.

    **Arguments:**

    - `covariance`: the covariance of the free numbers.
    - `considered_errors`: the considered errors. Each one holds the changes of the free numbers
      that it causes.
    - `model`: the fitted model.
    """
    if not considered_errors:
        return covariance
    root = considered.shift_matrix(considered_errors, len(covariance.determined))
    added, words = (
        root @ root.T,
        considered.describe(considered_errors, model.records.sensors),
    )
    return dataclasses.replace(
        covariance,
        covariance=covariance.covariance + added,
        determined=covariance.determined + added,
        kind=f"{covariance.kind}; considered: {words}",
    )
