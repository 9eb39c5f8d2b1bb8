"""Predict the part of the readings that a fit has not seen, from a fit of the rest."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax.identify.answer.answers import EXPLAINS, LEAVES, NOT_ENDED, Answer
from rigidjax.identify.answer.parts import HeldOut, Pair
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.model.charts import Known, body_places
from rigidjax.identify.model.index import build_index
from rigidjax.identify.model.model import Model, all_errors, require_one_kind
from rigidjax.identify.search.stages import (
    Attempt,
    Task,
    blocks_at,
    fit_in_stages,
    has_unit_noise,
    search_whole,
)
from rigidjax.identify.uncertainty import flat_limit
from rigidjax.identify.uncertainty.covariance import Linearisation, linearise, white_covariance
from rigidjax.identify.uncertainty.degrees_of_freedom import effective_parameters

# One of PARTS recordings or stretches of windows is held out, or one of PARTS parts of a record.
PARTS = 4
# The fit of the rest multiplies the residuals of held-out readings by LITTLE. With its square as
# their weight they hardly count, but they still determine what no other reading does, such as the
# initial state of a recording that is held out.
LITTLE = 1e-2
# The rest says nothing about a direction of the parameters whose variance makes that of a
# prediction more than LOST times that of the noise, and hardly less than 1 / LITTLE² times.
LOST = 1e3
# Errors of a prediction are too large if chance makes such errors with a lower probability.
RARE = 1e-4


class Part(NamedTuple):
    """Hold which readings are held out, and a name of this part."""

    name: str
    held: Bool[np.ndarray, "records times"]


def choose_part(model: Model, held_out: bool | float | Sequence[int]) -> Part | None:
    """Return the readings to hold out, as `fit` describes, or `None` for none."""
    (count, long), clusters, name = model.records.t.shape, model.clusters, None
    if held_out is True and clusters is not None:
        held_out = np.flatnonzero(np.asarray(clusters) % PARTS == PARTS - 1).tolist()
        name = f"every {PARTS}th stretch of windows"
    elif held_out is True and count >= PARTS:
        held_out, name = range(PARTS - 1, count, PARTS), f"every {PARTS}th recording"
    elif isinstance(held_out, bool):
        held_out = 1.0 / PARTS if held_out else ()
    if isinstance(held_out, Sequence):
        rows = [_checks.integer(row, "held_out", 0, count - 1) for row in held_out]
        if not 0 < len(set(rows)) < count:
            return None
        name = name or f"recordings {', '.join(map(str, rows))}"
        return Part(name, np.isin(np.arange(count), rows)[:, None] & np.ones((1, long), bool))
    share = _checks.fraction(held_out, "held_out", "a fraction of each record between 0 and 1")
    first = np.ceil((1.0 - share) * np.asarray(model.counts))
    name = f"the last {100 * share:.3g} % of {'the' if count == 1 else 'each'} record"
    return Part(name, np.arange(long) >= first[:, None])


def with_held_out(fit: Fit, task: Task, part: Part, before: Any = None) -> Fit:
    """Return the `fit` with the errors of its prediction of a held-out `part`, by a fit of the
    rest that starts at the answer; unchanged if the search did not end, or if too little is left.

    The recordings of `task` may be padded. A part that the rest does not predict is not explained.
    """
    model, held = task.model, part.held
    if fit.search.word == NOT_ENDED:
        return fit
    linear = _fit_of_rest(Attempt(fit.x), task, held)
    test = _test_prediction(model, linear, held)
    if test is None:
        return fit
    raw, mask = linear.raw, linear.mask
    sizes = [_sizes(raw, mask, ~held), _sizes(raw, mask, held), [None] * len(raw)]
    if before is not None:
        known, x = with_body(model, fit.x, before)
        task = task._replace(model=known)
        if x.size:
            raw = _fit_of_rest(fit_in_stages(x, task), task, held).raw
        else:  # a held body: nothing is left to fit
            raw = tuple(map(np.asarray, eqx.filter_jit(all_errors)(known, x)))
        sizes[2] = _sizes(raw, mask, held)
    pairs = tuple(
        Pair(type(sensor).__name__, sensor.unit, *three)
        for sensor, *three in zip(model.records.sensors, *sizes, strict=True)
        if np.isfinite(three[1])
    )
    found = HeldOut(part.name, pairs, *test)
    assessment = fit.assessment
    if test.chance < RARE:
        old, left = assessment.explanation, assessment.left
        word = LEAVES if old.word == EXPLAINS else old.word
        answer = Answer(word, (*old.reasons, f"a fit of the rest does not predict {found}"))
        left = left or tuple(range(len(linear.raw)))
        assessment = dataclasses.replace(assessment, explanation=answer, left=left)
    return dataclasses.replace(fit, assessment=assessment, held_out=found)


def _fit_of_rest(begin: Attempt, task: Task, held: np.ndarray) -> Linearisation:
    """Return the linearisation of all readings at the fit of those that are not held out."""
    model = task.model
    weights = np.where(held, LITTLE, 1.0).astype(model.records.t.dtype)
    if model.start_weight is not None:
        # The start of a window that is held out stays as close to its measurement as any other.
        starts = model.start_weight * weights.max(axis=1, keepdims=True)
        model = eqx.tree_at(lambda m: m.start_weight, model, starts)
    rest = search_whole(Attempt(begin.x), task._replace(model=model), weights=jnp.asarray(weights))
    near = flat_limit.thicken(model, rest.x)
    thickened = None if near is None else (near, blocks_at(model, near))
    return linearise(model, rest.x, task.noise, rest.blocks or blocks_at(model, rest.x), thickened)


def with_body(model: Model, x: Float[Array, " n"], body: Any) -> tuple[Model, Array]:
    """Return a `model` whose body is known, or bodies by name, and the rest of the parameters x."""
    require_one_kind(model, "before")
    names = list(dict.fromkeys(model.body_names))
    bodies: Any = body if isinstance(body, Mapping) else dict.fromkeys(names, body)
    if set(bodies) != set(names):
        raise ValueError(f"before: wanted a body for each of {names}, got {list(bodies)}")
    charts = tuple(Known(bodies[name]) for name in names)
    places = body_places(charts, model.body_indices, model.count)
    index, slots = build_index(places, model.slots, model.index.start.shape[1])
    parts: Any = dict(charts=charts, index=index, slots=slots, prior=None)
    return dataclasses.replace(model, **parts), x[model.index.bodies :]


def _sizes(
    raw: Sequence[np.ndarray], masks: Sequence[np.ndarray], rows: Bool[np.ndarray, "records times"]
) -> list[float]:
    """Return the root mean square length of the errors of each sensor in some rows, or NaN."""
    out = []
    for error, mask in zip(raw, masks, strict=True):
        squares = np.sum(error**2, axis=-1)[mask.all(axis=-1) & rows]
        out.append(float(np.sqrt(np.mean(squares))) if squares.size else np.nan)
    return out


class _Test(NamedTuple):
    """Hold the ratio and the chance of a `HeldOut`."""

    ratio: float
    chance: float


def _test_prediction(model: Model, linear: Linearisation, held: np.ndarray) -> _Test | None:
    """Return the test of the errors e of held-out readings at the fit of the rest, `None` if these
    are too few.

    The covariance of e is S = 1 + J Σ Jᵀ, with the covariance Σ of that fit: eᵀ S⁻¹ e is χ² (Chow
    1960, doi:10.2307/1910133), and so is its part in the range of J, which shows parameters that
    change. Windows, whose errors are correlated, are compared stretch by stretch.
    """
    from scipy.special import fdtrc, stdtr

    shares, places = np.where(held, LITTLE**2, 1.0), linear.places
    rest = dataclasses.replace(linear, weights=tuple(w * shares for w in linear.weights))
    white = white_covariance(rest)
    if white.root is None:
        return None
    covariance, seen, many, total, free = white.determined, ~held.all(axis=1), 0, 0.0, 0.0
    pull, information = np.zeros(len(covariance) + 1), np.zeros(np.add(covariance.shape, 1))
    squares, counts = np.zeros((2, len(held)))
    for reading, raw, e, slope, weight, mask, taken in zip(
        model.records.readings, linear.raw, linear.errors, linear.slopes, linear.weights,
        linear.mask, effective_parameters(rest, covariance), strict=True,
    ):  # fmt: skip
        out, root = mask & held[..., None], np.sqrt(weight)[..., None]
        e = e * root
        rows = np.where(out[..., None], slope * root[..., None], 0.0)
        squares = squares + np.sum(np.where(mask, e**2, 0.0), (1, 2))
        counts = counts + np.sum(mask, (1, 2))
        if not reading.has_known_noise or has_unit_noise(reading):
            fitted = mask & ~out
            left = float(fitted.sum() - taken[seen].sum())
            if left < 1.0:
                return None
            free += left
            e = e * np.sqrt(left / max(np.sum(e[fitted] ** 2), 1e-300))
        # Round-off is no error of a prediction.
        values = np.asarray(reading.values)[reading.host_mask]
        exact = np.sum(raw[out] ** 2) <= 1e-12 * np.sum(values**2)
        e = np.where(out & ~exact, e, 0.0).reshape(len(e), -1)
        rows = rows.reshape(len(e), -1, rows.shape[-1])
        np.add.at(pull, places, (e[:, None] @ rows)[:, 0])
        np.add.at(information, (places[:, :, None], places[:, None]), rows.swapaxes(1, 2) @ rows)
        total, many = total + float(np.sum(e**2)), many + int(out.sum())
    if model.clusters is not None and 0 < seen.sum() < seen.size:
        stretches = np.asarray(model.clusters)
        mean = np.bincount(stretches, squares) / np.maximum(np.bincount(stretches, counts), 1)
        both = inside, outside = [mean[np.unique(stretches[one])] for one in (seen, ~seen)]
        degrees = sum(map(len, both)) - 2
        spread = sum(np.sum((one - one.mean()) ** 2) for one in both) / max(degrees, 1)
        wide = np.sqrt(spread * sum(1.0 / len(one) for one in both))
        apart = outside.mean() - inside.mean()
        ratio = np.sqrt(outside.mean() / max(inside.mean(), 1e-300))
        return _Test(float(ratio), float(stdtr(max(degrees, 1), -apart / max(wide, 1e-300))))
    used = np.setdiff1d(places[held.any(axis=1)], [len(covariance)])
    size = np.sqrt(np.maximum(np.diag(covariance)[used], 1e-300))
    square, axes = np.linalg.eigh(covariance[np.ix_(used, used)] / np.outer(size, size))
    root = size[:, None] * axes * np.sqrt(np.maximum(square, 0.0))
    # Along orthonormal directions of predictions: the variance by Σ, and the square of e.
    variance, turn = np.linalg.eigh(root.T @ information[np.ix_(used, used)] @ root)
    variance = np.maximum(variance, 1e-12)
    along = (root.T @ pull[used] @ turn) ** 2 / variance
    lost, shown = variance > LOST, variance > 1e-6
    parts = along / (1.0 + variance)
    dof = many - int(lost.sum())
    if dof < 1:
        return None
    chi2 = max(total - np.sum(along - parts) - np.sum(parts[lost]), 0.0)
    tests = (chi2, dof), (np.sum(parts[shown & ~lost]), int(np.sum(shown & ~lost)))
    chances = [fdtrc(k, free or 1e12, x / k) for x, k in tests if k]
    return _Test(float(np.sqrt(chi2 / dof)), float(min(1.0, 2.0 * min(chances))))
