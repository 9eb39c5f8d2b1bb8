"""What a reader of a binary log returns."""

from typing import Any

# All names, and the arrays of the wanted ones.
Columns = tuple[list[str], dict[str, Any]]
