"""Find the least misfit from one start: Levenberg–Marquardt over growing parts of records."""

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

from rigidjax.identify.data.recording import Reading, count_of
from rigidjax.identify.model import terms
from rigidjax.identify.model.charts import chart_list, numbers_of
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.normal import NormalMatrix, normal_of
from rigidjax.identify.model.predict import FixedSteps, HeldSteps
from rigidjax.identify.model.terms import Blocks, Noise
from rigidjax.identify.search.least_squares import BOLD, CAREFUL, LMState, Settings, minimise

# These parts of a record are fitted one after the other. A long record has many wrong minima, in
# which the phase slips by whole turns; a short record has none.
HORIZONS = (0.25, 0.5, 1.0)
# If there are at least this many recordings, the normal equations eliminate the numbers that belong
# to one recording alone.
MANY = 16
# One run of the compiled search takes this many steps. An interrupt is noticed between two runs.
STRIDE = 25
# A search has reached the minimum if a stride lowers the misfit by less than this share of it.
SETTLED = 1e-7
# A fit to a part of the record may raise the misfit of the whole record by at most this factor.
WILD = 100.0
# A search over windows ends about TOLERANCES tolerances from the least misfit (0.05 standard
# deviations by default). It ends when a step gains less than the square of this distance, counted
# as a part of the gain of a fit from noise alone. A rough search ends at the part ROUGH.
TOLERANCES, ROUGH = 500.0, 1.0
# The first searches over windows use a ninth and a third of each window, if such a part has at
# least SHORTEST steps of time; each of these searches takes at most FEW steps.
PARTS, SHORTEST, FEW = (9, 3), 5, 10
# The motion is followed for this many samples after the last sample with a weight, since a low-pass
# filter takes its slopes from later samples.
_BEYOND = 2


class Evaluation(NamedTuple):
    """Hold the values that a search keeps of its last evaluation.

    **Fields:** `blocks` the errors of all readings and their derivatives
    (`terms.errors_and_jacobians`); `pulls` (R, m) the part of each of R recordings in the gradient,
    by the m numbers of the recording.
    """

    blocks: Blocks
    pulls: Float[Array, "records m"]


class Attempt(eqx.Module):
    """Hold the end of the search from one start.

    **Fields:**

    - `x`: (n,) the free numbers.
    - `cost`: half the sum of squares at x.
    - `converged`: whether the search converged.
    - `blocks`: the errors and their derivatives at x (`terms.errors_and_jacobians`), `None` if not
      known.
    """

    x: Float[Array, " n"]
    cost: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=np.inf)
    converged: Bool[Array, ""] = eqx.field(converter=jnp.asarray, default=False)
    blocks: Any = None


class Task(NamedTuple):
    """Hold what a search has to fit, and how precisely.

    **Fields:** `model` to be fitted; `noise` of its sensors; `tolerance`, in standard deviations;
    `max_steps` of the search.
    """

    model: Model
    noise: Noise
    tolerance: float
    max_steps: int

    @property
    def stride(self) -> int:
        """Return the number of steps of the search before it next notices an interrupt (Ctrl-C)."""
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

    The normal equations are added up recording by recording.

    **Arguments:**

    - `model`: the readings and the free numbers.
    - `x`: (n,) the start.
    - `noise`: the noise of the sensors.
    - `weights`: (R, T) the weights of the readings, zero for readings that are not fitted.
    - `settings`: the settings of the search.
    """
    number, kind, places = model.size, x.dtype, model.index.places
    model = _until_last_weight(model, weights)
    prior = terms.prior_weights(model)
    alone = np.asarray(model.index.alone, int) if model.count >= MANY else None

    def evaluate(x: Array) -> tuple[Evaluation, Array, NormalMatrix, Array]:
        errors, slopes = terms.errors_and_jacobians(model, x)
        residuals, rows = terms.residuals_and_jacobians(
            lambda e: terms.reading_residuals(model, e, noise, weights), errors, slopes
        )
        total, pulls = jnp.zeros((), kind), jnp.zeros(places.shape, kind)
        for e, row in zip(residuals, rows, strict=True):
            total = total + jnp.sum(e**2)
            # As in `normal_of`, a product of matrices is several times as fast as an `einsum`.
            flat = row.reshape(model.count, -1, places.shape[1])
            pulls = pulls + (e.reshape(model.count, 1, -1) @ flat)[:, 0]
        slope = jnp.zeros(number + 1, kind).at[places].add(pulls)
        normal = normal_of(rows, places, number, alone).add_diagonal(prior**2)
        total, slope = total + jnp.sum((prior * x) ** 2), slope[:-1] + prior**2 * x
        row, e = terms.with_jacobian(lambda x: terms.extra_residuals(model, x), x)
        if e.size:
            total, slope = total + jnp.sum(e**2), slope + e @ row
            normal = normal.with_rows(row)
        normal = normal.with_rows(_curvature_rows(model, x, slope))
        return Evaluation((errors, slopes), pulls), 0.5 * total, normal, slope

    zeros = _zeros_of_evaluation(model, kind)
    zero_normal = normal_of(
        (jnp.zeros((places.shape[0], 0, 0, places.shape[1]), kind),), places, number, alone
    )
    windows = model.clusters is not None
    by_noise = partial(_gain_of_noise, model) if windows else None
    order_one = is_order_one(model, kind)
    end = minimise(evaluate, x, order_one, settings, zeros, zero_normal, by_noise)
    # If the cost is finite at no point, not even at the start, the start stays the best point.
    lost = ~jnp.isfinite(end.cost)
    return dataclasses.replace(
        end,
        point=jnp.where(lost, x, end.point),
        cost=jnp.where(lost, jnp.inf, end.cost),
        converged=end.converged & ~lost,
    )


def _gain_of_noise(model: Model, evaluation: Evaluation, normal: NormalMatrix) -> Float[Array, ""]:
    """Return `½ tr(K G⁻¹)`, the mean gain in the cost of windows by a fit to noise alone.

    It is the mean excess of the cost at the true numbers over the least cost. G is the normal
    matrix of the shared numbers, from which the initial states of the windows are eliminated. K is
    the sum of g gᵀ over stretches of windows, with g the gradient of the cost of a stretch, within
    which errors may be alike: Takeuchi 1976; Burnham and Anderson 2002, doi:10.1007/b97636, section
    7.2. The gradient by the initial states is left out: near the least cost each initial state is
    at its own optimum.
    """
    assert model.clusters is not None
    # There is a row for each window, although there are fewer stretches: the number of stretches is
    # not known when this function is compiled.
    slopes = jnp.zeros((model.count, model.size), normal.core.dtype)
    slopes = slopes.at[model.clusters[:, None], model.index.places].add(
        evaluation.pulls, mode="drop"
    )
    starts = jnp.asarray(model.index.start).reshape(-1)
    slopes = slopes.at[:, starts].set(0.0)
    diagonal = normal.diagonal
    root = jnp.sqrt(jnp.maximum(diagonal, 1e-12 * jnp.max(diagonal)))
    definite = normal.in_units(1.0 / root).add_diagonal(jnp.full_like(root, 1e-12))
    scaled = slopes / root[None, :]
    return 0.5 * jnp.sum(scaled * definite.solve(scaled.T).T)


def is_order_one(model: Model, kind: DTypeLike) -> Float[Array, " n"]:
    """Return one for each free number that is of order one, and zero for each number of a `Free`.

    The user chooses the unit of a `Free`, so that its numbers may have any size. **Arguments:**
    `kind` the type of the result.
    """
    ones = jnp.zeros(model.size, kind).at[: model.index.bodies].set(1.0)
    return ones.at[model.index.start].set(1.0)


def _curvature_rows(model: Model, x: Array, slope: Float[Array, " n"]) -> Array:
    """Return the rows (m, n) that the curvature of the bodies' charts adds to the Jacobian at x.

    The `slope` (n,) is the gradient of the cost at x; see `AbstractBodyChart.bend`.
    """
    count = model.index.bodies
    parts = (chart_list(model.chart), *(numbers_of(model.chart, y[:count]) for y in (x, slope)))
    rows = block_diag(*(chart.bend(*mine) for chart, *mine in zip(*parts, strict=True)))
    return jnp.pad(rows, ((0, 0), (0, slope.size - rows.shape[1])))


def _until_last_weight(model: Model, weights: Float[Array, "records times"]) -> Model:
    """Return the model with its motion followed only to the last time that has a weight.

    The motion goes on for `_BEYOND` more samples, if the record has them. An adaptive integration
    is not changed.
    """
    steps = model.integrator
    if not isinstance(steps, FixedSteps | HeldSteps):
        return model
    counts = jnp.any(weights > 0, axis=0)
    place = jnp.arange(counts.size, dtype=jnp.int32)
    last = jnp.minimum(jnp.max(jnp.where(counts, place, 0)) + _BEYOND, counts.size - 1)
    shorter = eqx.tree_at(lambda s: s.last, steps, last, is_leaf=lambda node: node is None)
    return eqx.tree_at(lambda m: m.integrator, model, shorter)


def _zeros_of_evaluation(model: Model, kind: DTypeLike) -> Evaluation:
    """Return an `Evaluation` of zeros, of the type `kind`.

    Its shapes are computed from the model alone, because to trace `terms.errors_and_jacobians`
    takes seconds.
    """
    count, times = model.records.t.shape
    columns = model.index.places.shape[1]
    shapes = [(count, times, sensor.components) for sensor in model.records.sensors]
    errors = tuple(jnp.zeros(shape, kind) for shape in shapes)
    slopes = tuple(jnp.zeros((*shape, columns), kind) for shape in shapes)
    return Evaluation((errors, slopes), jnp.zeros(model.index.places.shape, kind))


def whole_record(model: Model) -> Float[Array, "records times"]:
    """Return the weights (R, T) for a fit to the whole of each record: ones."""
    # Use NumPy: outside of a trace each operation of JAX takes as long as a run of 100 steps.
    return jnp.asarray(np.ones(model.records.t.shape, model.records.t.dtype))


def weights_of_beginning(model: Model, part: float) -> Float[Array, "records times"]:
    """Return the weights (R, T) for a fit to the first `part` of each record: first ones, then
    zeros.
    """
    t = np.asarray(model.records.t)
    since, length = t - t[:, :1], t[:, -1:] - t[:, :1]
    return jnp.asarray((since <= part * length).astype(t.dtype))


def _attempt_of(state: LMState) -> Attempt:
    """Return the best point of a search as an attempt, with its errors if they were kept."""
    blocks = state.evaluation.blocks if bool(state.evaluated_at_best) else None
    return Attempt(state.point, state.cost, state.converged, blocks)


def _search_stride(
    x: Float[Array, " n"],
    task: Task,
    weights: Float[Array, "records times"],
    damping: float,
    aim: float = 0.0,
    margin: float = 0.0,
    steps: int | None = None,
    level: float | None = None,
) -> LMState:
    """Return the last state of a search after one stride from x.

    **Arguments:**

    - `x`: (n,) the start.
    - `task`: the model, its noise, and the tolerance.
    - `weights`: (R, T) the weights of the readings.
    - `damping`, `aim`, `level`: as for `Settings`; `margin` is `Settings.near`.
    - `steps`: the largest number of steps, `task.stride` unless given. Without a `level` the search
      ends about `TOLERANCES` tolerances from the least misfit.
    """
    steps, count = task.stride if steps is None else steps, nominal_count(task.model)
    level = (TOLERANCES * task.tolerance) ** 2 if level is None else level
    settings = Settings(task.tolerance, damping, steps, aim, margin, count, level)
    return least_squares_from(task.model, x, task.noise, weights, settings)


def _evaluate_at(model: Model, x: Float[Array, " n"], noise: Noise) -> LMState:
    """Return the state of a search that evaluates x and takes no step.

    It is computed by the compiled program of the search, so that nothing else is compiled.
    """
    return least_squares_from(model, x, noise, whole_record(model), Settings(0.0, 1.0, 0))


def errors_and_slopes(model: Model, x: Float[Array, " n"]) -> Blocks:
    """Return the errors of all readings at x and their derivatives.

    They are those of `terms.errors_and_jacobians`, computed by the compiled program of the search,
    so that nothing else is compiled.
    """
    kind, sensors = model.records.t.dtype, model.records.sensors
    ones = (np.ones((model.count, sensor.components), kind) for sensor in sensors)
    return _evaluate_at(model, x, tuple(map(jnp.asarray, ones))).evaluation.blocks


def cost_of(model: Model, x: Float[Array, " n"], noise: Noise) -> float:
    """Return the misfit of a model at x over the whole of its records, for this `noise`."""
    return float(_evaluate_at(model, x, noise).cost)


def polish(
    begin: Attempt,
    task: Task,
    *,
    damping: float = BOLD,
    aim: float = 0.0,
    watch: Callable[[Attempt], None] = lambda attempt: None,
) -> Attempt:
    """Return the end of a search over the whole of the records, which goes on stride by stride.

    It ends when a stride changes nothing. Large damping alone can look like convergence: each
    stride after the first one therefore begins with little damping.

    **Arguments:**

    - `begin`: the attempt at the first point.
    - `task`: the task of the search.
    - `damping`: the damping of the first stride.
    - `aim`: the cost that another start reached; a search that does not lead to it ends early.
    - `watch`: a function that is called with the attempt after each stride.
    """
    attempt, weights = begin, whole_record(task.model)
    for first in range(0, task.max_steps, STRIDE):
        before = float(attempt.cost)
        end = _search_stride(attempt.x, task, weights, BOLD if first else damping, aim)
        if not np.isfinite(float(end.cost)):
            # The misfit is not finite any more: go back to the point before this stride.
            attempt = Attempt(attempt.x, cost_of(task.model, attempt.x, task.noise))
            watch(attempt)
            break
        attempt = _attempt_of(end)
        # Round-off refuses every step at the minimum, so the search also ends if the misfit does
        # not fall any more. This test needs a whole stride: with a small `max_steps`, one or two
        # steps may all be refused only because they are too long.
        stands = before - float(attempt.cost) < SETTLED * (1.0 + abs(before))
        stands = stands and task.stride == STRIDE
        settled = bool(attempt.converged) or stands
        # The search is hopeless if the misfit would still be above the aim after another fall by
        # the factor of this stride.
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
    """Return the end of the search from one start, over growing parts of each record.

    The whole record is fitted first. If this fit does not explain the record, its beginning is
    fitted, then more of it, and then all of it (`HORIZONS`).

    **Arguments:**

    - `x`: (n,) the start.
    - `task`: the task of the search.
    - `aim`: the cost that another start reached; a search that does not lead to it ends early.
    - `watch`: a function that is called with each point reached over the whole of the records.
    """
    model, noise, *_ = task
    if model.clusters is not None:
        return _fit_windows(x, task, aim, watch)
    end = _search_stride(x, task, whole_record(model), CAREFUL, aim)
    at_once = _attempt_of(end)
    if bool(end.converged) and float(end.cost) <= sufficient_misfit(model):
        watch(at_once)
        return at_once
    level = float(end.first)
    for part in HORIZONS[:-1]:
        # A part of the record need not be fitted to convergence.
        weights = weights_of_beginning(model, part)
        end = _search_stride(x, task, weights, CAREFUL, aim * part, aim * part)
        # A point that explains only a part of the record may be far off later, for instance if its
        # drag has the wrong sign.
        after = cost_of(model, end.point, noise)
        if after < WILD * max(level, 1e-300):
            x, level = end.point, after
        if aim * part > 0 and not bool(end.converged) and float(end.cost) > WILD * aim * part:
            # Another start explains this part of the record, and this start does not: give it up.
            attempt = Attempt(x, level)
            watch(attempt)
            return attempt
    attempt = polish(Attempt(x), task, damping=CAREFUL, aim=aim, watch=watch)
    if not float(at_once.cost) < (1.0 - SETTLED) * float(attempt.cost):
        return attempt
    # The fit to the beginning may have led away from the least misfit of the whole record.
    return at_once if bool(at_once.converged) else polish(at_once, task, aim=aim, watch=watch)


def _fit_windows(
    x: Float[Array, " n"], task: Task, aim: float, watch: Callable[[Attempt], None]
) -> Attempt:
    """Return the end of the search from one start over windows; arguments as for `fit_in_stages`.

    The first searches are over a ninth and a third of each window, because a long run with poor
    numbers diverges.
    """
    model, begin = task.model, x
    length = model.records.t.shape[1] - 1
    for part in PARTS:
        steps = length // part
        if steps >= SHORTEST:
            weights = weights_of_beginning(model, (steps + 0.5) / length)
            end = _search_stride(begin, task, weights, BOLD, steps=FEW, level=ROUGH)
            begin = end.point if np.isfinite(float(end.cost)) else begin
    attempt = polish(Attempt(begin), task, aim=aim, watch=watch)
    if begin is not x and not float(attempt.cost) <= cost_of(model, x, task.noise):
        attempt = polish(Attempt(x), task, aim=aim, watch=watch)
    return attempt


def has_unit_noise(reading: Reading) -> bool:
    """Return whether the noise of a reading is only the unit of its errors, and not their size."""
    return getattr(reading.sensor, "nominal", False)


def nominal_count(model: Model) -> int:
    """Return the number of errors if the noise of every reading is only a unit, else 0."""
    readings = model.records.readings
    return sum(map(count_of, readings)) if all(map(has_unit_noise, readings)) else 0


def sufficient_misfit(model: Model) -> float:
    """Return a misfit that only the true motion reaches.

    For a sensor of known noise it is twice the mean of half χ²; for others it allows errors of
    about 1 % of the signal.
    """
    return sum(
        (1.0 if reading.known_noise and not has_unit_noise(reading) else 0.01) * count_of(reading)
        for reading in model.records.readings
    )
