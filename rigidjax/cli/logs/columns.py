"""Define the type of the result of a reader of binary logs."""

from typing import Any

# A reader returns the names of all columns, and the arrays of the wanted columns by name.
Columns = tuple[list[str], dict[str, Any]]
