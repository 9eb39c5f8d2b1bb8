"""Logs with the column names of a known program: phyphox, Blackbox."""

import csv
import re
from pathlib import Path
from typing import NamedTuple, TextIO

from rigidjax.identify import blackbox

SEPARATORS = ",;\t"


class Layout(NamedTuple):
    """Names of the time and the three rate columns, the unit of the rates, that of the time."""

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


USUAL = Layout(("t", "wx", "wy", "wz"), "rad/s", "s")


def layout_of(path: str | Path) -> Layout:
    """The layout of a log: phyphox or Blackbox if the names match, else `USUAL`.

    phyphox writes `Time (s)` and three columns such as `Gyroscope x (rad/s)`, in the language of
    the phone. It raises nothing: errors of a file are raised when it is read.
    """
    path = Path(path)
    if path.suffix.lower() in blackbox.SUFFIXES:
        return Layout(blackbox.COLUMNS, "deg/s", "us")
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


class Header(NamedTuple):
    """Column names; their separator; the number of their line; the lines read after it."""

    names: list[str]
    separator: str
    line: int
    after: list[str]


def read_header(file: TextIO) -> Header:
    """The header of a text, read from its beginning: the first line, below comments (`#`).

    It may be the last comment, as `numpy.savetxt` writes it: then numbers follow.
    """
    comments, first, line = "", file.readline(_LONGEST), 1
    while first.startswith("#") or (first and not first.strip()):
        comments = first if first.startswith("#") else comments
        first, line = file.readline(_LONGEST), line + 1
    names, separator = _split(first)
    if comments and (not first or any(map(_NUMBER.fullmatch, names))):
        return Header(*_split(comments.lstrip("#")), line - 1, [first])
    return Header(names, separator, line, [])


# A file of one endless line is not read for its header; what `csv` takes as one cell.
_LONGEST = 131_072
_NUMBER = re.compile(r"[-+.\d][-+.\deE]*")


def _split(first: str) -> tuple[list[str], str]:
    """The names in a line, and what separates them: whichever gives most of them."""
    separator = max(SEPARATORS, key=first.count)
    return [name.strip() for name in next(csv.reader([first], delimiter=separator), [])], separator
