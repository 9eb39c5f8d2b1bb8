"""Logs in text: a header line, then numbers. Errors name file, line and column."""

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

from rigidjax.cli.logs.errors import LogError

SEPARATORS = ",;\t"


def opened(path: Path) -> io.TextIOWrapper:
    """Open a log in text, packed (`.gz`) or not, by the encoding that its first bytes show."""
    packed = path.suffix.lower() == ".gz"
    raw: Any = gzip.open(path, "rb") if packed else path.open("rb")
    try:
        return io.TextIOWrapper(raw, encoding=_encoding(raw.peek(8192)), newline="")
    except BaseException:
        raw.close()
        raise


def _encoding(begin: bytes) -> str:
    """Return UTF-16 if its mark or zeros between the letters show it, else UTF-8 or Windows's."""
    if begin[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return "utf-16"
    if len(begin) > 1 and 0 in begin[:2]:
        return "utf-16-be" if begin[0] == 0 else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(begin)
    except UnicodeDecodeError:
        # Which bytes stand for no letter there, the reading says.
        return "cp1252"
    return "utf-8-sig"


class Header(NamedTuple):
    """Column names; their separator; the number of their line; the lines read after it."""

    names: list[str]
    separator: str
    line: int
    after: list[str]


def read_header(file: io.TextIOBase) -> Header:
    """Return the header of a text, read from its beginning: the first line, below comments (`#`).

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
    """Return the names in a line, and what separates them: whichever gives most of them."""
    separator = max(SEPARATORS, key=first.count)
    return [name.strip() for name in next(csv.reader([first], delimiter=separator), [])], separator


def rows(path: Path, file: io.TextIOBase, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Read the wanted columns of a text, line by line."""
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
    number_of = _Numbers(separator)
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


class _Numbers:
    """Read cells as numbers; the first decimal of a file decides between a point and a comma."""

    def __init__(self, separator: str):
        self.separator = separator
        self.decimal: str | None = None

    def __call__(self, cell: str) -> float:
        if not cell:
            return math.nan
        plain = cell
        if self.separator != "," and (self.decimal == "," or "," in cell):
            plain = self._with_point(cell)
        elif "." in cell:
            self.decimal = "."
        # Python's own spelling is wider than that of logs: 1_000, other alphabets' digits.
        try:
            value = float(plain if plain.isascii() and "_" not in plain else "")
        except ValueError:
            comma = "; a decimal comma? wanted a point" if "," in cell else ""
            raise ValueError(f"{cell!r} is not a number{comma}") from None
        if not math.isfinite(value):
            raise ValueError(f"{cell} is not a finite number; leave the cell empty for a gap")
        return value

    def _with_point(self, cell: str) -> str:
        """Return the cell with a point for its decimal comma."""
        if "." in cell or self.decimal == ".":
            raise ValueError(f"{cell!r} is not a number; the decimals above have the other sign")
        # Between tabs, 1,200 may be a thousand.
        if self.decimal is None and self.separator == "\t" and _THOUSANDS.fullmatch(cell):
            raise ValueError(f"{cell!r} is not a number; does its comma mark thousands?")
        if "," in cell:
            self.decimal = ","
        return cell.replace(",", ".")


_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
