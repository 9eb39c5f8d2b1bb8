"""Fit by least squares from several starts, and estimate unknown noise and the spread of deviations
between recordings.
"""

import dataclasses
import itertools
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax.identify.answer.assess import assess
from rigidjax.identify.answer.held_out import choose_part, with_body, with_held_out
from rigidjax.identify.answer.misread import warn_of_unit
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.data.reference_states import rates, require_no_swing, require_turning
from rigidjax.identify.model.model import Model, all_errors, checked_x
from rigidjax.identify.model.predict import AbstractIntegrator, Adaptive
from rigidjax.identify.search.checkpoint import (
    Checkpoint,
    fingerprint,
    report_progress,
    require_folder,
    without_arrays,
)
from rigidjax.identify.search.noise import estimate_noise, initial_noise
from rigidjax.identify.search.stages import (
    Attempt,
    Task,
    accepted_cost,
    blocks_at,
    cost_of,
    fit_in_stages,
    search_whole,
)
from rigidjax.identify.search.starts import starting_points
from rigidjax.identify.uncertainty.covariance import linearise, white_covariance

# At most this number of parameters may be shared by all recordings, because the normal equations
# are dense.
MOST_SHARED = 1000
# A fit of a model whose arrays hold fewer numbers takes ten times as long on a GPU as on a CPU,
# because a CPU starts each compiled program sooner.
_FEW = 100_000
# Integration steps are short enough if shorter steps change all predictions by less than this
# fraction of the noise.
_MATTERS = 0.05
# The noise of the sensors is estimated in rounds, and so is the `spread` of a `Free` (its standard
# deviation between recordings). Each round finds the best point for the last estimate, and then a
# new estimate at this point. For the spread a round is one of expectation and maximisation
# (Dempster, Laird and Rubin 1977; Laird and Ware 1982, doi:10.2307/2529876). There are at most
# _ROUNDS rounds, and they end once every estimate changes by less than the fraction _SETTLED of
# itself. A spread does not fall below _LEAST times its first value; this least value stands for
# zero.
_ROUNDS, _SETTLED, _LEAST = 40, 0.01, 1e-4
# All starting points are in memory at once.
_MOST_STARTS = 10_000


@suggest_arguments
def fit(
    model: Model,
    *,
    starts: int = 8,
    initial: Float[Array, " n"] | None = None,
    held_out: bool | float | Sequence[int] = True,
    before: Any = None,
    key: PRNGKeyArray | None = None,
    tolerance: float = 1e-4,
    max_steps: int = 200,
    checkpoint: str | Path | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Fit:
    """Fit the parameters of a model to its recordings: the body, the initial states and all
    `Free`s (numbers of torques or sensors that the fit may move).

    **Arguments:**

    - `model`: the readings and the parameters.
    - `starts`: the number of starting points. The first one comes from a regression, all others are
      scattered at random. The search from each point fits the whole record. If this fit does not
      explain the readings, the search fits a quarter, a half and then the whole of the record. A
      model of windows (short parts of a record) is fitted to longer and longer beginnings of them.
    - `initial`: (n,) a starting point of your own, which is tried first.
    - `held_out`: the part of the readings that a second fit, of the rest, has to predict: a
      fraction at the end of each record, or the indices of recordings or windows. `True` chooses
      every fourth recording or stretch of windows, or the last quarter of fewer than four records;
      `False` holds out nothing.
    - `before`: the body that one had before, or several by name, whose prediction of the same part
      is compared.
    - `key`: the random key of the scattered starting points; without a key these points are the
      same at each call.
    - `tolerance`: the search has converged if the next Levenberg–Marquardt step changes each
      parameter by less than `tolerance` standard deviations of this parameter, computed with all
      other parameters fixed.
    - `max_steps`: the largest number of Levenberg–Marquardt steps.
    - `checkpoint`: a file in which the end of the search from each starting point is saved. A
      second call with the same model and options continues after the last saved search, and ends at
      the same point to the last bit on the same machine with the same versions.
    - `progress`: a function such as `print`, called with a line of text after each search.

    **Returns** a `Fit` of the best point reached. It holds two answers:

    - `fit.search`: `found`, `not alone` (another motion fits as well), or `not ended`.
    - `fit.explanation`: `explains the readings` (the errors are white, as large as the sensor's
      noise, and not those of scattered time stamps, which lie along the derivative of the readings
      with respect to time), `leaves a part` (how large, and at which times), or `does not explain
      the readings`.

    `fit.status` holds both answers in one line, or `ok` if all is well. `fit.causes` names what
    most likely makes the errors, and `fit.advice` says whether the intervals can be trusted. An
    interrupt (Ctrl-C) ends the search and keeps the best point so far; the status then says that
    the search was interrupted.

    On a machine with a GPU, a model whose arrays hold fewer than 100 000 numbers is fitted on the
    CPU, and the report says so. Within `jax.default_device(…)`, or if an array of the model was put
    on a device, the fit runs on that device.

    **Raises:** `TypeError` unless `model` is a `Model`. `ValueError` for fewer than one start or
    more than 10 000; for a body whose rates in a recording are all zero; for more than 1000
    parameters that recordings share (`descend` takes any number); and for a checkpoint that is
    damaged, belongs to another model, or lies in a folder that does not exist. A `UserWarning`
    says, before the search, that the sizes of the rates show a wrong unit.

    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> result = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()))
    >>> result.ok, bool(jnp.allclose(result.body.tensor / result.body.tensor[0, 0],
    ...                                  jnp.diag(jnp.array([1.0, 2.0, 2.5])), atol=1e-6))
    (True, True)
    """
    _checks.require_instance(model, Model, "fit", requirement="a Model")
    starts = _checks.integer(starts, "starts", 1, _MOST_STARTS)
    max_steps = _checks.integer(max_steps, "max_steps", 1)
    tolerance = _checks.positive_float(tolerance, "tolerance")
    key = None if key is None else _checks.random_key(key)
    if initial is not None:
        initial = checked_x(model, initial)
    if progress is not None:
        _checks.require_function(progress, "progress", "of a line of text, such as print")
    if checkpoint is not None:
        require_folder(checkpoint)
    shared = model.size - len(model.index.alone) * model.count
    if shared > MOST_SHARED:
        raise ValueError(
            f"fit: {shared} parameters that recordings share are too many for least squares, "
            f"which is made for {MOST_SHARED} and fewer: its matrices are dense. Use "
            "identify.descend(model, Descent(optax.adam(1e-2), steps=…, batch=…)), which takes "
            "gradients of a few recordings at a time"
        )
    if (cpu := _cpu_if_faster(model)) is not None:
        with jax.default_device(cpu):
            result = fit(
                model, starts=starts, initial=initial, held_out=held_out, before=before, key=key,
                tolerance=tolerance, max_steps=max_steps, checkpoint=checkpoint, progress=progress,
            )  # fmt: skip
        return dataclasses.replace(result, place=_ON_CPU)
    if model.index.bodies:
        number = itertools.count(1)
        for one in stacking.kinds_of(model):
            recordings = stacking.on_host(one.records, one.counts)
            warn_of_unit(recordings[0], one.torque)
            for recording in recordings:
                named = rates(recording).values, f"fit: the rates of recording {next(number)}"
                require_turning(*named)
                if one.torque is None:
                    require_no_swing(*named)
    padded = stacking.pad_to_few(model)
    part = choose_part(padded, held_out)
    if before is not None:
        if part is None:
            raise ValueError("before: wanted readings to predict, but held_out leaves none")
        with_body(padded, model.start(), before)
    task = Task(padded, initial_noise(padded), tolerance, max_steps)
    points = [] if initial is None else [initial]
    if starts > len(points):
        points += starting_points(model, starts - len(points), key)
    points, interrupts, rough = points[:starts], [], []
    if any(isinstance(one.integrator, Adaptive) for one in stacking.kinds_of(padded)):
        # Choose the tolerance of the integrator at the first starting point, before the search,
        # because integration errors would slow the search down. Another tolerance needs no new
        # compilation.
        first = Attempt(points[0], blocks=blocks_at(padded, points[0]))
        finer = _converged_integrators(first, task, rough)
        task = task if rough else task._replace(model=_with_integrators(padded, finer))
    attempts = _search(points, task, checkpoint, progress, interrupts)
    best = min(attempts, key=lambda one: float(one.cost))
    lowest = float(best.cost)
    for estimated in (_noise_in_turn, _spreads_in_turn):
        best, task = estimated(best, task)
    best = _with_blocks(best, task.model)
    rough.clear()
    while (finer := _converged_integrators(best, task, rough)) is not None:
        task = task._replace(model=_with_integrators(task.model, finer))
        best, task = _noise_in_turn(search_whole(Attempt(best.x), task), task)
        best = _with_blocks(best, task.model)
    shown = model
    if task.model is not padded:
        # The model that is shown has no masked readings at the end of recordings. It keeps the
        # errors that the scatter of the time stamps (jitter) makes.
        records = model.records
        for index, r in enumerate(task.model.records.readings):
            if r.jitter_error is not None:
                one = records.readings[index]
                late = r.jitter_error[:, : one.mask.shape[1]]
                one = dataclasses.replace(one, jitter_error=late)
                records = eqx.tree_at(lambda a, i=index: a.readings[i], records, one)
        kinds = [part.model.records for part in model.parts] or [records]
        shown = stacking.with_records(task.model, kinds)
    found = assess(task.model, best, task.noise, attempts, lowest, shown, interrupts, rough)
    return found if part is None else with_held_out(found, task, part, before)


_ON_CPU = "computed on the CPU, which is faster than a GPU for so few readings"


def _cpu_if_faster(model: Model) -> Any:
    """Return the CPU if a fit is faster there than on the default device, else `None`.

    The result is `None` as well if the user chose a device, by `jax.default_device` or by arrays
    of the model that were put there.
    """
    chosen: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is not None or jax.default_backend() == "cpu":
        return None
    arrays = [a for a in jax.tree.leaves(model) if isinstance(a, jax.Array)]
    if sum(a.size for a in arrays) >= _FEW or any(a.committed for a in arrays):
        return None
    return jax.devices("cpu")[0]


def _noise_in_turn(best: Attempt, task: Task) -> tuple[Attempt, Task]:
    """Estimate the unknown noise of sensors and the best point alternately.

    The rounds end when the noise settles; known noise is left as it is.
    """
    if all(reading.has_known_noise for reading in task.model.records.readings):
        return best, task
    # Repeat the estimate of the noise, because it depends on what a new noise changes: the weights
    # of the sensors, the weights of the robust loss, and the degrees of freedom that the fit uses.
    for turn in range(_ROUNDS):
        before, blocks = task.noise, _with_blocks(best, task.model).blocks
        model, noise = estimate_noise(task.model, best.x, blocks, before)
        task = task._replace(model=model, noise=noise)
        pairs = zip(before, task.noise, strict=True)
        if turn > 1 and all(np.allclose(b, a, rtol=_SETTLED, atol=0.0) for a, b in pairs):
            break
        best = search_whole(Attempt(best.x), task)
    return best, task


def _search(
    points: list[Array],
    task: Task,
    checkpoint: str | Path | None,
    progress: Callable[[str], Any] | None,
    interrupts: list[str],
) -> list[Attempt]:
    """Return the end of the least-squares search from each starting point.

    Searches in the file `checkpoint` are not repeated. After an interrupt (Ctrl-C) a line is added
    to `interrupts`, and further starts are left out; it is raised again if no search has ended.
    """
    like, print_of = Attempt(points[0]), ""
    if checkpoint is not None:
        # The fingerprint tells whether a checkpoint belongs to this model and these starts. It
        # contains the costs at the starts, too: without them it would be the same for two different
        # torque functions with one name.
        costs = [cost_of(task.model, point, task.noise) for point in points]
        print_of = fingerprint(points, task, costs)
    keep = Checkpoint(checkpoint, like, print_of)
    # The last point of the present search, for an interrupt.
    attempts, latest = list(keep.done), deque([like], maxlen=1)
    try:
        for number, point in enumerate(points[len(keep.done) :], len(keep.done) + 1):
            # Once one search has explained the record, later searches only have to show whether
            # another motion explains the record as well. A later search is therefore given up if it
            # is not likely to reach the least cost so far.
            ended = [float(one.cost) for one in attempts if bool(one.converged)]
            aim = min(ended, default=np.inf)
            aim = aim if aim <= accepted_cost(task.model) else 0.0
            attempts.append(fit_in_stages(point, task, aim=aim, watch=latest.append))
            latest.append(like)
            # Only the best search so far keeps its errors and their derivatives, which need memory.
            best = min(attempts, key=lambda one: float(one.cost))
            attempts[:] = [one if one is best else without_arrays(one) for one in attempts]
            keep.save(attempts)
            words = f"cost {float(attempts[-1].cost):.6g}, best {float(best.cost):.6g}"
            report_progress(progress, f"start {number}/{len(points)}: {words}")
    except KeyboardInterrupt:
        interrupts.append(f"interrupted after {len(attempts)} of {len(points)} starts")
        if np.isfinite(float(latest[0].cost)):
            attempts.append(latest[0])
        if not attempts:
            raise
    return attempts


def _with_blocks(best: Attempt, model: Model) -> Attempt:
    """Return the end of a search with the errors there and their derivatives, if it lacks them."""
    if best.blocks is not None:
        return best
    return dataclasses.replace(best, blocks=blocks_at(model, best.x))


# A program without derivatives compiles sooner.
_only_errors = eqx.filter_jit(all_errors)


# The integrator of each kind of recordings; `None` for a kind without a torque.
Integrators = tuple[AbstractIntegrator | None, ...]


def _with_integrators(model: Model, integrators: Integrators | None) -> Model:
    """Return the `model` with other integrators, or unchanged for `None`."""
    if integrators is None:
        return model
    return stacking.with_field(model, "integrator", integrators)


def _refine(integrators: Integrators) -> Integrators | None:
    """Return integrators of shorter steps, or `None` if none can be refined."""
    finer = [None if one is None else one.refine() for one in integrators]
    if all(one is None for one in finer):
        return None
    return tuple(one if new is None else new for one, new in zip(integrators, finer, strict=True))


def _converged_integrators(best: Attempt, task: Task, remarks: list[str]) -> Integrators | None:
    """Return integrators with steps so short that shorter steps hardly change the predictions.

    They may change by a twentieth of the noise. The result is `None` if the present integrators are
    accurate enough; a line is added to `remarks` if even the shortest steps are not.
    """
    model, (errors, _) = task.model, best.blocks
    first = steps = tuple(one.integrator for one in stacking.kinds_of(model))
    apart = 0.0
    while (finer := _refine(steps)) is not None:
        closer = _with_integrators(model, finer)
        if jax.tree.structure(finer) == jax.tree.structure(first):
            exact, _ = blocks_at(closer, best.x)
        else:
            exact = _only_errors(closer, best.x)
        apart = max(
            float(np.max(np.abs(np.asarray(a) - np.asarray(b)) / np.asarray(sigma)[:, None]))
            for a, b, sigma in zip(errors, exact, task.noise, strict=True)
        )
        if apart <= _MATTERS:
            break
        steps, errors = finer, exact
        if apart <= 8 * _MATTERS:
            # The errors of `finer` are below an eighth of `apart`, because integration errors fall
            # by more than a factor of 8 with twice as many steps of a method of order 4, and with a
            # hundredth of the tolerance. So `finer` is accurate enough, and is not compared with
            # still shorter steps.
            break
    else:
        if apart > _MATTERS:
            remarks.append(
                f"the shortest steps still change readings by {apart:.1g} of their noise"
            )
    return None if steps is first else steps


def _spreads_in_turn(best: Attempt, task: Task) -> tuple[Attempt, Task]:
    """Estimate the unknown spreads of `Free`s and the best point alternately, until they settle."""
    indices = [index for index, slot in enumerate(task.model.slots) if slot.estimated]
    if not indices:
        return best, task
    before = np.asarray([task.model.slots[i].spread for i in indices], float)
    places = [np.ravel(task.model.slots[i].own).astype(int) for i in indices]
    least = _LEAST * before
    for _ in range(_ROUNDS):
        best = _with_blocks(best, task.model)
        # The expected mean square of the deviations of recordings from the shared value: Laplace's
        # method takes the posterior density as normal about the best point.
        linear = linearise(task.model, best.x, task.noise, best.blocks)
        variance, x = np.diag(white_covariance(linear).determined), np.asarray(best.x)
        squares = [np.mean(x[mine] ** 2) + np.mean(variance[mine]) for mine in places]
        new = np.maximum(np.sqrt(squares), least)
        widths = [jnp.asarray(width) for width in new]
        model = eqx.tree_at(lambda m: [m.slots[i].spread for i in indices], task.model, widths)
        task = task._replace(model=model)
        best = search_whole(Attempt(best.x), task)
        if (np.abs(new - before) < _SETTLED * before).all() or (new <= least).all():
            break
        before = new
    return best, task
