"""The columns of time and rates that a log is known to have."""

import contextlib
import re
from pathlib import Path
from typing import NamedTuple

from rigidjax.cli.logs.table import BINARY, kind_of
from rigidjax.cli.logs.text import read_header


class Layout(NamedTuple):
    """Names of the time and the three rate columns, the unit of the rates, that of the time."""

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


USUAL = Layout(("t", "wx", "wy", "wz"), "rad/s", "s")


def layout_of(path: str | Path) -> Layout:
    """The layout of a log: phyphox (any language) or a binary one if it has rates, else `USUAL`."""
    path = Path(path)
    if kind_of(path) in BINARY:
        # Whoever reads it says what is wrong.
        with contextlib.suppress(Exception):
            return _of_binary(path) or USUAL
        return USUAL
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            names = read_header(file).names
    except (OSError, UnicodeDecodeError):
        return USUAL
    times = [name for name in names if re.search(r"\(s\)$", name)]
    rates = [name for axis in "xyz" for name in names if re.search(rf"\b{axis} \(rad/s\)$", name)]
    if len(times) == 1 and len(rates) == 3:
        x, y, z = rates
        return Layout((times[0], x, y, z), "rad/s", "s")
    return USUAL


def _of_binary(path: Path) -> Layout | None:
    """The time and the rates that such a log has; `None` if it has no rates."""
    kind = kind_of(path)
    if kind in (".bbl", ".bfl"):
        return Layout(("time", "gyroADC[0]", "gyroADC[1]", "gyroADC[2]"), "deg/s", "us")
    if kind == ".usd":
        return Layout(("timestamp", "gyro.x", "gyro.y", "gyro.z"), "deg/s", "us")
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
                return Layout((time, x, y, z), "rad/s", "us" if kind == ".ulg" else "s")
    return None
