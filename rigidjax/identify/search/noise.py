"""Estimate the noise of sensors and the jitter of their clocks from the errors of a fit."""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import Blocks, Noise, error_derivatives_by_delay, reading_weights
from rigidjax.identify.uncertainty.covariance import linearise, white_covariance
from rigidjax.identify.uncertainty.degrees_of_freedom import counts_of_determined_numbers

# The joint estimate of the noise and the jitter of a sensor takes at most this many iterations.
ROUNDS = 500


def estimate_noise(model: Model, x: Array, blocks: Blocks, noise: Noise) -> tuple[Model, Noise]:
    """Return two things: the model with the estimated jitter of its sensors; and the noise of its
    sensors.

    The noise (R, k) of a sensor with k channels in R recordings is the noise that the sensor
    states. If the sensor states no noise, it is estimated from the scatter of the sensor's errors,
    as one number for all channels and for all recordings of a group. A fit makes the errors smaller
    than the noise, by a large factor if readings are few. The estimate is corrected for this effect
    by the leverage of the sensor's readings at the present `noise`, as in restricted maximum
    likelihood.

    **Arguments:**

    - `x`: (n,) the free numbers of the `model`.
    - `blocks`: the errors and derivatives at x, as `terms.errors_and_jacobians` returns them.
    - `noise`: the present estimate of the noise, (R, k) of each sensor.
    """
    errors = blocks[0]
    weights = reading_weights(model, errors, noise)
    groups, out = np.asarray(model.noise_groups), []
    shares = _shares_of_squared_error_left_by_fit(model, x, blocks, noise)
    readings = list(model.records.readings)
    for index, (reading, error, sigma, weight, share) in enumerate(
        zip(readings, errors, noise, weights, shares, strict=True)
    ):
        # The mask leaves out readings at full scale, whose errors are not noise.
        sensor, mask = cast(Any, reading.sensor), reading.usable_channel_mask
        known = sensor.noise is not None
        if known:
            sigma = sensor.noise
        else:
            squares = np.sum(np.where(mask, np.asarray(error) ** 2, 0.0), axis=2)
            if model.loss is None:
                parts = np.bincount(groups, squares.sum(axis=1))
                variance = parts / np.maximum(np.bincount(groups, mask.sum(axis=(1, 2))), 1)
            else:
                variance = _variance_by_median(squares, mask, groups)
            # The noise is never less than round-off, since even the errors of perfect data are
            # divided by the noise.
            floor = 1e-15 * float(np.abs(np.asarray(reading.values)).max() + 1e-300)
            each = np.maximum(np.sqrt(variance / share), floor)[groups]
            each = np.broadcast_to(each[:, None], sigma.shape)
            sigma = jnp.asarray(each.astype(sigma.dtype))
        if reading.jitter_error is not None:
            change = error_derivatives_by_delay(model, x)[index]
            root = np.sqrt(np.asarray(weight, float) / share[groups][:, None])
            size = np.asarray(sigma, float)
            e, u = (np.where(mask, np.asarray(x) / size[:, None], 0.0) for x in (error, change))
            tau = None if sensor.jitter.estimated else np.asarray(sensor.jitter.deviation)
            both = _most_likely_noise_and_jitter(
                e * root[..., None], u, mask.sum(axis=-1), groups, known, tau
            )
            grown, tau = (jnp.asarray(each, sigma.dtype) for each in both)
            sigma = sigma * grown[:, None]
            readings[index] = reading.with_jitter(tau[:, None, None] * change, tau)
        out.append(sigma)
    if any(reading.jitter_error is not None for reading in readings):
        model = eqx.tree_at(lambda p: p.records.readings, model, tuple(readings))
    return model, tuple(out)


def initial_noise(model: Model) -> Noise:
    """Return, for each sensor of a `model`, a first value (R, k) of the standard deviation of its
    noise, in its unit, for R recordings and k components.

    It is the noise that the sensor states, or a tenth of the sensor's signal if the noise is to be
    estimated.
    """
    out = []
    for reading in model.records.readings:
        sensor = reading.sensor
        if reading.has_known_noise:
            out.append(sensor.noise)
        else:
            # The noise of this sensor is not known, and its first value is a tenth of the signal.
            # Its size matters little, as long as no sensor outweighs another.
            values = reading.values.reshape(*reading.mask.shape, -1)
            size = jnp.sqrt(jnp.mean(jnp.sum(values**2, axis=-1)) + 1e-300)
            out.append(jnp.full((model.count, sensor.components), 0.1) * size)
    return tuple(out)


def _variance_by_median(
    squared_errors: np.ndarray, mask: np.ndarray, groups: np.ndarray
) -> np.ndarray:
    """Return the variance (groups,) of a component of the errors for each group of recordings, by a
    median that outliers hardly change.

    The median of the squared lengths is taken over the readings of a group, and divided by the
    median of χ² with k degrees of freedom. A reading is left out if one of its components is not
    used. If no reading is left in a group, the variance of the group is 0. A mean with the weights
    of the robust loss (which gives outliers less weight) would be too small without outliers, and
    too large with many outliers.

    - `squared_errors`: (R, T) the squared lengths of the errors, at T times of R recordings.
    - `mask`: (R, T, k) true where a component of an error is used, for k components.
    - `groups`: (R,) the index of the group of each recording.
    """
    half, _ = median_and_density_of_chi2(mask.shape[-1])
    whole = mask.all(axis=-1)
    rows = (squared_errors[groups == g][whole[groups == g]] for g in range(groups.max() + 1))
    return np.array([np.median(row) / half if row.size else 0.0 for row in rows])


def median_and_density_of_chi2(degrees_of_freedom: int) -> tuple[float, float]:
    """Return the median of the χ² distribution with `degrees_of_freedom`, and its density at the
    median.
    """
    from scipy.special import chdtri, gammaln

    median = float(chdtri(degrees_of_freedom, 0.5))
    power = 0.5 * degrees_of_freedom - 1
    density = 0.5 * np.exp(
        power * np.log(0.5 * median) - 0.5 * median - gammaln(0.5 * degrees_of_freedom)
    )
    return median, float(density)


def _shares_of_squared_error_left_by_fit(
    model: Model, x: Array, blocks: Blocks, noise: Noise
) -> list[np.ndarray]:
    """Return, for each sensor, the fraction of the expected sum of its squared errors that remains
    after a fit, as an array (groups,) with one fraction for each group of recordings.

    A fit makes the errors smaller than the noise. The fraction is one minus N / M, and at least
    0.1. Here M is the number of the sensor's errors in the group, and N is the number of free
    numbers that these errors determine (the sum of their leverages).

    - `model`: the model, which says which recordings form a group.
    - `x`: (n,) the free numbers after the fit.
    - `blocks`: the errors of all readings at x, and their derivatives with respect to the free
      numbers.
    - `noise`: for each sensor the standard deviations (R, k) of its noise, for R recordings and k
      components of an error.
    """
    groups, readings = np.asarray(model.noise_groups), model.records.readings
    sizes = [np.bincount(groups, one.usable_channel_mask.sum(axis=(1, 2))) for one in readings]
    held = model.prior, model.pull, *((slot.prior, slot.spread) for slot in model.slots)
    if len(readings) * sizes[0].size == 1 and not jax.tree.leaves(held):
        # Without priors, and if all readings share one noise, the leverages of the readings are not
        # needed one by one: their sum is the number of fitted numbers.
        taken = [np.array([x.size])]
    else:
        linear = linearise(model, x, noise, blocks)
        taken = counts_of_determined_numbers(
            linear, linear.information_by_sensor, white_covariance(linear).determined
        )
        taken = [np.bincount(groups, each) for each in taken]
    return [np.maximum(1.0 - n / np.maximum(m, 1), 0.1) for n, m in zip(taken, sizes, strict=True)]


def _most_likely_noise_and_jitter(
    errors: np.ndarray,
    u: np.ndarray,
    count: np.ndarray,
    groups: np.ndarray,
    known_noise: bool,
    tau: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return two things: the most likely standard deviation σ (R,) of the noise of a sensor, in the
    unit of the given errors; and the most likely standard deviation τ (R,), s, of its time stamps.

    The k errors of one reading have the covariance matrix `σ² E + τ² u uᵀ`. Here E is the unit
    matrix, and u (k,) the derivative of the errors with respect to the clock offset. The iteration
    updates τ² and σ² alternately. τ² is updated by Fisher scoring of the squared components of the
    errors along u; the mean of such a square is `σ² + τ² |u|²`. σ² is updated by a step of
    expectation and maximisation (EM).

    - `errors`: (R, T, k) the errors of a sensor with k channels, at T times of R recordings. They
      are divided by the noise (known, or its present estimate) and weighted by the robust loss.
      They are also enlarged, since the fit has made them smaller than the noise.
    - `u`: (R, T, k) the derivative of the errors with respect to the clock offset of the sensor,
      per second, divided by the same noise.
    - `count`: (R, T) the number of channels that were read.
    - `groups`: (R,) the group of each recording; the recordings of a group share σ and τ.
    - `known_noise`: whether the noise is known; σ is then 1, since the errors are divided by it.
    - `tau`: (R,) a known τ; `None` to estimate τ.
    """
    size, total = np.sum(u**2, axis=-1), np.sum(errors**2, axis=-1)
    is_read = total > 0
    dot = np.sum(errors * u, axis=-1)
    along = dot**2 / np.maximum(size, 1e-300)

    def ratio(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = (np.bincount(groups, np.sum(each * is_read, axis=1)) for each in (x, y))
        return (x / np.maximum(y, 1e-300))[groups][:, None]

    p, q = (
        np.ones((len(errors), 1)),
        np.zeros((len(errors), 1)) if tau is None else tau[:, None] ** 2,
    )
    for _ in range(ROUNDS):
        before, weight = (p, q), (p + q * size) ** -2.0
        if tau is None:
            q = np.maximum(ratio(weight * size * (along - p), weight * size**2), 0.0)
        if not known_noise:
            wide = p + q * size
            delay, unsure = q * dot / wide, p * q / wide
            left = total - 2 * delay * dot + size * (delay**2 + unsure)
            p = np.maximum(ratio(left, count), 1e-12)
        if np.allclose((p, q), before, rtol=1e-9, atol=0.0):
            break
    return np.sqrt(p[:, 0]), np.sqrt(q[:, 0])
