"""Define the type of the result of a reader of binary logs."""

from typing import Any

# The function that reads logs of one format returns this pair: the names of all columns of the log,
# and a dict of the arrays of the wanted columns by name.
Columns = tuple[list[str], dict[str, Any]]
