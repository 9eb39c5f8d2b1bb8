"""Describe the constant errors of sensors, such as an error of scale, that the intervals of a fit
allow for.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.considered import (
    Consideration,
    describe,
    sensor_slots,
)
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile
from rigidjax.identify.uncertainty.quantities import Quantity

# One sentence names at most this number of quantities.
MOST = 3
# A bias that a fit estimates is reported as large if it exceeds this fraction of the root mean
# square of the readings. In a record that is worth a fit, the bias of a real gyro is about a
# hundredth of the rates.
REMARKABLE = 0.2
# These words describe the two kinds of small constant errors of a sensor. The sizes of these
# errors, 1 % and 1°, are the numbers of `considered.USUAL`.
_WAYS = {
    "scale": "an error of 1 % in the scale of one axis",
    "cross_axis": "an axis that leans by 1°",
}

UsualShifts = Sequence[tuple[int, dict[str, Float[np.ndarray, " quantities"]]]]


def describe_allowed_sensor_errors(
    model: Model,
    considered_errors: tuple[Consideration, ...],
    usual_shifts: UsualShifts,
    quantities: Sequence[Quantity],
) -> str:
    """Return sentences on the sensor errors that the intervals of a fit allow for, and on the
    sensor errors that the intervals do not allow for.

    **Arguments:**

    - `model`: the fitted model.
    - `considered_errors`: the errors that the intervals allow for. They are the errors of the
      sensors with a `Tolerance`.
    - `usual_shifts`: for each sensor without a tolerance two things: the index of the sensor; and a
      dict of kind of error → shifts (q,), where a shift is the change of one of the q `quantities`
      that the error would cause. The kinds are "scale" (an error of 1 %) and "cross_axis" (an error
      of 1° between axes). The function `considered.usual_shifts` computes these
      shifts.
    - `quantities`: the q reported quantities that the sentences name.
    """
    out = []
    sensors = model.records.sensors
    if considered_errors:
        out.append(f"They allow for {describe(considered_errors, sensors)}.")
    for index, by_kind in usual_shifts:
        clauses = [
            f"{_WAYS[kind]} would move {_describe_quantity_shifts(quantities, shifts)}"
            for kind, shifts in by_kind.items()
        ]
        name = type(sensors[index]).__name__
        out.append(
            f"They do not allow for a {name} that is off: {'; '.join(clauses)}. Give its "
            f"tolerance, such as {name}(…, tolerance=Tolerance(scale=0.01, cross_axis=0.01))."
        )
    if not out:
        out.append("They do not allow for a sensor that is off.")
    return " ".join(out)


def describe_large_biases(model: Model, quantities: Sequence[Quantity]) -> str:
    """Describe each sensor bias that has no prior and that is large compared with the readings.

    Such a bias may stand for a part of the motion that the model lacks: in one fit the bias of a
    pendulum's gyro came out as 1.6 rad/s. The text is empty if there is no such bias.

    **Arguments:** `model` the fitted model; `quantities` the reported quantities of the fit, which
    hold the fitted biases.
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
    return " ".join(out)


def _describe_quantity_shifts(
    quantities: Sequence[Quantity], shifts: Float[np.ndarray, " quantities"]
) -> str:
    """Describe by how much each reported quantity would move if a sensor had a small constant
    error, such as an error of 1 % in the scale of one axis.

    The words are such as "I1 by 0.02 (interval ±0.1)". The number in brackets is half the width of
    the 95 % interval of the quantity; it is left out if it is not finite. Only the first `MOST`
    (three) quantities are named.

    **Arguments:**

    - `quantities`: the q reported quantities.
    - `shifts`: (q,) by how much each quantity moves: relative to its value if the quantity is
      positive (a moment, a mass), else in its unit.
    """
    words = []
    for quantity, shift in list(zip(quantities, shifts, strict=True))[:MOST]:
        unit = quantity.value if quantity.positive else 1.0
        half = float(student_quantile(0.95, quantity.freedom)) * quantity.deviation
        shown = f"{quantity.name} by {abs(unit) * shift:.2g}"
        words.append(f"{shown} (interval ±{half:.2g})" if np.isfinite(half) else shown)
    return ", ".join(words)
