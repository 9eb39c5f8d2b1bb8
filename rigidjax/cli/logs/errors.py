"""Define the error for a log that cannot be read, and the warning for a log that is read only in
part or whose units are doubtful.
"""

import warnings

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


def warn(words: str) -> None:
    """Warn with a `LogWarning` that says `words`."""
    warnings.warn(LogWarning(_checks.escape_controls(words)), stacklevel=3)
