"""Reading logs from files. Errors name file, line and column."""

import contextlib
import csv
import itertools
import math
import re
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from rigidjax import _checks
from rigidjax.identify import flight_logs
from rigidjax.identify.flight_logs import Layout

SEPARATORS = ",;\t"

USUAL = Layout(("t", "wx", "wy", "wz"), "rad/s", "s")


def layout_of(path: str | Path) -> Layout:
    """The layout of a log: phyphox (any language) or a binary one if it has rates, else `USUAL`."""
    path = Path(path)
    if flight_logs.kind_of(path) in flight_logs.READERS:
        # Whoever reads it says what is wrong.
        with contextlib.suppress(Exception):
            return flight_logs.usual(path) or USUAL
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


# All units become SI.
UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "m": 1.0, "mm": 1e-3, "m/s2": 1.0, "g": 9.80665, "1": 1.0,
    "rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30,
}  # fmt: skip


class LogError(ValueError):
    """A log that cannot be read; the message names the file and, where known, line and column."""

    def __str__(self) -> str:
        # Names out of a file must not move the cursor of the terminal that shows them.
        return _checks.printable(super().__str__())


def read_table(path: str | Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a log by name: text with a header, `.npz`, `.mat` (MATLAB up to v7), a Crazyflie's
    µSD log (without ending, or `.usd`), and with the extra of that name `blackbox` (`.bbl`,
    `.bfl`), `ulog` of PX4 (`.ulg`), `mcap` (JSON and ROS 2).

    **Arguments:** `path`; `columns` the names that are wanted, others are ignored. Text is
    separated by commas, semicolons or tabs, whichever splits the header line into most names; its
    decimals have a point. Lines that begin with `#` may stand above the header, which may be the
    last of them, as `numpy.savetxt` writes it. **Returns** name → (T,) numbers, NaN for an empty
    cell. A text is read line by line; the memory needed is up to three times its numbers.

    **Raises:** `ValueError`, one line naming file, line and column, for a file that is missing, cut
    or not of its kind, a missing column or two of its name, a name that is wanted twice, a cell
    that is not a number, a line with more cells than the header, columns of different lengths.

    >>> read_table("missing.csv", ["t"])
    Traceback (most recent call last):
    rigidjax.identify.csv_io.LogError: missing.csv: no such file
    """
    path = _checks.path(path)
    _checks.instance(columns, Sequence, "columns", wanted="a sequence of names")
    if isinstance(columns, str) or not columns or not all(isinstance(c, str) for c in columns):
        raise TypeError(f"columns: wanted a sequence of names, got {columns!r}")
    twice = [name for name in columns if columns.count(name) > 1]
    if twice:
        raise LogError(f"columns: {twice[0]!r} is named twice, one column cannot be two readings")
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir():
        raise LogError(f"{path}: is a folder, not a log")
    if flight_logs.kind_of(path) in _readers:
        return _arrays(path, columns)
    try:
        # Line by line: only the numbers of a large file stay in memory.
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _rows(path, file, columns)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path}: cannot be read as text ({why})") from None


def increasing(path: str | Path, t: np.ndarray, name: str) -> None:
    """Raise `LogError` unless there are at least four times and they increase."""
    if t.size < 4:
        raise LogError(f"{path}: wanted at least 4 samples, got {t.size}")
    if not np.isfinite(t).all():
        raise LogError(
            f"{path}: column {name!r}: row {int(np.argmin(np.isfinite(t))) + 1} is empty"
        )
    falling = np.flatnonzero(np.diff(t) <= 0)
    if falling.size:
        row = int(falling[0]) + 1
        raise LogError(
            f"{path}: column {name!r}: row {row + 1}: time {t[row]:g} is not above the "
            f"{t[row - 1]:g} before it"
        )


def _rows(path: Path, file: TextIO, columns: Sequence[str]) -> dict[str, np.ndarray]:
    header, separator, top, after = read_header(file)
    if not any(header):
        raise LogError(f"{path}: line 1: wanted a header with the columns {', '.join(columns)}")
    for name in columns:
        if name not in header:
            advice = (
                "names and numbers are separated by commas, semicolons or tabs"
                if len(header) == 1
                else "name yours with --columns or --sensor"
            )
            raise LogError(
                f"{path}: line {top}: no column {name!r}; the columns are {', '.join(header)} "
                f"({advice})"
            )
        if header.count(name) > 1:
            raise LogError(
                f"{path}: line {top}: {header.count(name)} columns are called {name!r}: which one?"
            )
    wanted = [(name, header.index(name), array("d")) for name in columns]
    reader = csv.reader(itertools.chain(after, file), delimiter=separator)
    for cells in reader:
        line = reader.line_num + top
        if len(cells) > len(header) and any(cell.strip() for cell in cells[len(header) :]):
            raise LogError(
                f"{path}: line {line}: {len(cells)} cells, but the header names {len(header)} "
                "columns"
            )
        if any(cell.strip() for cell in cells):
            for name, place, numbers in wanted:
                if place >= len(cells):
                    raise LogError(f"{path}: line {line}: column {name!r}: the line ends before it")
                try:
                    numbers.append(_number(cells[place].strip()))
                except ValueError as error:
                    raise LogError(f"{path}: line {line}: column {name!r}: {error}") from None
    return {name: np.frombuffer(numbers, float) for name, _, numbers in wanted}


def _number(cell: str) -> float:
    if not cell:
        return math.nan
    # Python's own spelling of numbers is wider than that of logs: 1_000, other alphabets' digits.
    plain = cell.isascii() and "_" not in cell
    try:
        value = float(cell if plain else "")
    except ValueError:
        comma = "; a decimal comma? wanted a point" if "," in cell else ""
        raise ValueError(f"{cell!r} is not a number{comma}") from None
    if not math.isfinite(value):
        raise ValueError(f"{cell} is not a finite number; leave the cell empty for a gap")
    return value


def _arrays(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    # The readers raise many kinds of errors for an empty or a cut file.
    try:
        names, held = _readers[flight_logs.kind_of(path)](path, columns)
    except ModuleNotFoundError as error:
        raise LogError(str(error)) from None
    except Exception as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(
            f"{path}: cannot be read; is it whole, and a {flight_logs.kind_of(path)} file? ({why})"
        ) from None
    out = {}
    for name in columns:
        if name not in held:
            more = f", and {len(names) - 40} more" if len(names) > 40 else ""
            listed = ", ".join(names[:40]) + more
            raise LogError(f"{path}: no array {name!r}; the arrays are {listed}")
        if np.asarray(held[name]).dtype.kind not in "biuf":
            raise LogError(f"{path}: array {name!r} does not hold real numbers")
        out[name] = np.asarray(held[name], float).reshape(-1)
        endless = np.isinf(out[name])
        if endless.any():
            raise LogError(
                f"{path}: array {name!r}: row {int(np.argmax(endless)) + 1} is infinite; NaN marks "
                "a gap"
            )
    sizes = {name: array.size for name, array in out.items()}
    if len(set(sizes.values())) > 1:
        raise LogError(f"{path}: arrays of different lengths: {sizes}")
    return out


def _npz(path: Path, columns: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    # NumPy does not close a file that it opened itself and cannot read.
    with path.open("rb") as raw, np.load(raw) as file:
        return file.files, {name: file[name] for name in columns if name in file.files}


def _mat(path: Path, columns: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    from scipy.io import loadmat, whosmat

    with path.open("rb") as raw:
        names = [name for name, *_ in whosmat(raw)]
        return names, loadmat(raw, variable_names=list(columns))


_readers = {".npz": _npz, ".mat": _mat} | flight_logs.READERS
