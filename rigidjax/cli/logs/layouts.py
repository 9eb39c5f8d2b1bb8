"""Find the columns of time and rates in a log, from its format or from the units in its names."""

import contextlib
import re
from pathlib import Path
from typing import NamedTuple

from rigidjax.cli.logs.blackbox import ACCELERATIONS, RATES
from rigidjax.cli.logs.table import BINARY, lowercase_file_ending
from rigidjax.cli.logs.text import open_text, read_header
from rigidjax.cli.logs.units import TIME_UNITS, unit_in_column_name


class ImuColumns(NamedTuple):
    """Hold the names and units of the columns of a log with the times and the body rates.

    **Fields:** `columns` four names: of the column of the times, and of the columns of the body
    rates about x, y and z; `unit` the unit of the rates; `time_unit` the unit of the times.
    """

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


USUAL = ImuColumns(("t", "wx", "wy", "wz"), "rad/s", "s")


# For each ending of the file name of a binary log, this table has the units of fields whose names
# do not contain a unit.
_UNITS = {
    ".bbl": {"time": "us"} | dict.fromkeys(RATES, "deg/s") | dict.fromkeys(ACCELERATIONS, "g"),
    ".ulg": {"timestamp": "us"},
    ".usd": {"timestamp": "us", "gyro": "deg/s", "acc": "g"},
}
_UNITS[".bfl"] = _UNITS[".bbl"]


def known_unit_of_column(path: str | Path, column: str) -> str | None:
    """Return the unit that the column named `column` has in every log of one format, or `None` if
    the format does not determine the unit. The format is that of the log at `path`, and follows
    from the ending of this name.
    """
    units = _UNITS.get(lowercase_file_ending(Path(path)), {})
    return next((units[part] for part in re.split(r"[.\[]", column) if part in units), None)


def imu_columns_of(path: str | Path) -> ImuColumns:
    """Return the columns of the times and the body rates of a log, or the usual columns t, wx, wy,
    wz if the columns of this log are not known.

    The columns of a text log are found by the units in their names: the app phyphox, for example,
    writes the same units in all languages, but not the same words.
    """
    path = Path(path)
    # Errors of a log that cannot be read are suppressed here, since the function that reads the log
    # raises them later with better messages.
    with contextlib.suppress(Exception):
        if lowercase_file_ending(path) in BINARY:
            return _imu_columns_of_binary(path) or USUAL
        with open_text(path) as file:
            return _imu_columns_by_units_in_names(read_header(file).names) or USUAL
    return USUAL


def _imu_columns_by_units_in_names(column_names: list[str]) -> ImuColumns | None:
    """Return the columns of a text log whose names contain the unit of a time, or an axis x, y or z
    and the unit of a body rate.

    The result is `None` unless there is exactly one such column for the time and one for the rate
    about each axis.
    """
    times = {n: unit for n in column_names if (unit := unit_in_column_name(n, ())) in TIME_UNITS}
    rates = {
        n: unit for n in column_names if (unit := unit_in_column_name(n, ())) in ("rad/s", "deg/s")
    }
    axes = [[n for n in rates if re.search(rf"\b{axis}\W*[(\[]", n)] for axis in "xyz"]
    if len(times) != 1 or any(len(one) != 1 for one in axes):
        return None
    (x,), (y,), (z,) = axes
    ((time, time_unit),) = times.items()
    return ImuColumns((time, x, y, z), str(rates[x]), str(time_unit))


def _imu_columns_of_binary(path: Path) -> ImuColumns | None:
    """Return the columns of the times and the body rates of a binary log, with their units, or
    `None` if the log has no body rates.
    """
    columns = _time_and_rate_columns_of_binary(path)
    if columns is None:
        return None
    time, x, *_ = columns
    return ImuColumns(
        columns, known_unit_of_column(path, x) or "rad/s", known_unit_of_column(path, time) or "s"
    )


def _time_and_rate_columns_of_binary(path: Path) -> tuple[str, str, str, str] | None:
    """Return the names of the fields of a binary log with the times and with the body rates about
    x, y and z, or `None` if the log has no body rates.
    """
    kind = lowercase_file_ending(path)
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
