"""Compute the effect of considered errors on a fit.

A considered error is a constant error of a sensor, such as an error of scale, that a fit does not
estimate, but that its covariance allows for.

Sources: Schmidt 1966, Application of state-space methods to navigation problems; Bierman 1977,
Factorization Methods for Discrete Sequential Estimation, ch. VIII; Tapley, Schutz and Born 2004,
Statistical Orbit Determination, ch. 6.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from rigidjax.identify.model.free import TOLERANCES, Slot, split_path
from rigidjax.identify.model.model import Model, part_of_sensor
from rigidjax.identify.model.terms import Noise, scaled_slopes
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.identify.sensors.base import extras
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
    - `shifts`: (n, c) the changes of the n parameters if one of the c independent components of
      the error is one standard deviation. The components are three scales, six pairs of axes, three
      biases, or one clock offset.

    >>> t = jnp.linspace(0.0, 2.0, 41)
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> rates = rj.simulate(body, rj.Spin([1.0, 2.0, 3.0]), t).ys.omega
    >>> gyro = rj.identify.Gyro(0.01, tolerance=rj.identify.Tolerance(scale=0.01))
    >>> record = rj.identify.Recording(t, (gyro, rates))
    >>> result = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)
    >>> [(part.kind, part.deviation, part.shifts.shape) for part in result.uncertainty.considered]
    [('scale', 0.01, (5, 3))]
    """

    sensor: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    deviation: float
    shifts: np.ndarray


def considerations(
    model: Model, linear: Linearisation, noise: Noise, covariance: Float[np.ndarray, "n n"]
) -> tuple[Consideration, ...]:
    """Return the considered errors of all sensors; `covariance` is that for white errors, within
    the directions that the data determine.
    """
    out = []
    for index, sensor in enumerate(model.records.sensors):
        tolerance = extras(sensor).tolerance
        for kind, member in MEMBERS.items():
            width = getattr(tolerance, kind, None)
            some = [split_path(one.path)[1] for one in sensor_slots(model, index, member)]
            if width is None or None in some:
                continue
            # The tolerance of one sensor may differ between recordings. The largest tolerance is
            # used.
            deviation = float(np.max(np.asarray(width)))
            shifts = deviation * unit_shifts(model, linear, noise, covariance, index, kind)
            # Entries that a `Free` estimates by itself are not considered once more. The three
            # entries of a skew are these of the six errors of the axes.
            columns = np.array([0, 1, 3] if kind == "cross_axis" else [0, 1, 2])
            shifts[:, [columns[i] for part in some if part for i in part.places]] = 0.0
            out.append(Consideration(index, kind, deviation, shifts))
    return tuple(out)


def sensor_slots(model: Model, sensor_index: int, member: str) -> list[Slot]:
    """Return the slots of one attribute of a sensor, such as "bias".

    There are several if a fit estimates entries of it by themselves, and none if it estimates none.
    """

    def names(slot: Slot) -> tuple[Any, ...]:
        path, _ = split_path(slot.path)
        return tuple(getattr(key, "name", getattr(key, "idx", None)) for key in path)

    part = part_of_sensor(model, sensor_index)
    place = ("sensors", sensor_index - part.first_sensor, member)
    return [slot for slot in part.model.slots if names(slot) == place]


def unit_shifts(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: Float[np.ndarray, "n n"],
    sensor_index: int,
    error_kind: str,
) -> Float[np.ndarray, "n ways"]:
    """Return the changes of the parameters of a fit, `−H⁻¹ Jᵀ W D`, by a unit error of a sensor.

    J and W are the derivatives and the weights of the readings, H⁻¹ is the `covariance` for white
    errors, and D the change of the readings.
    """
    reading = model.records.readings[sensor_index]
    shown, eye = np.asarray(reading.values) - linear.raw[sensor_index], np.eye(3)
    if error_kind == "scale":
        direction = shown[..., None] * eye
    elif error_kind == "bias":
        direction = np.broadcast_to(eye, (*shown.shape, 3))
    elif error_kind == "clock":  # a delay of 1 s
        direction = slope_in_time(model, shown)[..., None]
    else:
        # The reading of axis j is added to that of axis i.
        columns = [eye[i] * shown[..., j, None] for i, j in _OFF_DIAGONAL]
        direction = np.stack(columns, axis=-1)
    # Make NumPy arrays: single operations of JAX are slow outside of a compiled program.
    scaled = np.asarray(
        scaled_slopes(direction, np.asarray(noise[sensor_index]), reading.jitter_error)
    )
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


def slope_in_time(
    model: Model, prediction: Float[np.ndarray, "records times k"]
) -> Float[np.ndarray, "records times k"]:
    """Return the time derivative of the `prediction` of a sensor's readings, by differences.

    It is zero at the samples that pad a short recording, and in a recording of fewer than three.
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


def describe(
    considered_errors: tuple[Consideration, ...], sensors: Sequence[AbstractSensor]
) -> str:
    """Describe the errors in words, such as "a Gyro off by 1 % of scale, 0.5° between axes"."""
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


class UsualShifts(NamedTuple):
    sensor: int
    # The largest change of each quantity by one component of the error, without its sign.
    by_kind: dict[str, Float[np.ndarray, " quantities"]]


def usual_shifts(
    model: Model,
    linear: Linearisation,
    noise: Noise,
    covariance: Float[np.ndarray, "n n"],
    slopes: Float[np.ndarray, "quantities n"],
) -> list[UsualShifts]:
    """Return the shifts of quantities by a `USUAL` error of each sensor without a `Tolerance`.

    The `covariance` is that for white errors; `slopes` are the derivatives of the quantities.
    """
    out = []
    for index, sensor in enumerate(model.records.sensors):
        if not isinstance(sensor, VectorSensor) or sensor.tolerance is not None:
            continue
        shifts_by_kind = {}
        for kind, size in USUAL.items():
            if not sensor_slots(model, index, MEMBERS[kind]):
                shifts = size * unit_shifts(model, linear, noise, covariance, index, kind)
                shifts_by_kind[kind] = np.abs(slopes @ shifts).max(axis=1)
        if shifts_by_kind:
            out.append(UsualShifts(index, shifts_by_kind))
    return out
