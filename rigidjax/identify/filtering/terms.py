"""Compute the terms of a log-density in which every number read is normal, given the numbers read
before it.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.filtering import roots
from rigidjax.identify.filtering.filter import (
    FilterInput,
    belief_at,
    scan_filter,
    step_grid,
)
from rigidjax.identify.filtering.roots import LogDensityTerms
from rigidjax.identify.filtering.steps import require_sensors
from rigidjax.identify.model.first_order import value_and_jacfwd
from rigidjax.identify.model.model import (
    BodyIndex,
    Model,
    bound_torque,
    error_jacobians,
    scene_at,
    scene_errors,
)
from rigidjax.identify.model.normal import normal_matrix
from rigidjax.identify.model.terms import prior_residuals, standardise
from rigidjax.identify.sensors.base import extras
from rigidjax.motion.manifold import dimension


def recording_terms(
    model: Model,
    free_numbers: Array,
    record: Recording,
    reference: ReferenceStates,
    body_index: BodyIndex,
) -> LogDensityTerms:
    """Return the terms of the log-density of the readings of one recording, for its parameters.

    If the model has an unknown torque or walks, a Kalman filter integrates over these unknowns. Its
    terms are those of innovations; without such unknowns the residuals are independent.
    """
    scene = scene_at(model, free_numbers, record, reference, body_index)
    if scene.process is None and not model.walks:
        scaled, log_variance = [], []
        errors = scene_errors(model, scene, record)
        for reading, sensor, error in zip(record.readings, scene.sensors, errors, strict=True):
            limit: Any = extras(sensor).limit
            noise: Any = sensor.noise
            one, full, wider = standardise(
                reading.values, reading.mask, error, noise, limit, reading.jitter_error
            )
            scaled.append(one)
            # A component at full scale contributes the probability P of a reading beyond it instead
            # of a density: its error is √(−2 log P), and its logarithm of a variance is zero.
            mask = reading.mask[:, None] & ~full
            logs = jnp.log(2 * math.pi * noise**2)[None]
            log_variance.append(jnp.where(mask, logs if wider is None else logs + wider, 0))
        return LogDensityTerms(
            *(jnp.concatenate([a.reshape(-1) for a in part]) for part in (scaled, log_variance))
        )
    require_sensors(scene.sensors)
    scene = dataclasses.replace(scene, torque=bound_torque(scene, record))
    start: Any = scene.start
    known = jnp.zeros(dimension(start), start.omega.dtype)
    first = belief_at(record.t[0], start, known, scene, model.walks)
    grid = step_grid(scene.process, record, first, model.filter_steps)
    run = FilterInput(scene, model.walks, record, first, grid)
    _, _, read = scan_filter(run, lambda _, read: read)
    return jax.tree.map(jnp.ravel, roots.density_terms(*read))


class Curvature(NamedTuple):
    """Hold a quadratic approximation of minus the logarithm of a posterior density, at a point."""

    cost: Scalar
    gram: Float[Array, "n n"]  # Fisher's information
    slope: Float[Array, " n"]  # the gradient of the cost


def curvature(model: Model, x: Float[Array, " n"]) -> Curvature:
    """Return the cost, gradient and Fisher's information of a posterior density at x.

    The parameters change the variances of the readings, too. The information is that of the priors
    plus `Σ ∂ν ∂νᵀ/s + ½ ∂(log s) ∂(log s)ᵀ`, where the sum is over the innovations ν, s is the
    variance of ν, and ∂ is the gradient with respect to x (Gupta and Mehra 1974,
    doi:10.1109/TAC.1974.1100714, for the filter).
    """
    value, slopes = error_jacobians(model, x, recording_terms)
    # Compute dν/√s, with the innovation ν of variance s, from the derivative of ν/√s, by d(ν/√s) =
    # dν/√s − ½ ν/√s d(log s).
    moved = slopes.error + 0.5 * value.error[..., None] * slopes.log_variance
    both = jnp.concatenate([moved, 0.5**0.5 * slopes.log_variance], axis=1)
    places, size = model.index.places, model.size
    gram = normal_matrix([both[:, :, None, :]], places, size).core
    each = jnp.einsum("rn,rni->ri", value.error, slopes.error)
    each = each + 0.5 * jnp.sum(slopes.log_variance, 1)
    slope = jnp.zeros(size + 1, x.dtype).at[places].add(each)[:-1]
    rest, rows = value_and_jacfwd(lambda x: prior_residuals(model, x), x)
    cost = 0.5 * jnp.sum(rest**2) - value.total
    return Curvature(cost, gram + rows.T @ rows, slope + rest @ rows)
