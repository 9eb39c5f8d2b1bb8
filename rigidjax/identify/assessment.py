"""The quality of a fit: covariance, status, and whether other starts explain the data as well."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rigidjax.identify import flat_limit, uncertainty
from rigidjax.identify.answers import FAILS, FOUND, NOT_ALONE, NOT_ENDED, Answer
from rigidjax.identify.checkpoint import Tried
from rigidjax.identify.full_scale import at_limit
from rigidjax.identify.goodness import goodness
from rigidjax.identify.parameters import Parameters
from rigidjax.identify.problem import Problem
from rigidjax.identify.quantities import charts, quantities as quantities_of, values_and_slopes
from rigidjax.identify.real_bodies import of_charts
from rigidjax.identify.residual import Noise
from rigidjax.identify.result import Fit, Start

# A search may end so near to the least misfit, in standard deviations.
AT_THE_END = 0.05


def _margin(problem: Problem, best_cost: float, longest: float) -> float:
    """The largest excess over the best misfit with which a start still explains the data.

    Ten units of log-likelihood: a point further above the best is e¹⁰ times less likely. The cost
    of the best point is half the number of readings if the noise is estimated there. Autocorrelated
    errors count as fewer.
    """
    guessed = any(sensor.noise is None for sensor in problem.records.sensors)
    unit = 2 * best_cost / problem.records.size if guessed else 1.0
    return 10.0 * unit * max(longest, 1.0)


def _start(tried: Tried, level: float) -> Start:
    """A start for the user; it fits if its misfit is not above `level`."""
    cost = float(tried.cost)
    return Start(tried.parameters, cost, bool(tried.converged), cost <= level)


def _elsewhere(
    linear: uncertainty.Linearised, other: Parameters, value: Parameters, margin: float
) -> bool:
    """Whether the readings distinguish two points; in a flat valley they do not."""
    away = ravel_pytree(other)[0] - ravel_pytree(value)[0]
    return float(np.sum((linear.rows @ np.asarray(away)) ** 2)) > 2 * margin


def _search(
    best_cost: float, done: bool, rivals: str, interrupted: Sequence[str], remarks: Sequence[str]
) -> Answer:
    """The end of the search in words; `rivals` are the starts that fit as well elsewhere."""
    if not np.isfinite(best_cost):
        return Answer(NOT_ENDED, ("no start gave a finite misfit",))
    if not done:
        why = interrupted or ("max_steps reached",)
        return Answer(NOT_ENDED, (*why, "this is the best point found"))
    if rivals:
        return Answer(NOT_ALONE, (rivals, *interrupted, *remarks))
    return Answer(FOUND, (*interrupted, *remarks))


def assess(
    problem: Problem,
    best: Tried,
    noise: Noise,
    tried: list[Tried],
    best_cost: float,
    interrupted: Sequence[str] = (),
) -> Fit:
    """The `Fit` of the best point of all starts, converged or not.

    `interrupted` gives the point of the search in words.
    """
    value = best.parameters
    near = flat_limit.beside(problem, value)
    linear = uncertainty.linearise(problem, value, noise, best.found, near)
    cut = at_limit(problem.records.readings)
    times = uncertainty.correlation_times(linear, cut)
    white = uncertainty.of_white(linear)
    spread = uncertainty.spread(linear, times, white)
    numbers, names = values_and_slopes(problem, value, near), [n for n, _ in charts(problem)]
    limits = flat_limit.limits(problem, numbers, uncertainty.step(linear, white), names)
    # Steps stay short in a long curved valley, although hardly anything is left to gain.
    held = [limit.slope for limit in limits if limit.free < 0]
    done = bool(best.converged) or uncertainty.distance(linear, white, held) < AT_THE_END
    free = ravel_pytree(value)[0].size
    seen = goodness(problem, linear, times, free)
    believable = seen.model.word != FAILS
    margin = _margin(problem, best_cost, times.longest)

    level = best_cost + margin if believable else -np.inf
    starts = [_start(item, level) for item in tried]
    rivals = [
        s
        for s in starts
        if s.fits and s.converged and s.cost > best_cost + 0.01 * margin
        if _elsewhere(linear, s.parameters, value, margin)
    ]
    rival = f"{len(rivals)} of {len(starts)} starts fit as well elsewhere" if rivals else ""
    lost = believable and not any(start.fits for start in starts)
    remarks = ("no single start came near the best point",) if lost else ()
    search = _search(best_cost, done, rival, interrupted, remarks)
    unreal = of_charts(charts(problem), flat_limit.bodies_of(problem, value))
    model = Answer(seen.model.word, (*unreal, *seen.model.reasons))
    model = model if np.isfinite(best_cost) else Answer(FAILS)
    return Fit(
        problem,
        value,
        jnp.asarray(spread.covariance),
        jnp.asarray(spread.seen),
        spread.kind,
        noise,
        tuple(starts),
        seen.chi2,
        seen.dof,
        times.longest,
        times.independent,
        jnp.asarray(spread.singular_values),
        jnp.asarray(spread.null_directions),
        quantities_of(problem, numbers, spread.seen, spread.null_directions, limits),
        search,
        model,
        seen.left,
        limits,
        near,
    )
