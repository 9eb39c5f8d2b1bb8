"""Define the error for a log that cannot be read, and the warning for a log that is read only in
part or whose units are doubtful.
"""

import warnings
from collections.abc import Sequence

from rigidjax import _checks


class LogError(ValueError):
    """Describe why a log cannot be read: the message names the file and, if known, the line and
    column.
    """

    def __str__(self) -> str:
        """Return the message with control characters escaped: the name of a file or column may
        contain commands for a terminal.
        """
        return _checks.escape_controls(super().__str__())


class LogWarning(UserWarning):
    """Describe which part of a log is left out, or why its units are doubtful."""


def list_names(names: Sequence[str]) -> str:
    """Return the names of columns for a message; of many names or a long one the first part."""
    more = f", and {len(names) - 40} more" if len(names) > 40 else ""
    return ", ".join(name[:60] for name in names[:40]) + more


def warn(words: str) -> None:
    """Warn with a `LogWarning` that says `words`."""
    warnings.warn(LogWarning(_checks.escape_controls(words)), stacklevel=3)
