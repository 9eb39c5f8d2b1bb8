"""Find the columns of time and rates in a log, by their names and units."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rigidjax.cli.logs.errors import LogError, list_names
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.table import open_log
from rigidjax.cli.logs.units import FORCE_UNITS, RATE_UNITS, TIME_UNITS, unit_in_name


class ImuColumns(NamedTuple):
    """Hold the names and units of the columns of a log with the times and the body rates."""

    # The times, and the rates about x, y and z; an empty name of the times means that the rows are
    # counted.
    columns: tuple[str, str, str, str]
    # A unit is `None` if the log does not say it.
    unit: str | None
    time_unit: str | None
    # Readings a second, if the column of the times counts readings.
    rate: float | None = None


USUAL = ImuColumns(("t", "wx", "wy", "wz"), "rad/s", "s")

# The words of names, in small letters.
_WORD = re.compile(r"[a-z]+|[A-Z]+(?![a-z])|[A-Z][a-z]*|[^\W\d_]+|\d+")
_TIMES = frozenset(
    "t time timestamp stamp us ms millis micros seconds elapsed date datetime clock uptime zeit "
    "temps tiempo tempo".split()
)
_COUNTERS = frozenset("frame packetcounter counter sample samples index row".split())
_GYRO = re.compile(r"gyr|angular_?vel|rotation_?rate|omega|ω|^w\W*$|[. _]w\W*$", re.IGNORECASE)
_ACCELEROMETER = re.compile(r"acc(?!ur)|specific_?force|^a\W*$|[. _]a\W*$", re.IGNORECASE)
# An acceleration without gravity is no specific force (the field `linear_acceleration` of ROS is).
_NO_FORCE = re.compile(r"\blin(?!ear_acc)|linearacc|user|grav|without|ohne|sans", re.IGNORECASE)
# What else belongs to a sensor, but is not its readings.
_NO_READINGS = re.compile(r"cov|bias|offset|deriv|fifo|temp|std|var|noise|clip", re.IGNORECASE)
# The units of rates and times in tables exported from Blackbox and PX4, and of the usual names.
_UNITS = {"gyroADC": ("deg/s", "us"), "gyro_rad": ("rad/s", "us"), "wx": ("rad/s", None)}
_SECOND_CHOICE = re.compile(r"raw|unfilt|uncal|#\d", re.IGNORECASE)


def imu_columns(
    path: str | Path, log: Log | None = None, rate: float | None = None, time: str = ""
) -> ImuColumns:
    """Return the columns of the times and the body rates of a log; the usual columns t, wx, wy, wz
    if those of this log are not known.

    The column of the times may be given. At a `rate`, readings a second, the times are a column
    that counts them, or else the rows. The app phyphox, for example, writes the same units in all
    languages, but not the same words. **Raises** `LogError` for a log that cannot be read, or
    without a header.
    """
    path = Path(path)
    log = open_log(path) if log is None else log
    if log.is_nameless:
        raise LogError(
            f"{path}: line 1: no header, but {len(log.names)} columns of numbers; name them by "
            "their places, as in --columns 1 2 3 4 (time, then rates), or write a header above them"
        )
    found = sorted(
        (bool(_SECOND_CHOICE.search(stem)), place, names)
        for place, (stem, names) in enumerate(_triples(log, path.stem))
    )
    if not found:
        return USUAL
    names = found[0][-1]
    if not time:
        time, rate = time_column(path, log, names[0], rate)
    unit, time_unit = _unit(log, names[0], RATE_UNITS), _unit(log, time, TIME_UNITS)
    usual = next((units for word, units in _UNITS.items() if word in names[0]), (None, None))
    if time.endswith("seconds_elapsed"):
        usual = ("rad/s", "s")
    return ImuColumns((time, *names), unit or usual[0], time_unit or usual[1], rate)


def _unit(log: Log, name: str, allowed: Sequence[str]) -> str | None:
    """Return the unit of a column by the log or by its name, or `None`."""
    return log.units.get(name) or unit_in_name(name, allowed)


def accelerometer_columns(log: Log, title: str) -> tuple[str, str, str] | None:
    """Return the columns of the specific force along x, y and z, by their names and units."""
    found = [
        (bool(_SECOND_CHOICE.search(stem)), place, names)
        for place, (stem, names) in enumerate(_triples(log, title, _ACCELEROMETER, FORCE_UNITS))
        if not _NO_FORCE.search(stem)
    ]
    return min(found)[-1] if found else None


def _triples(
    log: Log, title: str, kind: re.Pattern[str] = _GYRO, units: Sequence[str] = RATE_UNITS
) -> Iterator[tuple[str, tuple[str, str, str]]]:
    """Yield the columns of each gyro, or another `kind`, in the order x, y, z, and their name
    without the axis; the rates of a log whose `title` names a gyro may be x, y, z.
    """
    every, weak = dict.fromkeys(log.names), []
    for name in every:
        for match in re.finditer(r"[xX]|\[0\]", name):
            before, after = name[: match.start()], name[match.end() :]
            axes = {"x": "xyz", "X": "XYZ"}.get(match[0], ("[0]", "[1]", "[2]"))
            x, y, z = (f"{before}{axis}{after}" for axis in axes)
            if y not in every or z not in every:
                continue
            stem = before + after
            unit = _unit(log, name, units)
            plain = not re.search(r"\w", stem.rpartition(".")[2])
            is_one = kind.search(before) or kind.search(after) or (plain and kind.search(title))
            if _NO_READINGS.search(stem) or unit not in (None, *units):
                continue
            if is_one or unit:
                yield stem, (x, y, z)
            elif kind is _GYRO and re.fullmatch(r"(.*[. _])?[gG][. _]?", before):
                weak.append((stem, (x, y, z)))
    yield from weak
    if kind is _GYRO and {"p", "q", "r"} <= {*every}:
        yield "", ("p", "q", "r")


def time_column(
    path: str | Path, log: Log, other: str, rate: float | None = None
) -> tuple[str, float | None]:
    """Return the column of the times of another column, and `None`; or the column that counts the
    readings, an empty name if the rows do, and the rate, which is that of the log if none is given.

    **Raises** `LogError` if there is neither.
    """
    counter, parts = "", other.split(".")
    for size in reversed(range(len(parts))):
        group, times = "".join(f"{part}." for part in parts[:size]), []
        for name in log.names:
            last = name.removeprefix(group)
            if not name.startswith(group) or (group and "." in last):
                continue
            bare, in_brackets, _ = re.split(r"([(\[]|$)", last, maxsplit=1)
            words = [word.lower() for word in _WORD.findall(bare)]
            if "".join(words) in _COUNTERS:
                counter = counter or name
            elif _TIMES & {*words} or (in_brackets and unit_in_name(last, ()) in TIME_UNITS):
                unknown = _unit(log, name, TIME_UNITS) is None
                by_logger = any(word.startswith("log") for word in words)
                times.append((unknown, by_logger, len(name), name))
        # A counter and a rate that the log says are better than times in an unknown unit.
        if times and not rate and not (min(times)[0] and counter and log.rate):
            return min(times)[-1], None
    if rate or log.rate:
        return counter, rate or log.rate
    raise LogError(
        f"{path}: no column of times is known; the columns are {list_names(log.names)}; name it "
        "with --time, or give the readings a second, as in --rate 100"
    )
