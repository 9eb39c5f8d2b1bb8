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
    grid_of_step_times,
    scan_filter,
)
from rigidjax.identify.filtering.roots import LogDensityTerms
from rigidjax.identify.filtering.steps import require_sensors
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.normal import normal_matrix
from rigidjax.identify.model.scene import Scene
from rigidjax.identify.model.terms import (
    BodyIndex,
    bound_torque,
    error_jacobians,
    map_rows,
    prior_residuals,
    scene_at,
    scene_errors,
    standardise,
    value_and_jacfwd,
)
from rigidjax.motion.manifold import dimension


def log_density_terms_of_recording(
    model: Model,
    free_numbers: Array,
    record: Recording,
    reference: ReferenceStates,
    body_index: BodyIndex,
) -> LogDensityTerms:
    """Return the terms of the log-density of the readings of one recording.

    The errors of the readings are normal. They are the differences of the readings from the motion
    that the equations of motion give. If the model has an unknown torque, or numbers that drift as
    random walks, a Kalman filter integrates over these unknowns, and the errors are the differences
    of the readings from the predictions of the filter.

    **Arguments:**

    - `model`: the model.
    - `free_numbers`: (m,) the free numbers on which this recording depends.
    - `record`: the times and readings of the recording.
    - `reference`: the state about which the initial state of the recording is parametrised.
    - `body_index`: the index of the body of the recording among several bodies, or `None` for one
      body.

    **Returns** the `LogDensityTerms`, two arrays with an entry for each component of each reading:
    its error divided by its standard deviation; and the logarithm of 2π times its variance.
    """
    scene = scene_at(model, free_numbers, record, reference, body_index)
    if scene.process is None and not model.walks:
        return _log_density_terms_of_motion(model, scene, record)
    require_sensors(scene.sensors)
    scene = dataclasses.replace(scene, torque=bound_torque(scene, record))
    start: Any = scene.start
    known = jnp.zeros(dimension(start), start.omega.dtype)
    first = belief_at(record.t[0], start, known, scene, model.walks)
    grid = grid_of_step_times(scene.process, record, first, model.filter_steps)
    run = FilterInput(scene, model.walks, record, first, grid)
    _, _, read = scan_filter(run, lambda _, read: read)
    return jax.tree.map(jnp.ravel, roots.log_density_terms(*read))


def _log_density_terms_of_motion(model: Model, scene: Scene, record: Recording) -> LogDensityTerms:
    """Return the terms of the log-density of one recording if no torque is random and no
    parameter drifts.

    The errors of the readings, which are their differences from the motion that the equations of
    motion give, are then independent and normal.

    **Arguments:**

    - `model`: the model, which holds the integrator.
    - `scene`: the body, torque, sensors and initial state of the recording.
    - `record`: the times and readings of the recording.

    **Returns** the `LogDensityTerms`, two arrays with an entry for each component of each reading:
    z, its error divided by its standard deviation σ; and l = log(2πσ²). The log-density is −½ Σ (z²
    + l). For a masked reading both entries are zero. For a component at full scale only a bound is
    known: z is √(−2 log P), where P is the probability that a reading exceeds this bound, and l is
    zero.
    """
    errors = scene_errors(model, scene, record)
    scaled, log_variance = [], []
    for reading, sensor, error in zip(record.readings, scene.sensors, errors, strict=True):
        limit: Any = getattr(sensor, "limit", None)
        noise: Any = sensor.noise
        one, full, wider = standardise(
            reading.values, reading.mask, error, noise, limit, reading.jitter_error
        )
        scaled.append(one)
        # A component at full scale contributes the probability of a reading beyond the full scale
        # instead of a density, so that its logarithm of a variance is set to zero.
        mask = reading.mask[:, None] & ~full
        logs = jnp.log(2 * math.pi * noise**2)[None]
        log_variance.append(jnp.where(mask, logs if wider is None else logs + wider, 0))
    return LogDensityTerms(
        *(jnp.concatenate([a.reshape(-1) for a in part]) for part in (scaled, log_variance))
    )


def log_density_terms_of_all_readings(model: Model, x: Float[Array, " n"]) -> LogDensityTerms:
    """Return the terms (R, N) of the log-density of all readings of a `model`.

    R is the number of recordings, N the number of terms of each recording, and x (n,) holds the
    free numbers. Derivatives with respect to x are computed for one recording after another, in
    forward mode.
    """
    return map_rows(model.index.rows(x), model, log_density_terms_of_recording)


def log_posterior_density(model: Model, x: Float[Array, " n"]) -> Scalar:
    """Return the logarithm of the posterior density of a `model` at its free numbers x, up to a
    constant.

    It is the logarithm of the density of all readings plus the logarithms of the priors.
    """
    return log_density_terms_of_all_readings(model, x).total_log_density - 0.5 * jnp.sum(
        prior_residuals(model, x) ** 2
    )


class Curvature(NamedTuple):
    """Hold a quadratic approximation of minus the logarithm of a posterior density, at a point.

    **Fields:** `cost` is minus the logarithm of the density; `gram` (n, n) is Fisher's information;
    `slope` (n,) is the gradient of the cost.
    """

    cost: Scalar
    gram: Float[Array, "n n"]
    slope: Float[Array, " n"]


def cost_gradient_and_information(model: Model, x: Float[Array, " n"]) -> Curvature:
    """Return the cost, gradient and Fisher's information of a posterior density at x (n,).

    The free numbers x change the variances of the readings, too. The information is that of the
    priors plus `Σ ∂ν ∂νᵀ/s + ½ ∂(log s) ∂(log s)ᵀ`, where the sum is over the innovations ν (each
    reading minus its prediction), s is the variance of ν, and ∂ is the gradient with respect to x
    (Gupta and Mehra 1974, doi:10.1109/TAC.1974.1100714, for the filter).
    """
    value, slopes = error_jacobians(model, x, log_density_terms_of_recording)
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
    cost = 0.5 * jnp.sum(rest**2) - value.total_log_density
    return Curvature(cost, gram + rows.T @ rows, slope + rest @ rows)
