"""Read text logs, which are a header line and lines of numbers; errors name the file, line and
column.
"""

import codecs
import csv
import gzip
import io
import itertools
import math
import re
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidjax.cli.logs.errors import LogError, list_names

SEPARATORS = ",;\t"
# A packed log is refused if it unpacks to more than _LARGE bytes and _MOST_TIMES its size; readings
# unpack to some ten times their size.
_LARGE, _MOST_TIMES = 10_000_000, 100


def open_text(path: Path) -> io.TextIOWrapper:
    """Return a text log, which may be packed (`.gz`), as an open file; its first bytes tell its
    encoding.

    **Raises** `LogError` for a packed file that unpacks to far more than its size.
    """
    packed = path.suffix.lower() == ".gz"
    if packed:
        # Nearly equal lines, which no readings are, would fill the memory or take minutes.
        most, unpacked = max(_LARGE, _MOST_TIMES * path.stat().st_size), 0
        with gzip.open(path, "rb") as file:
            while piece := file.read(2**20):
                unpacked += len(piece)
                if unpacked > most:
                    raise LogError(
                        f"{path}: unpacks to more than {_MOST_TIMES} times its size: nearly all "
                        "its lines are the same, so that it holds no readings"
                    )
    raw: Any = gzip.open(path, "rb") if packed else path.open("rb")
    try:
        return io.TextIOWrapper(raw, encoding=_encoding(raw.peek(8192)), newline="")
    except BaseException:
        raw.close()
        raise


def _encoding(first_bytes: bytes) -> str:
    """Return the encoding of a text: UTF-16 if it has a byte-order mark or zeros between its
    letters, UTF-8 if its bytes are valid there, else Windows's code page 1252.
    """
    if first_bytes[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return "utf-16"
    if len(first_bytes) > 1 and 0 in first_bytes[:2]:
        return "utf-16-be" if first_bytes[0] == 0 else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(first_bytes)
    except UnicodeDecodeError:
        # Bytes that are not a valid character in this code page raise an error when they are read.
        return "cp1252"
    return "utf-8-sig"


class Header(NamedTuple):
    """Hold the header of a text log."""

    names: list[str]
    separator: str
    # The number of the header's line, and the lines that were read after it.
    line: int
    after: list[str]


def read_header(file: io.TextIOBase) -> Header:
    """Return the header of a text log, open at its beginning: its first line that is neither empty
    nor a comment (`#`).

    If this line contains a number in place of a name, or is missing, the last comment before it is
    the header, as in files of `numpy.savetxt`.
    """
    comments, first, line = "", file.readline(_LONGEST), 1
    while first.startswith("#") or (first and not first.strip()):
        comments = first if first.startswith("#") else comments
        first, line = file.readline(_LONGEST), line + 1
    names, separator = _split(first)
    if comments and (not first or any(map(_NUMBER.fullmatch, names))):
        return Header(*_split(comments.lstrip("#")), line - 1, [first])
    return Header(names, separator, line, [])


# A line of the header is read up to this length only, since a file may be one endless line. The
# module `csv` allows no longer cell.
_LONGEST = 131_072
_NUMBER = re.compile(r"[-+.\d][-+.\deE]*")


def _split(line: str) -> tuple[list[str], str]:
    """Return the names of columns in a header line, and their separator: the comma, semicolon or
    tab that gives the most names.
    """
    separator = max(SEPARATORS, key=line.count)
    return [name.strip() for name in next(csv.reader([line], delimiter=separator), [])], separator


def read_columns(path: Path, file: io.TextIOBase, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Read the wanted columns of a text, open at its beginning, and return them by name.

    **Raises** `LogError`, with the line and the column, for a column that is missing or there
    twice, a line with more cells than the header, and a cell that is not a number.
    """
    header, separator, top, after = read_header(file)
    if not any(header):
        raise LogError(f"{path}: line 1: wanted a header with the columns {', '.join(columns)}")
    if any("\0" in name for name in header):
        raise LogError(f"{path}: line {top}: holds zero bytes, so that it is no text")
    for name in columns:
        if name not in header:
            advice = (
                "names and numbers are separated by commas, semicolons or tabs"
                if len(header) == 1
                else "name yours with --columns or --sensor"
            )
            raise LogError(
                f"{path}: line {top}: no column {name!r}; the columns are {list_names(header)} "
                f"({advice})"
            )
        if header.count(name) > 1:
            raise LogError(
                f"{path}: line {top}: wanted one column {name!r}, got {header.count(name)}; rename "
                "all but one"
            )
    wanted = [(name, header.index(name), array("d")) for name in columns]
    number_of = _NumberReader(separator)
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
                    numbers.append(number_of(cells[place].strip()))
                except ValueError as error:
                    raise LogError(f"{path}: line {line}: column {name!r}: {error}") from None
    return {name: np.frombuffer(numbers, float) for name, _, numbers in wanted}


class _NumberReader:
    """Read the cells of a text log as numbers: the first decimal sign decides whether all decimals
    have a point or a comma.
    """

    def __init__(self, separator: str):
        self.separator = separator
        self.decimal: str | None = None

    def __call__(self, cell: str) -> float:
        """Return the number in a cell, NaN for an empty one; raise `ValueError` for other cells."""
        if not cell:
            return math.nan
        plain = cell
        if self.separator != "," and (self.decimal == "," or "," in cell):
            plain = self._with_point(cell)
        elif "." in cell:
            self.decimal = "."
        # `float` accepts more texts than a log may contain, such as 1_000 and digits of other
        # alphabets. These texts are refused here.
        try:
            value = float(plain if plain.isascii() and "_" not in plain else "")
        except ValueError:
            comma = "; a decimal comma? wanted a point" if "," in cell else ""
            raise ValueError(f"{cell[:60]!r} is not a number{comma}") from None
        if not math.isfinite(value):
            raise ValueError(f"{cell} is not a finite number; leave the cell empty for a gap")
        return value

    def _with_point(self, cell: str) -> str:
        """Return the cell with a decimal point; raise `ValueError` after cells with points, and for
        a comma that may mark thousands.
        """
        if "." in cell or self.decimal == ".":
            raise ValueError(f"{cell!r} is not a number; the decimals above have the other sign")
        # In a text with tabs between its cells, the cell 1,200 may mean 1200 or 1.2, as long as no
        # earlier cell has shown which sign marks the decimals.
        if self.decimal is None and self.separator == "\t" and _THOUSANDS.fullmatch(cell):
            raise ValueError(f"{cell!r} is not a number; does its comma mark thousands?")
        if "," in cell:
            self.decimal = ","
        return cell.replace(",", ".")


_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
