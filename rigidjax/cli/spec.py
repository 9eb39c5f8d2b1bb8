"""Make the recordings and the model that the options of the command line describe."""

import functools
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.body.inertia import MassProperties
from rigidjax.cli.logs.errors import LogError, warn
from rigidjax.cli.logs.layouts import accelerometer_columns, time_column
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.table import full_names, open_log, read_columns
from rigidjax.cli.logs.times import (
    increasing,
    increasing_rows,
    since_first,
    unwrapped,
    warn_of_steps,
)
from rigidjax.cli.logs.units import (
    FORCE_UNITS,
    RATE_UNITS,
    TIME_UNITS,
    UNITS,
    common_unit,
    unit_in_name,
)
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import require_turning
from rigidjax.identify.model import charts
from rigidjax.identify.model.free import Free
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.priors import Huber, SoftL1
from rigidjax.identify.model.scene import Scene
from rigidjax.identify.sensors import (
    AbstractSensor,
    Accelerometer,
    AttitudeSensor,
    ForceTorque,
    Gyro,
    Tolerance,
)
from rigidjax.identify.sensors.tolerance import tolerance_of
from rigidjax.motion.torques import (
    Carried,
    Damping,
    Flywheel,
    Input,
    LoggedMotion,
    Series,
    Sum,
    Wheel,
)
from rigidjax.motion.torques.base import Torque
from rigidjax.rotation import euler

# Each word of the option `--model` names a function that returns a chart of the body, given the
# typical size of a moment of inertia, kg m².
MODELS: dict[str, Callable[[float], charts.AbstractBodyChart]] = {
    "ratios": lambda _: charts.Ratios(),
    "principal-ratios": lambda _: charts.PrincipalRatios(),
    "tensor": charts.Tensor,
    "principal": charts.Principal,
}
LOSSES = {"soft-l1": SoftL1(), "huber": Huber(), "none": None}
# These are the allowed units of each kind of sensor, the default unit first; "euler" stands for
# Euler angles of any sequence.
SENSOR_UNITS = {
    "gyro": (*RATE_UNITS, "rpm"),
    "accelerometer": FORCE_UNITS,
    "quaternion": ("1",),
    "euler": ("rad", "deg"),
}

# No gyro reads much more than 4000 deg/s; this bound is in rad/s.
FASTEST_GYRO = 70.0
_WHEEL_UNITS = ("rad/s", "rpm")


class Channel(eqx.Module):
    """Hold the description of one sensor of a log; noise and limit (full scale) are in the unit of
    the readings, and `None` if not known.
    """

    kind: str
    columns: tuple[str, ...]
    unit: str | None
    noise: tuple[float, ...] | None
    limit: float | None = None
    tolerance: Tolerance | str | None = None


class WheelColumn(eqx.Module):
    """Hold the description of a wheel whose speed was logged."""

    column: str
    unit: str | None
    # About the axis of the wheel, kg m².
    inertia: float
    # A unit vector, body frame.
    axis: tuple[float, float, float]


def parse_channel(text: str) -> Channel:
    """Return the sensor that is written as `KIND=COLUMNS[:UNIT[:NOISE]]`, such as
    `gyro=wx,wy,wz:deg/s:0.1`.

    KIND is `gyro`, `accelerometer`, `quaternion` (w, x, y, z) or `euler-ZXZ` (any sequence; body →
    world); NOISE is one number, or one for each axis, as in `0.1,0.1,0.2`. **Raises** `LogError`
    for any other text.
    """
    kind, _, rest = text.partition("=")
    names, *more = rest.split(":")
    columns = tuple(name.strip() for name in names.split(","))
    allowed = _units(kind)
    if not allowed:
        raise LogError(
            f"sensor {text!r}: wanted gyro, accelerometer, quaternion or euler-SEQUENCE, as in "
            "gyro=wx,wy,wz:deg/s"
        )
    wanted = 4 if kind == "quaternion" else 3
    if len(columns) != wanted or not all(columns):
        raise LogError(f"sensor {text!r}: wanted {wanted} columns, got {names!r}")
    unit = more[0] if more and more[0] else None
    if unit not in (None, *allowed):
        raise LogError(f"sensor {text!r}: wanted the unit {' or '.join(allowed)}, got {unit!r}")
    if len(more) < 2:
        return Channel(kind, columns, unit, None)
    try:
        noise = tuple(float(part) for part in more[1].split(","))
    except ValueError:
        raise LogError(f"sensor {text!r}: wanted a number for the noise, got {more[1]!r}") from None
    return Channel(kind, columns, unit, noise_of_axes(noise, f"sensor {text!r}"))


def accelerometer(path: str | Path, log: Log, rate: str, time: str) -> tuple[list[Channel], Log]:
    """Return the accelerometer of a log, if it has one, and the log, from which it is read at the
    times of the columns `rate` and `time`.

    It **warns** of one that cannot be read so. Readings of 0.8 to 1.2 in most rows, without a unit,
    are in g.
    """
    names = accelerometer_columns(log, Path(path).stem)
    if names is None:
        return [], log
    try:
        own = time_column(path, log, names[0])[0]
        apart = bool(own and time) and own != full_names(Path(path), log, [time])[0]
        table = read_columns(Path(path), log, [own if apart else rate, *names])
        size = np.nanmedian(np.linalg.norm([table[name] for name in names], axis=0))
        unit = unit_of_channel(path, log, Channel("accelerometer", names, None, None))
        if apart:
            # The tables of a phone's app have times of their own, by one clock.
            at, good = read_columns(Path(path), log, [time])[time], increasing(table[own])
            there, ends = table[own][good], (np.nan, np.nan)
            moved = {name: np.interp(at, there, table[name][good], *ends) for name in names}
            read = log.read

            def read_at(columns: Sequence[str]) -> dict[str, Any]:
                """Return the columns, those of the accelerometer at the times of the rates."""
                others = read([name for name in columns if name not in moved])
                return {**others, **{name: moved[name] for name in columns if name in moved}}

            log = log._replace(read=read_at)
    except LogError as error:
        warn(f"{path}: {', '.join(names)} are not read beside the rates: {error}")
        return [], log
    if not (_units_of_log(path, log, names) or unit_in_name(names[0], FORCE_UNITS)):
        low, high = 0.8 * UNITS["g"], 1.2 * UNITS["g"]
        unit = next((u for u in FORCE_UNITS[1:] if low < size * UNITS[u] < high), unit)
    return [Channel("accelerometer", names, unit, None)], log


def _units(kind: str) -> tuple[str, ...]:
    """Return the allowed units of a kind of sensor, the default unit first; none for an unknown
    kind.
    """
    key = "euler" if kind.startswith("euler-") else kind
    return () if kind == "euler" else SENSOR_UNITS.get(key, ())


def noise_of_axes(noise: Sequence[float], message_start: str) -> tuple[float, ...]:
    """Return the noise of three axes from one positive number or three; raise `LogError` for
    others.
    """
    if len(noise) not in (1, 3):
        raise LogError(f"{message_start}: wanted one noise or three, got {len(noise)}")
    if not all(0 < part < np.inf for part in noise):
        raise LogError(f"{message_start}: wanted a positive noise, got {min(noise):g}")
    return tuple(noise) if len(noise) == 3 else 3 * tuple(noise)


def parse_wheel(text: str) -> WheelColumn:
    """Return the wheel that is written as `COLUMN:INERTIA[:AXIS[:UNIT]]`, such as
    `flywheel:5.2e-7:z:rad/s`.

    INERTIA is about the wheel's axis, kg m²; AXIS is the body axis `x`, `y` or `z` along it.
    **Raises** `LogError` for any other text.
    """
    name, *more = text.split(":")
    axis = more[1] if len(more) > 1 else "z"
    unit = more[2] if len(more) > 2 else None
    try:
        inertia = float(more[0])
    except (IndexError, ValueError):
        raise LogError(f"wheel {text!r}: wanted COLUMN:INERTIA, as in flywheel:5.2e-7:z") from None
    if axis not in ("x", "y", "z") or unit not in (None, *_WHEEL_UNITS):
        raise LogError(f"wheel {text!r}: wanted an axis x, y or z and a unit rad/s or rpm")
    x, y, z = (float(axis == one) for one in "xyz")
    return WheelColumn(name, unit, inertia, (x, y, z))


def read_log(
    path: str | Path,
    channels: Sequence[Channel],
    *,
    time: str = "t",
    time_unit: str | None = None,
    window: tuple[float, float] | None = None,
    wheels: Sequence[WheelColumn] = (),
    free: Sequence[str] = (),
    rate: float | None = None,
    log: Log | None = None,
    motors: Sequence[str] = (),
) -> Recording:
    """Return the recording in a log, with the sensors that `channels` describe; its times count
    from the first time stamp of the log.

    A sensor has no reading in a row in which one of its cells is empty. The window (from, to) is in
    s from the first time stamp. The speeds of the wheels become inputs, `wheel`, or `wheel 1`,
    `wheel 2`, …, and the columns `motors` inputs of their names. Of the words in `free`, `bias`
    gives each sensor a bias; the others have no effect here. At a `rate`, readings a second, the
    column `time` counts readings, as the rows do if it is an empty name.

    It **warns** as `read_table` does, of rows that are left out because their times do not
    increase, of a long gap, of times that are plainly in another unit or no times, of rates that no
    gyro reads, and of an unknown unit in the name of a column. **Raises** `LogError` as
    `read_table` does, and for rates that are all zero.
    """
    log = open_log(Path(path)) if log is None else log
    # The dict has each column once: two wheels may have their speeds in the same column, and
    # `read_columns` refuses a column that is wanted twice.
    turning = dict.fromkeys([*(w.column for w in wheels), *motors])
    names = [*(c for one in channels for c in one.columns), *turning]
    table = read_columns(Path(path), log, [time, *names] if time else names)
    t, unit = _times(path, log, table, time, time_unit, rate)
    kept = increasing_rows(path, t, time, window)
    # A slice is used if all rows are kept, since indexing with a slice makes no copy of a large
    # log.
    kept = slice(None) if kept.size == t.size else kept
    readings, rate = [], 0.0
    for one in channels:
        values = np.stack([table[name] for name in one.columns], axis=1)
        factor = UNITS[unit_of_channel(path, log, one)]
        values *= factor
        mask = np.isfinite(values).all(axis=1)
        if one.kind == "gyro":
            rate = _median_rate(path, one, factor, values[kept][mask[kept]])
        sensor, values = _sensor(one, values, factor, "bias" in free)
        readings.append((sensor, values[kept], mask[kept]))
    warn_of_steps(path, t[kept], unit, rate)
    inputs = _wheel_speeds(path, t, table, wheels)
    for name in motors:
        seen = np.flatnonzero(np.isfinite(table[name]) & np.isfinite(t))
        seen = seen[increasing(t[seen])]
        inputs[name] = Series(t[seen], table[name][seen])
    # The memory of a large log is freed before the recording copies its columns.
    del table
    try:
        return Recording(t[kept], *readings, inputs=inputs)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from None


def _times(
    path: str | Path,
    log: Log,
    table: Mapping[str, np.ndarray],
    column: str,
    stated_unit: str | None,
    rate: float | None = None,
) -> tuple[np.ndarray, str]:
    """Return the times, s since the first time stamp, and the unit of their column: the stated one,
    else that of the log or its name, else that in which they may be since 1970, else s.
    """
    if rate is not None:
        if not rate > 0:
            raise LogError(f"--rate: wanted a positive number of readings a second, got {rate}")
        count = table[column] if column else np.arange(len(next(iter(table.values()))))
        return since_first(unwrapped(path, count)) / rate, "s"
    t = unwrapped(path, table[column])
    by_log = _units_of_log(path, log, [column])
    unit = common_unit([column], stated_unit, TIME_UNITS, str(path), by_log)
    if stated_unit is None and not by_log and unit == "s" and np.isfinite(t).any():
        # No other clock has such times: 1e9 s after 1970 are in 2001, 4e9 s in 2096.
        since = float(np.nanmedian(t))
        unit = next((u for u in TIME_UNITS[1:] if 1e9 < since * UNITS[u] < 4e9), unit)
    return since_first(t) * UNITS[unit], unit


def unit_of_channel(path: str | Path, log: Log, channel: Channel) -> str:
    """Return the stated unit of a sensor, else that of the log or in the names of its columns, else
    the usual one; raise `LogError` as `common_unit`.
    """
    by_log = _units_of_log(path, log, channel.columns)
    return common_unit(channel.columns, channel.unit, _units(channel.kind), str(path), by_log)


def _units_of_log(path: str | Path, log: Log, columns: Sequence[str]) -> dict[str, str]:
    """Return the units that a log itself says, of some columns."""
    if log.is_nameless:
        return {}
    full = zip(columns, full_names(Path(path), log, columns), strict=True)
    return {name: log.units[long] for name, long in full if long in log.units}


def _median_rate(path: str | Path, channel: Channel, factor: float, rates: np.ndarray) -> float:
    """Return the median magnitude of the rates, rad/s, or zero after a warning that no gyro reads
    such rates; raise `LogError` if there are none, or if all are zero.
    """
    names = ", ".join(channel.columns)
    if not rates.size:
        raise LogError(f"{path}: no row has a rate in each of the columns {names}")
    try:
        require_turning(rates, f"{path}: the rates ({names})")
    except ValueError as error:
        raise LogError(f"{error} (--columns, --window)") from None
    # Single rates may be wrong: the largest hundredth does not count.
    fastest = float(np.quantile(np.abs(rates).max(axis=1), 0.99, method="lower"))
    if fastest < FASTEST_GYRO:
        return float(np.median(np.linalg.norm(rates, axis=1)))
    unit = ", or deg/s (--unit deg/s)" if factor == 1 else ""
    warn(
        f"{path}: the rates ({names}) reach {fastest:.3g} rad/s, which no gyro reads: are they raw "
        f"counts of the sensor (divide them by its scale, such as 16.4 for each deg/s){unit}?"
    )
    return 0.0


def _sensor(
    channel: Channel, values: np.ndarray, factor: float, has_bias: bool
) -> tuple[AbstractSensor, np.ndarray]:
    """Return the sensor that a channel describes, and its readings: the SI values of its columns,
    or quaternions; raise `LogError` for Euler angles in an unknown order.
    """
    zero = [0.0, 0.0, 0.0] if has_bias else None
    noise = None if channel.noise is None else factor * np.array(channel.noise)
    limit = None if channel.limit is None else channel.limit * factor
    if channel.kind == "gyro":
        return Gyro(noise, bias=zero, limit=limit, tolerance=channel.tolerance), values
    if channel.kind == "accelerometer":
        more: Any = dict(bias=zero, limit=limit, tolerance=channel.tolerance)
        return Accelerometer(noise, place=[0.0, 0.0, 0.0], **more), values
    if channel.kind == "quaternion":
        return AttitudeSensor(noise), values
    try:
        turned = functools.partial(
            euler.to_quaternion, sequence=channel.kind.removeprefix("euler-")
        )
        return AttitudeSensor(noise), np.asarray(jax.vmap(turned)(jnp.asarray(values)))
    except ValueError as error:
        raise LogError(f"sensor {channel.kind}: {error}") from None


def read_held(
    path: str | Path,
    wrench: Sequence[str],
    pose: Sequence[str],
    motion: Sequence[str] = (),
    *,
    gravity: Sequence[float],
    time: str = "t",
    time_unit: str | None = None,
    window: tuple[float, float] | None = None,
    noise: Sequence[float] | None = None,
    free: Sequence[str] = (),
) -> Recording:
    """Return the recording of a body that is carried, from the columns of its `pose` (x y z qw qx
    qy qz, world) and of the `wrench` on it (fx fy fz tx ty tz, N and N m, in its own axes).

    The columns of `motion`, if there are any, are rate, acceleration of the origin and dΩ/dt (nine,
    rad and m, in its own axes); without them the poses are smoothed. The `gravity` (3,) is in m/s²,
    world frame; `noise` is that of force, N, and of torque, N m. The sensor has no reading in a row
    in which one of its cells is empty; a row without a pose is left out with a warning. **Raises**
    `LogError` as `read_table`, and for a motion through which no spline goes.
    """
    names = [*pose, *wrench, *motion]
    log = open_log(Path(path))
    table = read_columns(Path(path), log, [time, *dict.fromkeys(names)])
    t, unit = _times(path, log, table, time, time_unit)
    kept = increasing_rows(path, t, time, window)
    t, rows = t[kept], np.stack([table[name] for name in names], axis=1)[kept]
    posed = np.isfinite(np.delete(rows, np.s_[7:13], axis=1)).all(axis=1)
    if not posed.all():
        warn(f"{path}: {(~posed).sum()} rows without a pose or a motion are left out")
    t, rows = t[posed], rows[posed]
    warn_of_steps(path, t, unit, 0.0)
    if noise is not None and len(noise) != 2:
        raise LogError("--noise: wanted two numbers with --wrench: of force, N, and torque, N m")
    bias = np.zeros(6) if "bias" in free else None
    sensor = ForceTorque(noise, gravity=gravity, bias=bias)
    place, turn, logged = rows[:, :3], rows[:, 3:7], rows[:, 13:]
    turn = turn / np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-300)
    try:
        if motion:
            given = LoggedMotion(t, place, turn, *np.split(logged, 3, axis=1))
        else:
            given = LoggedMotion.from_poses(t, place, turn)
        readings = rows[:, 7:13]
        mask = np.isfinite(readings).all(axis=1)
        return Recording(t, (sensor, readings, mask), inputs={"motion": given})
    except ValueError as error:
        raise LogError(f"{path}: {error}") from None


def model_of_held(recordings: Sequence[Recording], free: Sequence[str], loss: str) -> Model:
    """Return the model of recordings of `read_held`: all ten numbers of the body, and the bias of
    the sensor in each recording if `free` names it.
    """
    bias: Callable[[Any], Any] = lambda scene: scene.sensors[0].bias  # noqa: E731
    where = Free(bias, "bias", unit="N, N m", each=True)
    guess = MassProperties(1.0, [0.0, 0.0, 0.0], 1e-3 * np.eye(3))
    return Model(
        list(recordings),
        charts.Mass(guess),
        torque=Carried(),
        free=[where] if "bias" in free else [],
        loss=LOSSES[loss],
    )


def wheel_names(wheels: Sequence[WheelColumn]) -> list[str]:
    """Return the names of the inputs with the wheels' speeds."""
    return [f"wheel {i + 1}" if len(wheels) > 1 else "wheel" for i in range(len(wheels))]


def _fill_gaps(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values in which the gaps of an evenly spaced series are filled by
    interpolation.

    A series is returned unchanged if a time differs from an even spacing by more than a thousandth
    of a step, or if it would become more than about ten times as long.
    """
    step = np.median(np.diff(t)) if t.size > 1 else np.nan
    place = (t - t[:1]) / step
    if not np.isfinite(step) or place[-1] > 10 * t.size:
        return t, values
    # The step is computed as the mean step over the whole series, which is more exact than the
    # difference of two rounded times.
    step *= place[-1] / np.round(place[-1])
    place = (t - t[0]) / step
    if np.abs(place - np.round(place)).max() > 1e-3:
        return t, values
    places = np.arange(np.round(place[-1]) + 1)
    return t[0] + step * places, np.interp(places, np.round(place), values)


def _wheel_speeds(
    path: str | Path, t: np.ndarray, table: dict[str, np.ndarray], wheels: Sequence[WheelColumn]
) -> dict[str, Series]:
    """Return the logged speed of each wheel, rad/s, as a function of time, s, by the names of the
    inputs; raise `LogError` for one that is none.
    """
    speeds = {}
    # The speeds of the wheels are kept also at times outside of the window, since a delayed speed
    # is from a time before that of the reading.
    kept = increasing(t) if wheels else slice(None)
    for name, one in zip(wheel_names(wheels), wheels, strict=True):
        unit = common_unit([one.column], one.unit, _WHEEL_UNITS, str(path))
        try:
            samples = table[one.column][kept] * UNITS[unit]
            speeds[name] = Series(*_fill_gaps(t[kept], samples))
        except ValueError as error:
            raise LogError(f"{path}: column {one.column!r}: {error}") from None
    return speeds


def model_of(
    recordings: Sequence[Recording],
    body_chart: str,
    *,
    typical_moment: float = 1.0,
    wheels: Sequence[WheelColumn] = (),
    free: Sequence[str] = (),
    loss: str = "soft-l1",
) -> Model:
    """Return the model of recordings that were read by `read_log`: all share one drag, and each has
    its own bias and delay.

    The word `body_chart` is a key of `MODELS`, `loss` one of `LOSSES`; the typical moment of
    inertia is in kg m². **Raises** `LogError` for another word.
    """
    if body_chart not in MODELS:
        raise LogError(f"model: wanted one of {', '.join(MODELS)}, got {body_chart!r}")
    if loss not in LOSSES:
        raise LogError(f"loss: wanted one of {', '.join(LOSSES)}, got {loss!r}")
    names = wheel_names(wheels)
    delay = 0.0 if "delay" in free else None
    parts: list[Torque] = [
        Flywheel(Wheel(one.inertia, one.axis, Input(name), delay=delay))
        for name, one in zip(names, wheels, strict=True)
    ]
    if "drag" in free:
        parts.append(Damping([0.0, 0.0, 0.0]))
    return Model(
        list(recordings),
        MODELS[body_chart](typical_moment),
        torque=Sum(*parts) if parts else None,
        free=_parameters(recordings[0].sensors, names, typical_moment, free),
        loss=LOSSES[loss],
    )


def _parameters(
    sensors: Sequence[AbstractSensor],
    wheels: Sequence[str],
    typical_moment: float,
    free: Sequence[str],
) -> list[Free]:
    """Return the parameters beside the body and its motion: biases, places of accelerometers, the
    drag, and the delays of wheels.

    Biases, the drag and the delays are free by their words in `free`.
    """

    def of_sensor(index: int, name: str) -> Callable[[Scene], Any]:
        return lambda scene: getattr(scene.sensors[index], name)

    def of_torque(index: int, path: str) -> Callable[[Scene], Any]:
        return lambda scene: attrgetter(path)(cast(Sum, scene.torque).parts[index])

    items: list[Free] = []
    kinds = [type(sensor).__name__.lower() for sensor in sensors]
    for index, (sensor, kind) in enumerate(zip(sensors, kinds, strict=True)):
        many = kinds.count(kind) > 1
        name = f"{kind} {kinds[: index + 1].count(kind)}" if many else kind
        if "bias" in free and getattr(sensor, "bias", None) is not None:
            size = 0.05 if isinstance(sensor, Gyro) else 0.5
            items.append(Free(of_sensor(index, "bias"), f"{name} bias", scale=size, each=True))
        if isinstance(sensor, Accelerometer):
            items.append(Free(of_sensor(index, "place"), f"{name} place", scale=0.01))
    if "drag" in free:
        where = of_torque(-1, "coefficient")
        items.append(Free(where, "drag", scale=0.1 * typical_moment, unit="N m s"))
    if "delay" in free:
        for index, wheel in enumerate(wheels):
            where = of_torque(index, "momentum.delay")
            items.append(Free(where, f"{wheel} delay", scale=1e-3, each=True))
    return items


def tolerance(text: str | None) -> Tolerance | str | None:
    """Return what `--tolerance` states: a word, or a number as the deviation of scale and axes."""
    if text is None:
        return None
    try:
        return tolerance_of(text)
    except ValueError:
        pass
    try:
        size: Any = float(text)
        return Tolerance(scale=size, cross_axis=size)
    except ValueError:
        raise LogError(
            "--tolerance: wanted phone, consumer, industrial, calibrated, or a positive number "
            f"such as 0.01, got {text!r}"
        ) from None
