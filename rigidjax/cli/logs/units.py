"""Convert units of columns to SI, and find units in the names of columns."""

import math
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rigidjax.cli.logs.errors import LogError, warn

# This table has a factor for each unit: the product of a value in the unit and the factor is the
# value in SI units.
UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "mm": 1e-3, "m/s2": 1.0, "g": 9.80665,
    "1": 1.0, "rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180,
    "mdeg/s": 1e-3 * math.pi / 180, "mg": 9.80665e-3, "rpm": math.pi / 30,
}  # fmt: skip
RATE_UNITS = ("rad/s", "deg/s", "mdeg/s")
FORCE_UNITS = ("m/s2", "g", "mg")
TIME_UNITS = ("s", "ms", "us", "ns")
# Each unit has the spellings in this table, in small letters; powers are without `^`, `**` or
# raised digits.
_SPELLINGS = {
    "s": "s sec secs second seconds",
    "ms": "ms msec millis millisecond milliseconds",
    "us": "us usec micros microsecond microseconds",
    "ns": "ns nsec nanos nanosecond nanoseconds",
    "rad/s": "rad/s rad/sec rads/s radian/s radians/s rads-1 rad_s",
    "deg/s": "deg/s deg/sec degs/s degree/s degrees/s °/s °/sec dps degs-1 °s-1 deg_s",
    "mdeg/s": "mdeg/s mdps millidps",
    "mg": "mg",
    "rpm": "rpm rev/min r/min 1/min u/min min-1",
    "m/s2": "m/s2 m/sec2 m/s/s ms-2 m_s2",
    "g": "g g0",
    "rad": "rad rads radian radians",
    "deg": "deg degs degree degrees °",
}
_UNIT_OF = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
_IN_BRACKETS = re.compile(r"[(\[]([^()\[\]]*)[)\]]\s*$")
# This pattern finds words in brackets, in the name of a column, that are meant as a unit, though as
# an unknown one; other words in brackets are an axis or an index.
_UNKNOWN = re.compile(r"[/°]|dps|lsb|count|raw", re.IGNORECASE)
# This table replaces characters that have several spellings by one spelling, and removes signs of
# powers and products.
_SIGNS = str.maketrans({
    "²": "2", "⁻": "-", "−": "-", "¹": "1", "µ": "u", "μ": "u", "º": "°", "^": None, "*": None,
    "·": None, "⋅": None, ".": None, " ": None,
})  # fmt: skip


def unit_in_name(column: str, allowed: Sequence[str]) -> str | None:
    """Return the unit at the end of the name of a column, or `None` if no known unit is there.

    A unit in brackets may be any of `UNITS`, since brackets hold little else; a unit after a blank,
    a comma or an underscore must be one of `allowed`.
    """
    brackets = _IN_BRACKETS.search(column)
    if brackets:
        return spelled_unit(brackets[1])
    endings = [
        column[match.end() :] for match in re.finditer(r"[\s,_]+|(?<=[a-z])(?=[A-Z])", column)
    ]
    if "ms" in allowed:
        # Of a time the unit alone may be the name, and a long word may stand at the beginning.
        last = column.rpartition(".")[2]
        endings += [last, *(word for word in re.split("[ _]", last) if len(word) > 3)]
    return next((unit for unit in map(spelled_unit, endings) if unit in allowed), None)


def spelled_unit(text: str) -> str | None:
    """Return the unit that a text is, perhaps in brackets, or `None`."""
    return _UNIT_OF.get(_plain(text.strip("()[] ")))


def _plain(unit: str) -> str:
    """Return a unit in small letters and with one spelling of each sign: "m/s2" for "m/s²". A
    capital G means gauss, unlike g, and stays.
    """
    return unit.translate(_SIGNS).lower() if unit.strip() != "G" else unit


def common_unit(
    columns: Sequence[str],
    stated_unit: str | None,
    allowed: Sequence[str],
    message_start: str,
    by_log: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the unit of columns of one quantity: the stated one, else that which the log has for
    them or their names say, else the first of the allowed ones.

    It **warns** of an unknown unit in brackets, if none is stated. **Raises** `LogError` for names
    that contradict one another or the stated unit, and for a unit that is not allowed.
    """
    if stated_unit not in (None, *allowed):
        raise LogError(f"{message_start}: wanted {' or '.join(allowed)}, got {stated_unit!r}")
    in_names = {n: u for n in columns if (u := by_log.get(n) or unit_in_name(n, allowed))}
    for name, unit in in_names.items():
        if unit not in allowed:
            wanted = " or ".join(allowed)
            raise LogError(f"{message_start}: column {name!r} is in {unit}; wanted {wanted}")
        if stated_unit is not None and unit != stated_unit:
            raise LogError(
                f"{message_start}: column {name!r} is in {unit} by "
                f"{'the log' if name in by_log else 'its name'}, and {stated_unit} is stated: "
                "which one? state the same unit, or none"
            )
    # For each unit in the names the dict has one column with this unit, so that a message about
    # different units can name two columns.
    by_unit = {unit: name for name, unit in in_names.items()}
    if len(by_unit) > 1:
        (one, first), (other, second) = list(by_unit.items())[:2]
        raise LogError(
            f"{message_start}: column {first!r} is in {one}, column {second!r} in {other}"
        )
    unit = stated_unit or next(iter(in_names.values()), allowed[0])
    for name in columns:
        brackets = _IN_BRACKETS.search(name)
        if (
            stated_unit is None
            and brackets
            and name not in in_names
            and _UNKNOWN.search(brackets[1])
        ):
            warn(f"{message_start}: column {name!r}: its unit is not known; it is read in {unit}")
    return unit
