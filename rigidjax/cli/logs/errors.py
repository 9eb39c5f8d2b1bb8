"""Define the error for a log that cannot be read, and the warning for a log that is read only in
part or whose units are doubtful.
"""

import warnings
from collections.abc import Sequence

from rigidjax import _checks


class LogError(ValueError):
    """Describe why a log, which is a file of measurements, cannot be read.

    The message names the file and, if they are known, the line and the column.
    """

    def __str__(self) -> str:
        """Return the message with control characters escaped, since the name of a file or column
        may contain characters that are commands for a terminal.
        """
        return _checks.escape_controls(super().__str__())


class LogWarning(UserWarning):
    """Describe which part of a log (a file of measurements) is left out, or why the units of the
    log are doubtful.
    """


def list_names(names: Sequence[str]) -> str:
    """Return the `names` of the columns of a log for a message; of many names or a long one only
    the first part.
    """
    more = f", and {len(names) - 40} more" if len(names) > 40 else ""
    return ", ".join(name[:60] for name in names[:40]) + more


def warn(words: str) -> None:
    """Warn with a `LogWarning` that says `words`."""
    warnings.warn(LogWarning(_checks.escape_controls(words)), stacklevel=3)
