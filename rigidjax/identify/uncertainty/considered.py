"""Compute the effect of considered errors on a fit.

A considered error is a constant error of a sensor, such as an error of scale, that a fit does not
estimate, but that its covariance allows for.

Sources: Schmidt 1966, Application of state-space methods to navigation problems; Bierman 1977,
Factorization Methods for Discrete Sequential Estimation, ch. VIII; Tapley, Schutz and Born 2004,
Statistical Orbit Determination, ch. 6.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from rigidjax.identify.model.free import TOLERANCES, Slot, split_path
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import Noise, scaled_slopes
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.identify.sensors.vectors import VectorSensor
from rigidjax.identify.uncertainty.covariance import Linearisation

# A report states the effect of errors of this size for a sensor of unknown tolerance: an error of
# the scale of 1 %, and of the angle between two axes of 1°.
USUAL = {"scale": 0.01, "cross_axis": float(np.radians(1.0))}
# This maps the name of each field of `Tolerance` to the name of the sensor's attribute whose error
# the field limits.
MEMBERS = {tolerance: member for member, tolerance in TOLERANCES.items()}
_OFF_DIAGONAL = [(i, j) for i in range(3) for j in range(3) if i != j]


class Consideration(eqx.Module):
    """Hold a constant error that a sensor may have, and its effect on a fit.

    The fit does not estimate the error, but its intervals allow for it. A `Tolerance` of the sensor
    gives the standard deviation of the error.

    **Fields:**

    - `sensor`: the index of the sensor.
    - `kind`: the name of the error, which is the name of a field of `Tolerance`: "scale",
      "cross_axis", "bias" or "clock".
    - `deviation`: the standard deviation of the error.
    - `shifts`: (n, c) for each of c independent components of the error the changes of the n free
      numbers if this component is one standard deviation. The components are three scales, six
      pairs of axes, three biases, or one clock offset.

    >>> t = jnp.linspace(0.0, 2.0, 41)
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> rates = rj.simulate(body, rj.Spin([1.0, 2.0, 3.0]), t).ys.omega
    >>> gyro = rj.identify.Gyro(0.01, tolerance=rj.identify.Tolerance(scale=0.01))
    >>> record = rj.identify.Recording(t, (gyro, rates))
    >>> result = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)
    >>> [(part.kind, part.deviation, part.shifts.shape) for part in result.considered]
    [('scale', 0.01, (5, 3))]
    """

    sensor: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    deviation: float
    shifts: np.ndarray


def compute_considered_errors(
    model: Model, linear: Linearisation, noise: Noise, covariance: np.ndarray
) -> tuple[Consideration, ...]:
    """Return the considered errors of all sensors. Each one holds the changes of the free numbers
    that it causes.

    A considered error is a constant error that a sensor may have within its `Tolerance`, and that
    no `Free` of the model estimates.

    **Arguments:**

    - `model`: the fitted model with n free numbers.
    - `linear`: the errors of the readings at the best point, with their derivatives.
    - `noise`: the standard deviations of the noise of the sensors.
    - `covariance`: (n, n) the covariance of the free numbers for white errors, within the
      directions that the data determine.
    """
    out = []
    for index, sensor in enumerate(model.records.sensors):
        tolerance = getattr(sensor, "tolerance", None)
        for kind, member in MEMBERS.items():
            width = getattr(tolerance, kind, None)
            some = [split_path(one.path)[1] for one in slots_of_sensor(model, index, member)]
            if width is None or None in some:
                continue
            # The tolerance of one sensor may differ between recordings. The largest tolerance is
            # used.
            deviation = float(np.max(np.asarray(width)))
            shifts = deviation * shifts_by_unit_errors(
                model, linear, noise, covariance, index, kind
            )
            # Entries that a `Free` estimates by itself are not considered once more. The three
            # entries of a skew are these of the six errors of the axes.
            columns = np.array([0, 1, 3] if kind == "cross_axis" else [0, 1, 2])
            shifts[:, [columns[i] for part in some if part for i in part.places]] = 0.0
            out.append(Consideration(index, kind, deviation, shifts))
    return tuple(out)


def slots_of_sensor(model: Model, sensor_index: int, member: str) -> list[Slot]:
    """Return the slots of one attribute of a sensor, such as "bias": several if a fit estimates
    entries of it by themselves, and none if a fit does not estimate it.
    """

    def names(slot: Slot) -> tuple[Any, ...]:
        path, _ = split_path(slot.path)
        return tuple(getattr(key, "name", getattr(key, "idx", None)) for key in path)

    return [slot for slot in model.slots if names(slot) == ("sensors", sensor_index, member)]


def shifts_by_unit_errors(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: np.ndarray,
    sensor_index: int,
    error_kind: str,
) -> Float[np.ndarray, "n ways"]:
    """Return the changes (n, c) of the n free numbers of a fit if a sensor has a unit error of the
    kind `error_kind`.

    A unit error with c components changes the readings of the sensor by D, an array (R, T, k, c)
    for R recordings, T times and k components of a reading. The change D of the readings changes
    the least-squares solution by `−H⁻¹ Jᵀ W D`. Here J holds the derivatives of the errors of the
    readings with respect to the free numbers, and W holds the weights of the readings.

    **Arguments:**

    - `model`: the fitted model.
    - `linear`: the errors of the readings at the best point, with their derivatives J and weights
      W.
    - `noise`: the standard deviations of the noise of the sensors.
    - `covariance`: H⁻¹ (n, n), the covariance of the free numbers for white errors.
    - `sensor_index`: the index of the sensor.
    - `error_kind`: "scale", "cross_axis", "bias" or "clock", the name of the error.
    """
    direction = _reading_changes_by_unit_errors(model, linear, sensor_index, error_kind)
    jitter_error = model.records.readings[sensor_index].jitter_error
    # Make NumPy arrays: single operations of JAX are slow outside of a compiled program.
    scaled = np.asarray(scaled_slopes(direction, np.asarray(noise[sensor_index]), jitter_error))
    pulls = np.einsum(
        "rtkm,rt,rtkc->rmc",
        linear.slopes[sensor_index],
        linear.weights[sensor_index],
        scaled,
        optimize=True,
    )
    rows = np.zeros((linear.free_count + 1, direction.shape[-1]))
    np.add.at(rows, linear.places, pulls)
    return -covariance @ rows[:-1]


def _reading_changes_by_unit_errors(
    model: Model, linear: Linearisation, sensor_index: int, error_kind: str
) -> Float[np.ndarray, "records times 3 ways"]:
    """Return the changes (R, T, 3, c) of the readings of a sensor if it has a unit error of the
    kind `error_kind`.

    The changes are for R recordings, T times, the three components of a reading, and the c
    components of the error.

    **Arguments:**

    - `model`: the fitted model with its readings.
    - `linear`: the errors of the readings at the best point; reading minus error is the prediction.
    - `sensor_index`: the index of the sensor.
    - `error_kind`: the name of the error:
        - "scale" has three components: the reading of an axis is larger by a factor of two.
        - "bias" has three components: the reading of an axis is larger by one unit of the sensor.
        - "clock" has one component: a delay of 1 s.
        - "cross_axis" has six components, one for each pair (i, j) of different axes: the reading
          of axis j is added to the reading of axis i.
    """
    reading = model.records.readings[sensor_index]
    shown = np.asarray(reading.values) - linear.raw[sensor_index]
    eye = np.eye(3)
    if error_kind == "scale":
        return shown[..., None] * eye
    if error_kind == "bias":
        return np.broadcast_to(eye, (*shown.shape, 3))
    if error_kind == "clock":
        return slope_in_time(model, shown)[..., None]
    columns = [eye[i] * shown[..., j, None] for i, j in _OFF_DIAGONAL]
    return np.stack(columns, axis=-1)


def slope_in_time(
    model: Model, prediction: Float[np.ndarray, "records times k"]
) -> Float[np.ndarray, "records times k"]:
    """Return the time derivative (R, T, k) of the `prediction` (R, T, k) of the readings of a
    sensor.

    Here R is the number of recordings, T the number of samples in time and k the number of
    components. The derivative is computed from differences of successive predictions. It is zero at
    the samples that pad a short recording, and in a recording of fewer than three samples. The
    `model` holds the times of the samples, and the number of samples of each recording.
    """
    t, counts = np.asarray(model.records.t)[..., None], np.asarray(model.counts)
    gap = np.diff(t, axis=1)
    slope = np.diff(prediction, axis=1) / np.where(gap > 0, gap, 1.0)
    # The slope is that of the parabola through three samples, as in numpy.gradient: the mean slope
    # in each of two intervals is weighted by the length of the other interval.
    before, after = gap[:, :-1], gap[:, 1:]
    whole = np.where(before + after > 0, before + after, 1.0)
    middle = (after * slope[:, :-1] + before * slope[:, 1:]) / whole
    out = np.concatenate([slope[:, :1], middle, slope[:, -1:]], axis=1)
    rows = np.arange(len(counts))
    out[rows, counts - 1] = slope[rows, np.maximum(counts - 2, 0)]
    inside = (np.arange(t.shape[1]) < counts[:, None]) & (counts[:, None] > 2)
    return np.where(inside[..., None], out, 0.0)


def shift_matrix(
    considered_errors: tuple[Consideration, ...], number_count: int
) -> Float[np.ndarray, "n ways"]:
    """Return the matrix S (n, c) of the shifts of the free numbers by all considered errors.

    The product S Sᵀ is the covariance that the considered errors add to a fit. The matrix has a
    column for each of the c independent components of all errors.

    **Arguments:**

    - `considered_errors`: the considered errors. Each one holds its shifts: the changes of the free
      numbers if a component of the error is one standard deviation.
    - `number_count`: the number n of free numbers.
    """
    return np.concatenate(
        [np.zeros((number_count, 0)), *(part.shifts for part in considered_errors)], axis=1
    )


def describe_considered_errors(
    considered_errors: tuple[Consideration, ...], sensors: Sequence[AbstractSensor]
) -> str:
    """Describe the considered errors in words, such as "a Gyro off by 1 % of scale, 0.5° between
    axes".

    **Arguments:** `considered_errors` the errors; `sensors` all sensors of the model.
    """
    units = {"scale": "{:.3g} % of scale", "cross_axis": "{:.3g}° between axes",
             "bias": "a bias of {:.3g} {unit}", "clock": "a clock offset of {:.3g} s"}  # fmt: skip
    sizes = {"scale": 100.0, "cross_axis": float(np.degrees(1.0)), "bias": 1.0, "clock": 1.0}
    by_sensor: dict[int, list[str]] = {}
    for part in considered_errors:
        words = units[part.kind].format(
            sizes[part.kind] * part.deviation, unit=sensors[part.sensor].unit
        )
        by_sensor.setdefault(part.sensor, []).append(words)
    named = [
        f"a {type(sensors[index]).__name__} off by {', '.join(words)}"
        for index, words in by_sensor.items()
    ]
    return "; ".join(named)


def quantity_shifts_by_usual_errors(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: np.ndarray,
    slopes: Float[np.ndarray, "quantities n"],
) -> list[tuple[int, dict[str, Float[np.ndarray, " quantities"]]]]:
    """Return how much a usual error of a sensor would change each of q quantities of a fit.

    The usual errors (`USUAL`) are an error of scale of 1 % and an error of 1° between two axes.
    Only sensors without a `Tolerance` are considered.

    **Arguments:**

    - `model`: the fitted model.
    - `linear`: the errors of its readings at the best point, with their derivatives.
    - `noise`: the standard deviations of the noise of the sensors.
    - `covariance`: (n, n) the covariance of the n free numbers for white errors.
    - `slopes`: (q, n) the derivatives of the q quantities with respect to the free numbers.

    **Returns** two things for each sensor without a tolerance: the index of the sensor; and a dict
    of kind of error ("scale" or "cross_axis") → changes (q,). The change of a quantity is the
    largest one that a single component of the error causes, without its sign.
    """
    out = []
    for index, sensor in enumerate(model.records.sensors):
        if not isinstance(sensor, VectorSensor) or sensor.tolerance is not None:
            continue
        shifts_by_kind = {}
        for kind, size in USUAL.items():
            if not slots_of_sensor(model, index, MEMBERS[kind]):
                shifts = size * shifts_by_unit_errors(model, linear, noise, covariance, index, kind)
                shifts_by_kind[kind] = np.abs(slopes @ shifts).max(axis=1)
        if shifts_by_kind:
            out.append((index, shifts_by_kind))
    return out
