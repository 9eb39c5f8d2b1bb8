"""Logs whose columns are known by their program: phyphox, Blackbox."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

from rigidjax.identify import blackbox

SEPARATORS = ",;\t"


class Layout(NamedTuple):
    """Names of the time and the three rate columns, the unit of the rates, that of the time."""

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


USUAL = Layout(("t", "wx", "wy", "wz"), "rad/s", "s")


def layout_of(path: str | Path) -> Layout:
    """The layout of a log: that of phyphox or Blackbox where it is one, else `USUAL`.

    phyphox writes `Time (s)` and three columns such as `Gyroscope x (rad/s)`, in the language of
    the phone. Nothing is raised: what is wrong with a file is said where it is read.
    """
    path = Path(path)
    if path.suffix.lower() in blackbox.SUFFIXES:
        return Layout(blackbox.COLUMNS, "deg/s", "us")
    names = header(path)
    times = [name for name in names if re.search(r"\(s\)$", name)]
    rates = [name for axis in "xyz" for name in names if re.search(rf"\b{axis} \(rad/s\)$", name)]
    if len(times) == 1 and len(rates) == 3:
        x, y, z = rates
        return Layout((times[0], x, y, z), "rad/s", "s")
    return USUAL


def header(path: Path) -> list[str]:
    """The names in the first line of a text; none where there is no such line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline(65536)
    except (OSError, UnicodeDecodeError):
        return []
    return split_header(first)[0]


def split_header(first: str) -> tuple[list[str], str]:
    """The names in a header line, and what separates them: whichever gives most of them."""
    separator = max(SEPARATORS, key=first.count)
    return [name.strip() for name in next(csv.reader([first], delimiter=separator), [])], separator
