"""Find the columns of time and rates in a log, from its format or from the units in its names."""

import contextlib
import re
from pathlib import Path
from typing import NamedTuple

from rigidjax.cli.logs.blackbox import ACCELERATIONS, RATES
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.table import BINARY, file_ending
from rigidjax.cli.logs.text import open_text, read_header
from rigidjax.cli.logs.units import TIME_UNITS, unit_in_name


class ImuColumns(NamedTuple):
    """Hold the names and units of the columns of a log with the times and the body rates."""

    # The times, and the rates about x, y and z.
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


def known_unit(path: str | Path, column: str) -> str | None:
    """Return the unit that a column has in every log of the format of `path`, or `None`; the ending
    of the name tells the format.
    """
    units = _UNITS.get(file_ending(Path(path)), {})
    return next((units[part] for part in re.split(r"[.\[]", column) if part in units), None)


def imu_columns(path: str | Path) -> ImuColumns:
    """Return the columns of the times and the body rates of a log; the usual columns t, wx, wy, wz
    if those of this log are not known.

    Those of a text log are found by the units in their names: the app phyphox, for example, writes
    the same units in all languages, but not the same words.
    """
    path = Path(path)
    # Errors of a log that cannot be read are suppressed here, since the function that reads the log
    # raises them later with better messages.
    with contextlib.suppress(Exception):
        if file_ending(path) in BINARY:
            columns = _binary_columns(path)
            unit = known_unit(path, columns[1]) or "rad/s"
            return ImuColumns(columns, unit, known_unit(path, columns[0]) or "s")
        with open_text(path) as file:
            units = {name: unit_in_name(name, ()) for name in read_header(file).names}
        # There must be one column with a unit of time, and for each axis one with a unit of rates:
        # unpacking raises an error, which is suppressed, if there are none or several.
        (time,) = (name for name, unit in units.items() if unit in TIME_UNITS)
        rates = [name for name, unit in units.items() if unit in ("rad/s", "deg/s")]
        (x,), (y,), (z,) = (
            [name for name in rates if re.search(rf"\b{axis}\W*[(\[]", name)] for axis in "xyz"
        )
        return ImuColumns((time, x, y, z), str(units[x]), str(units[time]))
    return USUAL


def _binary_columns(path: Path) -> tuple[str, str, str, str]:
    """Return the fields of a binary log with the times and the rates about x, y and z; raise
    `LogError` if it has no rates.
    """
    kind = file_ending(path)
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
    raise LogError(f"{path}: no body rates are in this log")
