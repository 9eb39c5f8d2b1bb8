"""The least misfit: Levenberg–Marquardt from several starts, over growing records."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float

from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import count_of
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model import terms
from rigidjax.identify.model.charts import charts_of, numbers_of
from rigidjax.identify.model.free import Parameters, columns_alone, local, places
from rigidjax.identify.model.predict import FixedSteps
from rigidjax.identify.model.problem import Problem
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.search.least_squares import BOLD, CAREFUL, Search, Settings, search
from rigidjax.identify.search.normal import Normal, normal_of

# The beginning of the record is fitted first: a long record has many wrong minima (the phase slips
# by whole turns), a short one has not.
HORIZONS = (0.25, 0.5, 1.0)
# From so many recordings on, numbers of one recording alone go out of the normal equations.
MANY = 16
# Steps between two checks of the clock, the keyboard and the checkpoint.
STRIDE = 25
# A stride that lowers the misfit by less than this share is at the minimum.
SETTLED = 1e-7
# A fit to a part of the record may raise the misfit of the whole by at most this factor.
WILD = 100.0
# Samples after the last one with weight: a low-pass filter looks ahead.
_BEYOND = 2


class Tried(eqx.Module):
    """The end of one start; `cost` is ½ Σ of squares; `found` of `with_blocks` there, if known."""

    parameters: Parameters
    cost: Float[Array, "*starts"] = eqx.field(converter=jnp.asarray, default=np.inf)
    converged: Bool[Array, "*starts"] = eqx.field(converter=jnp.asarray, default=False)
    found: Any = None


class SearchState(NamedTuple):
    """The search from one start: the next horizon (their number at the end), strides, result."""

    stage: int
    strides: int
    tried: Tried


class Task(NamedTuple):
    """What is fitted, with which noise, how closely, and in how many steps at most."""

    problem: Problem
    noise: Noise
    tolerance: float
    max_steps: int

    @property
    def stride(self) -> int:
        """Steps before the next look at clock and keyboard."""
        return min(STRIDE, self.max_steps)


@eqx.filter_jit
def descend(
    start: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    settings: Settings,
) -> tuple[Tried, Search]:
    """`search` for the free numbers of a problem, on normal equations added up by recordings."""
    flat, restore = ravel_pytree(start)
    where, made = places(problem, start), made_of(start)
    number, kind = flat.size, flat.dtype
    problem = _as_far_as(problem, weights)
    held = ravel_pytree(terms.firm(start, problem))[0]
    alone = None
    if problem.count >= MANY and problem.rows is None:
        alone = columns_alone(problem, stacking.one(local(problem, start), 0))

    def evaluated(point: Array) -> tuple[Any, Array, Normal, Array]:
        here = restore(point)
        found = terms.with_blocks(here, problem)
        (errors, ends), (slopes, end_slopes) = found
        total, slope = jnp.zeros((), kind), jnp.zeros(number + 1, kind)
        read, blocks = terms.with_rows(
            lambda e: terms.seen(problem, e, noise, weights), errors, slopes
        )
        for e, rows in zip(read, blocks, strict=True):
            total = total + jnp.sum(e**2)
            slope = slope.at[where].add(jnp.einsum("rtki,rtk->ri", rows, e))
        normal = normal_of(blocks, where, number, alone).plus(held**2)
        total, slope = total + jnp.sum((held * point) ** 2), slope[:-1] + held**2 * point
        e, rows = linked_rows(problem, point, restore, ends, end_slopes)
        if e.size:
            total, slope = total + jnp.sum(e**2), slope + e @ rows
            normal = normal.wider(rows)
        return found, 0.5 * total, normal.wider(_bends(problem, here.body, slope)), slope

    nothing = _nothing(problem, start, where.shape[1], kind)
    empty = normal_of(
        (jnp.zeros((*where.shape[:1], 0, 0, where.shape[1]), kind),), where, number, alone
    )
    end = search(evaluated, flat, made, settings, nothing, empty)
    # A wild step can end in NaN: the start is then the better point.
    lost = ~jnp.isfinite(end.cost)
    value = restore(jnp.where(lost, flat, end.point))
    return Tried(value, jnp.where(lost, jnp.inf, end.cost), end.converged & ~lost), end


def _bends(problem: Problem, numbers: Array, slope: Float[Array, " n"]) -> Array:
    """The rows (m, n) of the Jacobian from the curvature of the charts of bodies."""
    parts = (charts_of(problem.body), *(numbers_of(problem.body, x) for x in (numbers, slope)))
    rows = block_diag(*(chart.bend(*mine) for chart, *mine in zip(*parts, strict=True)))
    return jnp.pad(rows, ((0, 0), (0, slope.size - rows.shape[1])))


def _as_far_as(problem: Problem, weights: Float[Array, "records times"]) -> Problem:
    """The problem, with its motion followed to the last time with weight."""
    steps = problem.integrator
    if not isinstance(steps, FixedSteps) or problem.rows is not None:
        return problem
    counts = jnp.any(weights > 0, axis=0)
    place = jnp.arange(counts.size, dtype=jnp.int32)
    last = jnp.minimum(jnp.max(jnp.where(counts, place, 0)) + _BEYOND, counts.size - 1)
    return eqx.tree_at(
        lambda p: p.integrator, problem, FixedSteps(steps.substeps, steps.solver, last)
    )


def _nothing(problem: Problem, start: Parameters, columns: int, kind: Any) -> Any:
    """Zeros of the shapes that `with_blocks` returns: to trace it once more takes seconds."""
    count, times = problem.records.t.shape
    errors = tuple(
        jnp.zeros((count, times, reading.sensor.components), kind)
        for reading in problem.records.readings
    )
    ends = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, kind),
        eqx.filter_eval_shape(jax.vmap(ReferenceStates.moved), problem.reference, start.own),
    )
    blocks = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, columns), kind), (errors, ends))
    return (errors, ends), blocks


def made_of(parameters: Parameters) -> Float[Array, " n"]:
    """One for numbers scaled to order one, zero for those of a `Free`: their unit is a user's."""
    ones, zeros = (jax.tree.map(of, parameters) for of in (jnp.ones_like, jnp.zeros_like))
    marked = eqx.tree_at(lambda p: (p.shared, p.own.each), ones, (zeros.shared, zeros.own.each))
    return ravel_pytree(marked)[0]


def linked_rows(
    problem: Problem, point: Array, restore: Any, ends: Any, end_slopes: Any
) -> tuple[Array, Array]:
    """The residuals `linked` as one vector, and its Jacobian (m, n)."""

    @jax.custom_jvp
    def last(vector: Array) -> Any:
        return ends

    @last.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        return ends, terms.along(problem, end_slopes, restore(tangents[0]))

    def value(vector: Array) -> Array:
        parts = [leaf.reshape(-1) for leaf in terms.linked(restore(vector), problem, last(vector))]
        return jnp.concatenate(parts) if parts else jnp.zeros(0, vector.dtype)

    rows, e = terms.with_jacobian(value, point)
    return e, rows


def least_squares(
    start: Parameters,
    task: Task,
    weights: Float[Array, "records times"],
    steps: int,
    damping: float,
    aim: float = 0.0,
    near: float = 0.0,
) -> Tried:
    """At most `steps` steps from `start` (see `Settings`)."""
    settings = Settings(task.tolerance, damping, steps, aim, near=near)
    return _ended(*descend(start, task.problem, task.noise, weights, settings))


def _ended(tried: Tried, end: Search) -> Tried:
    return dataclasses.replace(tried, found=end.found) if bool(end.here) else tried


def _at(parameters: Parameters, problem: Problem, noise: Noise) -> Search:
    return descend(parameters, problem, noise, whole(problem), Settings(0.0, 1.0, 0))[1]


def evaluate(parameters: Parameters, problem: Problem) -> Any:
    """Errors and last states with their derivatives, by the program of the search."""
    kind, readings = problem.records.t.dtype, problem.records.readings
    ones = (np.ones((problem.count, reading.sensor.components), kind) for reading in readings)
    return _at(parameters, problem, tuple(map(jnp.asarray, ones))).found


def cost_of(parameters: Parameters, problem: Problem, noise: Noise) -> float:
    """The misfit over the whole of the records."""
    return float(_at(parameters, problem, noise).cost)


def whole(problem: Problem) -> Float[Array, "records times"]:
    """Weights that show all of each record."""
    # By NumPy: outside of a trace each operation of JAX costs as much as a run of 100 steps.
    return jnp.asarray(np.ones(problem.records.t.shape, problem.records.t.dtype))


def horizon(problem: Problem, part: float) -> Float[Array, "records times"]:
    """Weights that show this part of each record, from its beginning."""
    t = np.asarray(problem.records.t)
    since, length = t - t[:, :1], t[:, -1:] - t[:, :1]
    return jnp.asarray((since <= part * length).astype(t.dtype))


def settle(
    tried: Tried,
    task: Task,
    weights: Float[Array, "records times"],
    look: Callable[[Tried, int, bool], None] = lambda tried, strides, over: None,
    *,
    near: bool = False,
    strides: int = 0,
    aim: float = 0.0,
) -> Tried:
    """Strides from the end of `tried` until one more changes nothing: large damping alone can look
    like convergence. `near` says that it is near the minimum; `strides` were made before; `look` is
    called after each stride, with their number and whether it was the last.
    """
    if strides and bool(tried.converged):
        look(tried, strides, True)
        return tried
    for first in range(strides * STRIDE, task.max_steps, STRIDE):
        before, strides = float(tried.cost), strides + 1
        bold = BOLD if first or near else CAREFUL
        after = least_squares(tried.parameters, task, weights, task.stride, bold, aim)
        if not np.isfinite(float(after.cost)):
            # The residuals are no longer finite: go back to the point before these iterations.
            tried = Tried(tried.parameters, cost_of(tried.parameters, task.problem, task.noise))
            look(tried, strides, True)
            break
        tried = after
        # Round-off refuses every step at the minimum: the test is whether the point moved.
        stands = before - float(tried.cost) < SETTLED * (1.0 + abs(before))
        settled = bool(tried.converged) or stands
        # The same gain again would not reach the aim.
        hopeless = aim > 0 and not settled and float(tried.cost) ** 2 > aim * before
        over = settled or hopeless or first + STRIDE >= task.max_steps
        tried = dataclasses.replace(tried, converged=settled)
        look(tried, strides, over)
        if over:
            break
    return tried


def again(best: Tried, task: Task) -> Tried:
    """`settle` over the whole of the records from a point near the minimum."""
    return settle(Tried(best.parameters), task, whole(task.problem), near=True)


def climb(
    start: SearchState,
    task: Task,
    *,
    look: Callable[[SearchState], None] = lambda position: None,
    aim: float = 0.0,
) -> Tried:
    """The search from one start: the whole record at once if that explains it, else the horizons in
    turn; it ends early if it does not lead to `aim`. `look` is called after each stride.
    """
    problem, noise, *_ = task
    tried, level = start.tried, None
    if not start.stage and not start.strides:
        settings = Settings(task.tolerance, CAREFUL, task.stride, aim)
        found, end = descend(tried.parameters, problem, noise, whole(problem), settings)
        if bool(found.converged) and float(found.cost) <= enough(problem):
            tried = _ended(found, end)
            start = SearchState(len(HORIZONS) - 1, 1, tried)
        else:
            level = float(end.first)
    for stage in range(start.stage, len(HORIZONS)):
        shown = horizon(problem, HORIZONS[stage])
        if stage < len(HORIZONS) - 1:
            # A part of the record need not be fitted to convergence.
            before, part = tried.parameters, aim * HORIZONS[stage]
            found = least_squares(before, task, shown, task.stride, CAREFUL, aim=part, near=part)
            after = found.parameters
            # A point that explains a part alone may be wrong beyond it, such as a negative drag.
            first = cost_of(before, problem, noise) if level is None else level
            level = cost_of(after, problem, noise)
            kept = level < WILD * max(first, 1e-300)
            tried, level = Tried(after if kept else before), level if kept else first
            if part > 0 and not bool(found.converged) and float(found.cost) > WILD * part:
                # It does not even explain this part, which another start explains.
                tried = Tried(tried.parameters, level)
                look(SearchState(len(HORIZONS), 0, tried))
                break
            look(SearchState(stage + 1, 0, tried))
            continue

        def at_last(now: Tried, strides: int, over: bool, stage: int = stage) -> None:
            look(SearchState(stage + over, strides, now))

        done = start.strides if stage == start.stage else 0
        tried = settle(tried, task, shown, at_last, strides=done, aim=aim)
    return tried


def enough(problem: Problem) -> float:
    """A misfit that only the true motion reaches: twice the mean of χ², or 1 % of the signal."""
    return sum(
        (1.0 if reading.known_noise else 0.01) * count_of(reading)
        for reading in problem.records.readings
    )


@eqx.filter_jit
def _many(starts: Parameters, *of: Any) -> Tried:
    """`descend` from many starts at once (a leading axis on `starts`)."""
    return jax.vmap(lambda start: descend(start, *of)[0])(starts)


def climb_together(points: Parameters, task: Task) -> list[Tried]:
    """Many starts over the horizons in one `vmap` (a leading axis on `points`)."""
    problem, noise, tolerance, max_steps = task
    tried, settings = Tried(points), Settings(tolerance, CAREFUL, max_steps)
    for part in HORIZONS:
        tried = _many(tried.parameters, problem, noise, horizon(problem, part), settings)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tried) for i in range(tried.cost.shape[0])]
