"""Columns of a log by name, whatever its format."""

import csv
import functools
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs import text
from rigidjax.cli.logs.arrays import mat, npz
from rigidjax.cli.logs.blackbox import blackbox
from rigidjax.cli.logs.crazyflie import FIRST_BYTE, crazyflie
from rigidjax.cli.logs.errors import LogError, LogWarning
from rigidjax.cli.logs.mcap import mcap
from rigidjax.cli.logs.ulog import ulog

BINARY = {".bbl": blackbox, ".bfl": blackbox, ".ulg": ulog, ".mcap": mcap, ".usd": crazyflie}
_READERS = {".npz": npz, ".mat": mat} | BINARY


def read_table(
    path: str | Path, columns: Sequence[str], *, flight: int | None = None
) -> dict[str, np.ndarray]:
    """Return columns of a log by name.

    A log is text with a header, `.npz`, `.mat` (MATLAB up to v7), a Crazyflie's µSD log (without
    ending, or `.usd`), or with the extra of that name `blackbox` (`.bbl`, `.bfl`), `ulog` of PX4
    (`.ulg`), `mcap` (JSON and ROS 2). Text is in UTF-8, UTF-16 or Windows's code page 1252, and may
    be packed (`.gz`). It is separated by commas, semicolons or tabs, whichever splits the header
    line into most names. Decimals have a point, or between semicolons and tabs a comma. Lines that
    begin with `#` may stand above the header, which may be the last of them, as `numpy.savetxt`
    writes it. A text is read line by line; the memory needed is up to three times its numbers.

    **Arguments:**

    - `path`: the file;
    - `columns`: the names that are wanted, others are ignored;
    - `flight`: which flight of a Blackbox log is read, from 1; `None` for the only one.

    **Returns** name → (T,) numbers in the units of the log, NaN for an empty cell. It **warns** how
    many frames of a Blackbox log are left out: those before the first I frame, and those from a
    hurt one to the next I frame.

    **Raises:** `ValueError`, one line naming file, line and column, for a file that is missing, cut
    or not of its kind, a missing column or two of its name, a name that is wanted twice, a cell
    that is not a number, a line with more cells than the header, columns of different lengths, a
    log of several flights of which none is chosen.

    >>> read_table("missing.csv", ["t"])
    Traceback (most recent call last):
    rigidjax.cli.logs.errors.LogError: missing.csv: no such file
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
    if kind_of(path) in _READERS:
        return _arrays(path, columns, flight)
    _require_one_flight(path, flight)
    if path.suffix.lower() == ".gz" and kind_of(path.with_suffix("")) in _READERS:
        raise LogError(f"{path}: only text is read while it is packed; unpack it first: gunzip")
    try:
        # Line by line: only the numbers of a large file stay in memory.
        with text.opened(path) as file:
            return text.rows(path, file, columns)
    except (OSError, EOFError, UnicodeError, zlib.error, csv.Error) as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path}: cannot be read as text ({why})") from None


def kind_of(path: Path) -> str:
    """Return the ending of a log, in small letters; `.usd` for a Crazyflie's, which has none."""
    if path.suffix or not path.is_file():
        return path.suffix.lower()
    with path.open("rb") as file:
        return ".usd" if file.read(1) == bytes([FIRST_BYTE]) else ""


def _require_one_flight(path: Path, flight: int | None) -> None:
    """Raise `LogError` if a flight is chosen in a log that is none of Blackbox."""
    if flight is not None:
        raise LogError(f"{path}: flight {flight}: only a Blackbox log (.bbl, .bfl) has flights")


def _arrays(path: Path, columns: Sequence[str], flight: int | None) -> dict[str, np.ndarray]:
    """Read columns of a log that is no text."""
    read: Any = _READERS[kind_of(path)]
    if read is blackbox:
        read = functools.partial(blackbox, flight=flight)
    else:
        _require_one_flight(path, flight)
    # The readers raise many kinds of errors for an empty or a cut file.
    try:
        names, held = read(path, columns)
    except (LogError, LogWarning):
        raise
    except ModuleNotFoundError as error:
        raise LogError(str(error)) from None
    except Exception as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(
            f"{path}: cannot be read; is it whole, and a {kind_of(path)} file? ({why})"
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
