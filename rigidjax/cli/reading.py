"""Read the recordings that options of the command line name: whole logs, or their free flights."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import _checks
from rigidjax.cli import spec
from rigidjax.cli.logs.errors import LogError, warn
from rigidjax.cli.logs.layouts import USUAL, imu_columns, time_column
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.table import full_names, open_log
from rigidjax.cli.logs.units import TIME_UNITS, unit_in_name
from rigidjax.cli.output import print_line


def _columns(
    path: str, log: Log, options: argparse.Namespace
) -> tuple[list[spec.Channel], dict[str, Any]]:
    """Return the sensors of a log, and the column of its times, their unit, and the rate of its
    readings if that column counts them.

    The sensors are those of `--sensor`, else one gyro, which `--unit`, `--noise` and `--limit`
    describe; **raises** `LogError` for both together, or one that is not positive.
    """
    if options.columns and options.time:
        raise LogError("--time: not together with --columns, whose first name is the time column")
    time, *rates = options.columns or ("", "", "", "")
    time, rate = options.time or time, options.rate
    unit, time_unit = options.unit, options.time_unit
    if not options.columns and not options.sensor:
        found = imu_columns(path, log, rate, time)
        (first, *rates), rate = found.columns, found.rate
        time = time or first
        if found.columns != USUAL.columns:
            print_line(f"{path}: times {time or 'by the rate'}, rates {', '.join(rates)}")
            unit, time_unit = unit or found.unit, time_unit or found.time_unit
            if not unit:
                warn(f"{path}: no unit of the rates is said: read in rad/s; or give --unit deg/s")
    tolerance = spec.tolerance(options.tolerance)
    if options.sensor:
        alone = [name for name in ("unit", "noise", "limit") if getattr(options, name)]
        if alone:
            raise LogError(
                f"--{alone[0]}: not together with --sensor, whose text holds unit and noise, as in "
                "--sensor gyro=wx,wy,wz:deg/s:0.1"
            )
        channels = [spec.parse_channel(text) for text in options.sensor]
        if not time:
            first = full_names(Path(path), log, channels[0].columns)[0]
            time, rate = time_column(path, log, first, rate)
    else:
        noise = None if options.noise is None else spec.noise_of_axes(options.noise, "--noise")
        if options.limit is not None and not options.limit > 0:
            raise LogError(f"--limit: wanted a positive number, got {options.limit}")
        channels = [spec.Channel("gyro", tuple(rates), unit, noise, options.limit)]
    units = [spec.unit_of_channel(path, log, one) for one in channels]
    channels = [
        dataclasses.replace(c, unit=u, tolerance=tolerance)
        for c, u in zip(channels, units, strict=True)
    ]
    return channels, dict(time=time, rate=rate, time_unit=time_unit)


class Seen(NamedTuple):
    """Hold what is read of a log: its sensors, its recording, and its phases if they are asked for.

    The recording of `identify` has the sensors that the options name, and no motors.
    """

    channels: list[spec.Channel]
    record: rj.identify.Recording
    phases: list[rj.identify.Phase]


def _read_log(path: str, options: argparse.Namespace, wheels: list[spec.WheelColumn]) -> Seen:
    """Return what is read of a log; raise `LogError` as `spec.read_log`."""
    log = open_log(Path(path), options.flight)
    channels, times = _columns(path, log, options)
    asked, more = options.throws or options.command == "look", []
    if asked and not any(one.kind == "accelerometer" for one in channels):
        more, log = spec.accelerometer(path, log, channels[0].columns[0], times["time"])
        for one in more:
            print_line(f"{path}: specific force {', '.join(one.columns)} in {one.unit}")
    how: Any = dict(window=options.window, wheels=wheels, free=options.free, **times)
    record = spec.read_log(path, [*channels, *more], log=log, motors=options.motors, **how)
    said = [
        ("time", times["time"], TIME_UNITS),
        *((c.kind, c.columns[0], (c.unit,)) for c in channels),
    ]
    units = [(what, unit_in_name(name, allowed)) for what, name, allowed in said]
    words = [f"{what} in {unit}" for what, unit in units if unit]
    if words and not times["rate"]:
        print_line(f"{path}: {', '.join(words)}, as the names of its columns say")
    if not asked:
        return Seen(channels, record, [])
    alone = eqx.tree_at(lambda r: r.readings, record, record.readings[: len(channels)])
    try:
        phases = rj.identify.find_phases(record, options.motors)
    except ValueError as error:
        if not more:
            raise LogError(f"{path}: {error}") from None
        warn(f"{path}: {error}; the phases are by the gyro alone")
        phases, record = rj.identify.find_phases(alone, options.motors), alone
    return Seen(channels, record if options.command == "look" else alone, phases)


def _throws(path: str, seen: Seen) -> list[rj.identify.Recording]:
    """Return the free flights of a log from which a body can be fitted, and print all and what
    they say; raise `LogError` if there is none.
    """
    flights = [phase for phase in seen.phases if phase.kind == "free"]
    for one in flights:
        words = f"{path}: free flight {one.start:.3f} … {one.end:.3f} s"
        left_out = "" if one.is_usable else " is left out"
        print_line(f"{words}{left_out}; it says {one.says}")
    used = [phase for phase in flights if phase.is_usable]
    if not used:
        raise LogError(
            f"{path}: no free flight from which a body can be fitted; what is in it says: "
            "python -m rigidjax look"
        )
    record, rests = seen.record, [phase for phase in seen.phases if phase.kind == "rest"]
    if rests and isinstance(record.readings[0].sensor, rj.identify.Gyro):
        t, rates = (np.asarray(x) for x in (record.t, record.readings[0].values))
        still = np.any([(one.start <= t) & (t <= one.end) for one in rests], axis=0)
        bias = rates[still & record.readings[0].host_mask].mean(axis=0)
        words = ", ".join(f"{rate:.4f}" for rate in bias)
        print_line(f"{path}: the bias of the gyro is its rate at rest, {words} rad/s")
        gyro = dataclasses.replace(record.readings[0].sensor, bias=jnp.asarray(bias))
        record = eqx.tree_at(lambda r: r.readings[0].sensor, record, gyro)
    return [record.between(one.start, one.end) for one in used]


def read_logs(
    options: argparse.Namespace,
) -> tuple[list[spec.Channel], list[rj.identify.Recording], list[str], rj.identify.Model]:
    """Return the sensors of the first log, the recordings of all logs, their names, and the model
    that the options describe; raise `LogError` as `read_log`.
    """
    alone = [name for name in ("pose", "motion", "gravity") if getattr(options, name)]
    if alone and not options.wrench:
        raise LogError(f"--{alone[0]}: wanted a --wrench beside it, the columns of the readings")
    if options.wrench:
        others = ("columns", "sensor", "wheel", "unit", "limit", "flight", "throws", "motors")
        others = [name for name in others if getattr(options, name)]
        if others or set(options.free) - {"bias"}:
            what = f"--{others[0]}" if others else "--free drag, --free delay"
            raise LogError(f"{what}: not together with --wrench, whose motion is the logged one")
        how: dict[str, Any] = dict(
            gravity=options.gravity or [0.0, 0.0, -9.81],
            time=options.time or "t",
            window=options.window,
        )
        how |= dict(time_unit=options.time_unit, noise=options.noise, free=options.free)
        pose = options.pose or ["x", "y", "z", "qw", "qx", "qy", "qz"]
        columns = options.wrench, pose, options.motion
        held = [spec.read_held(path, *columns, **how) for path in options.logs]
        names = [_checks.escape_controls(Path(path).name) for path in options.logs]
        return [], held, names, spec.model_of_held(held, options.free, options.loss)
    wheels = [spec.parse_wheel(text) for text in options.wheel]
    if options.model in ("tensor", "principal") and not wheels:
        words = "free motion shows ratios only; a scale needs a --wheel"
        raise LogError(f"--model {options.model}: {words}")
    if "delay" in options.free and not wheels:
        raise LogError("--free delay: wanted a --wheel, whose delay is to be fitted, got none")
    records, names, of_first = [], [], None
    for path in options.logs:
        seen = _read_log(path, options, wheels)
        mine = _throws(path, seen) if options.throws else [seen.record]
        of_first, records = of_first or seen.channels, [*records, *mine]
        name = _checks.escape_controls(Path(path).name)
        names += [f"{name}, {one.t[0]:.3f} s" if options.throws else name for one in mine]
    how = dict(typical_moment=options.typical, wheels=wheels, free=options.free, loss=options.loss)
    return of_first or [], records, names, spec.model_of(records, options.model, **how)


def look_at(options: argparse.Namespace) -> list[Seen]:
    """Return what is read of each log."""
    wheels = [spec.parse_wheel(text) for text in options.wheel]
    return [_read_log(path, options, wheels) for path in options.logs]
