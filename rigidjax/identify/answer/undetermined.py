"""Describe in words which numbers a fit leaves undetermined."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax.body.inertia import tensor_of
from rigidjax.identify.answer.answers import FAILS, NOT_ENDED
from rigidjax.identify.answer.parts import Assessment, BestPoint, Uncertainty
from rigidjax.identify.data.full_scale import describe_full_scale
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.charts import BASIS, COMPONENTS, Tensor, body_list
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.model import Model, parts_of, shortened
from rigidjax.identify.model.several import Part
from rigidjax.identify.search.stages import blocks_at
from rigidjax.identify.search.starts import rate_only
from rigidjax.identify.sensors import Gyro
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile
from rigidjax.identify.uncertainty.flat_limit import bodies_at
from rigidjax.identify.uncertainty.quantities import (
    Label,
    Quantity,
    labels,
    log_deviation,
    named_charts,
    quantity_vector,
    recording_suffixes,
    reports_starts,
    starting_labels,
)
from rigidjax.motion.manifold import minus, parts_by_name
from rigidjax.rotation import quaternion

# A number belongs to a combination if it changes by more than this fraction of the largest change.
PART = 1e-3
# In the elimination of a matrix the remaining rows count as zero if all of their entries are below
# this fraction of the largest entry of the matrix.
ROUND_OFF = 1e-5
# Several numbers change by the same factor if their relative changes differ by less than this
# fraction of the largest relative change.
EVEN = 0.01
# Readings change along a direction if a small step along it (of at most 0.01 in each parameter)
# moves all readings together by more than this number of standard deviations.
CHANGED = 0.01
# A step that tells a constant sum from a constant product changes each number by this fraction.
FAR = 0.3
# A sentence on a combination lists at most MOST numbers, and a report has sentences on at most
# SEVERAL combinations.
MOST, SEVERAL = 6, 5
# The unit of rates is in doubt if a body whose moments differ by less than the factor ALIKE turns
# faster than FAST, rad/s.
FAST, ALIKE = 10.0, 0.9


class Combination(eqx.Module):
    """Hold a combination of numbers that may change together without changing a reading.

    **Fields:**

    - `names`: the names of the numbers.
    - `changes`: a small change of each number.
    - `units`: the unit of each change, "" for a relative change.
    - `relative`: for each number, whether its change is relative.
    - `unseen_switch`: whether the readings change along the combination although the derivatives of
      the readings are zero. This happens if the combination moves the time or the state at which a
      torque switches.

    >>> Combination(("I1", "I2"), (0.01, 0.01), ("", ""), (True, True)).in_words
    'I1 and I2 rise together: only I1/I2 is determined.'
    >>> Combination(("Ωx", "bias x"), (0.1, -0.1), ("rad/s", "rad/s"), (False, False)).in_words
    'Ωx rises as bias x falls: only Ωx + bias x is determined.'
    >>> Combination(("Ωx", "bias x"), (0.1, 0.2), ("rad/s", "rad/s"), (False, False)).in_words
    'No reading changes where these change together: Ωx by +0.1 rad/s, bias x by +0.2 rad/s.'
    """

    names: tuple[str, ...] = eqx.field(static=True)
    changes: tuple[float, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    relative: tuple[bool, ...] = eqx.field(static=True)
    unseen_switch: bool = eqx.field(static=True, default=False)

    @property
    def in_words(self) -> str:
        """Describe in a sentence or two a combination of numbers that the data do not determine."""
        names, sizes = self.names, np.array(self.changes)
        if self.unseen_switch:
            return (
                f"Readings change with {' and '.join(names)}, but derivatives do not see it: a "
                "torque most likely switches there (jnp.where, jnp.sign), and no search moves it. "
                "For a time take torques.Pulses or jump_times of the law; for a state, an Event."
            )
        if len(names) == 1:
            name = names[0][0].upper() + names[0][1:]
            return f"{name} is not determined: no reading changes with it."
        # All numbers change by one factor, or all by one amount.
        alike = all(self.relative) or (not any(self.relative) and len(set(self.units)) == 1)
        even = alike and np.ptp(np.abs(sizes)) < EVEN * np.abs(sizes).max()
        if even and (sizes > 0).all():
            listed = f"{', '.join(names[:-1])} and {names[-1]}"
            apart, kind = ("/", "ratios") if self.relative[0] else (" − ", "differences")
            only = f"{names[0]}{apart}{names[1]} is" if len(names) == 2 else f"their {kind} are"
            return f"{listed} rise together: only {only} determined."
        if even and len(names) == 2:
            both = (" + ", "·")[self.relative[0]].join(names)
            return f"{names[0]} rises as {names[1]} falls: only {both} is determined."
        parts = []
        for name, size, unit, ratio in zip(names, sizes, self.units, self.relative, strict=True):
            size = f"{100 * size if ratio else size:+.2g}".replace("-", "−")
            parts.append(f"{name} by {size} {'%' if ratio else unit}".rstrip())
        more = "" if len(parts) <= MOST else f", and {len(parts) - MOST} more"
        return f"No reading changes where these change together: {', '.join(parts[:MOST])}{more}."


TENSOR = dict(zip(Tensor.plain_names, COMPONENTS, strict=True))


def undetermined_combinations(
    point: BestPoint, null_directions: Float[Array, "k n"]
) -> tuple[Combination, ...]:
    """Return the combinations of numbers that the data of a fit do not determine at all.

    Each combination is made of few numbers, and it has one number that no other combination has,
    because the combinations are the rows of a reduced row echelon form.
    """
    null, model = np.asarray(null_directions), point.model
    if not null.size:
        return ()
    best = basis = None
    values, slopes = _named_quantities_on_host(point)
    names, many = _labels(model), len(named_charts(model))
    first = len(labels(model))
    turns = sum("attitude about the body" in one.name for one in names)
    for other in (1, 0):
        # Compute the combinations twice, with changes of attitude about the axes of the world and
        # about the axes of the body: first leave out the rows of the body's axes, then the rows of
        # the world's axes. The combinations with fewer numbers are kept.
        begin = first + 6 * many + other * turns
        rows = np.delete(np.arange(len(names)), slice(begin, begin + turns))
        here, slope = [names[row] for row in rows], slopes[rows]
        # The parameters are of order one, so that the largest derivative of a reported number with
        # respect to them measures its size.
        size = np.abs(slope).max(axis=1)
        tensors = size[first : first + 6 * many].reshape(many, 6)
        tensors[:] = tensors.max(axis=1, keepdims=True)
        relative = np.array([one.positive for one in here])
        size = np.where(relative | (size == 0), 1.0, size)
        changes = null @ slope.T / size
        changes = np.where(_mask(point, [one.name for one in here], changes), changes, 0.0)
        echelon = _echelon(changes)
        if best is None or np.count_nonzero(echelon) < np.count_nonzero(best[0]):
            best, basis = (echelon, here, size, values[rows], slope), changes
    assert best is not None and basis is not None
    # Sort the combinations by the index of their first number: the order in which the elimination
    # returns the combinations depends on round-off.
    rows = sorted((row for row in best[0] if row.any()), key=lambda row: np.flatnonzero(row)[0])
    out = []
    for row in rows:
        direction = np.linalg.lstsq(basis.T, row)[0] @ null
        # The derivatives of the readings along `direction` are zero. The readings may change all
        # the same: where a torque switches at a time or a state that moves. Half the difference of
        # a step forwards and a step backwards shows it; readings that depend on the square of a
        # number change by the same in both.
        step, switch = 0.01 * direction / np.abs(direction).max(), False
        if model.torque is not None:
            switch = 0.5 * _change_of_readings(point, (step, -step)) > CHANGED
        echelon, here, size, value, slope = best
        order = np.flatnonzero(row)
        # The largest entry becomes a hundredth, and the first number rises.
        changes = 0.01 * np.sign(row[order[0]]) * row / np.abs(row).max() * size
        mine = [here[i] for i in order]
        one = Combination(
            tuple(label.name for label in mine),
            tuple(float(changes[i]) for i in order),
            tuple("" if label.positive else label.unit for label in mine),
            tuple(label.positive for label in mine),
            switch,
        )
        out.append(_by_one_factor(point, one, row, size, value, slope, direction))
    return tuple(out)


def _change_of_readings(point: BestPoint, steps: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the length, in standard deviations, of the difference of all predicted readings after
    two steps (n,) from the best point.
    """
    x = point.derivative_point
    after, before = (blocks_at(point.model, x + jnp.asarray(step, x.dtype))[0] for step in steps)
    parts = zip(after, before, point.noises, strict=True)
    return float(
        np.sqrt(sum(np.sum((np.asarray(a - b) / np.asarray(n)[:, None]) ** 2) for a, b, n in parts))
    )


def _by_one_factor(
    point: BestPoint,
    one: Combination,
    row: np.ndarray,
    size: np.ndarray,
    values: np.ndarray,
    slope: np.ndarray,
    direction: np.ndarray,
) -> Combination:
    """Return a combination with relative changes if all of its numbers change by the same factor.

    Near the best point a common factor and a common amount look alike if the numbers are equal in
    magnitude. Then large steps decide, from a point at which the first number alone is changed:
    along `direction` (n,) numbers of one unit change by equal amounts, which changes no reading
    only where a sum or a difference is all that readings show.
    """
    order = np.flatnonzero(row)
    relative, changes = np.array(one.relative), np.array(one.changes)
    here = np.where(values[order] == 0, np.inf, values[order])
    shares = np.where(relative, changes, changes / here)
    largest = np.abs(shares).max()
    if relative.all() or len(order) < 2 or not np.ptp(np.abs(shares)) < EVEN * largest:
        return one
    same_unit = not relative.any() and len(set(one.units)) == 1
    if same_unit and np.ptp(np.abs(changes)) < EVEN * np.abs(changes).max():
        # `direction` changes the numbers by `row * size`, this step each by `FAR` of itself.
        step = FAR * direction / np.abs(row[order] * size[order] / here).max()
        first = slope[order[0]]
        aside = -0.5 * FAR * values[order[0]] * first / (first @ first)
        if _change_of_readings(point, (aside + step, aside)) < CHANGED:
            return one
    return dataclasses.replace(
        one,
        changes=tuple(map(float, 0.01 * shares / (np.sign(shares[0]) * largest))),
        units=("",) * len(order),
        relative=(True,) * len(order),
    )


def _labels(model: Model) -> list[Label]:
    """Return what each number that a report may name is called.

    The reported quantities come first; then the components of the inertia tensors; and, without
    windows, initial attitudes (turns about the world's, then about the body's axes), positions and
    velocities. Changes of positive numbers are given as relative changes.
    """
    out = labels(model)
    for name, chart in named_charts(model):
        out += [Label(f"{part}{name}", chart.unit, False) for part in TENSOR]
    for part, name, unit in (
        ("q", "attitude about the world's", "rad"),
        ("q", "attitude about the body's", "rad"),
        ("x", "position", "m"),
        ("v", "velocity", "m/s"),
    ):
        every = zip(parts_of(model), recording_suffixes(model), strict=True)
        for one, suffixes in every:
            if hasattr(one.model.reference.state, part) and reports_starts(one.model):
                for where in suffixes:
                    out += [Label(f"the initial {name} {k}{where}", unit, False) for k in "xyz"]
    return out


def _named_quantities_on_host(point: BestPoint) -> FirstOrder:
    """Return all numbers that a report may name, in the order of `_labels`."""
    return FirstOrder(
        *map(np.asarray, _named_quantities(shortened(point.model), point.derivative_point))
    )


@eqx.filter_jit
def _named_quantities(model: Model, point: Float[Array, " n"]) -> FirstOrder:
    """Return the values at `point` of all quantities that a report may name, with their
    derivatives with respect to the parameters.

    An initial attitude is a rotation vector from that at `point`, once along the world's axes and
    once along the body's; an initial position or velocity is the difference from that of the
    reference state.
    """

    def initial_states(part: Part, x: Array) -> dict[str, Array]:
        index, reference = part.model.index, part.model.reference
        start, states = (
            jax.vmap(ReferenceStates.initial)(reference, part.take(y)[index.start])
            for y in (point, x)
        )
        one, numbers = jax.tree.map(lambda leaf: leaf[0], states), {}
        change = parts_by_name(one, jax.vmap(minus)(states, start))
        offset = parts_by_name(one, jax.vmap(minus)(states, reference.state))
        if "q" in change:
            numbers["world"] = jax.vmap(quaternion.rotate)(start.q, change["q"])
            numbers["body"] = change["q"]
        return numbers | {name: offset[name] for name in ("x", "v") if name in offset}

    def value(x: Array) -> Array:
        numbers = [quantity_vector(model, x)]
        for body in body_list(model.bodies(x)):
            tensor = tensor_of(body)
            numbers.append(jnp.stack([tensor[place] for place in TENSOR.values()]))
        kinds = [initial_states(p, x) for p in parts_of(model) if reports_starts(p.model)]
        for name in ("world", "body", "x", "v"):
            numbers += [kind[name] for kind in kinds if name in kind]
        return jnp.concatenate([part.reshape(-1) for part in numbers])

    return value_and_jacfwd(value, point)


def _mask(
    point: BestPoint, names: list[str], changes: Float[np.ndarray, "k M"]
) -> Bool[np.ndarray, " M"]:
    """Return a mask, true for each number that a report may name as undetermined.

    The moments and the tensor components of a body describe the same changes: the components are
    named if one of the undetermined `changes` turns the principal axes, else the moments.
    """
    rows = bodies_at(point.model, point.derivative_point)
    mask = np.ones(len(names), bool)
    for (where, chart), body in zip(named_charts(point.model), rows, strict=True):
        # A name of a tensor component may occur twice in `names`: a chart, which maps parameters
        # to a body, may report the components, and `_labels` adds them in any case. The last entry
        # with the name is the one added.
        every = [[i for i, one in enumerate(names) if one == f"{part}{where}"] for part in TENSOR]
        places = [some[-1] for some in every]
        mask[[i for some in every for i in some]] = False
        moments = [names.index(f"{log}{where}") for log in chart.log_names if log != "mass"]
        if moments:
            _, axes = np.linalg.eigh(np.asarray(tensor_of(body)))
            steps = np.einsum("mk,kij->mij", changes[:, places], BASIS)
            along = np.einsum("ia,kij,jb->kab", axes, steps, axes)
            across = np.abs(along - along * np.eye(3)).max()
            if across > PART * max(np.abs(along).max(), 1e-6):
                mask[moments], mask[places] = False, True
    return mask


def _echelon(rows: Float[np.ndarray, "k M"]) -> Float[np.ndarray, "_ M"]:
    """Return the reduced row echelon form of a matrix, by elimination with complete pivoting.

    Rows that are zero up to round-off are left out, and so are small entries of a row.
    """
    rows = np.array(rows)
    size, done = np.abs(rows).max(), 0
    while done < len(rows):
        i, j = np.unravel_index(np.argmax(np.abs(rows[done:])), rows[done:].shape)
        if np.abs(rows[done + i, j]) <= ROUND_OFF * size:
            break
        rows[[done, done + i]] = rows[[done + i, done]]
        rows[done] /= rows[done, j]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, j], rows[done])
        done += 1
    rows = rows[:done]
    return np.where(np.abs(rows) > PART * np.abs(rows).max(axis=1, keepdims=True), rows, 0.0)


def describe_identifiability(
    point: BestPoint,
    uncertainty: Uncertainty,
    assessment: Assessment,
    quantities: tuple[Quantity, ...],
) -> tuple[str, ...]:
    """Describe which quantities the data of a fit do not determine, and what they cannot show."""
    lost = assessment.explanation.word == FAILS
    if lost or assessment.search.word == NOT_ENDED:
        why = "does not explain the data" if lost else "did not end in a minimum"
        out = [
            f"This fit {why}, so it determines nothing: its numbers and intervals belong to the "
            "best point found, and say nothing about the body."
        ]
        # Undetermined directions are the likely reason why a search did not end: name them.
        out += [] if lost else _describe_combinations(point, uncertainty)
        return (*out, *describe_full_scale(point.model.records.readings))
    moments, first = [], 0
    for _, chart in named_charts(point.model):
        moments += quantities[first : first + len(chart.log_names)]
        first += len(chart.log_names) + len(chart.plain_names)
    # The ends of an interval of a logarithm with the half-width w are exp(±w) times the value.
    out = [
        f"{quantity.name} is not determined by these data."
        for quantity in moments
        if not _half_width(quantity) <= 1.5
    ]
    determined = np.asarray(uncertainty.determined)
    out += [
        f"A flat body{limit.where} fits as well: (I1 + I2 − I3)/I3 ≤ "
        f"{limit.flatness_upper_bound(determined):.2g} (95 %). Intervals end at the limit of real "
        "bodies."
        for limit in uncertainty.limits
        if limit.is_flat_within(
            determined, float(student_quantile(0.95, uncertainty.degrees_of_freedom(limit.slope)))
        )
    ]
    starts = quantities[first : first + len(starting_labels(point.model))]
    # A free body has three components of its initial body rate.
    rates = [quantity for quantity in starts if quantity.name.startswith("Ω")]
    if count := len(rates) // 3:
        size = np.array([(q.value, _half_width(q)) for q in rates]).reshape(-1, 3, 2)
        if not (size[..., 1].max(axis=1) < np.linalg.norm(size[..., 0], axis=1)).all():
            many = "rate is" if count == 1 else "rates are"
            out.append(f"The initial body {many} not determined by these data.")
    # A ratio whose interval is tiny beside another one that spans all possible values.
    wide = [(q, np.ptp(np.asarray(q.interval(0.95)))) for q in moments if "/" in q.name]
    tiny = [q for q, width in wide if width < 1e-4 * q.value]
    free = [q for q, width in wide if width > 0.5]
    out += [
        f"The interval of {one.name} is a thousandth of a per cent wide or less, that of "
        f"{free[0].name} spans most of what is possible: the fit lies at a limit of real bodies, "
        "and neither interval says much."
        for one in tiny[: len(free)]
    ]
    out += _describe_combinations(point, uncertainty)
    only_gyros = all(isinstance(sensor, Gyro) for sensor in point.model.records.sensors)
    if point.model.torque is None:
        out.append(
            "Free motion cannot show the absolute inertia, only ratios of moments; nor the mass or "
            "the centre of mass."
        )
        if only_gyros:
            out.append(
                "Rates of free motion with an axis mirrored or two axes swapped fit another body "
                "as well: they cannot show such a mistake. Nor do they show rates in the world's "
                "axes if two moments are alike, or rates in deg/s read as rad/s if all are."
            )
            out += _describe_near_ball(point)
    elif only_gyros and rate_only(point.model.torque) and "kg m²" in {q.unit for q in moments}:
        out.append(
            "All moments are in proportion to the torque: rates cannot show that it is wrong by a "
            "factor, as of a wheel counted twice."
        )
    out += describe_full_scale(point.model.records.readings)
    return tuple(out)


def _describe_near_ball(point: BestPoint) -> list[str]:
    """Describe a free body that is nearly a ball and turns so fast that its unit is in doubt."""
    rate = float(np.max(np.asarray(point.model.reference.rate)))
    bodies = body_list(point.model.bodies(point.x))
    moments = np.linalg.eigvalsh(np.stack([np.asarray(tensor_of(body)) for body in bodies]))
    if rate < FAST or (moments[:, 0] < ALIKE * moments[:, -1]).any():
        return []
    return [
        f"Nearly a ball, at {rate:.2g} rad/s: so look rates in deg/s that were read as rad/s. "
        "Check the unit of the rates."
    ]


def _half_width(quantity: Quantity) -> float:
    """Return half the width of the 95 % interval of a quantity, or of its logarithm if positive."""
    return float(student_quantile(0.95, quantity.freedom)) * log_deviation(quantity)


def _describe_combinations(point: BestPoint, uncertainty: Uncertainty) -> list[str]:
    """Describe, each in a sentence, at most `SEVERAL` combinations that are not determined."""
    combinations = undetermined_combinations(point, uncertainty.null_directions)
    if not combinations:
        return []
    out = []
    if _scale_is_free(point, uncertainty):
        out.append("The data determine the inertia only up to scale.")
    out += [one.in_words for one in combinations[:SEVERAL]]
    if len(combinations) > SEVERAL:
        more = len(combinations) - SEVERAL
        out.append(f"{more} more combinations of numbers are not determined.")
    out.append("Intervals of quantities that depend on these are infinite.")
    return out


def _scale_is_free(point: BestPoint, uncertainty: Uncertainty) -> bool:
    """Return whether a change along undetermined directions multiplies all components of the tensor
    by one factor; false for several bodies.
    """
    null = np.asarray(uncertainty.null_directions)
    if not len(null) or point.model.body_indices is not None:
        return False
    first = len(labels(point.model))
    values, slopes = _named_quantities_on_host(point)
    here, moved = values[first : first + 6], slopes[first : first + 6] @ null.T
    wanted, *_ = np.linalg.lstsq(moved, here, rcond=None)
    return bool(np.linalg.norm(moved @ wanted - here) < 1e-3 * np.linalg.norm(here))
