"""Least squares from several starts."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax.identify import uncertainty
from rigidjax.identify.assessment import assess
from rigidjax.identify.checkpoint import (
    Checkpoint,
    SearchState,
    Tried,
    bare,
    fingerprint,
    require_folder,
)
from rigidjax.identify.initial_guess import starting_points
from rigidjax.identify.multiple_shooting import WIDTHS, joined, pieces as in_pieces, with_width
from rigidjax.identify.parameters import Parameters, by_slot, numbered
from rigidjax.identify.problem import Problem, fits
from rigidjax.identify.propagation import AbstractIntegrator, Adaptive, FixedSteps
from rigidjax.identify.result import Fit
from rigidjax.identify.search import (
    CAREFUL,
    again,
    climb,
    climb_together,
    cost_of,
    enough,
    evaluate,
    fresh,
    least_squares,
    whole,
)
from rigidjax.identify.stochastic_gradient import Descent, descend
from rigidjax.identify.terms import Noise, all_errors

# More fixed steps than this between two samples cost more than adaptive steps.
FINEST = 32


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
    - `pieces`: if more than one, the record is first fitted in so many pieces with joined ends (see
      `pieces`), and the result is the first start.
    - `descent`: a `Descent(optimiser, steps=…, batch=…)` of optax first improves each start on a
      few recordings at a time: for many recordings, when a step of least squares is expensive.
    - `checkpoint`: a file that keeps the state of the search after every 25 steps. A second call
      with the same problem and options continues from there. It ends at the same point to the last
      bit on the same machine and versions, wherever the first was killed. `together` = 1 only.
    - `progress`: called with a line of text after each start, such as `print`.

    **Returns** a `Fit`. It always holds the best point reached, and two answers.
    `fit.search`: `found`, `not alone` (another motion fits as well), or `not ended`. `fit.model`:
    `explains the readings` (the errors are white and of the sensor's size), `leaves a part` (how
    large, and where), or `does not explain the readings`. `fit.causes` names the most likely causes
    of the remaining errors, `fit.advice` says whether the intervals can be trusted and gives
    advice, `fit.status` is both answers in a line, `ok` if all is well. An interrupt (Ctrl-C) ends
    the search and keeps the best point so far; the status says so, and is not `ok`.

    The method is Levenberg–Marquardt on normal equations, with Jacobians by forward mode through
    the motion.

    **Raises:** `TypeError` unless `problem` is a `Problem`, `ValueError` for fewer than one start,
    a checkpoint that is damaged or of another problem, or one in a folder that does not exist.

    >>> import jax.numpy as jnp, rigidjax as rj
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
    given = (initial is not None) + (pieces > 1)
    points = starting_points(problem, starts - given, key) if starts > given else []
    noise = _first_noise(problem)
    _checks.instance(descent, (Descent, NoneType), "fit", wanted="a Descent(optimiser, …) or None")
    if pieces > 1:
        points = [_from_pieces(problem, pieces, tolerance, max_steps), *points][:starts]
    if initial is not None:
        points = [initial, *points][:starts]
    cut: list[str] = []
    if descent is not None:
        points = _descended(points, problem, noise, descent, key, progress, cut)
    if together > 1:
        tried = _together(points, problem, noise, tolerance, max_steps, together, progress, cut)
    else:
        tried = _one_by_one(points, problem, noise, tolerance, max_steps, checkpoint, progress, cut)
    best = min(
        tried, key=lambda item: float(item.cost) if np.isfinite(float(item.cost)) else np.inf
    )
    lowest = float(best.cost)
    best, noise = _with_noise(problem, best, noise, tolerance, max_steps)
    problem, best = with_widths(problem, best, noise, tolerance, max_steps)
    best = _evaluated(best, problem)
    while (finer := _finer(problem, best, noise)) is not None:
        problem = eqx.tree_at(lambda p: p.integrator, problem, finer)
        best = again(best, problem, noise, tolerance, max_steps)
        best, noise = _with_noise(problem, best, noise, tolerance, max_steps)
        best = _evaluated(best, problem)
    return assess(problem, best, noise, tried, lowest, cut)


def _with_noise(
    problem: Problem, best: Tried, noise: Noise, tolerance: float, max_steps: int
) -> tuple[Tried, Noise]:
    """The best point together with its noise, if some noise is to be estimated."""
    if all(sensor.noise is not None for sensor in problem.records.sensors):
        return best, noise

    def estimated(noise: Noise) -> Noise:
        (errors, _), _ = _evaluated(best, problem).found
        return uncertainty.estimate_noise(problem, errors, noise, best.parameters)

    # Twice: the weights of the channels and the robust loss both depend on the noise.
    for _ in range(2):
        noise = estimated(noise)
        best = again(best, problem, noise, tolerance, max_steps)
    return best, estimated(noise)


def _from_pieces(problem: Problem, count: int, tolerance: float, max_steps: int) -> Parameters:
    cut = in_pieces(problem, count)
    noise, everywhere = _first_noise(cut), whole(cut)
    point = starting_points(cut, 1, None)[0]
    for width in WIDTHS:
        narrowed = with_width(cut, width)
        end = least_squares(point, narrowed, noise, everywhere, tolerance, max_steps, CAREFUL)
        point = end.parameters
    return joined(problem, cut, point)


def _descended(
    points: list[Parameters],
    problem: Problem,
    noise: Noise,
    descent: Descent,
    key: PRNGKeyArray | None,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Parameters]:
    keys = jax.random.split(jax.random.key(1) if key is None else key, len(points))
    out: list[Parameters] = []
    for point, own in zip(points, keys, strict=True):
        near, whole = descend(point, problem, noise, descent, own, progress)
        out.append(near)
        if not whole:
            cut.append(f"interrupted in the descent of start {len(out)} of {len(points)}")
            break
    return out


def _one_by_one(
    points: list[Parameters],
    problem: Problem,
    noise: Noise,
    tolerance: float,
    max_steps: int,
    checkpoint: str | Path | None,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Tried]:
    like = Tried(points[0], jnp.asarray(jnp.inf), jnp.asarray(False))
    print_of = ""
    if checkpoint is not None:
        # The misfits as well: the fingerprint contains only the name of a torque function.
        costs = [cost_of(point, problem, noise) for point in points]
        print_of = fingerprint(points, problem, noise, costs, tolerance, max_steps)
    keep = Checkpoint(checkpoint, like, print_of)
    tried, latest = list(keep.done), [keep.position.tried]
    try:
        for number, point in enumerate(points, 1):
            if number <= len(keep.done):
                continue
            resumed = number == len(keep.done) + 1 and keep.position.stage > 0
            latest = [like]

            def look(position: SearchState) -> None:
                # This is a part of the record: its misfit is no measure of the whole.
                if np.isfinite(float(position.tried.cost)):
                    latest[0] = position.tried  # noqa: B023
                keep.save(tried, position)

            start = keep.position if resumed else SearchState(0, 0, fresh(point))
            # After a start that explains the record, other starts only show whether it is unique.
            aim = min((float(item.cost) for item in tried if bool(item.converged)), default=np.inf)
            aim = aim if aim <= enough(problem) else 0.0
            out = climb(start, problem, noise, tolerance, max_steps, look=look, aim=aim)
            latest = [like]
            tried[:] = _with_one_found([*tried, out])
            keep.save(tried, SearchState(0, 0, like))
            _say(progress, number, len(points), tried)
    except KeyboardInterrupt:
        cut.append(f"interrupted after {len(tried)} of {len(points)} starts")
        if np.isfinite(float(latest[0].cost)):
            tried.append(latest[0])
        if not tried:
            raise
    return tried


def _with_one_found(tried: list[Tried]) -> list[Tried]:
    """The same; only the best start keeps its derivatives, which need memory."""
    costs = [float(item.cost) for item in tried]
    lowest = int(np.argmin([cost if np.isfinite(cost) else np.inf for cost in costs]))
    return [item if index == lowest else bare(item) for index, item in enumerate(tried)]


def _together(
    points: list[Parameters],
    problem: Problem,
    noise: Noise,
    tolerance: float,
    max_steps: int,
    together: int,
    progress: Callable[[str], Any] | None,
    cut: list[str],
) -> list[Tried]:
    tried: list[Tried] = []
    try:
        for first in range(0, len(points), together):
            batch = points[first : first + together]
            stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
            tried += climb_together(stacked, problem, noise, tolerance, max_steps)
            _say(progress, len(tried), len(points), tried)
    except KeyboardInterrupt:
        cut.append(f"interrupted after {len(tried)} of {len(points)} starts")
        if not tried:
            raise
    return tried


def _say(progress: Any, number: int, total: int, tried: list[Tried]) -> None:
    if progress is not None:
        best = min(float(item.cost) for item in tried)
        progress(f"start {number}/{total}: misfit {float(tried[-1].cost):.6g}, best {best:.6g}")


def _evaluated(best: Tried, problem: Problem) -> Tried:
    """The same with errors and derivatives, unless the search ended with them."""
    if best.found is not None:
        return best
    return dataclasses.replace(best, found=evaluate(best.parameters, problem))


@eqx.filter_jit
def _errors_alone(parameters: Parameters, problem: Problem) -> tuple[Float[Array, "..."], ...]:
    # Without the derivatives that `errors_at` computes along: less to compile.
    return all_errors(parameters, problem)[0]


def _finer(problem: Problem, best: Tried, noise: Noise) -> AbstractIntegrator | None:
    """A finer integrator, if twice as many fixed steps change predictions by a twentieth of the
    noise.
    """
    steps = problem.integrator
    if not isinstance(steps, FixedSteps):
        return None
    count, parameters = steps.substeps, best.parameters
    (coarse, _), _ = best.found
    # Steps given by the user are tried in any case.
    while count <= max(FINEST, steps.substeps):
        finer: AbstractIntegrator = FixedSteps(2 * count, steps.solver)
        exact = _errors_alone(parameters, eqx.tree_at(lambda p: p.integrator, problem, finer))
        apart = max(
            float(np.max(np.abs(np.asarray(a) - np.asarray(b)) / np.asarray(sigma)[:, None]))
            for a, b, sigma in zip(coarse, exact, noise, strict=True)
        )
        if apart <= 0.05:
            return None if count == steps.substeps else FixedSteps(count, steps.solver)
        count, coarse = 2 * count, exact
    return Adaptive()


def _first_noise(problem: Problem) -> Noise:
    out = []
    for reading in problem.records.readings:
        sensor = reading.sensor
        if sensor.noise is not None:
            out.append(sensor.noise)
        else:
            # A tenth of the signal: what counts is that no channel drowns another.
            values = reading.values.reshape(*reading.mask.shape, -1)
            size = jnp.sqrt(jnp.mean(jnp.sum(values**2, axis=-1)) + 1e-300)
            out.append(jnp.full((problem.count, sensor.components), 0.1) * size)
    return tuple(out)


# Rounds, and the relative change at which they end; a width below so much of the first one is zero.
_ROUNDS, _SETTLED, _LEAST = 40, 0.01, 1e-4


def with_widths(
    problem: Problem, best: Tried, noise: Noise, tolerance: float, max_steps: int
) -> tuple[Problem, Tried]:
    """The problem with the estimated widths, and its best point near `best`."""
    wanted = [index for index, slot in enumerate(problem.slots) if slot.estimated]
    if not wanted:
        return problem, best
    least = _LEAST * _widths(problem)[wanted]
    for _ in range(_ROUNDS):
        before = _widths(problem)[wanted]
        found = np.maximum(_expected(problem, best.parameters, noise)[wanted], least)
        new = [jnp.asarray(width) for width in found]
        problem = eqx.tree_at(lambda p: [p.slots[i].spread for i in wanted], problem, new)
        best = again(best, problem, noise, tolerance, max_steps)
        if (np.abs(found - before) < _SETTLED * before).all() or (found <= least).all():
            break
    return problem, best


def _widths(problem: Problem) -> np.ndarray:
    """The width of each `Free`, in steps; 1 for a `Free` without one."""
    return np.array([1.0 if s.spread is None else float(s.spread) for s in problem.slots])


def _expected(problem: Problem, parameters: Parameters, noise: Noise) -> np.ndarray:
    """The root mean square of each one's deviations, with their uncertainty included."""
    linear = uncertainty.linearise(problem, parameters, noise)
    variance = np.diag(uncertainty.of_white(linear).seen)
    values, places = (by_slot(problem, of) for of in (parameters, numbered(parameters)))
    out = np.ones(len(problem.slots))
    for index, slot in enumerate(problem.slots):
        if slot.spread is not None:
            deviation, where = np.asarray(values[index][2]), np.ravel(places[index][2]).astype(int)
            out[index] = np.sqrt(np.mean(deviation**2) + np.mean(variance[where]))
    return out
