"""What a fit leaves in its errors, and which cause explains the most of it.

Each cause has a direction: how readings change with it, as the fitted motion says. Errors are
regressed on it beside all free numbers (a score test: Rao 1948, doi:10.1017/S0305004100023987), so
that a cause which those could take up explains nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike

from rigidjax.identify import padding
from rigidjax.identify.answers import Cause
from rigidjax.identify.jacobian import over_records, states_of_one
from rigidjax.identify.misread import misread
from rigidjax.identify.parameters import Parameters, local, numbered
from rigidjax.identify.problem import Problem
from rigidjax.identify.residual import Noise
from rigidjax.identify.sensor_inputs import sensor_inputs
from rigidjax.identify.sensors import Gyro
from rigidjax.identify.several_bodies import in_a_row, tensor_of
from rigidjax.identify.uncertainty import Linearised

# A cause is named that explains so much of the squared errors; of several nearly as good the first.
ENOUGH, NEARLY = 0.5, 0.95
# Directions of which the free numbers take up all but this part are not told from them.
APART = 0.05
# Beyond this the readings' own axes and scales are no small change of them.
SMALL = 0.5


# What x shows of y, x of z, and y of z.
_SKEW = np.zeros((3, 3, 3))
_SKEW[1, 0, 0] = _SKEW[2, 0, 1] = _SKEW[2, 1, 2] = 1.0


class Seen(eqx.Module):
    """A sensor of three axes, in its unit.

    **Fields:** `t` (R, T); `shown` (R, T, 3) what the fit predicts, its `slope` in time; `response`
    of the rates to torques (R, T, 3, c) that act all along, for a gyro.
    """

    t: np.ndarray
    shown: np.ndarray
    slope: np.ndarray
    response: Callable[[np.ndarray], np.ndarray]

    @property
    def axes(self) -> np.ndarray:
        """Each axis by itself (R, T, 3, 3)."""
        return np.broadcast_to(np.eye(3), (*self.shown.shape, 3))

    @property
    def turned(self) -> np.ndarray:
        """How `shown` changes with turns about the axes (R, T, 3, 3)."""
        return np.cross(self.shown[..., None, :], self.axes).swapaxes(-1, -2)


# Name, direction, words and what to try; the simplest first.
TABLE: tuple[tuple[str, Callable[[Seen], np.ndarray], str, str], ...] = (
    ("lag", lambda s: s.slope[..., None], "a clock that is off by {size} s against the rest",
     "let a Free move the sensor's offset, or the delay of the torque's log"),
    ("bias", lambda s: s.axes, "a bias left out, {size} {unit}",
     "let a Free move the sensor's bias"),
    ("scale", lambda s: s.shown[..., None] * s.axes,
     "scales that are off by {size} (all alike: also a clock that runs fast or slow)",
     "let a Free move the sensor's scale"),
    ("drag", lambda s: s.response(-s.shown[..., None] * s.axes),
     "a torque against the rate, such as drag of the air",
     "add a Damping or QuadraticDamping whose coefficient is free"),
    ("wheel", lambda s: s.response(s.turned),
     "a constant angular momentum inside the body, such as a wheel's",
     "add a Flywheel whose momentum is free"),
    ("mounting", lambda s: s.turned, "axes that are turned by {size} rad",
     "let a Free move the sensor's mounting, or take a chart of the full tensor"),
    ("skew", lambda s: np.einsum("rti,ijk->rtjk", s.shown, _SKEW),
     "axes that are off a right angle by {size} rad",
     "let a Free move the sensor's skew"),
    ("push", lambda s: s.response(s.axes), "a constant torque in the body's axes",
     "add a ConstantTorque whose value is free"),
    ("drift", lambda s: s.axes * (s.t - s.t[:, :1])[..., None, None],
     "a bias that drifts by {size} {unit} a second", "cut the record into pieces with a bias each"),
)  # fmt: skip


def causes(
    problem: Problem, parameters: Parameters, noise: Noise, linear: Linearised, which: Sequence[int]
) -> tuple[Cause, ...]:
    """The most likely cause of the errors of each sensor in `which`, where one shows."""
    given = zip(padding.on_host(problem.records, problem.counts), problem.of, strict=True)
    wrong = misread([recording for recording, of in given if of == problem.of[0]])
    if wrong is not None or not np.isfinite(linear.dense).all():
        return () if wrong is None else (wrong,)
    free, found = np.linalg.qr(linear.dense)[0], []
    for index in which:
        sensor = problem.records.readings[index].sensor
        name, rows = type(sensor).__name__, []
        if (late := clock(problem, linear, index)) is not None:
            found.append(late)
            continue
        if _of_three(sensor):
            seen = _seen(problem, parameters, noise, linear, index)
            rows = [(*row, row[1](seen)) for row in TABLE]
        if hasattr(sensor, "suspect"):
            column = np.asarray(_suspected(problem, parameters, index))
            rows.append((*sensor.suspect_words, column))
        told = [
            (share, row, size)
            for *row, columns in rows
            for share, size in (_explained(noise, linear, index, which, free, columns),)
            if row[0] not in ("scale", "mounting", "skew") or np.abs(size).max() < SMALL
        ]
        most = max((share for share, *_ in told), default=0.0)
        if most > ENOUGH:
            share, row, size = next(one for one in told if one[0] >= NEARLY * most)
            each = ", ".join(f"{x:.2g}" for x in size)
            words = row[-2].format(size=f"({each})" if size.size > 1 else each, unit=sensor.unit)
            found.append(Cause(row[0], name, share, f"most likely {words}", row[-1]))
    return tuple(found)


def clock(problem: Problem, linear: Linearised, index: int) -> Cause | None:
    """Time stamps that scatter: each error is along the change of the readings."""
    sensor, error = problem.records.readings[index].sensor, linear.raw[index]
    kept = linear.weights[index] > 0
    if not (_of_three(sensor) and error[kept].any()):
        return None
    slope = _slope(problem, np.asarray(problem.records.readings[index].values) - error)
    moved = np.sum(slope**2, axis=-1) * kept
    moving = moved > 1e-2 * moved.max()
    if not moving.any():
        return None
    along = np.sum(np.sum(error * slope, axis=-1)[moving] ** 2 / moved[moving])
    channels = np.sum(error[kept] ** 2, axis=0)
    # What errors of these channels' sizes have along this direction by chance.
    ways = np.mean(slope[moving] ** 2 / moved[moving][:, None], axis=0)
    chance, share = float(ways @ channels / channels.sum()), float(along / channels.sum())
    if not share > chance + 0.5 * (1.0 - chance) + 1.0 / np.sqrt(moving.sum()):
        return None
    scatter = 1e3 * np.sqrt(along / moved[moving].sum())
    words = f"most likely time stamps that scatter by {scatter:.2g} ms"
    remedy = "take times from the sensor's own count of samples, or say a larger noise"
    return Cause("clock", type(sensor).__name__, share, words, remedy)


def _of_three(sensor: Any) -> bool:
    """Whether errors are readings minus predictions along three axes."""
    return sensor.reading_shape == (3,) and sensor.components == 3


def _slope(problem: Problem, shown: np.ndarray) -> np.ndarray:
    """The derivative in time of what a sensor shows (R, T, k), zero where nothing was read."""
    t, out = np.asarray(problem.records.t), np.zeros_like(shown)
    for row, count in enumerate(problem.counts):
        if count > 2:
            out[row, :count] = np.gradient(shown[row, :count], t[row, :count], axis=0)
    return out


def _seen(
    problem: Problem, parameters: Parameters, noise: Noise, linear: Linearised, index: int
) -> Seen:
    """The sensor's `Seen`; the response is `Φ(t) ∫ Φ⁻¹ I⁻¹ τ dt` (variation of constants).

    Φ is the derivative of the rates by the first one, which the fit has; none but a gyro has one.
    """
    reading, error = problem.records.readings[index], linear.raw[index]
    t, shown = np.asarray(problem.records.t), np.asarray(reading.values) - error
    first = np.asarray(numbered(parameters).own.spin)[0]
    columns = (linear.places[0][:, None] == first).argmax(axis=0)
    flow = linear.slopes[index][..., columns] * np.asarray(noise[index])[:, None, :, None]
    tensors = np.stack([np.asarray(tensor_of(b)) for b in in_a_row(problem.bodies(parameters))])
    of = np.zeros(problem.count, int) if problem.which is None else np.asarray(problem.which)
    steps = np.diff(t, axis=1)[..., None, None]

    def response(torque: np.ndarray) -> np.ndarray:
        if not isinstance(reading.sensor, Gyro):
            return 0 * torque
        pushed = np.linalg.pinv(flow) @ np.linalg.inv(tensors)[of][:, None] @ torque
        middle = 0.5 * (pushed[:, 1:] + pushed[:, :-1]) * steps
        return flow @ np.concatenate([0 * pushed[:, :1], np.cumsum(middle, axis=1)], axis=1)

    return Seen(t, shown, _slope(problem, shown), response)


def _explained(
    noise: Noise,
    linear: Linearised,
    index: int,
    which: Sequence[int],
    free: np.ndarray,
    directions: np.ndarray,
) -> tuple[float, np.ndarray]:
    """The share of the squared errors that directions (R, T, k, c) explain, and how much of each.

    `free` (R, N, m) are orthonormal columns of the free numbers.
    """
    roots = [np.sqrt(weight)[..., None] for weight in linear.weights]
    parts = [e * root for e, root in zip(linear.errors, roots, strict=True)]
    scaled = directions / np.asarray(noise[index])[:, None, :, None] * roots[index][..., None]
    count, many = scaled.shape[0], scaled.shape[-1]
    size = np.sqrt(np.sum(scaled**2, axis=(0, 1, 2)))
    size[size == 0] = 1.0
    columns = [
        scaled / size if i == index else np.zeros((*e.shape, many)) for i, e in enumerate(parts)
    ]
    columns.append(np.zeros((count, 0, many)))
    stacked = np.concatenate([c.reshape(count, -1, many) for c in columns], axis=1)
    errors = np.concatenate([e.reshape(count, -1) for e in parts], axis=1)[..., None]
    basis, left = (
        (x - free @ (free.swapaxes(1, 2) @ x)).reshape(-1, x.shape[-1]) for x in (stacked, errors)
    )
    if not np.isfinite(basis).all():
        return 0.0, np.zeros(many)
    u, s, v = np.linalg.svd(basis, full_matrices=False)
    seen = np.where(s > APART, u.T @ left[:, 0], 0.0)
    total = sum(float(np.sum(parts[i] ** 2)) for i in which)
    return min(float(seen @ seen) / total, 1.0), v.T @ (seen / np.maximum(s, APART)) / size


@eqx.filter_jit
def _suspected(problem: Problem, parameters: Parameters, index: int) -> ArrayLike:
    """The directions (R, T, k, c) that the sensor itself suspects."""

    def of_one(*trees: Any) -> Any:
        record, body, state0, states = states_of_one(problem, *trees)
        sensor = record.readings[index].sensor
        times, there, now = sensor_inputs(sensor, body, record.torque, record.t, state0, states)
        return jax.vmap(lambda t, state: sensor.suspect(now(t, state)))(times, there)

    return over_records(of_one, problem, local(problem, parameters))
