"""Find the motions of a tumbler that have given pairs of frequencies, by least-squares searches
whose starting points are on a grid.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax._types import Mat3, Quat, Vec3
from rigidjax.body.inertia import Inertia
from rigidjax.identify.data.recording import Reading
from rigidjax.identify.model.free import leaf_at
from rigidjax.identify.model.model import Model, starting_scene
from rigidjax.identify.model.normal import NormalMatrix
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.search.least_squares import CAREFUL, Settings, minimise
from rigidjax.identify.search.stages import Attempt
from rigidjax.rotation import quaternion
from rigidjax.tumblers import starts
from rigidjax.tumblers.sensor import bisector_at
from rigidjax.tumblers.two_frequencies import pad_light_curve

# The search takes STEPS steps from each start; one run of a program computes a chunk of FIRST
# starts. Then the search takes MORE steps from each of the best results, which are SECOND in
# number.
FIRST, STEPS, SECOND, MORE = 96, 12, 24, 60
# Derivatives with respect to the parameters are finite differences with this step. The parameters
# are of order one.
DIFFERENCE = 1e-6
# The natural logarithm of a flux decreases by this number if the magnitude increases by one.
MAGNITUDE = 0.4 * np.log(10.0)


class Fluxes(NamedTuple):
    """Hold a light curve without gaps."""

    t: Float[np.ndarray, " times"]  # since the first time of the recording, s
    flux: Float[np.ndarray, " times"]  # divided by the median
    noise: Float[np.ndarray, " times"] | None  # of `flux`; None if it is not known


def fluxes_of(model: Model, reading: Reading) -> Fluxes:
    """Return the light curve of the `Brightness` sensor, with magnitudes converted to fluxes."""
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
    return Fluxes(t[mask] - t[0], flux, sigma)


def starts_of_pairs(
    model: Model,
    reading: Reading,
    t: Float[np.ndarray, " times"],
    squared_flux: Float[np.ndarray, " times"],
    noise: Float[np.ndarray, " times"] | None,
    pairs: Float[np.ndarray, "pairs 2"],
) -> list[Float[Array, " n"]]:
    """Return the best starting points of the searches, as parameters of the model, for all `pairs`.

    Squared fluxes and their `noise` are divided by the square of the median flux; a pair is the
    frequency of the mean precession and twice that of the rotation, 1/s.
    """
    sensor: Any = reading.sensor
    sigma = np.ones(t.shape) if noise is None else noise
    light = pad_light_curve(t, squared_flux, 1.0 / sigma)
    middle = np.asarray(bisector_at(sensor, model.records.t[0][0] + 0.5 * t[-1]))
    order, areas = np.arange(3), None
    if sensor.semi_axes is not None:
        axes = np.asarray(sensor.semi_axes)
        order = np.argsort(-axes)
        areas = (np.prod(axes) / axes[order]) ** 2
    best_of, others = [], []
    for pair in pairs:
        for mode in starts.MODES:
            candidates = starts.best_candidates(pair, mode, light, middle, areas, 3)
            # `best_of` gets the starts of the best body for this pair and this mode, and `others`
            # the starts of the other bodies. All starts of `best_of` are used, those of `others`
            # only to fill the last chunk, since χ² on a grid cannot decide between pairs and
            # modes.
            best_of += candidates[: len(starts.ABOUT)]
            others += candidates[len(starts.ABOUT) :]
    chunks = max(1, -(-len(best_of) // FIRST))
    in_order = [one for group in (best_of, others) for one in sorted(group, key=lambda c: c.chi2)]
    chosen = in_order[: chunks * FIRST]
    # The columns of this rotation are the axes of the body in the order of ascending moments.
    principal_to_body = np.eye(3)[:, order]
    principal_to_body = principal_to_body * np.array([1.0, 1.0, np.linalg.det(principal_to_body)])
    reference, out = model.reference, []
    for one in chosen:
        moments = principal_to_body @ np.diag(one.moments) @ principal_to_body.T
        start = model.start(Inertia(jnp.asarray(moments)))
        step = _step_from(jnp.asarray(one.q), jnp.asarray(principal_to_body), reference.state.q[0])
        spin = jnp.asarray(principal_to_body @ one.omega) / reference.rate[0]
        # The parameters of an initial `Attitude` are the rotation vector from the reference
        # attitude, and the rate in units of the typical rate.
        out.append(start.at[model.index.start[0]].set(jnp.concatenate([step, spin])))
    return out


@jax.jit
def _step_from(q: Quat, principal_to_body: Mat3, reference: Quat) -> Vec3:
    """Return the rotation vector, rad, body axes, that turns the attitude `reference` of a body to
    the attitude at which q maps principal axes to world axes.
    """
    back = quaternion.conjugate(quaternion.from_matrix(principal_to_body))
    q = quaternion.multiply(q, back)
    return quaternion.log(quaternion.multiply(quaternion.conjugate(reference), q))


def noise_of(reading: Reading, flux: np.ndarray, scatter: float) -> tuple[Float[Array, "1 1"], ...]:
    """Return the noise of the readings in the unit of the sensor, if not known from `scatter`, the
    deviation of the squared `flux` (over its median) about its best Fourier series.
    """
    sensor: Any = reading.sensor
    if sensor.noise is not None:
        return (sensor.noise[None],)
    left = scatter / (2.0 * np.median(flux))
    unit = 1.0 / MAGNITUDE if sensor.unit == "mag" else np.median(np.asarray(reading.values))
    return (jnp.full((1, 1), max(left * unit, 1e-12)),)


def search_starts(
    model: Model, starts: list[Array], noise: Noise, tolerance: float
) -> list[Attempt]:
    """Return the results of a few steps of least squares from all starts, continued from the best
    of the points that were reached.
    """
    points, costs = [], []
    for first in range(0, len(starts), FIRST):
        # Starts are repeated to fill the last chunk, so that all chunks use one program.
        chunk = [starts[first + k % len(starts[first:])] for k in range(FIRST)]
        stacked = _with_levels(jnp.stack(chunk), model)
        settings = Settings(tolerance, CAREFUL, STEPS)
        ends = _searched_starts(stacked, model, noise, settings, np.int32(FIRST))
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
    last = _searched_starts(all_points[rows], model, noise, settings, np.int32(len(best)))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], last) for k in range(len(best))]


@eqx.filter_jit
def _searched_starts(
    starts: Array,
    model: Model,
    noise: Noise,
    settings: Settings,
    count: np.ndarray | np.generic | Array,
) -> Attempt:
    """Return the results of least-squares searches, run one after another from the first `count`
    starts, as one `Attempt` with a leading axis; the other starts fill the array and are returned
    as they are.

    The derivatives are finite differences, because exact derivatives of the closed-form motion take
    a hundred times as long.
    """

    def search(numbered: tuple[Array, Array]) -> Attempt:
        start, number = numbered

        def evaluate(point: Array) -> tuple[tuple[()], Array, NormalMatrix, Array]:
            steps = jnp.concatenate([jnp.zeros((1, start.size)), jnp.eye(start.size)])
            moved = point[None] + DIFFERENCE * steps
            residuals = lambda x: model.errors(x)[0][:, 0] / noise[0][0, 0]  # noqa: E731
            e = jax.lax.map(residuals, moved)
            rows = (e[1:] - e[:1]) / DIFFERENCE
            return (), 0.5 * jnp.sum(e[0] ** 2), NormalMatrix(rows @ rows.T), rows @ e[0]

        steps = jnp.where(number < jnp.asarray(count), settings.steps, 0)
        mine = eqx.tree_at(lambda s: s.steps, settings, steps)
        end = minimise(evaluate, start, jnp.ones_like(start), mine, ())
        return Attempt(end.point, end.cost, end.converged)

    return jax.lax.map(search, (starts, jnp.arange(FIRST, dtype=jnp.int32)))


@eqx.filter_jit
def _with_levels(starts: Float[Array, "starts n"], model: Model) -> Float[Array, "starts n"]:
    """Return the starts, each with the level of brightness that fits the readings best, if the
    level is a parameter of the model.
    """
    scene = starting_scene(model, model.records)
    path = leaf_at(lambda s: s.sensors[0].level, scene, "level", "the sensor")[0]
    mine = [slot for slot in model.slots if slot.path == path and slot.shared is not None]
    if not mine:
        return starts
    slot, reading = mine[0], model.records.readings[0]
    sensor: Any = reading.sensor
    level = sensor.level[0]

    def with_level(start: Array) -> Array:
        error = model.errors(start)[0][:, 0]
        mask = reading.mask[0]
        if sensor.unit == "mag":
            better = level + jnp.sum(error) / jnp.sum(mask.astype(error.dtype))
        else:
            shape = jnp.where(mask, reading.values[0] - error, 0.0)
            better = level * jnp.sum(shape * reading.values[0]) / jnp.sum(shape * shape)
        step = slot.step(level, better)
        return start.at[slot.shared].set(step.reshape(jnp.asarray(slot.shared).shape))

    return jax.vmap(with_level)(starts)
