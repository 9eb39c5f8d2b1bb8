"""Find the least cost from one start: Levenberg–Marquardt fits to longer and longer beginnings of
the records.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from rigidjax.identify.data.recording import Reading, numbers_read
from rigidjax.identify.model import terms
from rigidjax.identify.model.charts import split_numbers
from rigidjax.identify.model.first_order import value_and_jacfwd
from rigidjax.identify.model.model import Model, error_jacobians, padded_arrays, parts_of
from rigidjax.identify.model.normal import NormalMatrix, normal_matrix
from rigidjax.identify.model.predict import FixedSteps, HeldSteps
from rigidjax.identify.model.several import Part
from rigidjax.identify.model.terms import Blocks, Noise
from rigidjax.identify.search.least_squares import BOLD, CAREFUL, LMState, Settings, minimise
from rigidjax.identify.sensors.base import extras
from rigidjax.rotation.barrier import barrier

# Fits to longer and longer beginnings of a record follow each other: to a quarter of its length, to
# half of its length, and to the whole. A fit to a long record has many wrong minima, in which the
# phase is wrong by whole turns. A fit to a short record has no such minima.
HORIZONS = (0.25, 0.5, 1.0)
# If there are at least this many recordings, the numbers that belong to one recording alone are
# eliminated from the normal equations.
MANY = 16
# One run of the compiled search takes this many steps. An interrupt is noticed between two runs.
STRIDE = 25
# A search has reached the minimum if one run of STRIDE steps lowers the cost by less than this
# fraction of the cost.
SETTLED = 1e-7
# The result of a fit to the beginning of a record is used only if it raises the cost of the whole
# record by less than this factor. A start is given up if its fit to the beginning does not
# converge, and its cost there exceeds, by more than this factor, the share of the beginning in
# the cost of another start.
WILD = 100.0
# A search over windows ends at a distance of about TOLERANCES times the tolerance from the minimum.
# By default this distance is 0.05 standard deviations. The search ends when the gain of a step
# (fall of the cost), divided by the gain of a fit from noise alone, is less than the square of this
# distance. A short search, which uses only a part of each window, ends when this ratio of gains is
# less than ROUGH.
TOLERANCES, ROUGH = 500.0, 1.0
# Two short searches come before the search over whole windows. As PARTS says, the first one uses
# one ninth of each window, and the second one a third. Each of them takes at most FEW steps of
# Levenberg and Marquardt, and is left out if its part of a window has fewer than SHORTEST time
# steps.
PARTS, SHORTEST, FEW = (9, 3), 5, 10


class Evaluation(NamedTuple):
    """Hold the blocks of the last evaluation of the cost, and the gradients of all recordings."""

    blocks: Blocks
    # For each kind and recording the gradient of the cost of its readings in its row.
    pulls: tuple[Float[Array, "records m"], ...]


class Attempt(eqx.Module):
    """Hold the result of the search from one start."""

    x: Float[Array, " n"]
    cost: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=np.inf)
    converged: Bool[Array, ""] = eqx.field(converter=jnp.asarray, default=False)
    # The errors and their Jacobian at x, or `None` if they were not kept.
    blocks: Any = None


class Task(NamedTuple):
    """Hold the model and the noise of a search, and its precision."""

    model: Model
    noise: Noise
    # In standard deviations, as `Settings.tolerance`.
    tolerance: float
    max_steps: int


@eqx.filter_jit
def marquardt(
    model: Model,
    x: Float[Array, " n"],
    noise: Noise,
    weights: Float[Array, "records times"],
    settings: Settings,
) -> LMState:
    """Return the last state of a search by Levenberg and Marquardt over the parameters of a model.

    The `weights` are zero for readings that are not fitted.
    """
    number, kind = model.size, x.dtype
    kinds = [_kind(model, part, noise, weights) for part in parts_of(model)]
    # Own parameters may be in a `Measured`, too.
    many = model.count >= MANY and not model.parts and not model.measured
    alone = np.asarray(model.index.alone, int) if many else None
    prior = terms.prior_weights(model)

    def evaluate(x: Array) -> tuple[Evaluation, Array, NormalMatrix, Array]:
        total, slope = jnp.zeros((), kind), jnp.zeros(number + 1, kind)
        blocks, every, normals = [], [], []
        for part, one, places, sigma, factors in kinds:
            # Without a barrier XLA on CPU computes the derivatives again inside each residual, and
            # the program takes a fifth longer to compile.
            errors, slopes = barrier(error_jacobians(one, part.take(x)))
            residuals, rows = terms.residual_jacobians(
                lambda e, m=one, s=sigma, w=factors: terms.reading_residuals(m, e, s, w),
                errors,
                slopes,
            )
            pulls = jnp.zeros(places.shape, kind)
            for e, row in zip(residuals, rows, strict=True):
                total = total + jnp.sum(e**2)
                # On a CPU a product of matrices is several times as fast as an `einsum`, as in
                # `normal_matrix`.
                flat = row.reshape(len(places), -1, places.shape[1])
                pulls = pulls + (e.reshape(len(places), 1, -1) @ flat)[:, 0]
            slope = slope.at[places].add(pulls)
            normals.append(normal_matrix(rows, places, number, alone))
            blocks.append((errors, slopes))
            every.append(pulls)
        normal = jax.tree.map(lambda *all_: sum(all_[1:], all_[0]), *normals)
        normal = normal.add_diagonal(prior**2)
        total, slope = total + jnp.sum((prior * x) ** 2), slope[:-1] + prior**2 * x
        e, row = value_and_jacfwd(lambda x: terms.joint_residuals(model, x), x)
        if e.size:
            total, slope = total + jnp.sum(e**2), slope + e @ row
            normal = normal.add_rows(row)
        # The body is no linear function of its parameters, which matters if it may be flat.
        charts, few = model.charts, slice(model.index.bodies)
        parts = (split_numbers(charts, y[few]) for y in (x, slope))
        bent = [chart.curvature_rows(*mine) for chart, *mine in zip(charts, *parts, strict=True)]
        curvature = block_diag(*bent)
        normal = normal.add_rows(jnp.pad(curvature, ((0, 0), (0, number - curvature.shape[1]))))
        kept = (tuple(x for block in some for x in block) for some in zip(*blocks, strict=True))
        return Evaluation(Blocks(*kept), tuple(every)), 0.5 * total, normal, slope

    # The shapes of the first state are computed here, since tracing `evaluate` would take seconds.
    shapes = [
        ((*one.records.t.shape, sensor.components), places.shape[1])
        for _, one, places, *_ in kinds
        for sensor in one.records.sensors
    ]
    zeros = Evaluation(
        Blocks(
            tuple(jnp.zeros(shape, kind) for shape, _ in shapes),
            tuple(jnp.zeros((*shape, columns), kind) for shape, columns in shapes),
        ),
        tuple(jnp.zeros(places.shape, kind) for _, _, places, *_ in kinds),
    )
    places = kinds[0].places
    none = jnp.zeros((len(places), 0, 0, places.shape[1]), kind)
    zero_normal = normal_matrix((none,), places, number, alone)
    by_noise = None if model.clusters is None else partial(_takeuchi, model)
    order_one = of_order_one(model, kind)
    end = minimise(evaluate, x, order_one, settings, zeros, zero_normal, by_noise)
    # If the cost is finite at none of the evaluated points, not even at x, the result is x with an
    # infinite cost.
    lost = ~jnp.isfinite(end.cost)
    return dataclasses.replace(
        end,
        point=jnp.where(lost, x, end.point),
        cost=jnp.where(lost, jnp.inf, end.cost),
        converged=end.converged & ~lost,
    )


class _Kind(NamedTuple):
    """Hold the model of one kind of recordings for one search."""

    part: Part
    # Its integrator computes no states long after the last reading with a weight.
    model: Model
    places: Int[Array, "records m"]  # of the columns of its rows among all parameters
    noise: Noise
    weights: Float[Array, "records times"]


def _kind(model: Model, part: Part, noise: Noise, weights: Float[Array, "records times"]) -> _Kind:
    """Return what a search needs of the recordings of one `part` of a `model`: their own model, and
    their places, noise and weights.
    """
    one, places = (
        dataclasses.replace(part.model, loss=model.loss),
        model.index.places[part.recordings_slice],
    )
    weights = weights[part.recordings_slice, : one.records.t.shape[1]]
    if isinstance(one.integrator, FixedSteps | HeldSteps):
        counts = jnp.any(weights > 0, axis=0)
        place = jnp.arange(counts.size, dtype=jnp.int32)
        last = jnp.max(jnp.where(counts, place, 0))
        shorter = eqx.tree_at(
            lambda s: s.last, one.integrator, last, is_leaf=lambda node: node is None
        )
        one = eqx.tree_at(lambda m: m.integrator, one, shorter)
    sigma = tuple(each[part.recordings_slice] for each in noise[part.sensors_slice])
    return _Kind(part, one, places[:, : one.index.places.shape[1]], sigma, weights)


def _takeuchi(model: Model, evaluation: Evaluation, normal: NormalMatrix) -> Float[Array, ""]:
    """Return the mean fall `½ tr(K G⁻¹)` of the cost of all windows by a fit of noise alone.

    G is the normal matrix of the parameters that all windows share; the initial states of the
    windows were eliminated from it. K is the sum of g gᵀ over stretches, where g is the gradient of
    the cost of one stretch, within which errors may be correlated (Takeuchi 1976; Burnham and
    Anderson 2002, doi:10.1007/b97636, section 7.2). The gradient with respect to the initial states
    is left out: near the least cost each initial state is at its own optimum.
    """
    assert model.clusters is not None
    # The rows of this array are the gradients of the stretches. It has as many rows as there are
    # windows, although there are fewer stretches: their number is not known when this function is
    # compiled. The other rows stay zero.
    slopes = jnp.zeros((model.count, model.size), normal.core.dtype)
    slopes = slopes.at[model.clusters[:, None], model.index.places].add(
        evaluation.pulls[0], mode="drop"
    )
    starts = jnp.asarray(model.index.start).reshape(-1)
    slopes = slopes.at[:, starts].set(0.0)
    diagonal = normal.diagonal
    root = jnp.sqrt(jnp.maximum(diagonal, 1e-12 * jnp.max(diagonal)))
    definite = normal.scaled(1.0 / root).add_diagonal(jnp.full_like(root, 1e-12))
    scaled = slopes / root[None, :]
    return 0.5 * jnp.sum(scaled * definite.solve(scaled.T).T)


def of_order_one(model: Model, dtype: DTypeLike) -> Float[Array, " n"]:
    """Return one for each parameter of a body or an initial state, and zero for those of `Free`s.

    The user chooses the unit of a `Free`, so that its parameters may have any size.
    """
    ones = jnp.zeros(model.size, dtype).at[: model.index.bodies].set(1.0)
    return ones.at[model.index.start].set(1.0)


def whole_weights(model: Model) -> Float[Array, "records times"]:
    """Return the weights of the readings for a fit to the whole of each recording: ones."""
    # NumPy is used since, outside of a trace, each operation of JAX takes as long as a run of 100
    # steps.
    return jnp.asarray(np.ones(model.records.t.shape, model.records.t.dtype))


def first_weights(model: Model, part: float) -> Float[Array, "records times"]:
    """Return the weights for a fit to the first fraction `part` of the duration of each record."""
    t = np.asarray(model.records.t)
    since, length = t - t[:, :1], t[:, -1:] - t[:, :1]
    return jnp.asarray((since <= part * length).astype(t.dtype))


def _best_attempt(state: LMState, model: Model) -> Attempt:
    """Return the best point of a search, with its `blocks` if it was the last evaluated one."""
    blocks = _blocks(state, model) if bool(state.evaluated_at_best) else None
    return Attempt(state.point, state.cost, state.converged, blocks)


def _take_steps(
    x: Float[Array, " n"],
    task: Task,
    weights: Float[Array, "records times"],
    damping: float,
    aim: float = 0.0,
    sufficient_cost: float = 0.0,
    steps: int | None = None,
    noise_gain_fraction: float | None = None,
) -> LMState:
    """Return the last state of a search after a few steps from x, in one compiled run.

    Without `noise_gain_fraction` (`Settings.level`) the search of a model of windows ends at a
    distance of about `TOLERANCES` tolerances from the minimum.
    """
    steps = min(STRIDE, task.max_steps) if steps is None else steps
    level = noise_gain_fraction
    level = (TOLERANCES * task.tolerance) ** 2 if level is None else level
    count = unit_noise_count(task.model)
    settings = Settings(task.tolerance, damping, steps, aim, sufficient_cost, count, level)
    return marquardt(task.model, x, task.noise, weights, settings)


def _evaluate_all_readings(model: Model, x: Float[Array, " n"], noise: Noise) -> LMState:
    """Return the state of a search that evaluates the cost of all readings and takes no step.

    It uses the compiled program of the search.
    """
    return marquardt(model, x, noise, whole_weights(model), Settings(0.0, 1.0, 0))


def _blocks(state: LMState, model: Model) -> Blocks:
    """Return the blocks of the last evaluation of a search."""
    return Blocks(*(padded_arrays(model, some) for some in state.evaluation.blocks))


def blocks_at(model: Model, x: Float[Array, " n"]) -> Blocks:
    """Return what `terms.error_jacobians` returns, by the compiled program of the search."""
    kind, sensors = model.records.t.dtype, model.records.sensors
    ones = (np.ones((model.count, sensor.components), kind) for sensor in sensors)
    return _blocks(_evaluate_all_readings(model, x, tuple(map(jnp.asarray, ones))), model)


def cost_of(model: Model, x: Float[Array, " n"], noise: Noise) -> float:
    """Return the cost of a `model` over the whole of its records."""
    return float(_evaluate_all_readings(model, x, noise).cost)


def search_whole(
    begin: Attempt,
    task: Task,
    *,
    damping: float = BOLD,
    aim: float = 0.0,
    weights: Float[Array, "records times"] | None = None,
    watch: Callable[[Attempt], None] = lambda attempt: None,
) -> Attempt:
    """Return the result of a search over the whole of the records, in runs of `STRIDE` steps.

    The search ends when a run hardly changes the cost, or if it is not likely to reach `aim`, the
    cost that the search from another start reached. Large damping alone makes steps short, which
    can look like convergence: each run after the first begins with little damping. `watch` is
    called after each run.
    """
    attempt, weights = begin, whole_weights(task.model) if weights is None else weights
    for first in range(0, task.max_steps, STRIDE):
        before = float(attempt.cost)
        end = _take_steps(attempt.x, task, weights, BOLD if first else damping, aim)
        if not np.isfinite(float(end.cost)):
            # The cost has become infinite or NaN. The search returns to the point before this
            # run.
            attempt = Attempt(attempt.x, cost_of(task.model, attempt.x, task.noise))
            watch(attempt)
            break
        attempt = _best_attempt(end, task.model)
        # At the minimum every step may be refused because of round-off. The search therefore also
        # ends if the cost does not fall any more. This test needs a whole run: with a small
        # `max_steps`, one or two steps may all be refused only because they are too long.
        stands = before - float(attempt.cost) < SETTLED * (1.0 + abs(before))
        stands = stands and task.max_steps >= STRIDE
        settled = bool(attempt.converged) or stands
        # The search is hopeless if the cost would still be above `aim`, the cost that the search
        # from another start reached, after another run that lowers the cost by the same factor as
        # this run.
        hopeless = aim > 0 and not settled and float(attempt.cost) ** 2 > aim * before
        attempt = dataclasses.replace(attempt, converged=settled)
        watch(attempt)
        if settled or hopeless:
            break
    return attempt


def fit_in_stages(
    x: Float[Array, " n"],
    task: Task,
    *,
    aim: float = 0.0,
    watch: Callable[[Attempt], None] = lambda attempt: None,
) -> Attempt:
    """Return the result of the search from one start, in fits to longer and longer beginnings.

    The whole record is fitted first. If this fit does not explain the record, its beginnings
    (`HORIZONS`) are fitted, and then the whole. `aim` and `watch` are as for `search_whole`.
    """
    model, noise, *_ = task
    if model.clusters is not None:
        # A prediction over a long time with poor parameters diverges: the first ninth and the
        # first third of each window come first, if they have enough steps.
        begin, length = x, model.records.t.shape[1] - 1
        for part in PARTS:
            steps = length // part
            if steps >= SHORTEST:
                weights = first_weights(model, (steps + 0.5) / length)
                end = _take_steps(begin, task, weights, BOLD, steps=FEW, noise_gain_fraction=ROUGH)
                begin = end.point if np.isfinite(float(end.cost)) else begin
        attempt = search_whole(Attempt(begin), task, aim=aim, watch=watch)
        if begin is not x and not float(attempt.cost) <= cost_of(model, x, noise):
            attempt = search_whole(Attempt(x), task, aim=aim, watch=watch)
        return attempt
    end = _take_steps(x, task, whole_weights(model), CAREFUL, aim)
    at_once = _best_attempt(end, model)
    if bool(end.converged) and float(end.cost) <= accepted_cost(model):
        watch(at_once)
        return at_once
    level = float(end.first)
    for part in HORIZONS[:-1]:
        # This fit to the beginning of the record need not converge, since its result is only the
        # start of the next fit.
        weights = first_weights(model, part)
        end = _take_steps(x, task, weights, CAREFUL, aim * part, aim * part)
        # Parameters that explain the beginning of the record may be far off later in the record,
        # for instance if the drag has the wrong sign. They are used only if the cost of the whole
        # record does not grow too much.
        after = cost_of(model, end.point, noise)
        if after < WILD * max(level, 1e-300):
            x, level = end.point, after
        if aim * part > 0 and not bool(end.converged) and float(end.cost) > WILD * aim * part:
            # The search from another start explains the whole record, and the search from this
            # start does not even explain the beginning of the record. This start is given up.
            attempt = Attempt(x, level)
            watch(attempt)
            return attempt
    attempt = search_whole(Attempt(x), task, damping=CAREFUL, aim=aim, watch=watch)
    if not float(at_once.cost) < (1.0 - SETTLED) * float(attempt.cost):
        return attempt
    # The fits to the beginning of the record may have led away from the minimum of the whole
    # record's cost. The first fit to the whole record, which has a lower cost, is then the
    # result, after further steps if it has not converged.
    return at_once if bool(at_once.converged) else search_whole(at_once, task, aim=aim, watch=watch)


def has_unit_noise(reading: Reading) -> bool:
    """Return whether a sensor's noise is only a unit for its errors, whose size is not known."""
    return extras(reading.sensor).nominal is True


def unit_noise_count(model: Model) -> int:
    """Return the number of errors of a `model` if every sensor has unit noise; else 0."""
    readings = model.records.readings
    return sum(map(numbers_read, readings)) if all(map(has_unit_noise, readings)) else 0


def accepted_cost(model: Model) -> float:
    """Return a cost low enough to accept a fit of a `model`: that of wrong minima is larger.

    A sensor of known noise adds the number of its errors, which is twice the cost to expect of
    them. A sensor of unknown noise adds a hundredth of this number, which allows errors of about 1
    % of the signal.
    """
    return sum(
        (1.0 if reading.has_known_noise and not has_unit_noise(reading) else 0.01)
        * numbers_read(reading)
        for reading in model.records.readings
    )
