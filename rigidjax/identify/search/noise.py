"""Estimate the noise of sensors from the errors of a fit."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.model.model import Model, error_slopes_by_delay
from rigidjax.identify.model.terms import Blocks, Noise, whiten
from rigidjax.identify.sensors.base import extras
from rigidjax.identify.uncertainty.covariance import linearise, white_covariance
from rigidjax.identify.uncertainty.degrees_of_freedom import effective_parameters


class Estimate(NamedTuple):
    """Hold the model with the errors by jitter, and the noise of its sensors."""

    model: Model
    noise: Noise


class Chi2Median(NamedTuple):
    """Hold the median of a χ² distribution, and the density there."""

    median: float
    density: float


def estimate_noise(model: Model, x: Float[Array, " n"], blocks: Blocks, noise: Noise) -> Estimate:
    """Return the noise of the sensors, as they state it or as estimated, and the model with the
    errors that their jitter makes at x.

    An estimate comes from the scatter of the sensor's errors, as one number for all channels and
    all recordings of a group. A fit makes the errors smaller than the noise, by a large factor if
    readings are few: the leverage of the readings at the present `noise` corrects for this, as in
    restricted maximum likelihood. The `blocks` are those at x.
    """
    groups, out = np.asarray(model.noise_groups), []
    shares = _shares(model, x, blocks, noise)
    readings = list(model.records.readings)
    if any(reading.jitter_error is not None for reading in readings):
        # A search holds these errors constant. If it changed them, errors would count less wherever
        # a motion changes quickly, and the search would prefer quick motions.
        for index, change in enumerate(error_slopes_by_delay(model, x)):
            if (tau := extras(readings[index].sensor).jitter) is not None:
                late = tau[:, None, None] * change
                readings[index] = dataclasses.replace(readings[index], jitter_error=late)
        model = eqx.tree_at(lambda p: p.records.readings, model, tuple(readings))
    white = whiten(model, blocks.value, noise)
    for reading, error, sigma, share in zip(readings, white, noise, shares, strict=True):
        # The mask leaves out readings at full scale, whose errors are not noise.
        mask = reading.usable
        if reading.sensor.noise is not None:
            out.append(reading.sensor.noise)
            continue
        error = np.asarray(error * sigma[:, None])
        squares = np.sum(np.where(mask, error**2, 0.0), axis=2)
        if model.loss is None:
            parts = np.bincount(groups, squares.sum(axis=1))
            variance = parts / np.maximum(np.bincount(groups, mask.sum(axis=(1, 2))), 1)
        else:
            # Outliers hardly change the median of the squared lengths. A mean with the weights of
            # the robust loss would be too small without outliers, and too large with many.
            half, whole = chi2_median(mask.shape[-1]).median, mask.all(axis=-1)
            rows = (squares[groups == g][whole[groups == g]] for g in range(groups.max() + 1))
            variance = np.array([np.median(row) / half if row.size else 0.0 for row in rows])
        # The noise is never less than round-off, since even the errors of perfect data are divided
        # by the noise.
        floor = 1e-15 * float(np.abs(np.asarray(reading.values)).max() + 1e-300)
        each = np.maximum(np.sqrt(variance / share), floor)[groups]
        out.append(jnp.asarray(np.broadcast_to(each[:, None], sigma.shape).astype(sigma.dtype)))
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
    """Return the fraction of each group's expected squared errors that a fit leaves.

    It is 1 − N / M, and at least 0.1, for M errors that determine N parameters: the sum of their
    leverages.
    """
    groups, readings = np.asarray(model.noise_groups), model.records.readings
    sizes = [np.bincount(groups, one.usable.sum(axis=(1, 2))) for one in readings]
    held = model.prior, model.measured, *((slot.prior, slot.spread) for slot in model.slots)
    if len(readings) * sizes[0].size == 1 and not jax.tree.leaves(held):
        # Without priors, and if all readings share one noise, the leverages of the readings are not
        # needed one by one: their sum is the number of fitted numbers.
        taken = [np.array([x.size])]
    else:
        linear = linearise(model, x, noise, blocks)
        taken = effective_parameters(linear, white_covariance(linear).determined)
        taken = [np.bincount(groups, each) for each in taken]
    return [np.maximum(1.0 - n / np.maximum(m, 1), 0.1) for n, m in zip(taken, sizes, strict=True)]
