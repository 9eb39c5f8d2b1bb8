"""Least squares from several starts."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax.identify import padding, search
from rigidjax.identify.assessment import assess
from rigidjax.identify.checkpoint import (
    Checkpoint,
    bare,
    fingerprint,
    report_progress,
    require_folder,
)
from rigidjax.identify.initial_guess import starting_points
from rigidjax.identify.multiple_shooting import WIDTHS, joined, pieces as in_pieces
from rigidjax.identify.noise import estimate_noise
from rigidjax.identify.parameters import Parameters, by_slot, numbered
from rigidjax.identify.problem import Problem, fits
from rigidjax.identify.propagation import AbstractIntegrator, Adaptive
from rigidjax.identify.result import Fit
from rigidjax.identify.search import SearchState, Task, Tried
from rigidjax.identify.stochastic_gradient import Descent, descend
from rigidjax.identify.terms import Noise, all_errors
from rigidjax.identify.uncertainty import linearise, of_white

# Steps are fine enough if finer ones change no prediction by more of its noise.
_MATTERS = 0.05


def fit(
    problem: Problem,
    *,
    starts: int = 8,
    initial: Parameters | None = None,
    key: PRNGKeyArray | None = None,
    tolerance: float = 1e-4,
    max_steps: int = 200,
    together: int = 1,
    pieces: int = 1,
    descent: Descent | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Fit:
    """The body and the initial state that explain a recording best.

    **Arguments:**

    - `problem`: the readings and the free numbers.
    - `starts`: the number of starting points (regression first, then scattered ones). Each is
      fitted to a quarter, a half and then the whole of the record.
    - `initial`: a starting point of your own, tried first.
    - `key`: random key of the scattered starts; they are always the same unless it is given.
    - `tolerance`, `max_steps`: Levenberg–Marquardt stops at steps of `tolerance` standard
      deviations (of each parameter with all others fixed) with an equally small change of the
      misfit, or after `max_steps` steps.
    - `together`: the number of starts in one `vmap`.
    - `pieces`: if more than one, the record is first fitted in so many pieces with joined ends.
    - `descent`: a `Descent(optimiser, steps=…, batch=…)` of optax first improves each start on a
      few recordings at a time: for many recordings, when a step of least squares is expensive.
    - `checkpoint`: a file that keeps the state of the search after every 25 steps. A second call
      with the same problem and options continues from there, and ends at the same point to the
      last bit on the same machine and versions. `together` = 1 only.
    - `progress`: called with a line of text after each start, such as `print`.

    **Returns** a `Fit` of the best point reached, with two answers. `fit.search`: `found`, `not
    alone` (another motion fits as well), or `not ended`. `fit.model`: `explains the readings` (the
    errors are white and of the sensor's size), `leaves a part` (how large, and where), or `does not
    explain the readings`. `fit.causes` and `fit.advice` say what most likely makes the errors and
    whether the intervals can be trusted; `fit.status` is both answers in a line, `ok` if all is
    well. An interrupt (Ctrl-C) ends the search and keeps the best point so far; the status says so.

    **Raises:** `TypeError` unless `problem` is a `Problem`, `ValueError` for fewer than one start,
    a checkpoint that is damaged or of another problem, or one in a folder that does not exist.

    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> found.status, bool(jnp.allclose(found.body.tensor / found.body.tensor[0, 0],
    ...                                 jnp.diag(jnp.array([1.0, 2.0, 2.5])), atol=1e-6))
    ('ok', True)
    """
    _checks.instance(problem, Problem, "fit", wanted="a Problem")
    starts, together = _checks.whole(starts, "starts", 1), _checks.whole(together, "together", 1)
    pieces, max_steps = _checks.whole(pieces, "pieces", 1), _checks.whole(max_steps, "max_steps", 1)
    tolerance = _checks.positive(tolerance, "tolerance")
    key = None if key is None else _checks.key(key)
    if initial is not None:
        fits(problem, initial)
    if progress is not None:
        _checks.function(progress, "progress", "of a line of text, such as print")
    if checkpoint is not None:
        if together > 1:
            raise ValueError("fit: a checkpoint goes with together=1, one start after another")
        require_folder(checkpoint)
    wanted = "a Descent(optimiser, …) or None"
    _checks.instance(descent, (Descent, NoneType), "fit", wanted=wanted)
    given, problem = problem, padding.of_few_lengths(problem)
    task = Task(problem, _first_noise(problem), tolerance, max_steps)
    points = [] if initial is None else [initial]
    if pieces > 1:
        points.append(_from_pieces(given, pieces, tolerance, max_steps))
    if starts > len(points):
        points += starting_points(given, starts - len(points), key)
    points, cut, rough = points[:starts], [], []
    if isinstance(problem.integrator, Adaptive):
        # Another tolerance is no other program: the noise of long steps would slow down the search.
        finer = _finer(Tried(points[0], found=search.evaluate(points[0], problem)), task, rough)
        task = task if rough else task._replace(problem=_with(problem, finer))
    if descent is not None:
        points = _descended(points, task, descent, key, progress, cut)
    if together > 1:
        tried = _together(points, task, together, progress, cut)
    else:
        tried = _one_by_one(points, task, checkpoint, progress, cut)
    best = min(tried, key=_cost)
    lowest = float(best.cost)
    best, task = _with_noise(best, task)
    best, task = _with_widths(best, task)
    best = _evaluated(best, task.problem)
    rough.clear()
    while (finer := _finer(best, task, rough)) is not None:
        task = task._replace(problem=_with(task.problem, finer))
        best, task = _with_noise(search.again(best, task), task)
        best = _evaluated(best, task.problem)
    shown = given if task.problem is problem else _as_given(given, task.problem)
    return assess(task.problem, best, task.noise, tried, lowest, shown, cut, rough)


def _as_given(given: Problem, fitted: Problem) -> Problem:
    """The problem that was fitted, of the readings as they were given, with their jitter."""
    records = given.records
    for index, r in enumerate(fitted.records.readings):
        if r.late is not None:
            one, jitter = records.readings[index], cast(Any, r.sensor).jitter
            one = one.scattered(r.late[:, : one.mask.shape[1]], jitter.deviation)
            records = eqx.tree_at(lambda a, i=index: a.readings[i], records, one)
    return eqx.tree_at(lambda p: p.records, fitted, records)


# Rounds of the search for noise, and for the width of the recordings' deviations from a shared
# number, the latter by expectation and maximisation (Dempster, Laird and Rubin 1977; Laird and Ware
# 1982, doi:10.2307/2529876); the relative change at which they end; a width below so much of the
# first one is zero.
_ROUNDS, _SETTLED, _LEAST = 40, 0.01, 1e-4


def _cost(tried: Tried) -> float:
    cost = float(tried.cost)
    return cost if np.isfinite(cost) else np.inf


def _with_noise(best: Tried, task: Task) -> tuple[Tried, Task]:
    """The best point together with its noise, if some noise is to be estimated."""
    if all(reading.known_noise for reading in task.problem.records.readings):
        return best, task

    def estimated(best: Tried, task: Task) -> Task:
        found = _evaluated(best, task.problem).found
        problem, noise = estimate_noise(task.problem, found, task.noise, best.parameters)
        return task._replace(problem=problem, noise=noise)

    # Weights, the robust loss, and what the fit takes from few readings depend on the noise.
    for turn in range(_ROUNDS):
        before, task = task.noise, estimated(best, task)
        pairs = zip(before, task.noise, strict=True)
        if turn > 1 and all(np.allclose(b, a, rtol=_SETTLED, atol=0.0) for a, b in pairs):
            break
        best = search.again(best, task)
    return best, task


def _from_pieces(problem: Problem, count: int, tolerance: float, max_steps: int) -> Parameters:
    cut = in_pieces(problem, count)
    task = Task(cut, _first_noise(cut), tolerance, max_steps)
    point = starting_points(cut, 1, None)[0]
    for width in WIDTHS:
        narrowed = eqx.tree_at(lambda t: t.problem.rows.width, task, jnp.asarray(width))
        point = search.least_squares(
            point, narrowed, search.whole(cut), max_steps, search.CAREFUL
        ).parameters
    return joined(problem, cut, point)


def _descended(
    points: list[Parameters],
    task: Task,
    descent: Descent,
    key: PRNGKeyArray | None,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Parameters]:
    keys = jax.random.split(jax.random.key(1) if key is None else key, len(points))
    out: list[Parameters] = []
    for point, own in zip(points, keys, strict=True):
        near, ended = descend(point, task.problem, task.noise, descent, own, progress)
        out.append(near)
        if not ended:
            cut.append(f"interrupted in the descent of start {len(out)} of {len(points)}")
            break
    return out


def _one_by_one(
    points: list[Parameters],
    task: Task,
    checkpoint: str | Path | None,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Tried]:
    like, print_of = Tried(points[0]), ""
    if checkpoint is not None:
        # The misfits as well: the fingerprint contains only the name of a torque function.
        costs = [search.cost_of(point, task.problem, task.noise) for point in points]
        print_of = fingerprint(points, task, costs)
    keep = Checkpoint(checkpoint, like, print_of)
    tried, latest = list(keep.done), keep.position.tried

    def look(position: SearchState) -> None:
        nonlocal latest
        # A part of the record is no measure of the whole.
        if np.isfinite(float(position.tried.cost)):
            latest = position.tried
        keep.save(tried, position)

    try:
        for number, point in enumerate(points[len(keep.done) :], len(keep.done) + 1):
            resumed = number == len(keep.done) + 1 and keep.position.stage > 0
            latest = like
            start = keep.position if resumed else SearchState(0, 0, Tried(point))
            # After a start that explains the record, other starts only show whether it is unique.
            aim = min((float(item.cost) for item in tried if bool(item.converged)), default=np.inf)
            aim = aim if aim <= search.enough(task.problem) else 0.0
            out, latest = search.climb(start, task, look=look, aim=aim), like
            tried.append(out)
            # Only the best start keeps its derivatives, which need memory.
            best = min(tried, key=_cost)
            tried[:] = [item if item is best else bare(item) for item in tried]
            keep.save(tried, SearchState(0, 0, like))
            _say(progress, number, len(points), tried)
    except KeyboardInterrupt:
        cut.append(f"interrupted after {len(tried)} of {len(points)} starts")
        if np.isfinite(float(latest.cost)):
            tried.append(latest)
        if not tried:
            raise
    return tried


def _together(
    points: list[Parameters],
    task: Task,
    together: int,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Tried]:
    tried: list[Tried] = []
    try:
        for first in range(0, len(points), together):
            batch = points[first : first + together]
            stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
            tried += search.climb_together(stacked, task)
            _say(progress, len(tried), len(points), tried)
    except KeyboardInterrupt:
        cut.append(f"interrupted after {len(tried)} of {len(points)} starts")
        if not tried:
            raise
    return tried


def _say(progress: Any, number: int, total: int, tried: list[Tried]) -> None:
    best, last = min(float(item.cost) for item in tried), float(tried[-1].cost)
    report_progress(progress, f"start {number}/{total}: misfit {last:.6g}, best {best:.6g}")


def _evaluated(best: Tried, problem: Problem) -> Tried:
    """The same with errors and derivatives, unless the search ended with them."""
    if best.found is not None:
        return best
    return dataclasses.replace(best, found=search.evaluate(best.parameters, problem))


@eqx.filter_jit
def _errors_alone(parameters: Parameters, problem: Problem) -> tuple[Float[Array, "..."], ...]:
    # Without the derivatives that `evaluate` computes along: less to compile.
    return all_errors(parameters, problem)[0]


def _with(problem: Problem, integrator: AbstractIntegrator | None) -> Problem:
    if integrator is None:
        return problem
    return eqx.tree_at(lambda p: p.integrator, problem, integrator)


def _finer(best: Tried, task: Task, rough: list[str]) -> AbstractIntegrator | None:
    """The integrator whose predictions finer steps do not change, `None` if it is the one in use.

    If there is none, `rough` says so.
    """
    problem, (errors, _) = task.problem, best.found[0]
    steps, apart = problem.integrator, 0.0
    while steps is not None and (finer := steps.finer()) is not None:
        closer = _with(problem, finer)
        if jax.tree.structure(finer) == jax.tree.structure(problem.integrator):
            (exact, _), _ = search.evaluate(best.parameters, closer)
        else:
            exact = _errors_alone(best.parameters, closer)
        apart = max(
            float(np.max(np.abs(np.asarray(a) - np.asarray(b)) / np.asarray(sigma)[:, None]))
            for a, b, sigma in zip(errors, exact, task.noise, strict=True)
        )
        if apart <= _MATTERS:
            break
        steps, errors = finer, exact
        if apart <= 8 * _MATTERS:
            # What is left of it with twice as many steps, or a hundredth of the tolerance.
            break
    else:
        if apart > _MATTERS:
            rough.append(f"the shortest steps still change readings by {apart:.1g} of their noise")
    return None if steps is problem.integrator else steps


def _first_noise(problem: Problem) -> Noise:
    out = []
    for reading in problem.records.readings:
        sensor = reading.sensor
        if reading.known_noise:
            out.append(sensor.noise)
        else:
            # A tenth of the signal: what counts is that no channel drowns another.
            values = reading.values.reshape(*reading.mask.shape, -1)
            size = jnp.sqrt(jnp.mean(jnp.sum(values**2, axis=-1)) + 1e-300)
            out.append(jnp.full((problem.count, sensor.components), 0.1) * size)
    return tuple(out)


def _with_widths(best: Tried, task: Task) -> tuple[Tried, Task]:
    """The best point together with the estimated widths, and the task with them."""
    wanted = [index for index, slot in enumerate(task.problem.slots) if slot.estimated]
    if not wanted:
        return best, task
    before = np.asarray([task.problem.slots[i].spread for i in wanted], float)
    least = _LEAST * before
    for _ in range(_ROUNDS):
        found = np.maximum(_expected(best.parameters, task, wanted), least)
        new = [jnp.asarray(width) for width in found]
        problem = eqx.tree_at(lambda p: [p.slots[i].spread for i in wanted], task.problem, new)
        task = task._replace(problem=problem)
        best = search.again(best, task)
        if (np.abs(found - before) < _SETTLED * before).all() or (found <= least).all():
            break
        before = found
    return best, task


def _expected(parameters: Parameters, task: Task, wanted: list[int]) -> np.ndarray:
    """The root mean square of each one's deviations, with their posterior variance (Laplace)."""
    problem = task.problem
    variance = np.diag(of_white(linearise(problem, parameters, task.noise)).seen)
    values, places = (by_slot(problem, of) for of in (parameters, numbered(parameters)))
    squares = [np.mean(np.asarray(values[i][2]) ** 2) for i in wanted]
    own = [np.mean(variance[np.ravel(places[i][2]).astype(int)]) for i in wanted]
    return np.sqrt(np.add(squares, own))
