"""Select the terms of a model that its recordings ask for."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rigidjax import _checks
from rigidjax.body.inertia import tensor_of
from rigidjax.identify.answer.answers import NOT_ENDED
from rigidjax.identify.answer.fit import fit
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.inference.compare import criterion
from rigidjax.identify.model.build import Extended, extended
from rigidjax.identify.model.charts import body_list
from rigidjax.identify.model.free import Free, Slot
from rigidjax.identify.model.model import Model, require_one_kind
from rigidjax.identify.model.scene import Scene
from rigidjax.identify.model.widened import with_slots, with_torques
from rigidjax.identify.sensors.vectors import VectorSensor
from rigidjax.identify.uncertainty.covariance import Linearisation, owners
from rigidjax.motion import Attitude, Rigid
from rigidjax.motion.torques import (
    ConstantTorque,
    Damping,
    Flywheel,
    InSpace,
    QuadraticDamping,
)
from rigidjax.motion.torques.composite import parts_of

# A term that is left out is held at its starting value by a prior of this deviation, and a term
# that is in has a prior of one over it, in units of its scale: so all subsets of the terms share
# one compiled program.
HELD = 1e-9
# So many of the changes that promise most to first order are fitted in a round.
TRIED = 3
# A new set of terms may not predict held-out readings with errors larger by this factor.
WORSE = 1.05
# Sets of terms do nearly as well if their criteria differ by less: the odds are below e³ = 20.
ALIKE = 6.0


class Step(eqx.Module):
    """Hold one step of a selection.

    **Fields:**

    - `terms`: the names of the terms after this step.
    - `gain`: the fall of the criterion by this step; 10 and more is strong evidence.
    - `rms`: the root mean square error of each sensor, in its unit.
    - `held_out`: that of the readings which a fit of the rest predicts, as in `Fit.held_out`; empty
      if the search did not end.

    >>> Step(("drag",), 25.0, (0.1,), (0.11,)).terms
    ('drag',)
    """

    terms: tuple[str, ...]
    gain: float
    rms: tuple[float, ...]
    held_out: tuple[float, ...]


class Selection(eqx.Module):
    """Hold the terms that recordings ask for, and the fit with these terms.

    **Fields:**

    - `terms`: the names of the selected terms.
    - `fit`: the fit of the model with these terms free, all others at their starting values.
    - `path`: a `Step` for each round, the first one without terms.
    - `alternatives`: for each selected term the names of terms that do as well in its place.

    >>> Selection(("drag",), None, (Step((), 0.0, (0.2,), ()),), {"drag": ()}).terms
    ('drag',)
    """

    terms: tuple[str, ...]
    fit: Any
    path: tuple[Step, ...]
    alternatives: dict[str, tuple[str, ...]]

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [("terms", "criterion", "errors", "held out")]
        for step in self.path:
            sizes = (", ".join(f"{x:.4g}" for x in some) for some in (step.rms, step.held_out))
            rows.append((" + ".join(step.terms) or "none", f"{-step.gain:+.4g}", *sizes))
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, wide)).rstrip() for row in rows]
        for name, others in self.alternatives.items():
            if others:
                lines.append(f"The data do not tell {name} from {' or '.join(others)}.")
        return "\n".join(lines)


class Candidates(NamedTuple):
    """Hold a model with terms that are switched off, and by name the `Free` that sets one free.

    >>> Candidates(None, {}).terms
    {}
    """

    model: Any
    terms: dict[str, Free]


def usual_terms(model: Model) -> Candidates:
    """Return a `model` with the terms for which records of a body most often ask, switched off.

    The torques are linear and quadratic drag, a constant torque, a wheel of constant speed and, if
    the model follows the attitude, a torque that is constant in space. A sensor of vectors has a
    bias and a scale, and a clock offset beside other sensors, with priors unless the sensor has a
    tolerance: a tenth of the readings, 5 %, and 0.1 s. A term that the model has is left out.

    **Arguments:** `model` the model to which the terms are added. **Returns** `Candidates` with the
    fields `model` and `terms`. **Raises** `TypeError` unless `model` is a `Model`, and `ValueError`
    for a model of several kinds of recordings.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> list(usual_terms(rj.identify.Model(record, rj.identify.Ratios())).terms)
    ['linear drag', 'quadratic drag', 'constant torque', 'wheel', 'Gyro bias', 'Gyro scale']
    """
    _checks.require_instance(model, Model, "usual_terms", requirement="a Model")
    require_one_kind(model, "usual_terms")
    t, rate, zero = np.asarray(model.records.t), float(model.typical_rate), np.zeros(3)
    body: Any = body_list(model.bodies(model.start()))[0]
    length, moment = float(np.max(t[:, -1] - t[:, 0])), float(jnp.trace(tensor_of(body))) / 3
    laws = {
        "linear drag": (Damping(zero), "coefficient", moment / length),
        "quadratic drag": (QuadraticDamping(zero), "coefficient", moment / length / rate),
        "constant torque": (ConstantTorque(zero), "torque", moment * rate / length),
        "wheel": (Flywheel(zero), "momentum", moment * rate),
    }
    if model.state_kind in (Attitude, Rigid):
        laws["torque in space"] = (InSpace(zero), "torque", moment * rate / length)
    old = tuple(map(type, parts_of(model.torque)))
    laws = {name: law for name, law in laws.items() if not isinstance(law[0], old)}
    first = 0 if model.torque is None else 1
    terms = {
        name: Free(partial(_part, place, field), name, scale=scale)
        for place, (name, (_, field, scale)) in enumerate(laws.items(), first)
    }
    records = model.records
    for index, sensor in enumerate(records.sensors):
        if not isinstance(sensor, VectorSensor):
            continue
        size = float(np.sqrt(np.mean(np.asarray(records.readings[index].values) ** 2)))
        errors = {"bias": (jnp.zeros(3), 0.1 * size), "scale": (jnp.ones(3), 0.05)}
        if len(records.sensors) > 1:
            errors["offset"] = (jnp.zeros(()), 0.01)
        for field, (value, scale) in errors.items():
            if getattr(sensor, field) is not None:
                continue
            place = partial(_sensor_field, index, field)
            each = jnp.broadcast_to(value, (model.count, *value.shape))
            records = eqx.tree_at(
                lambda r, index=index, field=field: getattr(r.readings[index].sensor, field),
                records, each, is_leaf=lambda node: node is None,
            )  # fmt: skip
            name = f"{type(sensor).__name__} {'clock' if field == 'offset' else field}"
            alike = [type(one) for one in records.sensors].count(type(sensor))
            name += f" {index}" if alike > 1 else ""
            # Without a prior, errors of sensors run away where the motion explains as much.
            prior = 10 * scale if field == "offset" else scale
            prior = prior if sensor.tolerance is None else None
            terms[name] = Free(place, name, scale=scale, prior=prior)
    wider = with_torques(model, [law for law, *_ in laws.values()]) if laws else model
    return Candidates(dataclasses.replace(wider, records=records), terms)


def _part(place: int, field: str, scene: Scene) -> Any:
    torque: Any = scene.torque
    return getattr(torque.parts[place], field)


def _sensor_field(index: int, field: str, scene: Scene) -> Any:
    return getattr(scene.sensors[index], field)


def select(
    model: Model,
    candidates: Mapping[str, Free | Sequence[Free]] | None = None,
    *,
    starts: int = 8,
    key: PRNGKeyArray | None = None,
) -> Selection:
    """Select the terms of a model for which its recordings ask, and fit the model with these terms.

    The first two fits have no term and all terms. Each round starts from the best fit so far. It
    computes to first order (a score test: Rao 1948, doi:10.1017/S0305004100023987) the effect of
    one term more, one less, or one in the place of one or two, and fits the sets of terms that
    promise most and all with one term less. The best fit is that of the least extended Bayesian
    information criterion `Σ Nₛ log s² + p log N + 2 k log K` for k of K candidates with p
    parameters (Chen and Chen 2008, doi:10.1093/biomet/asn034; Nₛ, s and N as for `compare`); a new
    set of terms must also predict the readings that a fit of the rest has not seen, with errors
    at most 5 % larger, and its search must have ended. The selection ends after a round without a
    new set.

    **Arguments:**

    - `model`: a model whose torques and sensors contain all terms, with the starting values that
      switch them off, such as zero coefficients. What it has free stays free.
    - `candidates`: for each term by name the `Free`, or a sequence of `Free`s, that it sets free;
      `None` for those of `usual_terms`, which adds them to the model.
    - `starts`, `key`: as for `fit`, for the fit without terms and for the last one.

    **Returns** a `Selection` with `terms`, `fit`, `path` and `alternatives`. **Raises**
    `ValueError` for no candidates and for a model of several kinds of recordings.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> select(rj.identify.Model(record, rj.identify.Ratios()), {})
    Traceback (most recent call last):
    ValueError: candidates: wanted one or more terms, got none
    """
    _checks.require_instance(model, Model, "select", requirement="a Model")
    require_one_kind(model, "select")
    if candidates is None:
        model, candidates = usual_terms(model)
    _checks.require_instance(candidates, Mapping, "candidates", requirement="Frees by name")
    if not candidates:
        raise ValueError("candidates: wanted one or more terms, got none")
    groups = {n: [one] if isinstance(one, Free) else list(one) for n, one in candidates.items()}
    free = [one for group in groups.values() for one in group]
    of_term = {name: [one.name for one in group] for name, group in groups.items()}
    terms = _Terms(model, with_slots(model, free), of_term)
    none, every = frozenset[str](), frozenset(groups)
    trials = {one: fit(terms.held(one), starts=starts, key=key) for one in (none, every)}
    best, path = none, [Step((), 0.0, trials[none].rms, _held_out(trials[none]))]
    while True:
        correlation = max(min(trial.correlation for trial in trials.values()), 1.0)
        found = {one: terms.criterion(trial, one, correlation) for one, trial in trials.items()}
        before = _held_out(trials[best])
        for one, trial in trials.items():
            after = _held_out(trial)
            # Too few readings to hold some out are no reason against a set.
            worse = before and (not after or _mean_ratio(after, before) > WORSE)
            if one != best and (worse or trial.search.word == NOT_ENDED):
                found[one] = math.inf
        least = min(found, key=lambda one: found[one])
        if least != best:
            sizes = trials[least].rms, _held_out(trials[least])
            path.append(Step(terms.names(least), found[best] - found[least], *sizes))
        best, new = least, set()
        # The fit of all terms, which may run away together in it, is a place to start from.
        for source in (every, best):
            first_order, goal = terms.first_order(trials[source], correlation), source
            while (ahead := min([goal, *terms.neighbours(goal)], key=first_order)) != goal:
                goal = ahead
            new.add(goal)
        # First order fails where terms are hard to tell apart, so that a term less is always tried,
        # and what seems to do nearly as well.
        near = sorted(set(terms.neighbours(best)) - {*trials}, key=first_order)[:TRIED]
        new |= {one for one in near if first_order(one) < first_order(best) + ALIKE}
        new |= {best - {name} for name in best}
        new = sorted(new - {*trials}, key=first_order)
        if not new:
            break
        trials |= {one: fit(terms.held(one), starts=2, initial=trials[best].x) for one in new}
    alternatives = {
        name: terms.names(
            {
                other
                for other in set(groups) - best
                if first_order(best - {name} | {other}) < first_order(best) + ALIKE
            }
        )
        for name in terms.names(best)
    }
    last = terms.only(best, trials[best].x)
    result = fit(last.model, starts=starts, initial=last.x, key=key)
    return Selection(terms.names(best), result, tuple(path), alternatives)


def _held_out(trial: Fit) -> tuple[float, ...]:
    pairs = () if trial.held_out is None else trial.held_out.pairs
    return tuple(pair.held_out for pair in pairs)


def _mean_ratio(after: Sequence[float], before: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(np.array(after) / before))))


class _Point(NamedTuple):
    model: Model
    x: Float[Array, " n"]


class _Terms(NamedTuple):
    """Hold a model, and the same model with the slots of all candidate terms."""

    model: Model
    wide: Extended
    of_term: dict[str, list[str]]  # the names of the slots of each term

    @property
    def slots(self) -> tuple[Slot, ...]:
        """Return the slots of all terms."""
        return self.wide.model.slots[len(self.model.slots) :]

    @property
    def places(self) -> dict[str, Int[np.ndarray, " k"]]:
        """Return the places of each slot among the parameters of the model with all terms."""
        both = {slot.name: (slot.shared, slot.own) for slot in self.slots}
        return {
            name: np.concatenate([np.ravel(part) for part in parts if part is not None])
            for name, parts in both.items()
        }

    def names(self, terms: Collection[str]) -> tuple[str, ...]:
        """Return the `terms` in the order in which they were given."""
        return tuple(name for name in self.of_term if name in terms)

    def inside(self, terms: Collection[str]) -> list[str]:
        """Return the names of the slots of the `terms`."""
        return [slot for name in self.names(terms) for slot in self.of_term[name]]

    def neighbours(self, terms: frozenset[str]) -> list[frozenset[str]]:
        """Return the sets with one term more, one less, or one in the place of one or two."""
        rest = [name for name in self.of_term if name not in terms]
        less = [terms - {name} for name in terms]
        few = {one - {name} for one in less for name in one}
        return [one | {name} for one in (terms, *less, *few) for name in rest] + less

    def held(self, terms: frozenset[str]) -> Model:
        """Return the model with all slots, where those of other terms hardly move."""
        inside, held = self.inside(terms), list(self.wide.model.slots[: len(self.model.slots)])
        for slot in self.slots:
            prior = 1.0 / HELD if slot.prior is None else slot.prior
            prior = jnp.asarray(prior if slot.name in inside else HELD)
            held.append(dataclasses.replace(slot, prior=prior))
        return dataclasses.replace(self.wide.model, slots=tuple(held))

    def only(self, terms: frozenset[str], x: Float[Array, " n"]) -> _Point:
        """Return the model without the slots of other terms, and its parameters at the point x of
        the model with all slots.
        """
        inside = self.inside(terms)
        new = [slot for slot in self.slots if slot.name in inside]
        last, places = extended(self.model, new)
        out = jnp.zeros(last.size, x.dtype).at[places].set(x[self.wide.places])
        for before, after in zip(new, last.slots[len(self.model.slots) :], strict=True):
            for there, here in ((before.shared, after.shared), (before.own, after.own)):
                out = out if here is None else out.at[here].set(x[there])
        return _Point(last, out)

    def criterion(self, trial: Fit, terms: frozenset[str], correlation: float) -> float:
        """Return the criterion of the fit `trial`, if one in `correlation` readings is
        independent.
        """
        inside = self.inside(terms)
        held = sum(where.size for name, where in self.places.items() if name not in inside)
        choices = 2.0 * len(terms) * math.log(len(self.of_term))
        return criterion(trial, trial.x.size - held, correlation) + choices

    def first_order(self, trial: Fit, correlation: float) -> Callable[[frozenset[str]], float]:
        """Return the criterion to first order about the fit `trial`, a function of the terms."""
        linear: Any = trial.linear
        x, weights = np.asarray(trial.x), np.array(linear.prior_weights)
        for slot in self.slots:
            prior = 0.0 if slot.prior is None else 1.0 / float(slot.prior)
            weights[self.places[slot.name]] = prior
        linear = dataclasses.replace(linear, prior_weights=weights, prior_residuals=weights * x)
        of_terms = np.concatenate(list(self.places.values()))
        kept = owners(linear) < 0
        kept[of_terms] = True
        rows = _reduced(linear, kept)
        # The residuals with all terms at their starting values.
        shift = np.zeros(x.size)
        shift[of_terms] = x[of_terms]
        left = rows[:, -1] - rows[:, :-1] @ shift[kept]
        many = sum(int(mask.sum()) for mask in linear.mask) / correlation

        def value(terms: frozenset[str]) -> float:
            use = kept.copy()
            use[of_terms] = False
            inside = [self.places[name] for name in self.inside(terms)]
            use[np.concatenate([np.zeros(0, int), *inside])] = True
            part = rows[:, :-1][:, use[kept]]
            size = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
            rest = left - part @ (np.linalg.lstsq(part / size, left, rcond=1e-10)[0] / size)
            cost = sum(where.size for where in inside) * math.log(many)
            cost += 2.0 * len(terms) * math.log(len(self.of_term))
            return many * math.log(rest @ rest + 1e-300) + cost

        return value


def _reduced(linear: Linearisation, kept: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "q _"]:
    """Return the derivatives of all residuals with respect to the `kept` parameters, and in a last
    column the residuals, after the elimination of the other parameters, each of one recording.
    """
    n = kept.size
    both = np.dstack([linear.weighted_jacobian, linear.weighted_residuals])
    triangles, wanted = np.linalg.qr(both, mode="r"), np.append(np.flatnonzero(kept), n + 1)
    whole = np.zeros((n + len(linear.extra), n + 2))
    whole[np.arange(n), np.arange(n)] = linear.prior_weights
    whole[:n, -1] = linear.prior_residuals
    whole[n:, :n], whole[n:, -1] = linear.extra_slopes, linear.extra
    out, alone = [], np.append(~kept, [False, False])
    for triangle, columns in zip(triangles, linear.places, strict=True):
        rows = np.zeros((len(triangle), n + 2))
        rows[:, columns], rows[:, -1] = triangle[:, :-1], triangle[:, -1]
        mine = np.flatnonzero(alone & (rows != 0).any(axis=0))
        priors = whole[:n][mine]
        rows = np.concatenate([rows, priors])
        range_ = np.linalg.qr(rows[:, mine])[0]
        rows = rows[:, wanted]
        out.append(np.linalg.qr(rows - range_ @ (range_.T @ rows), mode="r"))
    rest = np.concatenate([whole[:n][kept], whole[n:]])[:, wanted]
    return np.linalg.qr(np.concatenate([*out, rest]), mode="r")
