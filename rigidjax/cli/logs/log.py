"""Define what every reader of logs returns."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple


class Log(NamedTuple):
    """Hold the names of a log's columns, and a function that reads some of them."""

    names: Sequence[str]
    # Of names, it returns arrays by name.
    read: Callable[[Sequence[str]], Mapping[str, Any]]
    # The units that the log itself, not the names, says.
    units: Mapping[str, str] = MappingProxyType({})
    # Readings a second, where the log has a line that says it.
    rate: float | None = None
    # Whether no header names the columns: the names are then their numbers, from 1.
    is_nameless: bool = False
