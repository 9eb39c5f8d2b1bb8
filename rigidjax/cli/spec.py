"""From a description in words, as the command line gives it, to recordings and a problem."""

import functools
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.table import read_table
from rigidjax.cli.logs.times import increasing
from rigidjax.cli.logs.units import UNITS
from rigidjax.identify import body_charts
from rigidjax.identify.loss import Huber, SoftL1
from rigidjax.identify.parameters import Free
from rigidjax.identify.problem import Problem
from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import AbstractSensor, Accelerometer, AttitudeSensor, Gyro
from rigidjax.motion.torques import Damping, Flywheel, Series, Sum, Wheel
from rigidjax.motion.torques.base import Torque
from rigidjax.rotation import euler

# Of the typical size of a moment, kg m².
MODELS: dict[str, Callable[[float], body_charts.AbstractBodyChart]] = {
    "ratios": lambda _: body_charts.Ratios(),
    "principal-ratios": lambda _: body_charts.PrincipalRatios(),
    "tensor": body_charts.Tensor,
    "principal": body_charts.Principal,
}
LOSSES = {"soft-l1": SoftL1(), "huber": Huber(), "none": None}
# The units of each kind of sensor, the usual one first; angles have those of "euler".
SENSOR_UNITS = {
    "gyro": ("rad/s", "deg/s", "rpm"),
    "accelerometer": ("m/s2", "g"),
    "quaternion": ("1",),
    "euler": ("rad", "deg"),
}


class Channel(eqx.Module):
    """One sensor of a log; noise (of each axis) and full scale in its unit."""

    kind: str
    columns: tuple[str, ...]
    unit: str
    noise: tuple[float, ...] | None
    limit: float | None = None


class WheelColumn(eqx.Module):
    """A wheel whose speed was logged: column, unit, inertia (kg m²), axis."""

    column: str
    unit: str
    inertia: float
    axis: tuple[float, float, float]


def channel(text: str) -> Channel:
    """A sensor written `KIND=COLUMNS[:UNIT[:NOISE]]`, such as `gyro=wx,wy,wz:deg/s:0.1`.

    KIND is `gyro`, `accelerometer`, `quaternion` (w, x, y, z) or `euler-ZXZ` (any sequence; body →
    world); NOISE one number or three, one for each axis, as in `0.1,0.1,0.2`. **Raises**
    `LogError` in words.
    """
    kind, _, rest = text.partition("=")
    names, *more = rest.split(":")
    columns = tuple(name.strip() for name in names.split(","))
    allowed = SENSOR_UNITS.get("euler" if kind.startswith("euler-") else kind)
    if allowed is None or kind == "euler":
        raise LogError(
            f"sensor {text!r}: wanted gyro, accelerometer, quaternion or euler-SEQUENCE, as in "
            "gyro=wx,wy,wz:deg/s"
        )
    wanted = 4 if kind == "quaternion" else 3
    if len(columns) != wanted or not all(columns):
        raise LogError(f"sensor {text!r}: wanted {wanted} columns, got {names!r}")
    unit = more[0] if more and more[0] else allowed[0]
    if unit not in allowed:
        raise LogError(f"sensor {text!r}: wanted the unit {' or '.join(allowed)}, got {unit!r}")
    if len(more) < 2:
        return Channel(kind, columns, unit, None)
    try:
        noise = tuple(float(part) for part in more[1].split(","))
    except ValueError:
        raise LogError(f"sensor {text!r}: wanted a number for the noise, got {more[1]!r}") from None
    return Channel(kind, columns, unit, noises(noise, f"sensor {text!r}"))


def noises(noise: Sequence[float], where: str) -> tuple[float, ...]:
    """The noise of three axes, from one positive number or three; `LogError` for others."""
    if len(noise) not in (1, 3):
        raise LogError(f"{where}: wanted one noise or three, got {len(noise)}")
    if not all(0 < part < np.inf for part in noise):
        raise LogError(f"{where}: wanted a positive noise, got {min(noise):g}")
    return tuple(noise) if len(noise) == 3 else 3 * tuple(noise)


def wheel(text: str) -> WheelColumn:
    """A wheel written `COLUMN:INERTIA[:AXIS[:UNIT]]`, such as `flywheel:5.2e-7:z:rad/s`.

    INERTIA in kg m² about its axis, AXIS `x`, `y` or `z` of the body. **Raises** `LogError`.
    """
    name, *more = text.split(":")
    axis = more[1] if len(more) > 1 else "z"
    unit = more[2] if len(more) > 2 else "rad/s"
    try:
        inertia = float(more[0])
    except (IndexError, ValueError):
        raise LogError(f"wheel {text!r}: wanted COLUMN:INERTIA, as in flywheel:5.2e-7:z") from None
    if axis not in ("x", "y", "z") or unit not in ("rad/s", "rpm"):
        raise LogError(f"wheel {text!r}: wanted an axis x, y or z and a unit rad/s or rpm")
    x, y, z = (float(axis == one) for one in "xyz")
    return WheelColumn(name, unit, inertia, (x, y, z))


def read_log(
    path: str | Path,
    channels: Sequence[Channel],
    *,
    time: str = "t",
    time_unit: str = "s",
    window: tuple[float, float] | None = None,
    wheels: Sequence[WheelColumn] = (),
    free: Sequence[str] = (),
) -> Recording:
    """One recording from a file, with the described sensors and wheels.

    **Arguments:** `path`; `channels`; `time`, `time_unit` the time column; `window` (from, to), s,
    or `None` for all; `wheels`; `free` some of `bias`, `drag`, `delay`: sensors and torque get
    these numbers, so that a fit can move them. An empty cell is a gap. **Raises** `LogError` as
    `read_table`.
    """
    # Two wheels may share a column of their speed.
    turning = dict.fromkeys(w.column for w in wheels)
    names = [time, *(c for one in channels for c in one.columns), *turning]
    table = read_table(path, names)
    t = table[time] * UNITS[time_unit]
    increasing(path, t, time)
    inside = np.ones(t.shape, bool)
    if window is not None:
        inside = (t >= window[0] - 1e-12) & (t <= window[1] + 1e-12)
        if inside.sum() < 4:
            raise LogError(f"{path}: fewer than 4 samples between {window[0]} and {window[1]} s")
    kept = slice(None) if inside.all() else inside
    readings = []
    for one in channels:
        values = np.stack([table[name] for name in one.columns], axis=1)
        values *= UNITS[one.unit]
        seen = np.isfinite(values).all(axis=1)
        sensor, values = _sensor(one, values, "bias" in free)
        readings.append((sensor, values[kept], seen[kept]))
    torque = _torque(path, t, table, wheels, free)
    # A large log is not to be held twice.
    del table
    try:
        return Recording(t[kept], *readings, torque=torque)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from None


def _sensor(one: Channel, values: np.ndarray, bias: bool) -> tuple[AbstractSensor, np.ndarray]:
    zero = [0.0, 0.0, 0.0] if bias else None
    noise = None if one.noise is None else UNITS[one.unit] * np.array(one.noise)
    limit = None if one.limit is None else one.limit * UNITS[one.unit]
    if one.kind == "gyro":
        return Gyro(noise, bias=zero, limit=limit), values
    if one.kind == "accelerometer":
        return Accelerometer(noise, place=[0.0, 0.0, 0.0], bias=zero, limit=limit), values
    if one.kind == "quaternion":
        return AttitudeSensor(noise), values
    try:
        turned = functools.partial(euler.to_quaternion, sequence=one.kind.removeprefix("euler-"))
        return AttitudeSensor(noise), np.asarray(jax.vmap(turned)(jnp.asarray(values)))
    except ValueError as error:
        raise LogError(f"sensor {one.kind}: {error}") from None


def _torque(
    path: str | Path,
    t: np.ndarray,
    table: dict[str, np.ndarray],
    wheels: Sequence[WheelColumn],
    free: Sequence[str],
) -> Torque | None:
    parts: list[Torque] = []
    for one in wheels:
        try:
            speed = Series(t, table[one.column] * UNITS[one.unit])
        except ValueError as error:
            raise LogError(f"{path}: column {one.column!r}: {error}") from None
        delay = 0.0 if "delay" in free else None
        parts.append(Flywheel(Wheel(one.inertia, one.axis, speed, delay=delay)))
    if "drag" in free:
        parts.append(Damping([0.0, 0.0, 0.0]))
    return Sum(*parts) if parts else None


def problem_of(
    recordings: Sequence[Recording],
    model: str,
    *,
    typical: float = 1.0,
    free: Sequence[str] = (),
    loss: str = "soft-l1",
) -> Problem:
    """The problem of recordings of `read_log`: a drag for all, bias and delay for each."""
    if model not in MODELS:
        raise LogError(f"model: wanted one of {', '.join(MODELS)}, got {model!r}")
    if loss not in LOSSES:
        raise LogError(f"loss: wanted one of {', '.join(LOSSES)}, got {loss!r}")
    chart, moving = MODELS[model](typical), _free(recordings[0], typical, free)
    return Problem(list(recordings), chart, free=moving, loss=LOSSES[loss])


def _free(first: Recording, typical: float, free: Sequence[str]) -> list[Free]:
    """The free numbers of the sensors and the torque, as `read_log` laid them out."""

    def of_sensor(index: int, name: str) -> Callable[[Any], Any]:
        return lambda r: getattr(r.readings[index].sensor, name)

    def of_torque(index: int, path: str) -> Callable[[Any], Any]:
        return lambda r: attrgetter(path)(r.torque.parts[index])

    items: list[Free] = []
    kinds = [type(sensor).__name__.lower() for sensor in first.sensors]
    for index, (sensor, kind) in enumerate(zip(first.sensors, kinds, strict=True)):
        many = kinds.count(kind) > 1
        name = f"{kind} {kinds[: index + 1].count(kind)}" if many else kind
        if getattr(sensor, "bias", None) is not None:
            size = 0.05 if isinstance(sensor, Gyro) else 0.5
            items.append(Free(of_sensor(index, "bias"), f"{name} bias", scale=size, each=True))
        if isinstance(sensor, Accelerometer):
            items.append(Free(of_sensor(index, "place"), f"{name} place", scale=0.01))
    if "drag" in free:
        where = of_torque(-1, "coefficient")
        items.append(Free(where, "drag", scale=0.1 * typical, unit="N m s"))
    if "delay" in free and isinstance(first.torque, Sum):
        wheels = len(first.torque.parts) - ("drag" in free)
        for i in range(wheels):
            name = f"wheel {i + 1} delay" if wheels > 1 else "wheel delay"
            items.append(Free(of_torque(i, "momentum.delay"), name, scale=1e-3, each=True))
    return items
