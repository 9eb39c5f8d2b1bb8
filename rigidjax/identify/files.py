"""Reading logs from files. What is wrong is said with file, line and column."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import Gyro

# Everything is turned into SI.
UNITS = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "rad/s": 1.0,
    "deg/s": math.pi / 180,
    "rpm": math.pi / 30,
    "m/s2": 1.0,
    "g": 9.80665,
    "rad": 1.0,
    "deg": math.pi / 180,
    "m": 1.0,
    "mm": 1e-3,
    "1": 1.0,
}


class LogError(ValueError):
    """A log that cannot be read; the message names the file and, where known, line and column."""


def read_table(path: str | Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a log by name: `.csv` with a header line, `.npz`, or `.mat` (MATLAB up to v7).

    **Arguments:** `path`; `columns` the names that are wanted, others are ignored. **Returns** name
    → (T,) numbers. An empty cell of a .csv is a gap and comes back as NaN.

    **Raises:** `LogError`, one line naming file, line and column, for a file that is missing or not
    of its kind, a missing column, a cell that is not a number, columns of different lengths.

    >>> read_table("missing.csv", ["t"])
    Traceback (most recent call last):
    rigidjax.identify.files.LogError: missing.csv: no such file
    """
    path = Path(path)
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir():
        raise LogError(f"{path}: is a folder, not a log")
    if path.suffix.lower() in (".npz", ".mat"):
        return _arrays(path, columns)
    return _csv(path, columns)


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
    reading in that unit, or `None` to have it estimated. Other columns are ignored. For other
    sensors and files: `read_table`, then `Recording`.

    **Raises:** `LogError`, one line naming file, line and column, for a file that is missing or not
    text, a missing column, a cell that is not a finite number, or times that do not increase.

    >>> read_gyro_csv("missing.csv")
    Traceback (most recent call last):
    rigidjax.identify.files.LogError: missing.csv: no such file
    """
    if unit not in ("rad/s", "deg/s"):
        raise LogError(f"unit: wanted one of rad/s, deg/s, got {unit!r}")
    table = read_table(path, columns)
    data = np.stack([table[name] for name in columns], axis=1)
    if not np.isfinite(data).all():
        row, place = np.argwhere(~np.isfinite(data))[0]
        raise LogError(f"{path}: column {columns[place]!r}: row {row + 1} is empty")
    increasing(path, data[:, 0], columns[0])
    sensor = Gyro(None if noise is None else noise * UNITS[unit])
    return Recording(data[:, 0], (sensor, data[:, 1:] * UNITS[unit]))


def increasing(path: str | Path, t: np.ndarray, name: str) -> None:
    """Raise `LogError` unless there are four times at least and each is above the one before."""
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
            f"{path}: line {row + 2}: column {name!r}: time {t[row]:g} is not above the "
            f"{t[row - 1]:g} before it"
        )


def _csv(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    try:
        text = path.read_text(encoding="utf-8-sig")
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
                " (name yours with --columns or --sensor)"
            )
    places = [header.index(name) for name in columns]
    rows: list[list[float]] = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        line = reader.line_num
        rows.append(
            [_number(path, line, n, cells, p) for n, p in zip(columns, places, strict=True)]
        )
    data = np.asarray(rows, float).reshape(-1, len(columns))
    return {name: data[:, index] for index, name in enumerate(columns)}


def _number(path: Path, line: int, column: str, cells: list[str], place: int) -> float:
    where = f"{path}: line {line}: column {column!r}"
    if place >= len(cells):
        raise LogError(f"{where}: the line ends before it")
    cell = cells[place].strip()
    if not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise LogError(f"{where}: {cells[place]!r} is not a number") from None
    if not math.isfinite(value):
        raise LogError(f"{where}: {cell} is not a finite number; leave the cell empty for a gap")
    return value


def _arrays(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    held: Mapping[str, Any]
    try:
        if path.suffix.lower() == ".mat":
            from scipy.io import loadmat

            held = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
        else:
            with np.load(path) as file:
                held = {name: file[name] for name in file.files}
    except (OSError, ValueError, NotImplementedError) as error:
        raise LogError(f"{path}: cannot be read ({error})") from None
    out = {}
    for name in columns:
        if name not in held:
            raise LogError(f"{path}: no array {name!r}; the arrays are {', '.join(held)}")
        try:
            out[name] = np.asarray(held[name], float).reshape(-1)
        except (TypeError, ValueError):
            raise LogError(f"{path}: array {name!r} does not hold numbers") from None
    sizes = {name: array.size for name, array in out.items()}
    if len(set(sizes.values())) > 1:
        raise LogError(f"{path}: arrays of different lengths: {sizes}")
    return out
