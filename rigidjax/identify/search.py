"""The least misfit: Levenberg–Marquardt from several starts, over growing records."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.checkpoint import SearchState, Tried
from rigidjax.identify.levenberg_marquardt import (
    BOLD as BOLD,
    CAREFUL as CAREFUL,
    Search,
    Settings,
    descend,
)
from rigidjax.identify.parameters import Parameters
from rigidjax.identify.problem import Problem
from rigidjax.identify.recording import count_of
from rigidjax.identify.terms import Noise, residuals

# The beginning of the record is fitted first: a long record has many wrong minima (the phase slips
# by whole turns), a short one has not.
HORIZONS = (0.25, 0.5, 1.0)
# Steps between two checks of the clock, the keyboard and the checkpoint.
STRIDE = 25
# A stride that lowers the misfit by less than this share is at the minimum.
SETTLED = 1e-7
# A fit to a part of the record may raise the misfit of the whole by at most this factor.
WILD = 100.0


def least_squares(
    start: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    tolerance: float,
    max_steps: int,
    damping: float,
    aim: float = 0.0,
    near: float = 0.0,
) -> Tried:
    """At most `max_steps` steps from `start` (see `Settings`)."""
    settings = Settings(tolerance, damping, max_steps, aim, near=near)
    return _ended(*_descend(start, problem, noise, weights, settings))


def _ended(tried: Tried, end: Search) -> Tried:
    return dataclasses.replace(tried, found=end.found) if bool(end.here) else tried


@eqx.filter_jit
def _descend(
    start: Parameters, problem: Problem, noise: Noise, weights: Array, settings: Settings
) -> tuple[Tried, Search]:
    value, end = descend(start, problem, noise, weights, settings)
    # A wild step can end in NaN: the start is then the better point.
    lost = ~jnp.isfinite(end.cost)
    value = jax.tree.map(lambda a, b: jnp.where(lost, b, a), value, start)
    return Tried(value, jnp.where(lost, jnp.inf, end.cost), end.converged & ~lost), end


def evaluate(parameters: Parameters, problem: Problem) -> Any:
    """Errors and last states with their derivatives, by the program of the search."""
    kind = problem.records.t.dtype
    noise = tuple(
        jnp.asarray(np.ones((problem.count, reading.sensor.components), kind))
        for reading in problem.records.readings
    )
    return _at(parameters, problem, noise, whole(problem)).found


def _at(parameters: Parameters, problem: Problem, noise: Noise, weights: Array) -> Search:
    return _descend(parameters, problem, noise, weights, Settings(0.0, 1.0, 0))[1]


@eqx.filter_jit
def many(
    starts: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    settings: Settings,
) -> Tried:
    """`least_squares` from many starts at once (a leading axis on `starts`)."""
    return jax.vmap(lambda start: _descend(start, problem, noise, weights, settings)[0])(starts)


def cost_of(parameters: Parameters, problem: Problem, noise: Noise) -> float:
    """The misfit over the whole of the records."""
    return float(_at(parameters, problem, noise, whole(problem)).cost)


def misfit(parameters: Parameters, args: Any) -> Float[Array, ""]:
    """Half the sum of the squares of all residuals."""
    return half_sum(residuals(parameters, args))


def half_sum(tree: Any) -> Float[Array, ""]:
    """Half the sum of the squares of all leaves."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


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
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    tolerance: float,
    max_steps: int,
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
    for first in range(strides * STRIDE, max_steps, STRIDE):
        before = float(tried.cost)
        count = min(STRIDE, max_steps)
        strides += 1
        bold = BOLD if first or near else CAREFUL
        after = least_squares(
            tried.parameters, problem, noise, weights, tolerance, count, bold, aim
        )
        if not np.isfinite(float(after.cost)):
            # The residuals are no longer finite: go back to the point before these iterations.
            cost = jnp.asarray(cost_of(tried.parameters, problem, noise))
            tried = Tried(tried.parameters, cost, jnp.asarray(False))
            look(tried, strides, True)
            break
        tried = after
        # Round-off refuses every step at the minimum: the test is whether the point moved.
        stands = before - float(tried.cost) < SETTLED * (1.0 + abs(before))
        settled = bool(tried.converged) or stands
        # The same gain again would not reach the aim.
        hopeless = aim > 0 and not settled and float(tried.cost) ** 2 > aim * before
        over = settled or hopeless or first + STRIDE >= max_steps
        tried = dataclasses.replace(tried, converged=jnp.asarray(settled))
        look(tried, strides, over)
        if over:
            break
    return tried


def fresh(point: Parameters) -> Tried:
    """A start before its misfit is known."""
    return Tried(point, jnp.asarray(jnp.inf), jnp.asarray(False))


def again(best: Tried, problem: Problem, noise: Noise, tolerance: float, max_steps: int) -> Tried:
    """`settle` over the whole of the records from a point near the minimum."""
    near = fresh(best.parameters)
    return settle(near, problem, noise, whole(problem), tolerance, max_steps, near=True)


def climb(
    start: SearchState,
    problem: Problem,
    noise: Noise,
    tolerance: float,
    max_steps: int,
    *,
    look: Callable[[SearchState], None] = lambda position: None,
    aim: float = 0.0,
) -> Tried:
    """The search from one start: the whole record at once if that explains it, else the horizons in
    turn; it ends early if it does not lead to `aim`. `look` is called after each stride.
    """
    tried, start, level = _at_once(start, problem, noise, tolerance, max_steps, aim)
    for stage in range(start.stage, len(HORIZONS)):
        seen = horizon(problem, HORIZONS[stage])
        if stage < len(HORIZONS) - 1:
            # A part of the record need not be fitted to convergence.
            count, before = min(STRIDE, max_steps), tried.parameters
            part = aim * HORIZONS[stage]
            found = least_squares(
                before, problem, noise, seen, tolerance, count, CAREFUL, aim=part, near=part
            )
            after = found.parameters
            # A point that explains a part alone may be wrong beyond it, such as a negative drag.
            first = cost_of(before, problem, noise) if level is None else level
            level = cost_of(after, problem, noise)
            kept = level < WILD * max(first, 1e-300)
            tried, level = fresh(after if kept else before), level if kept else first
            if part > 0 and not bool(found.converged) and float(found.cost) > WILD * part:
                # It does not even explain this part, which another start explains.
                tried = Tried(tried.parameters, jnp.asarray(level), tried.converged)
                look(SearchState(len(HORIZONS), 0, tried))
                break
            look(SearchState(stage + 1, 0, tried))
            continue

        def at_last(now: Tried, strides: int, over: bool, stage: int = stage) -> None:
            look(SearchState(stage + over, strides, now))

        done = start.strides if stage == start.stage else 0
        tried = settle(
            tried, problem, noise, seen, tolerance, max_steps, at_last, strides=done, aim=aim
        )
    return tried


def _at_once(
    start: SearchState,
    problem: Problem,
    noise: Noise,
    tolerance: float,
    max_steps: int,
    aim: float,
) -> tuple[Tried, SearchState, float | None]:
    """The start fitted to the whole record, if that explains it; else the start and its misfit."""
    if start.stage or start.strides:
        return start.tried, start, None
    seen, count = whole(problem), min(STRIDE, max_steps)
    here = start.tried.parameters
    tried, end = _descend(here, problem, noise, seen, Settings(tolerance, CAREFUL, count, aim))
    if not bool(tried.converged) or float(tried.cost) > enough(problem):
        return start.tried, start, float(end.first)
    found = _ended(tried, end)
    return found, SearchState(len(HORIZONS) - 1, 1, found), None


def enough(problem: Problem) -> float:
    """A misfit that only the true motion reaches: twice the mean of χ², or a hundredth of the
    signal.
    """
    total = 0.0
    for reading in problem.records.readings:
        share = 0.01 if reading.sensor.noise is None else 1.0
        total += share * count_of(reading)
    return total


def climb_together(
    points: Parameters, problem: Problem, noise: Noise, tolerance: float, max_steps: int
) -> list[Tried]:
    """Many starts over the horizons in one `vmap` (a leading axis on `points`)."""
    tried, settings = None, Settings(tolerance, CAREFUL, max_steps)
    for part in HORIZONS:
        seen = horizon(problem, part)
        tried = many(points, problem, noise, seen, settings)
        points = tried.parameters
    assert tried is not None
    count = int(tried.cost.shape[0])
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tried) for i in range(count)]
