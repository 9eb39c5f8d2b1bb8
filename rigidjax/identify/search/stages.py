"""Find the least misfit from one start: Levenberg–Marquardt fits to longer and longer beginnings of
the records.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from rigidjax.identify.data.recording import Reading, count_numbers_read
from rigidjax.identify.model import terms
from rigidjax.identify.model.charts import chart_list, numbers_of_each_body
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.normal import NormalMatrix, normal_matrix_of_jacobians
from rigidjax.identify.model.predict import FixedSteps, HeldSteps
from rigidjax.identify.model.terms import Blocks, Noise
from rigidjax.identify.search.least_squares import BOLD, CAREFUL, LMState, Settings, minimise
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
# A search has reached the minimum if one run of STRIDE steps lowers the misfit by less than this
# fraction of the misfit.
SETTLED = 1e-7
# The result of a fit to the beginning of a record is used only if it raises the misfit of the whole
# record by less than this factor. A start is given up if its fit to the beginning does not
# converge, and its misfit there exceeds, by more than this factor, the share of the beginning in
# the misfit of another start.
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
# The motion is integrated for this many samples beyond the last sample with a weight, since a
# low-pass filter computes the slope at a sample from later samples, too.
_BEYOND = 2


class Evaluation(NamedTuple):
    """Hold the values that a search keeps from its last evaluation of the cost.

    **Fields:**

    - `blocks`: the errors of all readings and their derivatives, as `terms.errors_and_jacobians`
      returns them.
    - `pulls`: (R, m) for each of R recordings the gradient of the cost of its readings with respect
      to its m free numbers.
    """

    blocks: Blocks
    pulls: Float[Array, "records m"]


class Attempt(eqx.Module):
    """Hold the result of the search from one start.

    **Fields:**

    - `x`: (n,) the free numbers at the end of the search.
    - `cost`: half the sum of the squared residuals at x.
    - `converged`: whether the search converged.
    - `blocks`: the errors and their derivatives at x (`terms.errors_and_jacobians`), or `None` if
      they were not kept.
    """

    x: Float[Array, " n"]
    cost: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=np.inf)
    converged: Bool[Array, ""] = eqx.field(converter=jnp.asarray, default=False)
    blocks: Any = None


class Task(NamedTuple):
    """Hold what a search has to fit, and how precisely.

    **Fields:**

    - `model`: the model to be fitted.
    - `noise`: for each sensor the standard deviations (R, k) of its noise.
    - `tolerance`: the tolerance of the search, in standard deviations (`Settings.tolerance`).
    - `max_steps`: the largest number of steps of the search.
    """

    model: Model
    noise: Noise
    tolerance: float
    max_steps: int

    @property
    def steps_per_run(self) -> int:
        """Return how many steps the search for this task takes in one compiled run. An interrupt
        (Ctrl-C) is noticed after the run.
        """
        return min(STRIDE, self.max_steps)


@eqx.filter_jit
def least_squares_from(
    model: Model,
    x: Float[Array, " n"],
    noise: Noise,
    weights: Float[Array, "records times"],
    settings: Settings,
) -> LMState:
    """Return the last state of a least-squares search over the free numbers of a model.

    The normal matrix is the sum of the matrices of the single recordings.

    **Arguments:**

    - `model`: the readings and the free numbers.
    - `x`: (n,) the free numbers at which the search starts.
    - `noise`: the noise (R, k) of each sensor.
    - `weights`: (R, T) the weights of the readings, zero for readings that are not fitted.
    - `settings`: the settings of the search.
    """
    number, kind, places = model.size, x.dtype, model.index.places
    model = _model_until_last_weight(model, weights)
    prior = terms.prior_weights(model)
    alone = np.asarray(model.index.alone, int) if model.count >= MANY else None

    def evaluate(x: Array) -> tuple[Evaluation, Array, NormalMatrix, Array]:
        # Without a barrier XLA on CPU computes the derivatives again inside each residual, and the
        # program takes a fifth longer to compile.
        errors, slopes = barrier(terms.errors_and_jacobians(model, x))
        residuals, rows = terms.residuals_and_jacobians(
            lambda e: terms.reading_residuals(model, e, noise, weights), errors, slopes
        )
        total, pulls = jnp.zeros((), kind), jnp.zeros(places.shape, kind)
        for e, row in zip(residuals, rows, strict=True):
            total = total + jnp.sum(e**2)
            # On a CPU a product of matrices is several times as fast as an `einsum`, as in
            # `normal_matrix_of_jacobians`.
            flat = row.reshape(model.count, -1, places.shape[1])
            pulls = pulls + (e.reshape(model.count, 1, -1) @ flat)[:, 0]
        slope = jnp.zeros(number + 1, kind).at[places].add(pulls)
        normal = normal_matrix_of_jacobians(rows, places, number, alone).add_diagonal(prior**2)
        total, slope = total + jnp.sum((prior * x) ** 2), slope[:-1] + prior**2 * x
        row, e = terms.jacobian_and_value(
            lambda x: terms.body_prior_and_pull_residuals(model, x), x
        )
        if e.size:
            total, slope = total + jnp.sum(e**2), slope + e @ row
            normal = normal.add_residual_rows(row)
        normal = normal.add_residual_rows(_rows_for_chart_curvature(model, x, slope))
        return Evaluation((errors, slopes), pulls), 0.5 * total, normal, slope

    zeros = _zeros_of_evaluation(model, kind)
    zero_normal = normal_matrix_of_jacobians(
        (jnp.zeros((places.shape[0], 0, 0, places.shape[1]), kind),), places, number, alone
    )
    windows = model.clusters is not None
    by_noise = partial(_expected_cost_drop_from_noise, model) if windows else None
    order_one = order_one_indicator(model, kind)
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


def _expected_cost_drop_from_noise(
    model: Model, evaluation: Evaluation, normal: NormalMatrix
) -> Float[Array, ""]:
    """Return the mean amount by which a fit lowers the cost because it follows the noise of the
    readings: `½ tr(K G⁻¹)`.

    The cost is half the sum of the squared residuals of all windows, which are short parts of a
    record of measured states. The amount is the cost at the true numbers minus the least cost. G is
    the normal matrix of the numbers that all windows share; the initial states of the windows were
    eliminated from it. K is the sum of g gᵀ over stretches (groups of neighbouring windows), where
    g is the gradient of the cost of one stretch. Errors may be correlated within a stretch
    (Takeuchi 1976; Burnham and Anderson 2002, doi:10.1007/b97636, section 7.2). The gradient with
    respect to the initial states is left out: near the least cost each initial state is at its own
    optimum.

    - `model`: the model, whose recordings are the windows.
    - `evaluation`: the errors, and the gradient of the cost of each window.
    - `normal`: the normal matrix of all free numbers.
    """
    assert model.clusters is not None
    # The rows of this array are the gradients of the stretches. It has as many rows as there are
    # windows, although there are fewer stretches: their number is not known when this function is
    # compiled. The other rows stay zero.
    slopes = jnp.zeros((model.count, model.size), normal.core.dtype)
    slopes = slopes.at[model.clusters[:, None], model.index.places].add(
        evaluation.pulls, mode="drop"
    )
    starts = jnp.asarray(model.index.start).reshape(-1)
    slopes = slopes.at[:, starts].set(0.0)
    diagonal = normal.diagonal
    root = jnp.sqrt(jnp.maximum(diagonal, 1e-12 * jnp.max(diagonal)))
    definite = normal.scale_rows_and_columns(1.0 / root).add_diagonal(jnp.full_like(root, 1e-12))
    scaled = slopes / root[None, :]
    return 0.5 * jnp.sum(scaled * definite.solve(scaled.T).T)


def order_one_indicator(model: Model, dtype: DTypeLike) -> Float[Array, " n"]:
    """Return an array (n,) with one for each free number of a `model` that describes a body or an
    initial state, and zero for each number of a `Free` (other number that a fit may move).

    The numbers of bodies and initial states are of order one. The user chooses the unit of a
    `Free`, so that its numbers may have any size. `dtype` is the dtype of the result.
    """
    ones = jnp.zeros(model.size, dtype).at[: model.index.bodies].set(1.0)
    return ones.at[model.index.start].set(1.0)


def _rows_for_chart_curvature(
    model: Model, x: Array, slope: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """Return rows B (m, n), by which a fit allows for the curvature of the charts of the bodies:
    BᵀB is added to the normal matrix of the n free numbers of a `model`.

    A chart is a map from free numbers to a possible body, and this map is not linear. Its curvature
    matters if a body may be flat. Each chart gives some of the m rows
    (`AbstractBodyChart.curvature_rows`).

    - `x`: (n,) the free numbers.
    - `slope`: (n,) the gradient of the cost at x.
    """
    count = model.index.bodies
    parts = (
        chart_list(model.chart),
        *(numbers_of_each_body(model.chart, y[:count]) for y in (x, slope)),
    )
    rows = block_diag(*(chart.curvature_rows(*mine) for chart, *mine in zip(*parts, strict=True)))
    return jnp.pad(rows, ((0, 0), (0, slope.size - rows.shape[1])))


def _model_until_last_weight(model: Model, weights: Float[Array, "records times"]) -> Model:
    """Return the `model` with an integrator that computes no states long after the last reading
    with a weight above zero.

    The states are computed up to `_BEYOND` samples after the time of this reading, if the record
    has so many, since a low-pass filter uses later samples, too. A model whose integrator is not a
    `FixedSteps` or `HeldSteps` is returned unchanged. `weights` (R, T) holds the weight of each
    reading in the fit of R recordings with T times; zero for a reading that is not fitted.
    """
    steps = model.integrator
    if not isinstance(steps, FixedSteps | HeldSteps):
        return model
    counts = jnp.any(weights > 0, axis=0)
    place = jnp.arange(counts.size, dtype=jnp.int32)
    last = jnp.minimum(jnp.max(jnp.where(counts, place, 0)) + _BEYOND, counts.size - 1)
    shorter = eqx.tree_at(lambda s: s.last, steps, last, is_leaf=lambda node: node is None)
    return eqx.tree_at(lambda m: m.integrator, model, shorter)


def _zeros_of_evaluation(model: Model, dtype: DTypeLike) -> Evaluation:
    """Return an `Evaluation` that holds zeros in place of the errors of a `model`, their
    derivatives, and the gradients of the cost; a compiled search needs it for the shapes of its
    first state.

    `dtype` is the dtype of the zeros. The shapes are computed from the shapes in the model, since
    tracing the function that computes the errors (`terms.errors_and_jacobians`) would take seconds.
    """
    count, times = model.records.t.shape
    columns = model.index.places.shape[1]
    shapes = [(count, times, sensor.components) for sensor in model.records.sensors]
    errors = tuple(jnp.zeros(shape, dtype) for shape in shapes)
    slopes = tuple(jnp.zeros((*shape, columns), dtype) for shape in shapes)
    return Evaluation((errors, slopes), jnp.zeros(model.index.places.shape, dtype))


def weights_of_whole_record(model: Model) -> Float[Array, "records times"]:
    """Return the weights (R, T) of the readings for a fit of a `model` to the whole of each of its
    R recordings: ones.
    """
    # NumPy is used since, outside of a trace, each operation of JAX takes as long as a run of 100
    # steps.
    return jnp.asarray(np.ones(model.records.t.shape, model.records.t.dtype))


def weights_of_beginning(model: Model, part: float) -> Float[Array, "records times"]:
    """Return the weights (R, T) of the readings for a fit of a `model` to the beginning of each of
    its R recordings.

    The weight is one in the first fraction `part` of the duration of the recording, then zero.
    """
    t = np.asarray(model.records.t)
    since, length = t - t[:, :1], t[:, -1:] - t[:, :1]
    return jnp.asarray((since <= part * length).astype(t.dtype))


def _attempt_at_best_point(state: LMState) -> Attempt:
    """Return the best point of a search as an `Attempt` (free numbers, cost, convergence).

    A search keeps the errors and derivatives of its last evaluation only. The `Attempt` has them if
    the last evaluation was at the best point. `state` is the last state of the search.
    """
    blocks = state.evaluation.blocks if bool(state.evaluated_at_best) else None
    return Attempt(state.point, state.cost, state.converged, blocks)


def _take_marquardt_steps(
    x: Float[Array, " n"],
    task: Task,
    weights: Float[Array, "records times"],
    damping: float,
    aim: float = 0.0,
    sufficient_cost: float = 0.0,
    steps: int | None = None,
    noise_gain_fraction: float | None = None,
) -> LMState:
    """Return the last state of a search after a few steps of Levenberg and Marquardt from the free
    numbers x, in one compiled run.

    **Arguments:**

    - `x`: (n,) the free numbers before the first step.
    - `task`: the model, its noise, and the tolerance.
    - `weights`: (R, T) the weights of the readings at T times of R recordings.
    - `damping`: the damping of the first step.
    - `aim`: a cost that another search reached; this search ends if it is not likely to reach this
      cost. Zero for none.
    - `sufficient_cost`: the search ends at a cost of this value or less. Zero for none.
    - `steps`: the largest number of steps, `task.steps_per_run` unless given.
    - `noise_gain_fraction`: for a model of windows (short parts of a record of measured states),
      the search ends after a step whose gain (fall of the cost) is about the predicted gain, but
      less than this fraction of the gain of a fit from noise alone. Without the argument the
      fraction is chosen so that the search ends at a distance of about `TOLERANCES` tolerances from
      the minimum.
    """
    steps, count = (
        task.steps_per_run if steps is None else steps,
        count_of_errors_if_unit_noise(task.model),
    )
    default_fraction = (TOLERANCES * task.tolerance) ** 2
    level = default_fraction if noise_gain_fraction is None else noise_gain_fraction
    settings = Settings(task.tolerance, damping, steps, aim, sufficient_cost, count, level)
    return least_squares_from(task.model, x, task.noise, weights, settings)


def _evaluate_at(model: Model, x: Float[Array, " n"], noise: Noise) -> LMState:
    """Return the state of a search that evaluates the cost (half the sum of squared residuals) of
    all readings at the free numbers x (n,) of a `model`, and takes no step.

    `noise` holds for each sensor the standard deviations (R, k) of its noise, for R recordings and
    k components. The evaluation uses the compiled program of the search, so that no second program
    is compiled.
    """
    return least_squares_from(
        model, x, noise, weights_of_whole_record(model), Settings(0.0, 1.0, 0)
    )


def errors_and_slopes(model: Model, x: Float[Array, " n"]) -> Blocks:
    """Return two things, as `terms.errors_and_jacobians` does: the errors of all readings at the
    free numbers x (n,) of a `model`; and the derivatives of these errors with respect to the free
    numbers.

    The compiled program of the search computes the errors and derivatives, so that no second
    program is compiled.
    """
    kind, sensors = model.records.t.dtype, model.records.sensors
    ones = (np.ones((model.count, sensor.components), kind) for sensor in sensors)
    return _evaluate_at(model, x, tuple(map(jnp.asarray, ones))).evaluation.blocks


def cost_of(model: Model, x: Float[Array, " n"], noise: Noise) -> float:
    """Return the misfit of a `model` at the free numbers x (n,), half the sum of squared residuals
    over the whole of its records.

    `noise` holds for each sensor the standard deviations (R, k) of its noise.
    """
    return float(_evaluate_at(model, x, noise).cost)


def search_whole_records(
    begin: Attempt,
    task: Task,
    *,
    damping: float = BOLD,
    aim: float = 0.0,
    watch: Callable[[Attempt], None] = lambda attempt: None,
) -> Attempt:
    """Return the result of a search over the whole of the records, in runs of `STRIDE` steps.

    The search ends when a run hardly changes the misfit. Large damping alone makes steps short,
    which can look like convergence. Each run after the first run therefore begins with little
    damping.

    **Arguments:**

    - `begin`: the attempt at the first point.
    - `task`: the model, its noise, the tolerance, and the largest number of steps.
    - `damping`: the damping of the first run.
    - `aim`: the cost that the search from another start reached, or zero for none. This search
      ends early if it is not likely to reach this cost.
    - `watch`: a function that is called with the attempt after each run.
    """
    attempt, weights = begin, weights_of_whole_record(task.model)
    for first in range(0, task.max_steps, STRIDE):
        before = float(attempt.cost)
        end = _take_marquardt_steps(attempt.x, task, weights, BOLD if first else damping, aim)
        if not np.isfinite(float(end.cost)):
            # The misfit has become infinite or NaN. The search returns to the point before this
            # run.
            attempt = Attempt(attempt.x, cost_of(task.model, attempt.x, task.noise))
            watch(attempt)
            break
        attempt = _attempt_at_best_point(end)
        # At the minimum every step may be refused because of round-off. The search therefore also
        # ends if the misfit does not fall any more. This test needs a whole run: with a small
        # `max_steps`, one or two steps may all be refused only because they are too long.
        stands = before - float(attempt.cost) < SETTLED * (1.0 + abs(before))
        stands = stands and task.steps_per_run == STRIDE
        settled = bool(attempt.converged) or stands
        # The search is hopeless if the misfit would still be above `aim`, the cost that the search
        # from another start reached, after another run that lowers the misfit by the same factor as
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
    """Return the result of the search from one start, in fits to longer and longer beginnings of
    each record.

    The whole record is fitted first. If this fit does not explain the record, the first quarter of
    the record is fitted, then its first half, and then the whole record (`HORIZONS`).

    **Arguments:**

    - `x`: (n,) the free numbers at the start.
    - `task`: the model, its noise, the tolerance, and the largest number of steps.
    - `aim`: the cost that the search from another start reached, or zero for none. This search
      ends early if it is not likely to reach this cost.
    - `watch`: a function that is called with each `Attempt` (result so far) of a fit to the whole
      of the records.
    """
    model, noise, *_ = task
    if model.clusters is not None:
        return _fit_windows(x, task, aim, watch)
    end = _take_marquardt_steps(x, task, weights_of_whole_record(model), CAREFUL, aim)
    at_once = _attempt_at_best_point(end)
    if bool(end.converged) and float(end.cost) <= sufficient_misfit(model):
        watch(at_once)
        return at_once
    level = float(end.first)
    for part in HORIZONS[:-1]:
        # This fit to the beginning of the record need not converge, since its result is only the
        # start of the next fit.
        weights = weights_of_beginning(model, part)
        end = _take_marquardt_steps(x, task, weights, CAREFUL, aim * part, aim * part)
        # Free numbers that explain the beginning of the record may be far off later in the record,
        # for instance if the drag has the wrong sign. They are used only if the misfit of the whole
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
    attempt = search_whole_records(Attempt(x), task, damping=CAREFUL, aim=aim, watch=watch)
    if not float(at_once.cost) < (1.0 - SETTLED) * float(attempt.cost):
        return attempt
    # The fits to the beginning of the record may have led away from the minimum of the whole
    # record's misfit. The first fit to the whole record, which has a lower misfit, is then the
    # result, after further steps if it has not converged.
    return (
        at_once
        if bool(at_once.converged)
        else search_whole_records(at_once, task, aim=aim, watch=watch)
    )


def _fit_windows(
    x: Float[Array, " n"], task: Task, aim: float, watch: Callable[[Attempt], None]
) -> Attempt:
    """Return the result of the search from one start over windows (short parts of a record of
    measured states), in fits to longer and longer beginnings of each window.

    The first searches use the first ninth, then the first third of each window, if this part has
    enough steps (`SHORTEST`), since a prediction over a long time with poor numbers diverges. Then
    the whole windows are fitted. If the cost at the end is higher than the cost at the starting
    point x, the whole windows are fitted once more, directly from x.

    - `x`: (n,) the free numbers at the start.
    - `task`: the model, its noise, the tolerance, and the largest number of steps.
    - `aim`: the cost that the search from another start reached, or zero for none. This search
      ends early if it is not likely to reach this cost.
    - `watch`: a function that is called with each `Attempt` (result so far) of a fit to the whole
      windows.
    """
    model, begin = task.model, x
    length = model.records.t.shape[1] - 1
    for part in PARTS:
        steps = length // part
        if steps >= SHORTEST:
            weights = weights_of_beginning(model, (steps + 0.5) / length)
            end = _take_marquardt_steps(
                begin, task, weights, BOLD, steps=FEW, noise_gain_fraction=ROUGH
            )
            begin = end.point if np.isfinite(float(end.cost)) else begin
    attempt = search_whole_records(Attempt(begin), task, aim=aim, watch=watch)
    if begin is not x and not float(attempt.cost) <= cost_of(model, x, task.noise):
        attempt = search_whole_records(Attempt(x), task, aim=aim, watch=watch)
    return attempt


def has_unit_noise(reading: Reading) -> bool:
    """Return whether the noise of the sensor of a `reading` is only a unit for the errors of the
    sensor, because the size of these errors is not known.
    """
    return getattr(reading.sensor, "nominal", False)


def count_of_errors_if_unit_noise(model: Model) -> int:
    """Return the number of errors of a `model` (readings times components) if every sensor has unit
    noise; else 0.

    The noise of a sensor is unit noise if it is only a unit for the errors of the sensor, because
    the size of these errors is not known (`has_unit_noise`).
    """
    readings = model.records.readings
    return sum(map(count_numbers_read, readings)) if all(map(has_unit_noise, readings)) else 0


def sufficient_misfit(model: Model) -> float:
    """Return a misfit of a `model` that is low enough to accept a fit: wrong minima have a larger
    misfit.

    It is a sum over the sensors. A sensor of known noise adds the number of its errors, which is
    twice the misfit to expect of them. A sensor of unknown noise adds a hundredth of the number of
    its errors, which allows errors of about 1 % of the signal.
    """
    return sum(
        (1.0 if reading.has_known_noise and not has_unit_noise(reading) else 0.01)
        * count_numbers_read(reading)
        for reading in model.records.readings
    )
