"""Read the columns of a log by name, whatever the format of the log."""

import contextlib
import csv
import functools
import gzip
import io
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs import arrays, messages
from rigidjax.cli.logs.blackbox import read_blackbox
from rigidjax.cli.logs.crazyflie import FIRST_BYTE, read_crazyflie
from rigidjax.cli.logs.errors import LogError, LogWarning, list_names, warn
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.text import decoded, open_text, table_log, text_log

_AS_CSV = "export it as CSV"


def read_table(
    path: str | Path, columns: Sequence[str], *, flight: int | None = None
) -> dict[str, np.ndarray]:
    """Read columns of a log by name; its first bytes tell its format.

    A log is one of these:

    - Text, which may be packed (gzip), in UTF-8, UTF-16 or Windows's code page 1252. Cells are
      separated by commas, semicolons, tabs or blanks. Decimals have a point or, except between
      commas, a comma. The header is the line above the first lines of numbers; units, and the names
      of groups of columns, may stand below and above it. Comments begin with `#`, `//` or `%`. A
      cell may be a date (ISO 8601), then in s. Without a header the names of the columns are `1`,
      `2`, …; lines of pairs such as `gx:1.5` need none. Text is read line by line, so that reading
      needs up to three times the memory of the numbers that are read.
    - Text in a zip file, `.npy`, `.npz`, `.mat` (MATLAB up to v7), JSON, or a Crazyflie's µSD log.
    - With the extra of the same name (`pip install '.[blackbox]'` in the clone): `blackbox`; `ulog`
      of PX4; `ardupilot` (`.bin` and its text dump); `mcap` (JSON and ROS 2); `ros` (`.bag`,
      `.db3`); `excel` (`.xlsx`, `.xls`, `.ods`); `hdf5` (and MATLAB's v7.3); `parquet` (and
      Feather).

    Columns of matrices, structs, topics, sheets and files in a zip file have names such as
    `gyro[0]`, `imu.t` and `Gyroscope.x`; the end of a name after a point suffices if it is that of
    one column only.

    **Arguments:**

    - `path`: the path of the file.
    - `columns`: the names of the wanted columns; all other columns are ignored.
    - `flight`: the number of the flight in a Blackbox log, from 1; `None` if the log has only one
      flight.

    **Returns** name → (T,) numbers in the units of the log, NaN for a gap. It **warns** of lines
    without a number, of a last line that is cut, and of frames (records) of a Blackbox log, that
    are left out. An I frame is a frame that can be read alone: all frames before the first I frame
    are left out, and all frames from a damaged frame to the next I frame.

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
    return read_columns(path, open_log(path, flight), columns)


def read_columns(path: Path, log: Log, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the columns of an open log as numbers, as `read_table`."""
    twice = [name for name in columns if columns.count(name) > 1]
    if twice:
        raise LogError(
            f"columns: wanted different names, got {twice[0]!r} twice; one column cannot be two "
            "readings"
        )
    full = full_names(path, log, columns)
    read = _tried(path, lambda: log.read(full))
    out = {
        name: _as_numbers(path, name, read[long]) for name, long in zip(columns, full, strict=True)
    }
    sizes = {name: array.size for name, array in out.items()}
    if len(set(sizes.values())) > 1:
        raise LogError(f"{path}: arrays of different lengths: {sizes}")
    return out


def open_log(path: Path, flight: int | None = None) -> Log:
    """Return the log in a file, by its first bytes; raise `LogError` as `read_table`."""
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir() and (path / "metadata.yaml").exists():
        return _tried(path, lambda: messages.read_bag(path))
    if path.is_dir():
        raise LogError(f"{path}: is a folder, not a log")
    with path.open("rb") as file:
        first = file.read(1000)
    packed = first.startswith(b"\x1f\x8b")
    if packed:
        with contextlib.suppress(OSError, EOFError, zlib.error), gzip.open(path) as file:
            first = file.read(1000)
    kinds = ((how, words) for start, how, words in _FORMATS if re.match(start, first, re.DOTALL))
    how, words = next(kinds, (_read_text, ""))
    if packed and how is not _read_text:
        raise LogError(f"{path}: only text is read while it is packed; unpack it first: gunzip")
    if path.suffix.lower() == ".mat" and how is _read_text:
        how = arrays.read_mat
    if flight is not None and how is not read_blackbox:
        raise LogError(f"{path}: flight {flight}: only a Blackbox log (.bbl, .bfl) has flights")
    if how is None:
        raise LogError(f"{path}: {words}")
    if how is read_blackbox:
        how = functools.partial(read_blackbox, flight=flight)
    return _tried(path, lambda: how(path), words)


def _tried(path: Path, read: Callable[[], Any], words: str = "") -> Any:
    """Return what `read()` returns. Readers raise errors of many kinds for an empty or a cut file;
    each becomes a `LogError` with the name of the file, and with `words` on what to do.
    """
    try:
        return read()
    except (LogError, LogWarning):
        raise
    except ModuleNotFoundError as error:
        raise LogError(f"{error}{words and f', or {words}'}") from None
    except (UnicodeError, EOFError, zlib.error, csv.Error) as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path}: cannot be read as text ({why}); {_AS_CSV}") from None
    except Exception as error:
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(
            f"{path}: cannot be read; is it whole? ({why}){words and f'; {words}'}"
        ) from None


def full_names(path: Path, log: Log, columns: Sequence[str]) -> list[str]:
    """Return the full names in the log of the wanted columns, of each of which the end may be
    given; raise `LogError` for one that is missing or there twice.

    Of several columns with one end, that is meant whose group has most of the wanted columns.
    """
    names = list(log.names)
    if log.is_nameless and not {*columns} <= {*names}:
        if len(columns) != len(names):
            raise LogError(
                f"{path}: line 1: no header, but {len(names)} columns of numbers; name them by "
                f"their places, as in --columns 1 2 3 4, or write a header above them"
            )
        warn(f"{path}: no header: its columns are taken as {', '.join(columns)}, in this order")
        return names
    full = []
    for wanted in columns:
        found = [n for n in names if n == wanted] or [n for n in names if n.endswith(f".{wanted}")]
        groups = [name.removesuffix(wanted) for name in found]
        share = [sum(group + other in names for other in columns) for group in groups]
        found = [name for name, one in zip(found, share, strict=True) if one == max(share)]
        if not found:
            raise LogError(
                f"{path}: no column {wanted!r}; the columns are {list_names(names)} (name yours "
                "with --columns or --sensor)"
            )
        if len(found) > 1:
            advice = "rename all but one" if len({*found}) == 1 else f"name one: {', '.join(found)}"
            raise LogError(f"{path}: wanted one column {wanted!r}, got {len(found)}; {advice}")
        full += found
    return full


def _as_numbers(path: Path, name: str, values: Any) -> np.ndarray:
    """Return a column as numbers, a date in s; raise `LogError` for other values and infinity."""
    values = np.asarray(values).reshape(-1)
    if values.dtype.kind in "mM":
        values = (values - values[:1].astype(values.dtype)) / np.timedelta64(1, "s")
    if values.dtype.kind not in "biuf":
        raise LogError(f"{path}: array {name!r} does not hold real numbers")
    infinite = np.isinf(values)
    if infinite.any():
        row = int(np.argmax(infinite)) + 1
        raise LogError(f"{path}: array {name!r}: row {row} is infinite; NaN marks a gap")
    return values.astype(float)


def _read_text(path: Path) -> Log:
    """Return the log of a text."""
    return text_log(str(path), lambda: open_text(path))


def _tables_log(path: Path, tables: Mapping[str, Log]) -> Log:
    """Return the log of several tables, whose columns have names such as `Gyroscope.x`."""
    if not tables:
        raise LogError(f"{path}: no table of numbers is in it; {_AS_CSV}")
    places = {f"{title}.{name}": (log, name) for title, log in tables.items() for name in log.names}

    def read(columns: Sequence[str]) -> dict[str, Any]:
        out = {}
        for log in tables.values():
            inside = {name: places[name][1] for name in columns if places[name][0] is log}
            arrays = log.read(list(inside.values())) if inside else {}
            out |= {name: arrays[short] for name, short in inside.items()}
        return out

    units = {name: log.units[short] for name, (log, short) in places.items() if short in log.units}
    rates = {log.rate for log in tables.values()}
    return Log(list(places), read, units, rates.pop() if len(rates) == 1 else None)


def _read_zip(path: Path) -> Log:
    """Return the log of the texts in a zip file, or of NumPy's arrays or of sheets in one."""
    tables = {}
    with zipfile.ZipFile(path) as file:
        names = [n for n in file.namelist() if not n.startswith("__MACOSX") and not n.endswith("/")]
    if any(name.startswith(("xl/", "content.xml")) for name in names):
        return _read_sheets(path)
    if any(name.endswith(".npy") for name in names):
        return arrays.read_numpy(path)
    texts = [n for n in names if n.lower().endswith((".csv", ".tsv", ".txt", ".log"))]
    if not texts:
        raise LogError(f"{path}: no text is in it, but {list_names(names)}; unpack it first")
    for name in texts:

        def opened(name: str = name) -> io.TextIOWrapper:
            return decoded(zipfile.ZipFile(path).open(name))

        log = text_log(f"{path}: {name}", opened)
        if len(log.names) > 2:
            tables[
                Path(name).stem if len({Path(n).stem for n in texts}) == len(texts) else name
            ] = log
    return _tables_log(path, tables)


def _read_sheets(path: Path) -> Log:
    """Return the log of the sheets of a file of Excel or OpenDocument, by python-calamine."""
    library = _checks.import_library("python_calamine", "excel", str(path)).CalamineWorkbook
    book, tables = library.from_path(str(path)), {}
    for title in book.sheet_names:
        rows = [[_cell(one) for one in row] for row in book.get_sheet_by_name(title).to_python()]
        if len(rows) > 2:
            tables[title] = table_log(
                f"{path}: {title}", lambda count=None, rows=rows: iter(rows[:count])
            )
    return _tables_log(path, {title: log for title, log in tables.items() if len(log.names) > 2})


def _cell(value: Any) -> str:
    """Return the text of a cell of a sheet."""
    return value.isoformat() if hasattr(value, "isoformat") else str(value).strip()


# The first bytes of each format, its reader, and words on what to do if it cannot be read. A format
# without a reader is refused with these words.
_FORMATS: Sequence[tuple[bytes, Callable[[Path], Log] | None, str]] = (
    (rb"PK\x03\x04", _read_zip, "unpack it first, or " + _AS_CSV),
    (rb"\xd0\xcf\x11\xe0", _read_sheets, "save it as CSV"),
    (rb"\x93NUMPY", arrays.read_numpy, ""),
    (rb"MATLAB 7\.3", arrays.read_hdf5, "save it in MATLAB with save(…, '-v7')"),
    (rb"MATLAB", arrays.read_mat, ""),
    (rb"\x89HDF", arrays.read_hdf5, _AS_CSV),
    (rb"PAR1|ARROW1|FEA1", arrays.read_arrow, _AS_CSV),
    (rb"ULog", messages.read_ulog, "export it with ulog2csv"),
    (rb"\x89MCAP", messages.read_mcap, ""),
    (rb"#ROSBAG V2|SQLite", messages.read_bag, "export the topic as CSV"),
    (rb"\xa3\x95|FMT, ?128", messages.read_ardupilot, _AS_CSV),
    (rb"H Product:", read_blackbox, "export it with blackbox_decode"),
    (bytes([FIRST_BYTE]), read_crazyflie, ""),
    (rb"\s*\{|\s*\[\s*[\[{\]]", messages.read_json, _AS_CSV),
    (rb"#ROSBAG", None, "a ROS bag of an old version; convert it with rosbag fix"),
    (
        rb"\x1f\x9d|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd|7z\xbc\xaf|Rar!|.{257}ustar",
        None,
        "is packed; unpack it first",
    ),
    (rb"CDF[\x01\x02\x05]", None, "netCDF 3; convert it with nccopy -k nc4, or export it as CSV"),
    (rb"TDSm", None, "a TDMS file of LabVIEW; export it as CSV, as npTDMS does"),
    (
        rb"\x80[\x02-\x05]",
        None,
        "a pickle, which may run code; save its columns with to_csv or numpy.savez",
    ),
    (rb"[\x02-\x08]\x50", None, "a C3D file; export its motion as CSV or TSV"),
    (
        rb"\x00[\x00-\x0f].{6}[\xfd\xfe]",
        None,
        "telemetry of MAVLink; convert it with mavlogdump.py --format csv",
    ),
    (rb".{4}ftyp", None, "a video; extract its gyro as CSV, as Gyroflow does"),
    (rb"(\xef\xbb\xbf)?\s*<", None, "a page or a file of XML; export the readings as CSV or text"),
    (
        rb"%PDF|\x89PNG|\xff\xd8\xff|HIERARCHY|XDF:|MDF |\{\\rtf",
        None,
        "not a table of readings; export them as CSV",
    ),
)
