"""Read tables of text, such as CSV: the header is found by the rows of numbers below it."""

import codecs
import csv
import datetime
import functools
import gzip
import io
import itertools
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidjax.cli.logs.errors import LogError, warn
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.units import spelled_unit

# A packed log is refused if it unpacks to more than _LARGE bytes and _MOST_TIMES its size; readings
# unpack to some ten times their size.
_LARGE, _MOST_TIMES = 10_000_000, 100
# A line is read in pieces of this length, since a file may be one endless line. The module `csv`
# allows no longer cell.
_LONGEST = 131_072
# The header is looked for in so many lines.
_HEAD = 200
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?", re.ASCII)
_GAP = re.compile(r"[-+]?nan|n/?a|null|none|--?", re.IGNORECASE)
_DATE = re.compile(r"\d{4}[-/]\d\d[-/]\d\d|\d\d:\d\d:\d\d", re.ASCII)
_COMMENT = re.compile(r"\s*(#|//|%)[\s#/%]*")
# A name and its number, as in `gx:1.5` or `gyro.x = 2`.
_PAIR = re.compile(
    r"(?<![\w.\]])([A-Za-z_][\w.\[\]]*)\s*[:=]\s*([-+]?(?:nan|[\d.]+(?:[eE][-+]?\d+)?))", re.ASCII
)
# The time of day that a terminal writes before each line.
_STAMP = re.compile(r"\[?(\d\d:\d\d:\d\d[.,]\d+)\]?\s*->\s*", re.ASCII)
_RATE = re.compile(
    r"(?:frame|sampl\w*|update|data|output)[ _]*(?:rate|freq\w*)\W+(\d+(?:\.\d+)?)"
    r"|\b(?:frequency|fs|odr)\W+(\d+(?:\.\d+)?)",
    re.IGNORECASE,
)
# The scales that a log of Gyroflow has above its header, and the unit of the scaled numbers.
_SCALES = {
    "t": ("tscale", "s"),
    "g": ("gscale", "rad/s"),
    "r": ("gscale", "rad/s"),
    "a": ("ascale", "g"),
}
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")


def open_text(path: Path) -> io.TextIOWrapper:
    """Return a text log, which may be packed (gzip), as an open file; its first bytes tell its
    encoding.

    **Raises** `LogError` for a packed file that unpacks to far more than its size.
    """
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
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
        return decoded(raw)
    except BaseException:
        raw.close()
        raise


def decoded(raw: Any) -> io.TextIOWrapper:
    """Return a binary file as text: UTF-16 if it has a byte-order mark or zeros between its
    letters, UTF-8 if its first bytes are valid there, else Windows's code page 1252.
    """
    first = raw.peek(8192)[:8192]
    encoding = "utf-8-sig"
    if first[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        encoding = "utf-16"
    elif len(first) > 1 and 0 in first[:2]:
        encoding = "utf-16-be" if first[0] == 0 else "utf-16-le"
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(first)
        except UnicodeDecodeError:
            # Bytes that are not a valid character in this code page raise an error later.
            encoding = "cp1252"
    return io.TextIOWrapper(raw, encoding=encoding, newline="")


def text_log(path: str, open_file: Callable[[], io.TextIOBase]) -> Log:
    """Return a log of text; `path` is its name in messages."""

    def rows(dialect: "_Dialect", count: int | None = None) -> Iterator[list[str]]:
        with open_file() as file:
            lines = iter(functools.partial(file.readline, _LONGEST), "")
            yield from dialect.rows(itertools.islice(lines, count))

    with open_file() as file:
        head = list(itertools.islice(iter(functools.partial(file.readline, _LONGEST), ""), _HEAD))
    if head and "\0" in head[0]:
        raise LogError(
            f"{path}: line 1: holds zero bytes, so that it is no text; unpack it first, or export "
            "it as CSV"
        )
    dialect = _dialect(path, head)
    return table_log(path, functools.partial(rows, dialect), dialect.separator)


class _Dialect(NamedTuple):
    """Hold the separator, or the names of the pairs, by which lines become cells."""

    # A blank stands for any blanks.
    separator: str
    # The names of the pairs in each line, if the lines are pairs of a name and a number.
    pairs: tuple[str, ...] = ()

    def rows(self, lines: Iterable[str]) -> Iterator[list[str]]:
        """Yield the cells of each line; of one line for each line of pairs, the names first."""
        if self.pairs:
            begun = False
            for line in lines:
                pairs = _PAIR.findall(line)
                same = tuple(name for name, _ in pairs) == self.pairs
                if same and not begun:
                    begun = True
                    yield list(self.pairs)
                yield [number for _, number in pairs] if same else [line.strip()]
        elif self.separator == " ":
            for line in map(self._stamped, lines):
                mark = _COMMENT.match(line)
                first, *more = (line[mark.end() :] if mark else line).split() or [""]
                yield [mark[1] + first if mark else first, *more]
        else:
            for cells in csv.reader(map(self._stamped, lines), delimiter=self.separator):
                yield [cell.strip() for cell in cells]

    def _stamped(self, line: str) -> str:
        """Return a line in which the stamp of a terminal is a cell."""
        stamp = _STAMP.match(line)
        if not stamp:
            return line
        rest = line[stamp.end() :]
        return ("clock" if rest[:1].isalpha() else stamp[1]) + self.separator + rest


def _dialect(path: str, head: Sequence[str]) -> _Dialect:
    """Return how the lines of a log become cells, by its first lines: the separator whose cells are
    numbers most often.
    """
    pairs = [(line, found) for line in head if len(found := _PAIR.findall(line)) >= 3]
    if 2 * len(pairs) > len(head):
        # The words between the numbers.
        counts = Counter(
            " ".join(re.sub(r"[-+]?\b\d[\d.eE]*", "", line).split()) for line, _ in pairs
        )
        names = tuple(name for name, _ in pairs[0][1])
        (_, most), *others = counts.most_common(2)
        if len(set(names)) < len(names) or (others and 10 * others[0][1] > most):
            raise LogError(
                f"{path}: its readings stand on lines of several kinds, or one name stands twice "
                "in a line; print one line for each reading, such as t:0.01,gx:1.2,gy:3.4,gz:5.6"
            )
        return _Dialect("", names)
    first = next(
        (line for line in head if line.strip() and not _COMMENT.match(line)), "".join(head[-1:])
    )

    def score(separator: str) -> tuple[float, float]:
        total = 0.0
        for cells in _Dialect(separator).rows(head):
            full = list(filter(None, cells))
            total += max(0, 2 * sum(map(_is_number, full)) - len(full))
        # Blanks also stand within dates and names: they separate only where no other sign does.
        is_blank = separator == " "
        return total * (0.6 if is_blank else 1.0), 0.5 if is_blank else float(
            first.count(separator)
        )

    return _Dialect(max(",;\t ", key=score))


def _is_number(cell: str) -> bool:
    """Return whether a cell is read as a number, a date or a gap that is written as a word."""
    return bool(_NUMBER.fullmatch(cell) or _GAP.fullmatch(cell) or _DATE.match(cell))


class _Head(NamedTuple):
    """Hold what stands above the numbers of a table."""

    # A name that several columns have is preceded by their groups.
    names: list[str]
    units: dict[str, str]
    # The factors of some columns.
    factors: dict[str, float]
    rate: float | None
    # How many rows stand above the first row of numbers.
    start: int
    has_names: bool
    # Whether a row of numbers was found.
    has_numbers: bool
    # The last cell of the header.
    last: str = ""


def table_log(path: str, rows: Callable[..., Iterable[list[str]]], separator: str = ";") -> Log:
    """Return the log of a table; `rows(count=None)` yields the cells of its first `count` rows."""
    head = _head(path, list(rows(count=_HEAD)))
    read = lambda columns: _read(path, rows(), head, separator, columns)  # noqa: E731
    return Log(head.names, read, head.units, head.rate, not head.has_names)


def _head(path: str, rows: Sequence[list[str]]) -> _Head:
    """Return what stands above the numbers of a table, from its first rows."""
    plain = [[_COMMENT.sub("", cells[0], count=1), *cells[1:]] if cells else [] for cells in rows]
    plain = [cells[: max((i + 1 for i, c in enumerate(cells) if c), default=0)] for cells in plain]
    comment = [bool(cells and _COMMENT.match(cells[0])) for cells in rows]
    full = [[cell for cell in cells if cell] for cells in plain]
    counts = [sum(map(_is_number, cells)) for cells in full]
    is_data = [
        not c and n and 2 * n >= len(f) for c, n, f in zip(comment, counts, full, strict=True)
    ]
    widths = Counter(len(cells) for cells, data in zip(plain, is_data, strict=True) if data)
    if not widths:
        lines = [i for i, cells in enumerate(full) if cells]
        top = next((i for i in lines if not comment[i]), lines[-1] if lines else None)
        if top is None:
            raise LogError(f"{path}: line 1: wanted a header with the names of columns")
        return _Head(plain[top], {}, {}, None, top + 1, True, False)
    width = widths.most_common(1)[0][0]
    # A row of numbers among the names, such as one of identifiers, is followed by names.
    starts = [i for i, cells in enumerate(plain) if is_data[i] and len(cells) == width]
    after = [next((is_data[j] for j in range(i + 1, len(rows)) if full[j]), True) for i in starts]
    start = starts[after.index(True) if any(after) else 0]
    while (
        start
        and len(full[start - 1]) > 1
        and counts[start - 1] == len(full[start - 1])
        and is_data[start - 1]
    ):
        start -= 1
    above = [i for i in range(start) if full[i]]

    def named(i: int) -> bool:
        wide = len(plain[i])
        return not counts[i] and 2 * wide >= width and (wide > 1 or width == 1)

    top = above.pop() if above and named(above[-1]) else None
    units: list[str | None] = []
    if top is not None and above and named(above[-1]):
        units = [spelled_unit(cell) for cell in plain[top]]
        if 2 * sum(map(bool, units)) >= len(full[top]):
            top = above.pop()
        else:
            units = []
    preamble = "\n".join(" ".join(full[i]) for i in above)
    rates = {float(one or two) for one, two in _RATE.findall(preamble)}
    # Vicon writes the rate alone in the line below the title.
    rates |= {
        float(full[b][0])
        for a, b in itertools.pairwise(above[:2])
        if len(full[a]) == len(full[b]) == 1 and counts[b]
    }
    rate = rates.pop() if len(rates) == 1 else None
    if top is None:
        return _Head([str(i + 1) for i in range(width)], {}, {}, rate, start, False, True)
    of_columns = [
        [*plain[i], *[""] * width][: len(plain[top])]
        for i in above
        if len(plain[i]) > 1 and (not plain[i][0] or (len(plain[i]) == width and not counts[i]))
    ]
    names = _qualified(plain[top], of_columns)
    known = {name: unit for name, unit in zip(names, units, strict=False) if unit}
    known |= {
        name: "s" for name, cell in zip(names, plain[start], strict=False) if _DATE.match(cell)
    }
    factors = {}
    if any("IMU LOG" in full[i][0] for i in above):
        scales = {full[i][0]: full[i][1] for i in above if len(full[i]) > 1}
        for name in names:
            word, unit = _SCALES.get(name[:1], ("", ""))
            if word in scales:
                factors[name], known[name] = float(scales[word]), unit
    return _Head(names, known, factors, rate, start, True, True, plain[top][-1])


def _qualified(names: Sequence[str], labels: Sequence[Sequence[str]]) -> list[str]:
    """Return the names of columns; one that several columns have is preceded by the labels above
    it, each of which also belongs to the columns without a label after it.
    """
    # A column whose name stands in the line above.
    names = [n or next((row[i] for row in labels[::-1] if row[i]), "") for i, n in enumerate(names)]
    filled = [list(itertools.accumulate(row, lambda last, label: label or last)) for row in labels]
    twice = [[i for i, name in enumerate(names) if name == one] for one in {*names} - {""}]
    tells = [row for row in filled if any(len({row[i] for i in places}) > 1 for places in twice)]
    return [
        ".".join([*(row[i] for row in tells if row[i] not in ("", n)), n])
        for i, n in enumerate(names)
    ]


def _read(
    path: str, rows: Iterable[list[str]], head: _Head, separator: str, columns: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return the wanted columns of a table by name.

    A row without any number is left out with a warning, as is a last row that is cut. **Raises**
    `LogError`, with the line and the column, for a row with more cells than the header, and for a
    cell that is not a number.
    """
    wanted = [(head.names.index(name), array("d")) for name in columns]
    number_of, silent = _NumberReader(separator), []
    # What is wrong with the last row that was read, and whether it may be cut.
    wrong, is_cut = "", False
    for line, cells in enumerate(itertools.islice(rows, head.start, None), head.start + 1):
        full = [cell for cell in cells if cell]
        if not full or _COMMENT.match(full[0]):
            continue
        if head.has_numbers and not any(map(_is_number, full)):
            if len(cells) == len(head.names) > 1 and cells[-1] != head.last:
                raise LogError(f"{path}: line {line}: another table begins; cut the file above it")
            silent.append(line)
            continue
        if wrong:
            break
        if any(cells[len(head.names) :]):
            wrong = f"{len(cells)} cells, but the header names {len(head.names)} columns"
        numbers = []
        for name, (place, _) in zip(columns, wanted, strict=True):
            if wrong:
                break
            cell = cells[place] if place < len(cells) else None
            try:
                numbers.append(math.nan if cell is None else number_of(cell))
            except ValueError as error:
                wrong = f"column {name!r}: {error}"
            if cell is None:
                wrong = f"column {name!r}: the line ends before it"
            is_cut = bool(wrong) and (cell is None or not _is_number(cell))
        if wrong:
            wrong = f"{path}: line {line}: {wrong}"
            continue
        for number, (_, kept) in zip(numbers, wanted, strict=True):
            kept.append(number)
    else:
        if wrong and is_cut and wanted[0][1]:
            warn(f"{wrong}; this last line is left out: it seems to be cut")
            wrong = ""
    if wrong:
        raise LogError(wrong)
    if silent:
        warn(
            f"{path}: {len(silent)} lines without a number are left out (line {silent[0]} is the "
            "first)"
        )
    read = {
        name: np.frombuffer(kept, float) for name, (_, kept) in zip(columns, wanted, strict=True)
    }
    return {name: x * head.factors[name] if name in head.factors else x for name, x in read.items()}


class _NumberReader:
    """Read the cells of a text log as numbers: the first decimal sign decides whether all decimals
    have a point or a comma.
    """

    def __init__(self, separator: str):
        self.separator = separator
        self.decimal: str | None = None

    def __call__(self, cell: str) -> float:
        """Return the number in a cell, NaN for a gap, and of a date the seconds since 1970, or
        since midnight; raise `ValueError` for other cells.
        """
        if not cell or _GAP.fullmatch(cell):
            return math.nan
        plain = cell
        if self.separator != "," and (self.decimal == "," or "," in cell):
            plain = cell if _DATE.match(cell) else self._with_point(cell)
        elif "." in cell:
            self.decimal = "."
        # `float` accepts more texts than a log may contain, such as 1_000 and digits of other
        # alphabets. These texts are refused here.
        try:
            if _DATE.match(plain):
                return _seconds(plain)
            value = float(plain if plain.isascii() and "_" not in plain else "")
        except ValueError:
            comma = "; a decimal comma? wanted a point" if "," in cell else ""
            date = "; a date? wanted 2024-05-01T12:00:00.02" if cell.count(":") > 1 else ""
            raise ValueError(f"{cell[:60]!r} is not a number{comma}{date}") from None
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


def _seconds(date: str) -> float:
    """Return the seconds of a date since 1970, or of a time of day since midnight."""
    date = date.replace("/", "-").removesuffix("UTC").strip()
    if date[2] == ":":
        time = datetime.time.fromisoformat(date)
        date = f"1970-01-01T{time.isoformat()}"
    when = datetime.datetime.fromisoformat(date)
    return (when if when.tzinfo else when.replace(tzinfo=datetime.UTC)).timestamp()
