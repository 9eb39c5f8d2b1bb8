"""The type of the result of a reader of binary logs."""

from typing import Any

# The names of all columns, and the arrays of the wanted ones.
Columns = tuple[list[str], dict[str, Any]]
