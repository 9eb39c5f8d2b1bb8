"""From pairs of frequencies to motions of a tumbler: starts on a grid, and the search from them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.body.inertia import Inertia
from rigidjax.identify.model.free import leaf_at
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.normal import Normal
from rigidjax.identify.model.terms import template
from rigidjax.identify.search.least_squares import CAREFUL, Settings, minimise
from rigidjax.identify.search.stages import Attempt
from rigidjax.rotation import quaternion
from rigidjax.tumblers import starts
from rigidjax.tumblers.sensor import half_way
from rigidjax.tumblers.two_frequencies import TwoFrequencies, padded

# Starts of the first round, its steps; those that go on, and how far.
FIRST, STEPS, SECOND, MORE = 96, 12, 24, 60
# Step of the differences, of numbers of order one.
DIFFERENCE = 1e-6
# Magnitudes to the logarithm of a flux.
MAGNITUDE = 0.4 * np.log(10.0)


def relative_flux(model: Model, reading: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """Times since the first, s, fluxes relative to their mean and their noise."""
    t = np.asarray(model.records.t[0])
    keep, sensor = reading.seen, reading.sensor
    values = np.asarray(reading.values, float)[keep]
    noise = None if sensor.noise is None else float(np.asarray(sensor.noise)[0])
    if sensor.unit == "mag":
        flux = np.exp(-MAGNITUDE * (values - np.median(values)))
        spread = None if noise is None else MAGNITUDE * noise * flux
    else:
        flux = np.maximum(values, 1e-3 * np.median(values)) / np.median(values)
        spread = None if noise is None else np.full(flux.shape, noise / np.median(values))
    return t[keep] - t[0], flux, spread


def starts_of(
    model: Model,
    reading: Any,
    t: np.ndarray,
    squares: np.ndarray,
    spread: np.ndarray | None,
    found: TwoFrequencies,
    used: int,
) -> list[Array]:
    """Return the best starting points over all pairs of frequencies."""
    sensor = reading.sensor
    sigma = np.ones(t.shape) if spread is None else spread
    light = padded(t, squares, 1.0 / sigma)
    middle = np.asarray(half_way(sensor, model.records.t[0][0] + 0.5 * t[-1]))
    order, areas = np.arange(3), None
    if sensor.semi_axes is not None:
        axes = np.asarray(sensor.semi_axes)
        order = np.argsort(-axes)
        areas = (np.prod(axes) / axes[order]) ** 2
    best_of, others = [], []
    for pair in found.frequencies[:used]:
        for mode in starts.MODES:
            some = starts.candidates(pair, mode, light, middle, areas, 3)
            # One start for each mode of each pair: a grid alone cannot decide between them.
            best_of += some[: len(starts.ABOUT)]
            others += some[len(starts.ABOUT) :]
    chunks = max(1, -(-len(best_of) // FIRST))
    in_order = [one for some in (best_of, others) for one in sorted(some, key=lambda c: c.misfit)]
    all_of = in_order[: chunks * FIRST]
    # The rotation whose columns are the body's axes of ascending moments.
    turn = np.eye(3)[:, order]
    turn = turn * np.array([1.0, 1.0, np.linalg.det(turn)])
    return [_free_numbers(model, one, turn) for one in all_of]


def _free_numbers(model: Model, one: starts.Candidate, turn: np.ndarray) -> Array:
    """Return the free numbers (n,) of a candidate."""
    moments = turn @ np.diag(one.moments) @ turn.T
    start = model.start(Inertia(jnp.asarray(moments)))
    reference = model.reference
    q = _place(jnp.asarray(one.q), jnp.asarray(turn), reference.state.q[0])
    spin = jnp.asarray(turn @ one.omega) / reference.rate[0]
    # An initial state of an `Attitude` is its turn and its rate.
    return start.at[model.index.start[0]].set(jnp.concatenate([q, spin]))


@jax.jit
def _place(q: Array, turn: Array, reference: Array) -> Array:
    back = quaternion.conjugate(quaternion.from_matrix(turn))
    q = quaternion.multiply(q, back)
    return quaternion.log(quaternion.multiply(quaternion.conjugate(reference), q))


def noise_of(
    model: Model, reading: Any, flux: np.ndarray, found: TwoFrequencies
) -> tuple[Float[Array, "1 1"], ...]:
    """The noise (1, 1) in the sensor's unit; if it is not known, the residuals of the series."""
    sensor = reading.sensor
    if sensor.noise is not None:
        return (sensor.noise[None],)
    left = found.scatter / (2.0 * np.median(flux))
    unit = 1.0 / MAGNITUDE if sensor.unit == "mag" else np.median(np.asarray(reading.values))
    return (jnp.full((1, 1), max(left * unit, 1e-12)),)


def descended(model: Model, starts: list[Array], noise: Any, tolerance: float) -> list[Attempt]:
    """Return the ends of a few steps from all starts, then the best of them to convergence."""
    points, costs = [], []
    for first in range(0, len(starts), FIRST):
        # Always as many: one program.
        some = [starts[first + k % len(starts[first:])] for k in range(FIRST)]
        stacked = _levelled(jnp.stack(some), model)
        found = _many(stacked, model, noise, Settings(tolerance, CAREFUL, STEPS), np.int32(FIRST))
        points.append(found.x)
        costs.append(np.asarray(found.cost))
    all_of = jnp.concatenate(points)
    cost_of = np.concatenate(costs)
    kept: list[int] = []
    for index in np.argsort(cost_of):
        others = cost_of[kept]
        if (np.abs(cost_of[index] - others) > 1e-3 * (1.0 + others)).all():
            kept.append(int(index))
    kept = kept[:SECOND]
    rows = jnp.asarray(np.resize(kept, FIRST))
    last = _many(all_of[rows], model, noise, Settings(tolerance, 1e-2, MORE), np.int32(len(kept)))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], last) for k in range(len(kept))]


@eqx.filter_jit
def _many(starts: Array, model: Model, noise: Any, settings: Settings, count: Any) -> Attempt:
    """Return the ends of the searches from the first `count` starts, one after another.

    The slopes are differences of the closed form: derivatives take a hundred times as long.
    """

    def one(given: tuple[Array, Array]) -> Attempt:
        start, number = given

        def errors(point: Array) -> Array:
            return model.errors(point)[0][:, 0] / noise[0][0, 0]

        def evaluated(point: Array) -> tuple[Any, Array, Normal, Array]:
            steps = jnp.concatenate([jnp.zeros((1, start.size)), jnp.eye(start.size)])
            moved = point[None] + DIFFERENCE * steps
            e = jax.lax.map(errors, moved)
            rows = (e[1:] - e[:1]) / DIFFERENCE
            return (), 0.5 * jnp.sum(e[0] ** 2), Normal(rows @ rows.T), rows @ e[0]

        steps = jnp.where(number < count, settings.steps, 0)
        mine = eqx.tree_at(lambda s: s.steps, settings, steps)
        end = minimise(evaluated, start, jnp.ones_like(start), mine, ())
        return Attempt(end.point, end.cost, end.converged)

    return jax.lax.map(one, (starts, jnp.arange(FIRST, dtype=jnp.int32)))


@eqx.filter_jit
def _levelled(starts: Float[Array, "starts n"], model: Model) -> Float[Array, "starts n"]:
    """Return the starts with the level at which they fit best, if it is free."""
    scene = template(model, model.records)
    path = leaf_at(lambda s: s.sensors[0].level, scene, "level", "the sensor")[0]
    mine = [slot for slot in model.slots if slot.path == path and slot.shared is not None]
    if not mine:
        return starts
    slot, reading = mine[0], model.records.readings[0]
    sensor: Any = reading.sensor
    level = sensor.level[0]

    def one(start: Array) -> Array:
        error = model.errors(start)[0][:, 0]
        seen = reading.mask[0]
        if sensor.unit == "mag":
            better = level + jnp.sum(error) / jnp.sum(seen.astype(error.dtype))
        else:
            shape = jnp.where(seen, reading.values[0] - error, 0.0)
            better = level * jnp.sum(shape * reading.values[0]) / jnp.sum(shape * shape)
        step = slot.step(level, better)
        return start.at[slot.shared].set(step.reshape(jnp.asarray(slot.shared).shape))

    return jax.vmap(one)(starts)
