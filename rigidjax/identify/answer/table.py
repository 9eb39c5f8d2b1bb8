"""Write quantities with their intervals as a table, in plain text and in HTML."""

import html
from collections.abc import Iterable

import numpy as np

from rigidjax import _checks

Row = tuple[str, float, float, float, str]


def table(lines: list[Row]) -> str:
    """Return `lines` as a table of text, with each number rounded by the width of its interval.

    **Arguments:** `lines` one or more rows (name, value, low, high, unit), such as those that
    `rows` returns.

    >>> print(table([("I1", 1.23456, 1.2, 1.27, "kg m²")]))
                 value  95 % interval
    I1          1.2346  1.2000 … 1.2700 kg m²
    """
    for line in _checks.require_instance(
        lines, (list, tuple), "lines", requirement="a list of rows"
    ):
        if not isinstance(line, tuple) or len(line) != 5:
            raise TypeError(f"lines: wanted rows (name, value, low, high, unit), got {line!r}")
    if not lines:
        raise ValueError("lines: wanted at least one row, got none")
    wide = max(len(name) for name, *_ in lines)
    out = [f"{'':{wide}}  {'value':>14}  95 % interval"]
    for name, value, low, high, unit in lines:
        shown = numbers(value, low, high)
        out.append(f"{name:{wide}}  {shown[0]:>14}  {interval_text(shown)} {unit}".rstrip())
    return "\n".join(out)


def numbers(value: float, low: float, high: float) -> list[str]:
    """Return three texts: `value`, `low` and `high`, rounded by the width of the interval.

    **Arguments:** `value` the number; `low` and `high` the ends of the interval of this number, in
    the same unit.

    >>> numbers(1.23456, 1.2, 1.27)
    ['1.2346', '1.2000', '1.2700']
    """
    value = _checks.python_float(value, "value")
    low, high = _checks.python_float(low, "low"), _checks.python_float(high, "high")
    wholes = [abs(number) for number in (value, low, high) if np.isfinite(number)]
    size, gaps = max(wholes, default=0.0), (value - low, high - value)
    fixed = size == 0 or 1e-3 <= size < 1e6
    near = min((gap for gap in gaps if 0 < gap < np.inf), default=0.0)

    def shown(number: float, gap: float) -> str:
        if not np.isfinite(number):
            return str(number)
        top = _power_of_ten(size if fixed else number)
        # The number is shown to two digits after the first digit of the uncertainty, or with six
        # digits if there is no uncertainty.
        last = _power_of_ten(2 * min(gap, 8e307)) - 2 if 0 < gap < np.inf else top - 5
        last = min(max(last, top - 12), top - 2)
        return f"{number:.{max(-last, 0)}f}" if fixed else f"{number:.{top - last}e}"

    ends = (near, near, near) if fixed else (near, *gaps)
    return [shown(number, gap) for number, gap in zip((value, low, high), ends, strict=True)]


def _power_of_ten(number: float) -> int:
    """Return the power of ten of the first digit of `number`, such as 2 for 345; 0 for zero."""
    return int(np.floor(np.log10(abs(number)))) if number else 0


def interval_text(texts: list[str]) -> str:
    """Return "low … high" of the texts (value, low, high), or "not determined" for NaN."""
    return "not determined" if "nan" in texts[1:] else f"{texts[1]} … {texts[2]}"


def html_rows(lines: Iterable[tuple[str, ...]]) -> str:
    """Return lines of cells as rows (`tr`) of a table of HTML."""
    cells = ("".join(f"<td>{html.escape(cell)}</td>" for cell in line) for line in lines)
    return "".join(f"<tr>{line}</tr>" for line in cells)
