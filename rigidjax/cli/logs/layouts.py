"""Find the columns of time and rates in a log, from its format or from the units in its names."""

import contextlib
import re
from pathlib import Path
from typing import NamedTuple

from rigidjax.cli.logs.table import BINARY, kind_of
from rigidjax.cli.logs.text import open_text, read_header
from rigidjax.cli.logs.units import TIME_UNITS, unit_in


class ImuColumns(NamedTuple):
    """Hold the columns of time and rates of a log.

    **Fields:** `columns` the names of the columns of the time and of the three rates; `unit` the
    unit of the rates; `time_unit` the unit of the time.
    """

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


USUAL = ImuColumns(("t", "wx", "wy", "wz"), "rad/s", "s")


# Fields in binary logs, by the ending of the file, have these units, which their names do not
# contain.
_UNITS = {
    ".bbl": {"time": "us", "gyroADC": "deg/s", "accSmooth": "g"},
    ".ulg": {"timestamp": "us"},
    ".usd": {"timestamp": "us", "gyro": "deg/s", "acc": "g"},
}
_UNITS[".bfl"] = _UNITS[".bbl"]


def usual_unit(path: str | Path, name: str) -> str | None:
    """Return the unit that a column of a binary log is known to have, or `None`."""
    units = _UNITS.get(kind_of(Path(path)), {})
    return next((units[part] for part in re.split(r"[.\[]", name) if part in units), None)


def imu_columns_of(path: str | Path) -> ImuColumns:
    """Return the columns of time and rates of a log, or `USUAL` if they are not known.

    The columns of a text are found by the units in their names, which phyphox writes in the same
    way in all languages.
    """
    path = Path(path)
    # Errors are suppressed here, since the reader of the log raises them later with better
    # messages.
    with contextlib.suppress(Exception):
        if kind_of(path) in BINARY:
            return _imu_columns_of_binary(path) or USUAL
        with open_text(path) as file:
            return _columns_by_name(read_header(file).names) or USUAL
    return USUAL


def _columns_by_name(names: list[str]) -> ImuColumns | None:
    """Return the columns of the time and of the three rates, about x, y and z, whose names contain
    their units.

    It returns `None` unless there is exactly one time and one rate about each axis.
    """
    times = {name: unit for name in names if (unit := unit_in(name, ())) in TIME_UNITS}
    rates = {name: unit for name in names if (unit := unit_in(name, ())) in ("rad/s", "deg/s")}
    axes = [[n for n in rates if re.search(rf"\b{axis}\W*[(\[]", n)] for axis in "xyz"]
    if len(times) != 1 or any(len(one) != 1 for one in axes):
        return None
    (x,), (y,), (z,) = axes
    ((time, time_unit),) = times.items()
    return ImuColumns((time, x, y, z), str(rates[x]), str(time_unit))


def _imu_columns_of_binary(path: Path) -> ImuColumns | None:
    """Return the columns of time and rates of a binary log, or `None` if it has no rates."""
    columns = _columns_of_binary(path)
    if columns is None:
        return None
    time, x, *_ = columns
    return ImuColumns(columns, usual_unit(path, x) or "rad/s", usual_unit(path, time) or "s")


def _columns_of_binary(path: Path) -> tuple[str, str, str, str] | None:
    """Return the names of the time and of the rates in a binary log, or `None` if it has no
    rates.
    """
    kind = kind_of(path)
    if kind in (".bbl", ".bfl"):
        return "time", "gyroADC[0]", "gyroADC[1]", "gyroADC[2]"
    if kind == ".usd":
        return "timestamp", "gyro.x", "gyro.y", "gyro.z"
    names, _ = BINARY[kind](path, [])
    for stem, parts in (
        ("gyro_rad", ("[0]", "[1]", "[2]")),
        ("xyz", ("[0]", "[1]", "[2]")),
        ("angular_velocity", (".x", ".y", ".z")),
    ):
        for name in names:
            topic, _, field = name.rpartition(f".{stem}{parts[0]}")
            if topic and not field and (stem != "xyz" or topic == "vehicle_angular_velocity"):
                times = ("timestamp",) if kind == ".ulg" else ("stamp", "log_time")
                time = next(f"{topic}.{t}" for t in times if f"{topic}.{t}" in names)
                x, y, z = (f"{topic}.{stem}{part}" for part in parts)
                return time, x, y, z
    return None
