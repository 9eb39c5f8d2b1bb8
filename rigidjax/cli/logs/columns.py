"""Define the type of the result of a reader of binary logs."""

from collections.abc import Sequence
from typing import Any, NamedTuple


class Columns(NamedTuple):
    """Hold the columns that were read from a binary log."""

    # The names of all columns of the log, also of those that were not read.
    names: Sequence[str]
    # The wanted columns by name; a column that the log lacks is left out.
    arrays: dict[str, Any]
