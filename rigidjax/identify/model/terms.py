"""Compute the residuals of readings and priors, in standard deviations."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from rigidjax.identify.model.first_order import FirstOrder
from rigidjax.identify.model.model import Model, unpack_at
from rigidjax.identify.sensors.base import extras

# `SensorErrors` holds one array for each sensor, such as its errors (R, T, k), for R recordings, T
# times and k components.
SensorErrors = tuple[Array | np.ndarray, ...]
# `Noise` holds the standard deviations (R, k) of each sensor.
Noise = tuple[Float[Array, "records _"], ...]


# `Blocks` holds for each sensor the errors (R, T, k), and their Jacobian (R, T, k, m) with respect
# to the m columns of a row.
Blocks = FirstOrder


class White(NamedTuple):
    """Hold independent errors of variance one."""

    errors: Float[Array, "*rows k"]
    # The variance of each component if all before it are given: the squares of the diagonal of L.
    log_variances: Float[Array, "*rows k"]


class Standardised(NamedTuple):
    """Hold the errors of one sensor in standard deviations."""

    errors: Float[Array, "times k"]
    # True for a channel at full scale.
    saturated: Bool[Array, "times k"]
    # The logarithm of the factor by which jitter multiplies each variance; `None` without jitter.
    widening: Float[Array, "times k"] | None


def whiten(model: Model, errors: SensorErrors, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Return the errors of each sensor in standard deviations, as `standardise` computes them."""
    out = []
    for reading, error, sigma in zip(model.records.readings, errors, noise, strict=True):
        limit = extras(reading.sensor).limit
        parts: Any = reading.values, reading.mask, error, sigma, limit, reading.jitter_error
        out.append(jax.vmap(standardise)(*parts).errors)
    return tuple(out)


def decorrelate(errors: Float[Array, "*rows k"], jitter_error: Float[Array, "*rows k"]) -> White:
    """Return independent errors of variance one from errors e whose covariance is `1 + v vᵀ`.

    Here v is the `jitter_error`, the error due to a time stamp that is one standard deviation late;
    e and v are in standard deviations of the noise. The result is `L⁻¹ e` with the Cholesky factor
    L of the covariance.
    """
    e, v = errors, jitter_error
    along, total = jnp.cumsum(v * e, axis=-1), 1.0 + jnp.cumsum(v * v, axis=-1)
    none = jnp.zeros_like(total[..., :1])
    along = jnp.concatenate([none, along[..., :-1]], axis=-1)
    before = jnp.concatenate([none + 1.0, total[..., :-1]], axis=-1)
    return White((e - v * along / before) * jnp.sqrt(before / total), jnp.log(total / before))


def scaled_slopes(
    tangents: Array | np.ndarray, sigma: Array | np.ndarray, jitter_error: Array | None
) -> Float[Array, "..."] | Float[np.ndarray, "..."]:
    """Return tangents of a sensor's errors in deviations, independent as by `decorrelate`.

    The tangents and the `jitter_error` are in the unit of the sensor.
    """
    scaled = tangents / sigma[:, None, :, None]
    if jitter_error is None:
        return scaled
    return jax.vmap(lambda e: decorrelate(e, jitter_error / sigma[:, None]).errors, -1, -1)(scaled)


def standardise(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
    jitter_error: Float[Array, "times k"] | None,
) -> Standardised:
    """Return the errors of one sensor in standard deviations.

    `error` and `jitter_error`, the error of a time stamp that is one standard deviation late, are
    in the unit of the sensor. The reading of a channel at full scale (`limit`) says only that the
    true value is at least as large. Its error is `√(−2 log Φ(z))` in magnitude, where z is the
    excess of the prediction over the limit in standard deviations (Tobin 1958,
    doi:10.2307/1907382).
    """
    scaled, wider = error / sigma[None], None
    full = jnp.zeros(scaled.shape, bool)
    if limit is not None:
        full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    if jitter_error is not None:
        v = jitter_error / sigma[None]
        # The reading of a channel at full scale carries no information about the error of its time
        # stamp. Its part of the jitter error is therefore set to zero.
        white, wider = decorrelate(scaled, jnp.where(full, 0.0, v))
        scaled = jnp.where(full, scaled / jnp.sqrt(1.0 + v * v), white)
    if limit is None:
        return Standardised(scaled, full, wider)
    side = jnp.sign(values)
    z = jnp.where(full, -side * scaled, 0.0)
    # Here z is the excess of the prediction over the limit in standard deviations. For a large z
    # the argument of the root underflows to zero, where a square root has no derivative. The error
    # is therefore set to zero beyond z = 5.
    root = jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(jnp.minimum(z, 5.0)))
    errors = jnp.where(full, -side * jnp.where(z < 5.0, root, 0.0), scaled)
    return Standardised(errors, full, wider)


def reading_residuals(
    model: Model, errors: SensorErrors, noise: Noise, weights: Float[Array, "records times"]
) -> tuple[Array, ...]:
    """Return the residuals of the readings of each sensor, shrunk by the robust loss.

    The factor `weights` of a reading is zero if the reading is not fitted.
    """
    out = []
    for scaled in whiten(model, errors, noise):
        if model.loss is not None:
            scaled = jax.vmap(jax.vmap(model.loss.shrink))(scaled)
        out.append(scaled * weights[..., None])
    return tuple(out)


def residual_jacobians(
    function: Callable[[tuple[Array, ...]], tuple[Array, ...]],
    errors: SensorErrors,
    slopes: SensorErrors,
) -> FirstOrder:
    """Return the residuals `function(errors)` and their Jacobians.

    Each residual may depend only on the errors of its own reading.
    """
    # The product of the derivative of `function` with the slopes is cheap, since each residual
    # depends only on the errors of the same reading: no matrix of all residuals by all errors is
    # made.
    value, push = jax.linearize(function, errors)
    return FirstOrder(value, jax.vmap(push, in_axes=-1, out_axes=-1)(slopes))


def prior_weights(model: Model) -> Float[Array, " n"]:
    """Return 1/standard deviation of each parameter's prior, or zero without a prior."""
    weights = jnp.zeros(model.index.size, model.records.t.dtype)
    for slot in model.slots:
        about = (slot.shared, slot.prior), (slot.own, slot.prior if slot.each else slot.spread)
        for places, deviation in about:
            if places is not None and deviation is not None:
                weights = weights.at[places].set((1.0 / deviation).astype(weights.dtype))
    if model.start_weight is not None:
        weights = weights.at[model.index.start].set(model.start_weight)
    return weights


def joint_residuals(model: Model, x: Float[Array, " n"]) -> Float[Array, " j"]:
    """Return the residuals of the prior of the body, if there is one, and of each `Measured`."""
    out = []
    if model.prior is not None:
        (chart,) = model.charts
        body = chart.body(x[: model.index.bodies])
        out.append(model.prior.residuals(body, to_scale=chart.unit != "").reshape(-1))
    return jnp.concatenate([*out, measured_residuals(model, x)])


def measured_residuals(model: Model, x: Float[Array, " n"]) -> Float[Array, " k"]:
    """Return the residuals of each `Measured` of a `model`, one after another."""
    if not model.measured:
        return jnp.zeros(0, x.dtype)
    point = unpack_at(model, x)
    parts = [one.residual(point).astype(x.dtype).reshape(-1) for one in model.measured]
    return jnp.concatenate(parts)


def prior_residuals(model: Model, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return the residuals that belong to no reading: of each prior, and `joint_residuals`."""
    return jnp.concatenate([prior_weights(model) * x, joint_residuals(model, x)])


def reading_weights(
    model: Model, errors: SensorErrors, noise: Noise
) -> tuple[Float[Array, "..."], ...]:
    """Return the weights of each sensor's readings in the normal equations, zero for a masked one.

    With a robust loss ρ(s) the weight is dρ/ds, else 1.
    """
    masks = [reading.mask for reading in model.records.readings]
    if model.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(model.loss.weight))
    scaled = whiten(model, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))


def half_squares(tree: PyTree) -> Float[Array, ""]:
    """Return half the sum of the squares of all numbers in a pytree."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
