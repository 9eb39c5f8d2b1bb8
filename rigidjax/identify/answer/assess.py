"""Measure the quality of a fit.

The measures are the covariance of the fit, the answer on its search, the answer on its model, and
the number of searches that ended at another point but fit as well.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rigidjax import _show
from rigidjax.identify.answer.allowance import describe_allowed, describe_doubtful
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
from rigidjax.identify.answer.parts import Assessment, BestPoint, Uncertainty
from rigidjax.identify.answer.result import Fit, Start
from rigidjax.identify.data.full_scale import beyond_gyros
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
    residuals_by_name,
    white_noise_variance,
)
from rigidjax.identify.uncertainty.degrees_of_freedom import prepare_freedom
from rigidjax.identify.uncertainty.flat_limit import describe_unreal
from rigidjax.identify.uncertainty.quantities import (
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
# A `Measured` contradicts the model if it is farther from it, in standard deviations.
FAR_OFF = 5.0


class _SensorGoodness(NamedTuple):
    word: str
    words: str = ""  # how large the errors are, and when
    chi2: float = 0.0  # zero if the noise is estimated, and so is the number of errors
    many: int = 0
    white: bool = False  # whether the errors, although large, are white and of unknown noise


class Goodness(NamedTuple):
    chi2: float  # over the sensors whose noise is given
    dof: int
    answer: Answer
    left: tuple[int, ...]  # the sensors whose errors the model does not explain


def goodness_of_fit(
    model: Model,
    noise: Noise,
    linear: Linearisation,
    times: CorrelationTimes,
    covariance: Float[np.ndarray, "n n"],
) -> Goodness:
    """Return the χ² of a fit, and whether its model explains the readings.

    The `covariance` is that for white errors.
    """
    own = linear.covariance_by_recording(covariance)
    each = [
        _goodness_of_sensor(model, noise, linear, times, own, index)
        for index in range(len(model.records.readings))
    ]
    if any(one.word == EXPLAINS for one in each):
        # Beside a sensor that the model explains, another one may read little but white noise.
        each = [one._replace(word=EXPLAINS) if one.white else one for one in each]
    left = tuple(index for index, one in enumerate(each) if one.word != EXPLAINS)
    rest = []
    for name, off in residuals_by_name(model, linear):
        words = f"the measured {name} is {abs(off):.3g} standard deviations off"
        far = abs(off) > FAR_OFF
        rest.append(_SensorGoodness(LEAVES if far else EXPLAINS, words, off**2, 1))
    words = [one.words for one in (*each, *rest) if one.word != EXPLAINS]
    found = [one.word for one in (*each, *rest)]
    word = next((word for word in (FAILS, LEAVES) if word in found), EXPLAINS)
    dof = max(sum(one.many for one in (*each, *rest)) - linear.free_count, 1)
    chi2 = float(sum(one.chi2 for one in (*each, *rest)))
    return Goodness(chi2, dof, Answer(word, tuple(words)), left)


def _goodness_of_sensor(
    model: Model,
    noise: Noise,
    linear: Linearisation,
    times: CorrelationTimes,
    covariance: Float[np.ndarray, "records m m"],
    index: int,
) -> _SensorGoodness:
    """Return whether the model explains the readings of one sensor, those at full scale left out.

    Errors count as larger than a given noise if their χ² exceeds the expected χ² by more than five
    standard deviations. Under a robust loss the median of the squared errors takes the place of χ².
    The errors are also compared with the variance of the readings. Ljung and Box's test (1978,
    doi:10.1093/biomet/65.2.297) says whether they are white, and `time_stamp_cause` whether they
    come from scattered time stamps.
    """
    reading, error, e = model.records.readings[index], linear.raw[index], linear.errors[index]
    weight, mask = linear.weights[index], linear.mask[index]
    values = np.asarray(reading.values)[reading.host_mask]
    varies = float(np.sum((values - values.mean(axis=0)) ** 2))
    # Sums of squares that are not larger than this bound of round-off count as zero.
    tiny = 1e-12 * float(np.sum(values**2))
    left, has_noise = float(np.sum(error[mask] ** 2)), reading.sensor.noise is not None
    factor, total, many = 1.0, 0.0, 0
    if has_noise:
        total, many = float(np.sum((weight[..., None] * e**2)[mask])), int(mask.sum())
        dof = max(many - linear.free_count, 1)
        factor = float(np.sqrt(total / dof)) if total > dof + 5 * np.sqrt(2 * dof) else 1.0
        if model.loss is not None and many:
            factor = _noise_ratio(np.sum(e[mask.all(axis=-1)] ** 2, axis=-1), e.shape[-1])
    root = np.sqrt(weight)[..., None]
    slope = linear.slopes[index] * root[..., None]
    white = left <= tiny or _is_white(e * root, mask, slope, covariance, has_noise)
    has_clock_error = left > tiny and time_stamp_cause(model, noise, linear, index) is not None
    # Errors cannot hide a missing part of the model in two cases: a noise is given and they are no
    # larger (`factor` is 1); or they are small beside the readings, with at most a QUARTER of the
    # variance of the readings.
    small = has_noise or left <= QUARTER * varies + tiny
    beyond = None if len(model.records.readings) > 1 else beyond_gyros([reading])
    if factor == 1.0 and white and small and not has_clock_error and not beyond:
        return _SensorGoodness(EXPLAINS, "", total, many)
    lasting = max(times.closeness, 0.0) * left
    missed = left > HALF * varies + tiny or lasting > TENTH * varies + tiny
    # An error has the unit of the reading only if both have the same number of components: an
    # attitude is read as a quaternion, for example, but its error is a rotation vector.
    alike = int(np.prod(reading.sensor.reading_shape)) == reading.sensor.components
    share = left / varies if varies > tiny and alike else None
    span = None if white else times.longest_span
    words = _describe_errors(model, reading, error, mask, factor, share, span)
    word = FAILS if missed and (factor > 1.0 or not has_noise) else LEAVES
    if beyond:
        words = f"{words}, and the Gyro reads {beyond:.3g} rad/s, more than gyros do"
    only_white = white and not has_noise and not has_clock_error and not beyond
    return _SensorGoodness(word, words, total, many, only_white)


def _describe_errors(
    model: Model,
    reading: Reading,
    error: Float[np.ndarray, "records times k"],
    mask: Bool[np.ndarray, "records times k"],
    factor: float,
    share: float | None,
    span: float | None,
) -> str:
    """Describe how large the errors of a sensor are (in its unit), and at which times.

    The `factor` is the size of the errors divided by the known noise, `share` their fraction of the
    variance of the readings (`None` if units differ or readings are constant), and `span` the
    number of samples over which they are autocorrelated (`None` for white errors).
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
    return f"{', '.join(words)}, {_when_largest(model, error, mask)}"


def _when_largest(
    model: Model,
    error: Float[np.ndarray, "records times k"],
    mask: Bool[np.ndarray, "records times k"],
) -> str:
    """Describe the shortest interval with half of the squared errors of the worst recording."""
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


def _noise_ratio(squared_lengths: Float[np.ndarray, " count"], components: int) -> float:
    """Return the factor by which errors are larger than their noise, 1 if that may be chance.

    It is √(m/m₁), where m is the median of their squared lengths in deviations, and m₁ is the
    expected one. Under a robust loss, which expects outliers, these would dominate χ².
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
    errors: Float[np.ndarray, "records times k"],
    mask_of_used: Bool[np.ndarray, "records times k"],
    slope: Float[np.ndarray, "records times k m"],
    covariance: Float[np.ndarray, "records m m"],
    has_noise: bool,
) -> bool:
    """Return whether the errors of a sensor, in deviations, are white, by Ljung and Box's test.

    A fit makes white errors correlated: it subtracts `slope covariance slopeᵀ` from the covariance
    of the errors (Box and Pierce 1970, doi:10.1080/01621459.1970.10481180). This is noticeable if
    there are many short recordings, and the test allows for it. If the noise is known, errors that
    are far smaller are no evidence of autocorrelation.
    """
    from scipy.special import chdtrc

    total, degrees = 0.0, 0
    for channel in range(errors.shape[-1]):
        long = mask_of_used[..., channel].sum(axis=1) >= 2 * LAGS
        mask = mask_of_used[long, :, channel]
        x = _centred(errors[long, :, channel, None], mask)[..., 0]
        j = _centred(slope[long, :, channel], mask)
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


def _centred(
    rows: Float[np.ndarray, "records times m"], mask: Bool[np.ndarray, "records times"]
) -> Float[np.ndarray, "records times m"]:
    """Return the entries in the `mask` minus their mean over time, moved to the front."""
    order = np.argsort(~mask, axis=1, kind="stable")
    valid = np.take_along_axis(mask, order, axis=1)[..., None]
    packed = np.where(valid, np.take_along_axis(rows, order[..., None], axis=1), 0.0)
    mean = packed.sum(axis=1, keepdims=True) / valid.sum(axis=1, keepdims=True)
    return np.where(valid, packed - mean, 0.0)


# A search has ended if the distance to the minimum of the linearised problem, in standard
# deviations, is below this number.
AT_THE_END = 0.05


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

    The recordings of `model` may be padded; the `Fit` holds the `original`. The texts of
    `interrupted` and `remarks` are reasons for the answer on the search.
    """
    x = best.x
    near = flat_limit.thicken(model, x)
    thickened = None if near is None else (near, blocks_at(model, near))
    linear = uncertainty.linearise(model, x, noise, best.blocks, thickened)
    times = uncertainty.correlation_times(linear)
    white = uncertainty.white_covariance(linear)
    stretches = leave_one_out(model, white.root)
    numbers, charts = quantities_on_host(model, x, near), named_charts(model)
    hidden = np.zeros((0, linear.free_count))
    if stretches is None:
        covariance = uncertainty.robust_covariance(linear, times, white)
    else:
        covariance, hidden = jackknife(stretches, white), stretches.hidden_directions
        remarks = (*remarks, *stretch_remarks(stretches, model, numbers, white))
    remarks = (*remarks, *late_delays(model, x))
    considered_errors = considered.considerations(model, linear, noise, white.determined)
    if considered_errors:
        added = sum(part.shifts @ part.shifts.T for part in considered_errors)
        words = considered.describe(considered_errors, model.records.sensors)
        covariance = dataclasses.replace(
            covariance,
            covariance=covariance.covariance + added,
            determined=covariance.determined + added,
            kind=f"{covariance.kind}; considered: {words}",
        )
    freedom = prepare_freedom(model, linear, times, white.determined)
    limits = flat_limit.limits(
        model, numbers, -white.determined @ linear.misfit_gradient, [one.suffix for one in charts]
    )
    # A search has ended if it converged, or if the minimum of the linearised problem is near: in a
    # long curved valley the steps of a search stay short, although the cost can hardly fall any
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
    # Another motion fits as well if a search converged to a higher cost, since two searches that
    # reach the same minimum end at slightly different costs, and if the readings change on the way
    # there: distant points of a flat valley predict the same readings.
    rivals = sum(
        one.fits
        and one.converged
        and one.cost > best_cost + 0.01 * margin
        and linear.squared_residual_change(np.asarray(one.x - x)) > 2 * margin
        for one in starts
    )
    rival = (f"{rivals} of {len(starts)} starts fit as well elsewhere",) if rivals else ()
    if believable and not any(start.fits for start in starts):
        remarks = ("no single start came near the best point", *remarks)
    unreal = describe_unreal(charts, flat_limit.bodies_at(model, x))
    reasons = (*unreal, *explanation.reasons)
    explanation = Answer(explanation.word, reasons) if best_cost < np.inf else Answer(FAILS)
    quantities = reported_quantities(
        model,
        numbers,
        covariance.determined,
        np.concatenate([covariance.null_directions, hidden]),
        limits,
        freedom.of_variance(numbers.jacobian),
    )
    allowed = describe_allowed(
        model, linear, noise, white.determined, considered_errors, quantities, numbers.jacobian
    )
    words = f"{allowed.words} {describe_doubtful(model, quantities)}".rstrip()
    if not np.isfinite(best_cost):
        search = Answer(NOT_ENDED, ("no start gave a finite cost",))
    elif not done:
        why = interrupted or ("max_steps reached",)
        search = Answer(NOT_ENDED, (*why, *remarks, "this is the best point found"))
    else:
        word = NOT_ALONE if rivals else FOUND
        search = Answer(word, (*rival, *interrupted, *remarks))
    return Fit(
        point=BestPoint(original, x, noise, near),
        uncertainty=Uncertainty(
            covariance=jnp.asarray(covariance.covariance),
            determined=jnp.asarray(covariance.determined),
            kind=covariance.kind,
            null_directions=jnp.asarray(covariance.null_directions),
            hidden_directions=jnp.asarray(hidden),
            limits=limits,
            freedom=freedom,
            considered=considered_errors,
            allowance=words,
            condition=allowed.condition,
        ),
        assessment=Assessment(search, explanation, left, chi2, dof, times.longest_span),
        quantities=quantities,
        starts=tuple(starts),
        linear=linear.first_times(original.records.t.shape[1]),
    )
