"""Estimate the noise of sensors and the jitter of their clocks from the errors of a fit."""

from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax.identify.model.model import Model, delay_slopes
from rigidjax.identify.model.terms import Blocks, Noise, reading_weights
from rigidjax.identify.uncertainty.covariance import linearise, white_covariance
from rigidjax.identify.uncertainty.degrees_of_freedom import effective_parameters

# The joint estimate of the noise and the jitter of a sensor takes at most this many iterations.
ROUNDS = 500


class Estimate(NamedTuple):
    """Hold the model with the jitter of its sensors, and their noise."""

    model: Model
    noise: Noise


class Chi2Median(NamedTuple):
    """Hold the median of a χ² distribution, and the density there."""

    median: float
    density: float


class Spread(NamedTuple):
    """Hold the standard deviations of a sensor's noise and time stamps in each recording."""

    # In the unit of the errors.
    noise: Float[np.ndarray, " records"]
    # In s.
    jitter: Float[np.ndarray, " records"]


def estimate_noise(model: Model, x: Float[Array, " n"], blocks: Blocks, noise: Noise) -> Estimate:
    """Return the noise of the sensors and the model with their jitter, as they state or as
    estimated.

    An estimate comes from the scatter of the sensor's errors, as one number for all channels and
    all recordings of a group. A fit makes the errors smaller than the noise, by a large factor if
    readings are few: the leverage of the readings at the present `noise` corrects for this, as in
    restricted maximum likelihood. The `blocks` are those at x.
    """
    errors = blocks.value
    weights = reading_weights(model, errors, noise)
    groups, out = np.asarray(model.noise_groups), []
    shares = _shares(model, x, blocks, noise)
    readings = list(model.records.readings)
    for index, (reading, error, sigma, weight, share) in enumerate(
        zip(readings, errors, noise, weights, shares, strict=True)
    ):
        # The mask leaves out readings at full scale, whose errors are not noise.
        sensor, mask = cast(Any, reading.sensor), reading.usable
        known = sensor.noise is not None
        if known:
            sigma = sensor.noise
        else:
            squares = np.sum(np.where(mask, np.asarray(error) ** 2, 0.0), axis=2)
            if model.loss is None:
                parts = np.bincount(groups, squares.sum(axis=1))
                variance = parts / np.maximum(np.bincount(groups, mask.sum(axis=(1, 2))), 1)
            else:
                # Outliers hardly change the median of the squared lengths. A mean with the weights
                # of the robust loss would be too small without outliers, and too large with many.
                half, whole = chi2_median(mask.shape[-1]).median, mask.all(axis=-1)
                rows = (squares[groups == g][whole[groups == g]] for g in range(groups.max() + 1))
                variance = np.array([np.median(row) / half if row.size else 0.0 for row in rows])
            # The noise is never less than round-off, since even the errors of perfect data are
            # divided by the noise.
            floor = 1e-15 * float(np.abs(np.asarray(reading.values)).max() + 1e-300)
            each = np.maximum(np.sqrt(variance / share), floor)[groups]
            each = np.broadcast_to(each[:, None], sigma.shape)
            sigma = jnp.asarray(each.astype(sigma.dtype))
        if reading.jitter_error is not None:
            change = delay_slopes(model, x)[index]
            root = np.sqrt(np.asarray(weight, float) / share[groups][:, None])
            size = np.asarray(sigma, float)
            e, u = (np.where(mask, np.asarray(x) / size[:, None], 0.0) for x in (error, change))
            tau = None if sensor.jitter.estimated else np.asarray(sensor.jitter.deviation)
            both = _noise_and_jitter(e * root[..., None], u, mask.sum(axis=-1), groups, known, tau)
            grown, tau = (jnp.asarray(each, sigma.dtype) for each in both)
            sigma = sigma * grown[:, None]
            readings[index] = reading.with_jitter(tau[:, None, None] * change, tau)
        out.append(sigma)
    if any(reading.jitter_error is not None for reading in readings):
        model = eqx.tree_at(lambda p: p.records.readings, model, tuple(readings))
    return Estimate(model, tuple(out))


def initial_noise(model: Model) -> Noise:
    """Return the noise that each sensor states, or a tenth of the signal to start an estimate."""
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


def chi2_median(degrees_of_freedom: int) -> Chi2Median:
    """Return the median of the χ² distribution and its density there."""
    from scipy.special import chdtri, gammaln

    median = float(chdtri(degrees_of_freedom, 0.5))
    power = 0.5 * degrees_of_freedom - 1
    density = 0.5 * np.exp(
        power * np.log(0.5 * median) - 0.5 * median - gammaln(0.5 * degrees_of_freedom)
    )
    return Chi2Median(median, float(density))


def _shares(
    model: Model, x: Float[Array, " n"], blocks: Blocks, noise: Noise
) -> list[Float[np.ndarray, " groups"]]:
    """Return the fraction of each group's expected squared errors that a fit leaves, for each
    sensor.

    It is 1 − N / M, and at least 0.1, for M errors that determine N parameters: the sum of their
    leverages.
    """
    groups, readings = np.asarray(model.noise_groups), model.records.readings
    sizes = [np.bincount(groups, one.usable.sum(axis=(1, 2))) for one in readings]
    held = model.prior, model.pull, *((slot.prior, slot.spread) for slot in model.slots)
    if len(readings) * sizes[0].size == 1 and not jax.tree.leaves(held):
        # Without priors, and if all readings share one noise, the leverages of the readings are not
        # needed one by one: their sum is the number of fitted numbers.
        taken = [np.array([x.size])]
    else:
        linear = linearise(model, x, noise, blocks)
        taken = effective_parameters(
            linear, linear.information_by_sensor, white_covariance(linear).determined
        )
        taken = [np.bincount(groups, each) for each in taken]
    return [np.maximum(1.0 - n / np.maximum(m, 1), 0.1) for n, m in zip(taken, sizes, strict=True)]


def _noise_and_jitter(
    errors: Float[np.ndarray, "records times k"],
    u: Float[np.ndarray, "records times k"],
    count: Int[np.ndarray, "records times"],
    groups: Int[np.ndarray, " records"],
    known_noise: bool,
    tau: Float[np.ndarray, " records"] | None,
) -> Spread:
    """Return the most likely noise of a sensor and jitter of its clock.

    The k errors of one reading have the covariance `σ² E + τ² u uᵀ` with the unit matrix E and the
    derivative u of the errors with respect to the clock offset, per second. `errors` and u are
    divided by the present noise; the errors are weighted by the robust loss and enlarged, since the
    fit has made them smaller than the noise. `count` is the number of channels that were read; a
    given `tau`, and a `known_noise`, are kept. The iteration updates τ² and σ² alternately: τ² by
    Fisher scoring of the squared components of the errors along u, whose mean is `σ² + τ² |u|²`,
    and σ² by a step of expectation and maximisation (EM).
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
    return Spread(np.sqrt(p[:, 0]), np.sqrt(q[:, 0]))
