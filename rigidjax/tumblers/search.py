"""From pairs of frequencies to motions of a tumbler: starts on a grid, and the search from them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax.body.inertia import Inertia
from rigidjax.identify.model.free import Parameters
from rigidjax.identify.model.problem import Problem
from rigidjax.identify.search.least_squares import CAREFUL, Settings, search
from rigidjax.identify.search.normal import Normal
from rigidjax.identify.search.stages import Tried
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


def relative_flux(problem: Problem, reading: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """Times since the first, s, fluxes relative to their mean and their noise."""
    t = np.asarray(problem.records.t[0])
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
    problem: Problem,
    reading: Any,
    t: np.ndarray,
    squares: np.ndarray,
    spread: np.ndarray | None,
    found: TwoFrequencies,
    used: int,
) -> list[Parameters]:
    """The best starting points over all pairs of frequencies."""
    sensor = reading.sensor
    sigma = np.ones(t.shape) if spread is None else spread
    light = padded(t, squares, 1.0 / sigma)
    middle = np.asarray(half_way(sensor, problem.records.t[0][0] + 0.5 * t[-1]))
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
    return [_parameters(problem, one, turn) for one in all_of]


def _parameters(problem: Problem, one: starts.Candidate, turn: np.ndarray) -> Parameters:
    moments = turn @ np.diag(one.moments) @ turn.T
    start = problem.start(Inertia(jnp.asarray(moments)))
    reference = problem.reference
    q = _place(jnp.asarray(one.q), jnp.asarray(turn), reference.state.q[0])
    spin = jnp.asarray(turn @ one.omega)[None] / reference.rate[:, None]
    return eqx.tree_at(lambda p: (p.own.spin, p.own.turn), start, (spin, q[None]))


@jax.jit
def _place(q: Array, turn: Array, reference: Array) -> Array:
    back = quaternion.conjugate(quaternion.from_matrix(turn))
    q = quaternion.multiply(q, back)
    return quaternion.log(quaternion.multiply(quaternion.conjugate(reference), q))


def noise_of(
    problem: Problem, reading: Any, flux: np.ndarray, found: TwoFrequencies
) -> tuple[Float[Array, "1 1"], ...]:
    """The noise (1, 1) in the sensor's unit; if it is not known, the residuals of the series."""
    sensor = reading.sensor
    if sensor.noise is not None:
        return (sensor.noise[None],)
    left = found.scatter / (2.0 * np.median(flux))
    unit = 1.0 / MAGNITUDE if sensor.unit == "mag" else np.median(np.asarray(reading.values))
    return (jnp.full((1, 1), max(left * unit, 1e-12)),)


def descended(
    problem: Problem, starts: list[Parameters], noise: Any, tolerance: float
) -> list[Tried]:
    """A few steps from all starts, then the best of them to convergence."""
    parameters, costs = [], []
    for first in range(0, len(starts), FIRST):
        # Always as many: one program.
        some = [starts[first + k % len(starts[first:])] for k in range(FIRST)]
        stacked = _levelled(jax.tree.map(lambda *leaves: jnp.stack(leaves), *some), problem)
        found = _many(stacked, problem, noise, Settings(tolerance, CAREFUL, STEPS), np.int32(FIRST))
        parameters.append(found.parameters)
        costs.append(np.asarray(found.cost))
    all_of = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parameters)
    cost_of = np.concatenate(costs)
    kept: list[int] = []
    for index in np.argsort(cost_of):
        others = cost_of[kept]
        if (np.abs(cost_of[index] - others) > 1e-3 * (1.0 + others)).all():
            kept.append(int(index))
    kept = kept[:SECOND]
    rows = jnp.asarray(np.resize(kept, FIRST))
    nearer = jax.tree.map(lambda leaf: leaf[rows], all_of)
    last = _many(nearer, problem, noise, Settings(tolerance, 1e-2, MORE), np.int32(len(kept)))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], last) for k in range(len(kept))]


@eqx.filter_jit
def _many(
    starts: Parameters, problem: Problem, noise: Any, settings: Settings, count: Any
) -> Tried:
    """The search from the first `count` starts, one after another, with slopes by differences.

    The closed form without derivatives takes a hundredth of the time.
    """

    def one(given: tuple[Parameters, Array]) -> Tried:
        start, number = given
        flat, restore = ravel_pytree(start)

        def errors(point: Array) -> Array:
            return problem.errors(restore(point))[0][:, 0] / noise[0][0, 0]

        def evaluated(point: Array) -> tuple[Any, Array, Normal, Array]:
            steps = jnp.concatenate([jnp.zeros((1, flat.size)), jnp.eye(flat.size)])
            moved = point[None] + DIFFERENCE * steps
            e = jax.lax.map(errors, moved)
            rows = (e[1:] - e[:1]) / DIFFERENCE
            return (), 0.5 * jnp.sum(e[0] ** 2), Normal(rows @ rows.T), rows @ e[0]

        steps = jnp.where(number < count, settings.steps, 0)
        mine = eqx.tree_at(lambda s: s.steps, settings, steps)
        end = search(evaluated, flat, jnp.ones_like(flat), mine, ())
        return Tried(restore(end.point), end.cost, end.converged)

    return jax.lax.map(one, (starts, jnp.arange(FIRST, dtype=jnp.int32)))


@eqx.filter_jit
def _levelled(starts: Parameters, problem: Problem) -> Parameters:
    """Starts with the level at which they fit best, if it is free."""
    leaves, structure = jax.tree.flatten(problem.records)
    numbered: Any = jax.tree.unflatten(structure, list(range(len(leaves))))
    at = numbered.readings[0].sensor.level
    mine = [k for k, slot in enumerate(problem.slots) if slot.leaf == at and not slot.each]
    if not mine:
        return starts
    which = sum(1 for slot in problem.slots[: mine[0]] if not slot.each)
    slot, reading = problem.slots[mine[0]], problem.records.readings[0]
    sensor: Any = reading.sensor
    level = sensor.level[0]

    def one(start: Parameters) -> Parameters:
        error = problem.errors(start)[0][:, 0]
        seen = reading.mask[0]
        if sensor.unit == "mag":
            better = level + jnp.sum(error) / jnp.sum(seen.astype(error.dtype))
        else:
            shape = jnp.where(seen, reading.values[0] - error, 0.0)
            better = level * jnp.sum(shape * reading.values[0]) / jnp.sum(shape * shape)
        step = slot.step(level, better).reshape(start.shared[which].shape)
        return eqx.tree_at(lambda p: p.shared[which], start, step)

    return jax.vmap(one)(starts)
