"""Reading a gyro log from a CSV file. What is wrong is said with file, line and column."""

import csv
import math
from pathlib import Path

import numpy as np

from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import Gyro

UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180}


class LogError(ValueError):
    """A log that cannot be read; the message names the file and, where known, line and column."""


def read_gyro_csv(
    path: str | Path,
    *,
    columns: tuple[str, str, str, str] = ("t", "wx", "wy", "wz"),
    unit: str = "rad/s",
    noise: float | None = None,
) -> Recording:
    """A recording of body rates from a CSV file with a header line.

    **Arguments:** `path` the file; `columns` the names of the time column (s) and of the three rate
    columns (body frame); `unit` of the rates, `rad/s` or `deg/s`; `noise` standard deviation of a
    reading in that unit, or `None` to have it estimated. Other columns are ignored.

    **Raises:** `LogError`, one line naming file, line and column, for a file that is missing or not
    text, a missing column, a cell that is not a finite number, or times that do not increase.

    >>> read_gyro_csv("missing.csv")
    Traceback (most recent call last):
    rigidjax.identify.files.LogError: missing.csv: no such file
    """
    if unit not in UNITS:
        raise LogError(f"unit: wanted one of {', '.join(UNITS)}, got {unit!r}")
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise LogError(f"{path}: is a folder, not a CSV file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: cannot be read as text ({type(error).__name__})") from None
    reader = csv.reader(text.splitlines())
    header = [name.strip() for name in next(reader, [])]
    if not header:
        raise LogError(f"{path}: line 1: wanted a header with the columns {', '.join(columns)}")
    for name in columns:
        if name not in header:
            raise LogError(
                f"{path}: line 1: no column {name!r}; the columns are {', '.join(header)}"
                " (name yours with --columns)"
            )
    places = [header.index(name) for name in columns]
    rows: list[list[float]] = []
    for cells in reader:
        line = reader.line_num
        if not any(cell.strip() for cell in cells):
            continue
        row = [_number(path, line, n, cells, p) for n, p in zip(columns, places, strict=True)]
        if rows and row[0] <= rows[-1][0]:
            raise LogError(
                f"{path}: line {line}: column {columns[0]!r}: time {row[0]:g} is not above the "
                f"{rows[-1][0]:g} before it"
            )
        rows.append(row)
    if len(rows) < 4:
        raise LogError(f"{path}: wanted at least 4 samples, got {len(rows)}")
    data = np.asarray(rows)
    sensor = Gyro(None if noise is None else noise * UNITS[unit])
    return Recording(data[:, 0], (sensor, data[:, 1:] * UNITS[unit]))


def _number(path: Path, line: int, column: str, cells: list[str], place: int) -> float:
    where = f"{path}: line {line}: column {column!r}"
    if place >= len(cells):
        raise LogError(f"{where}: the line ends before it")
    try:
        value = float(cells[place])
    except ValueError:
        raise LogError(f"{where}: {cells[place]!r} is not a number") from None
    if not math.isfinite(value):
        raise LogError(f"{where}: {cells[place].strip()} is not a finite number")
    return value
