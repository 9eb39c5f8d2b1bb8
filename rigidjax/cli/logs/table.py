"""Read the columns of a log by name, whatever the format of the log."""

import csv
import functools
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs import text
from rigidjax.cli.logs.arrays import read_mat, read_npz
from rigidjax.cli.logs.blackbox import read_blackbox
from rigidjax.cli.logs.crazyflie import FIRST_BYTE, read_crazyflie
from rigidjax.cli.logs.errors import LogError, LogWarning, list_names
from rigidjax.cli.logs.mcap import read_mcap
from rigidjax.cli.logs.ulog import read_ulog

BINARY = {
    ".bbl": read_blackbox,
    ".bfl": read_blackbox,
    ".ulg": read_ulog,
    ".mcap": read_mcap,
    ".usd": read_crazyflie,
}
_READERS = {".npz": read_npz, ".mat": read_mat} | BINARY


def read_table(
    path: str | Path, columns: Sequence[str], *, flight: int | None = None
) -> dict[str, np.ndarray]:
    """Read columns of a log by name, from text or from one of several binary formats.

    A log is one of these:

    - Text with a header, which may be packed (`.gz`), in UTF-8, UTF-16 or Windows's code page 1252.
      Cells are separated by commas, semicolons or tabs; the separator is the one of these signs
      that splits the header into the largest number of names. Decimals have a point or, between
      semicolons and tabs, a comma. Lines that begin with `#` may stand above the header; the last
      such line may be the header itself, as in files of `numpy.savetxt`. Text is read line by line,
      so that reading needs up to three times the memory of the numbers that are read.
    - `.npz`, `.mat` (MATLAB up to v7), or a Crazyflie's µSD log (without ending, or `.usd`).
    - With the extra of the same name (`pip install '.[blackbox]'` in the clone): `blackbox`
      (`.bbl`, `.bfl`), `ulog` of PX4 (`.ulg`), `mcap` (JSON and ROS 2).

    **Arguments:**

    - `path`: the path of the file.
    - `columns`: the names of the wanted columns; all other columns are ignored.
    - `flight`: the number of the flight in a Blackbox log, from 1; `None` if the log has only one
      flight.

    **Returns** name → (T,) numbers in the units of the log, NaN for an empty cell. It **warns** of
    frames (records) of a Blackbox log that are left out. An I frame is a frame that can be read
    alone: all frames before the first I frame are left out, and all frames from a damaged frame to
    the next I frame.

    **Raises:** `LogError`, a `ValueError`, in one line that names file, line and column, for a file
    that is missing, cut or of another kind; for a column that is missing, there twice, or wanted
    twice; for a cell that is not a number, a line with more cells than the header, and columns of
    different lengths; for a flight of a log that has none, and a log of several flights of which
    none is chosen. `TypeError` for columns that are no sequence of names.

    >>> read_table("missing.csv", ["t"])
    Traceback (most recent call last):
    rigidjax.cli.logs.errors.LogError: missing.csv: no such file
    """
    path = _checks.file_path(path)
    _checks.require_instance(columns, Sequence, "columns", requirement="a sequence of names")
    if isinstance(columns, str) or not columns or not all(isinstance(c, str) for c in columns):
        raise TypeError(f"columns: wanted a sequence of names, got {columns!r}")
    twice = [name for name in columns if columns.count(name) > 1]
    if twice:
        raise LogError(
            f"columns: wanted different names, got {twice[0]!r} twice; one column cannot be two "
            "readings"
        )
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir():
        raise LogError(f"{path}: is a folder, not a log")
    read = _READERS.get(file_ending(path))
    if flight is not None and read is not read_blackbox:
        raise LogError(f"{path}: flight {flight}: only a Blackbox log (.bbl, .bfl) has flights")
    if read is not None:
        return _binary(path, columns, flight)
    if path.suffix.lower() == ".gz" and file_ending(path.with_suffix("")) in _READERS:
        raise LogError(f"{path}: only text is read while it is packed; unpack it first: gunzip")
    try:
        # The file is read line by line, so that only the numbers of a large file stay in memory.
        with text.open_text(path) as file:
            return text.read_columns(path, file, columns)
    except (OSError, EOFError, UnicodeError, zlib.error, csv.Error) as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path}: cannot be read as text ({why})") from None


def file_ending(path: Path) -> str:
    """Return the ending of the name of a log in small letters; `.usd` for a Crazyflie's log without
    an ending.
    """
    if path.suffix or not path.is_file():
        return path.suffix.lower()
    with path.open("rb") as file:
        return ".usd" if file.read(1) == bytes([FIRST_BYTE]) else ""


def _binary(path: Path, columns: Sequence[str], flight: int | None) -> dict[str, np.ndarray]:
    """Read the wanted columns of a log that is not text, and return them by name; raise `LogError`
    as `read_table`.
    """
    read: Any = _READERS[file_ending(path)]
    if read is read_blackbox:
        read = functools.partial(read_blackbox, flight=flight)
    # For an empty or a cut file the readers raise errors of many kinds; the user gets a `LogError`
    # with the name of the file instead.
    try:
        names, arrays = read(path, columns)
    except (LogError, LogWarning):
        raise
    except ModuleNotFoundError as error:
        raise LogError(str(error)) from None
    except Exception as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(
            f"{path}: cannot be read; is it whole, and a {file_ending(path)} file? ({why})"
        ) from None
    out = {}
    for name in columns:
        if name not in arrays:
            raise LogError(f"{path}: no array {name!r}; the arrays are {list_names(names)}")
        if np.asarray(arrays[name]).dtype.kind not in "biuf":
            raise LogError(f"{path}: array {name!r} does not hold real numbers")
        out[name] = np.asarray(arrays[name], float).reshape(-1)
        infinite = np.isinf(out[name])
        if infinite.any():
            raise LogError(
                f"{path}: array {name!r}: row {int(np.argmax(infinite)) + 1} is infinite; NaN "
                "marks a gap"
            )
    sizes = {name: array.size for name, array in out.items()}
    if len(set(sizes.values())) > 1:
        raise LogError(f"{path}: arrays of different lengths: {sizes}")
    return out
