"""Find the motions of a tumbler that have given pairs of frequencies, by least-squares searches
whose starting points are on a grid.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax._types import Vec3
from rigidjax.body.inertia import Inertia
from rigidjax.identify.data.recording import Reading
from rigidjax.identify.model.free import leaf_at
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.normal import NormalMatrix
from rigidjax.identify.model.terms import Noise, starting_scene
from rigidjax.identify.search.least_squares import CAREFUL, Settings, minimise
from rigidjax.identify.search.stages import Attempt
from rigidjax.rotation import quaternion
from rigidjax.tumblers import starts
from rigidjax.tumblers.sensor import sun_observer_bisector
from rigidjax.tumblers.two_frequencies import pad_light_curve

# The search takes STEPS steps from each start; one run of a program computes a chunk of FIRST
# starts. Then the search takes MORE steps from each of the best results, which are SECOND in
# number.
FIRST, STEPS, SECOND, MORE = 96, 12, 24, 60
# Derivatives with respect to the free numbers are finite differences with this step. The free
# numbers are of order one.
DIFFERENCE = 1e-6
# The natural logarithm of a flux decreases by this number if the magnitude increases by one.
MAGNITUDE = 0.4 * np.log(10.0)


def times_fluxes_and_noise(
    model: Model, reading: Reading
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the light curve as three arrays (T,), without gaps: the times since the first time, s;
    the fluxes divided by their median; and the noise of these relative fluxes.

    The noise is `None` if it is not known. Magnitudes are converted to fluxes.

    - `model`: the model, whose recording has the times.
    - `reading`: the values of the one `Brightness` sensor, their mask and the sensor.
    """
    t = np.asarray(model.records.t[0])
    mask: np.ndarray = reading.host_mask
    sensor: Any = reading.sensor
    values = np.asarray(reading.values, float)[mask]
    noise = None if sensor.noise is None else float(np.asarray(sensor.noise)[0])
    if sensor.unit == "mag":
        flux = np.exp(-MAGNITUDE * (values - np.median(values)))
        sigma = None if noise is None else MAGNITUDE * noise * flux
    else:
        flux = np.maximum(values, 1e-3 * np.median(values)) / np.median(values)
        sigma = None if noise is None else np.full(flux.shape, noise / np.median(values))
    return t[mask] - t[0], flux, sigma


def starts_from_frequency_pairs(
    model: Model,
    reading: Reading,
    t: np.ndarray,
    squared_flux: np.ndarray,
    noise: np.ndarray | None,
    pairs: np.ndarray,
) -> list[Float[Array, " n"]]:
    """Return the best starting points of the searches, over all given pairs of frequencies.

    A starting point is a vector (n,) of the free numbers of the model.

    - `model`: the model of the light curve.
    - `reading`: the readings of the one `Brightness` sensor.
    - `t`: (T,) the times since the first time, s.
    - `squared_flux`: (T,) the squared fluxes, divided by the square of the median flux.
    - `noise`: (T,) the standard deviations of `squared_flux`, or `None`.
    - `pairs`: (P, 2) the pairs of frequencies, 1/s, that of the mean precession and twice that of
      the rotation.
    """
    sensor: Any = reading.sensor
    sigma = np.ones(t.shape) if noise is None else noise
    light = pad_light_curve(t, squared_flux, 1.0 / sigma)
    middle = np.asarray(sun_observer_bisector(sensor, model.records.t[0][0] + 0.5 * t[-1]))
    order, areas = np.arange(3), None
    if sensor.semi_axes is not None:
        axes = np.asarray(sensor.semi_axes)
        order = np.argsort(-axes)
        areas = (np.prod(axes) / axes[order]) ** 2
    best_of, others = [], []
    for pair in pairs:
        for mode in starts.MODES:
            candidates = starts.candidate_motions(pair, mode, light, middle, areas, 3)
            # `best_of` gets the starts of the best body for this pair and this mode, and `others`
            # the starts of the other bodies. All starts of `best_of` are used, those of `others`
            # only to fill the last chunk, since misfits on a grid cannot decide between pairs and
            # modes.
            best_of += candidates[: len(starts.ABOUT)]
            others += candidates[len(starts.ABOUT) :]
    chunks = max(1, -(-len(best_of) // FIRST))
    in_order = [one for group in (best_of, others) for one in sorted(group, key=lambda c: c.misfit)]
    chosen = in_order[: chunks * FIRST]
    # The columns of this rotation are the axes of the body in the order of ascending moments.
    principal_to_body = np.eye(3)[:, order]
    principal_to_body = principal_to_body * np.array([1.0, 1.0, np.linalg.det(principal_to_body)])
    return [_free_numbers_of_candidate(model, one, principal_to_body) for one in chosen]


def _free_numbers_of_candidate(
    model: Model, candidate: starts.Candidate, principal_to_body: np.ndarray
) -> Float[Array, " n"]:
    """Return the n free numbers (n,) of the `model` for a `candidate` motion; a search starts from
    them.

    - `candidate`: principal moments, initial attitude and initial rate, all in principal axes.
    - `principal_to_body`: (3, 3) the rotation matrix from principal axes to body axes.
    """
    moments = principal_to_body @ np.diag(candidate.moments) @ principal_to_body.T
    start = model.start(Inertia(jnp.asarray(moments)))
    reference = model.reference
    step = _rotation_vector_from_reference(
        jnp.asarray(candidate.q), jnp.asarray(principal_to_body), reference.state.q[0]
    )
    spin = jnp.asarray(principal_to_body @ candidate.omega) / reference.rate[0]
    # The free numbers of an initial `Attitude` are the rotation vector from the reference attitude,
    # and the rate in units of the typical rate.
    return start.at[model.index.start[0]].set(jnp.concatenate([step, spin]))


@jax.jit
def _rotation_vector_from_reference(q: Array, principal_to_body: Array, reference: Array) -> Vec3:
    """Return the rotation vector (3,), rad, that turns a reference attitude of a body to its
    attitude. The components are along the body axes.

    - `q`: (4,) the quaternion that maps principal axes to world axes at the attitude of the body.
    - `principal_to_body`: (3, 3) the rotation matrix from principal axes to body axes.
    - `reference`: (4,) the quaternion of the reference attitude, body → world.
    """
    back = quaternion.conjugate(quaternion.from_matrix(principal_to_body))
    q = quaternion.multiply(q, back)
    return quaternion.log(quaternion.multiply(quaternion.conjugate(reference), q))


def noise_of(reading: Reading, flux: np.ndarray, scatter: float) -> tuple[Float[Array, "1 1"], ...]:
    """Return the noise of the readings in the unit of the sensor, as a tuple of one array (1, 1).

    If the noise is not known, it is computed from the `scatter`.

    - `reading`: the readings of the one `Brightness` sensor.
    - `flux`: (T,) the fluxes divided by their median.
    - `scatter`: the standard deviation of the squared `flux` about its best Fourier series.
    """
    sensor: Any = reading.sensor
    if sensor.noise is not None:
        return (sensor.noise[None],)
    left = scatter / (2.0 * np.median(flux))
    unit = 1.0 / MAGNITUDE if sensor.unit == "mag" else np.median(np.asarray(reading.values))
    return (jnp.full((1, 1), max(left * unit, 1e-12)),)


def search_all_then_best_starts(
    model: Model, starts: list[Array], noise: Noise, tolerance: float
) -> list[Attempt]:
    """Return the results of least-squares searches: a few steps from all starts, then more steps
    from the best of the points that were reached.

    - `model`: the model of the light curve.
    - `starts`: the free numbers (n,) of each start.
    - `noise`: the noise of the readings, as `noise_of` returns it.
    - `tolerance`: the tolerance at which a search has converged.
    """
    points, costs = [], []
    for first in range(0, len(starts), FIRST):
        # Starts are repeated to fill the last chunk, so that all chunks use one program.
        chunk = [starts[first + k % len(starts[first:])] for k in range(FIRST)]
        stacked = _fit_brightness_level_of_starts(jnp.stack(chunk), model)
        settings = Settings(tolerance, CAREFUL, STEPS)
        ends = _search_from_starts(stacked, model, noise, settings, np.int32(FIRST))
        points.append(ends.x)
        costs.append(np.asarray(ends.cost))
    all_points = jnp.concatenate(points)
    cost_of = np.concatenate(costs)
    best: list[int] = []
    for index in np.argsort(cost_of):
        others = cost_of[best]
        if (np.abs(cost_of[index] - others) > 1e-3 * (1.0 + others)).all():
            best.append(int(index))
    best = best[:SECOND]
    rows = jnp.asarray(np.resize(best, FIRST))
    settings = Settings(tolerance, 1e-2, MORE)
    last = _search_from_starts(all_points[rows], model, noise, settings, np.int32(len(best)))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], last) for k in range(len(best))]


@eqx.filter_jit
def _search_from_starts(
    starts: Array,
    model: Model,
    noise: Noise,
    settings: Settings,
    count: np.ndarray | np.generic | Array,
) -> Attempt:
    """Return the results of least-squares searches as one `Attempt` with a leading axis of length
    `FIRST`.

    The `Attempt` has one entry for each start. A search is run only from the first `count` starts.

    The searches run one after another within one compiled program. The derivatives are finite
    differences, because exact derivatives of the closed-form motion take a hundred times as long.

    - `starts`: (`FIRST`, n) the n free numbers of each start; starts after the first `count` fill
      the array, and are returned as they are.
    - `model`: the model of the light curve.
    - `noise`: the standard deviation of the readings, in the unit of the sensor, as a tuple of one
      array (1, 1).
    - `settings`: the tolerance and the number of steps of a search.
    - `count`: the number of starts that are searched from, at most `FIRST`.
    """

    def search_from_start(numbered_start: tuple[Array, Array]) -> Attempt:
        start, number = numbered_start

        def scaled_errors(point: Array) -> Array:
            return model.errors(point)[0][:, 0] / noise[0][0, 0]

        def evaluate(point: Array) -> tuple[tuple[()], Array, NormalMatrix, Array]:
            steps = jnp.concatenate([jnp.zeros((1, start.size)), jnp.eye(start.size)])
            moved = point[None] + DIFFERENCE * steps
            e = jax.lax.map(scaled_errors, moved)
            rows = (e[1:] - e[:1]) / DIFFERENCE
            return (), 0.5 * jnp.sum(e[0] ** 2), NormalMatrix(rows @ rows.T), rows @ e[0]

        steps = jnp.where(number < jnp.asarray(count), settings.steps, 0)
        mine = eqx.tree_at(lambda s: s.steps, settings, steps)
        end = minimise(evaluate, start, jnp.ones_like(start), mine, ())
        return Attempt(end.point, end.cost, end.converged)

    return jax.lax.map(search_from_start, (starts, jnp.arange(FIRST, dtype=jnp.int32)))


@eqx.filter_jit
def _fit_brightness_level_of_starts(
    starts: Float[Array, "starts n"], model: Model
) -> Float[Array, "starts n"]:
    """Return the `starts` of searches, each with the level of brightness that fits the readings
    best.

    A start is a vector (n,) of free numbers of the `model`. The level is the flux or magnitude of a
    sphere of the same volume, if sun and observer are in the same direction. If the level is not a
    free number of the `model`, it must keep its value, and the starts are returned unchanged.
    """
    scene = starting_scene(model, model.records)
    path = leaf_at(lambda s: s.sensors[0].level, scene, "level", "the sensor")[0]
    mine = [slot for slot in model.slots if slot.path == path and slot.shared is not None]
    if not mine:
        return starts
    slot, reading = mine[0], model.records.readings[0]
    sensor: Any = reading.sensor
    level = sensor.level[0]

    def level_of_start(start: Array) -> Array:
        error = model.errors(start)[0][:, 0]
        mask = reading.mask[0]
        if sensor.unit == "mag":
            better = level + jnp.sum(error) / jnp.sum(mask.astype(error.dtype))
        else:
            shape = jnp.where(mask, reading.values[0] - error, 0.0)
            better = level * jnp.sum(shape * reading.values[0]) / jnp.sum(shape * shape)
        step = slot.step(level, better)
        return start.at[slot.shared].set(step.reshape(jnp.asarray(slot.shared).shape))

    return jax.vmap(level_of_start)(starts)
