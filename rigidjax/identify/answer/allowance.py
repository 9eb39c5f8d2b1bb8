"""Describe the constant errors of sensors, such as an error of scale, that the intervals of a fit
allow for.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rigidjax.identify.data import stacking
from rigidjax.identify.model.free import split_path
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.sensors import Gyro
from rigidjax.identify.uncertainty import considered
from rigidjax.identify.uncertainty.considered import (
    Consideration,
    sensor_slots,
    unit_shifts,
)
from rigidjax.identify.uncertainty.covariance import Linearisation
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile
from rigidjax.identify.uncertainty.quantities import Quantity, log_deviation, named_charts
from rigidjax.motion.torques import Damping, QuadraticDamping, Rotors
from rigidjax.motion.torques.forces import rotors_of
from rigidjax.motion.torques.inputs import input_names_of
from rigidjax.motion.torques.states import has_own_states

# One sentence names at most this number of quantities.
MOST = 3
# A bias that a fit estimates is reported as large if it exceeds this fraction of the root mean
# square of the readings. In a record that is worth a fit, the bias of a real gyro is about a
# hundredth of the rates.
REMARKABLE = 0.2
# A status has a condition on the bias of a gyro if this fraction of the readings' root mean square
# would move a moment by half its interval.
USUAL_BIAS = 0.03
# No tip of a propeller is faster than sound, m/s, and its radius is at most half the distance
# between two rotors. Speeds of hover in rpm, read as rad/s, move the tips at 500 m/s and more.
FASTEST_TIP = 400.0
# These words describe the two kinds of small constant errors of a sensor. The sizes of these
# errors, 1 % and 1°, are the numbers of `considered.USUAL`.
_WAYS = {
    "scale": "an error of 1 % in the scale of one axis",
    "cross_axis": "an axis that leans by 1°",
}


class Allowance(NamedTuple):
    """Hold what the intervals of a fit allow for."""

    words: str  # sentences on the constant errors of sensors
    condition: str  # under which the intervals are right, such as "if the Gyro is right to 0.1 %"


def describe_allowed(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: Float[np.ndarray, "n n"],
    considered_errors: tuple[Consideration, ...],
    quantities: Sequence[Quantity],
    slopes: Float[np.ndarray, "_ n"],
) -> Allowance:
    """Return sentences on the constant sensor errors that the intervals of a fit allow for, and
    the condition under which the intervals are right.

    For a sensor without a `Tolerance` they say how far a small error would move moments of bodies
    or, without these, the values of `Free`s. The `covariance` is that for white errors; `slopes`
    are the derivatives of the quantities, perhaps with more rows at the end.
    """
    bodies = {log + name for name, chart in named_charts(model) for log in chart.log_names}
    free, out, shifts = {slot.name for slot in model.slots}, [], []
    rows = [i for i, one in enumerate(quantities) if one.name in bodies and one.name != "mass"]
    rows = rows or [i for i, one in enumerate(quantities) if one.name.split(" ")[0] in free]
    rows = [i for i in rows if np.isfinite(quantities[i].deviation)]
    if rows and np.isfinite(linear.weighted_jacobian).all() and np.isfinite(covariance).all():
        shifts = considered.usual_shifts(model, linear, noise, covariance, slopes[rows])
    sensors = model.records.sensors
    if considered_errors:
        out.append(f"They allow for {considered.describe(considered_errors, sensors)}.")
    halves = [
        float(student_quantile(0.95, one.freedom)) * log_deviation(one)
        for one in (quantities[i] for i in rows)
    ]
    conditions = []
    for index, by_kind in shifts:
        clauses = []
        name, own = type(sensors[index]).__name__, []
        # The errors of scale and bias that would move a quantity by half its interval.
        scale = 0.01 * np.min(np.divide(halves, by_kind.get("scale", 0.0) + 1e-300))
        if scale < considered.USUAL["scale"]:
            own.append(f"the {name} is right to {100 * scale:.1g} %")
        if isinstance(sensors[index], Gyro) and not sensor_slots(model, index, "bias"):
            one = unit_shifts(model, linear, noise, covariance, index, "bias")
            bias = np.min(np.divide(halves, np.abs(slopes[rows] @ one).max(axis=1) + 1e-300))
            reading = model.records.readings[index]
            size = np.sqrt(np.mean(np.asarray(reading.values)[reading.host_mask] ** 2))
            if bias < USUAL_BIAS * size:
                whose = "its bias" if own else f"the {name}'s bias is"
                own.append(f"{whose} below {bias:.1g} {reading.sensor.unit}")
        conditions += [" and ".join(own)] if own else []
        for kind, sizes in by_kind.items():
            words = []
            for quantity, shift in zip((quantities[i] for i in rows[:MOST]), sizes, strict=False):
                # A shift of a positive quantity is relative to its value.
                unit = quantity.value if quantity.positive else 1.0
                half = float(student_quantile(0.95, quantity.freedom)) * quantity.deviation
                shown = f"{quantity.name} by {abs(unit) * shift:.2g}"
                words.append(f"{shown} (interval ±{half:.2g})" if np.isfinite(half) else shown)
            clauses.append(f"{_WAYS[kind]} would move {', '.join(words)}")
        out.append(
            f"They do not allow for a {name} that is off: {'; '.join(clauses)}. Give its "
            f"tolerance, such as {name}(…, tolerance=Tolerance(scale=0.01, cross_axis=0.01))."
        )
    words = " ".join(out) or "They do not allow for a sensor that is off."
    conditions += ["the speeds of the rotors are in rad/s, not rpm"] if _in_rpm(model) else []
    condition = " and ".join(dict.fromkeys(conditions))
    return Allowance(words, f"if {condition}" if condition else "")


def _in_rpm(model: Model) -> bool:
    """Return whether logged speeds of rotors are more likely rpm: in rad/s the tips would be faster
    than sound.
    """
    for one in stacking.kinds_of(model):
        for rotors in rotors_of(one.torque):
            places = np.asarray(rotors.positions)
            apart = np.linalg.norm(places[:, None] - places, axis=-1)
            radius = 0.5 * apart.min(initial=np.inf, where=apart > 0)
            # Commands, which a motor follows with a lag, may have any unit.
            names = () if has_own_states(rotors.speeds) else input_names_of(rotors.speeds)
            logs = (one.records.inputs[name] for name in names)
            logs = (getattr(log, "values", 0.0 if callable(log) else log) for log in logs)
            if any(FASTEST_TIP < radius * np.abs(log).max() < np.inf for log in logs):
                return True
    return False


def describe_doubtful(model: Model, quantities: Sequence[Quantity]) -> str:
    """Describe each sensor bias without a prior that is large compared with the readings, and each
    damping, or number of rotors, below zero.

    Such a bias may stand for a part of the motion that the model lacks: in one fit the bias of a
    pendulum's gyro came out as 1.6 rad/s.
    """
    out = []
    slots = [
        (slot, reading)
        for index, reading in enumerate(model.records.readings)
        for slot in sensor_slots(model, index, "bias")
        if slot.prior is None
    ]
    for slot, reading in slots:
        largest = max(
            (abs(one.value) for one in quantities if f"{one.name} ".startswith(f"{slot.name} ")),
            default=0.0,
        )
        rows = np.asarray(reading.values)[reading.host_mask]
        size = float(np.sqrt(np.mean(np.sum(rows.reshape(len(rows), -1) ** 2, axis=1))))
        if largest > REMARKABLE * size:
            out.append(
                f"{slot.name!r}, a bias without a prior, came out as {largest:.2g} "
                f"{reading.sensor.unit}, {100 * largest / size:.0f} % of the readings: it may "
                "stand for a part of the motion that the model lacks. Give what is known of it, "
                "such as Free(…, prior=…)."
            )
    for slot in model.slots:
        holder, (leaf, _) = model.torque, split_path(slot.path)
        if slot.path[0].name != "torque":
            continue
        for key in leaf[1:-1]:
            holder = getattr(holder, key.name) if hasattr(key, "name") else holder[key.idx]
        mine = [q.value for q in quantities if f"{q.name} ".startswith(f"{slot.name} ")]
        if isinstance(holder, Damping | QuadraticDamping) and min(mine, default=0.0) < 0:
            out.append(
                f"{slot.name!r}, a damping, came out as {min(mine):.2g}: below zero it would drive "
                "the motion. Something else stands behind it, or it is zero within its interval."
            )
        # The places of rotors may be below zero; thrust, drag and inertia may not.
        least = 0.0 if leaf[-1].name == "positions" else min(mine, default=0.0)
        if isinstance(holder, Rotors) and least < 0:
            out.append(
                f"{slot.name!r}, of rotors, came out as {least:.2g}: it is below zero if the "
                "spins are wrong, or zero within its interval."
            )
    return " ".join(out)
