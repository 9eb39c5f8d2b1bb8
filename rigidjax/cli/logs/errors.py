"""The error for a log that cannot be read, and the warning for one that is not read whole."""

import warnings

from rigidjax import _checks


class LogError(ValueError):
    """The error for a log that cannot be read.

    The message names the file and, if they are known, the line and the column.
    """

    def __str__(self) -> str:
        """Return the message without control characters: a name may hold those of a terminal."""
        return _checks.escape_controls(super().__str__())


class LogWarning(UserWarning):
    """The warning for a log of which a part is left out, or whose units are doubtful."""


def warn(words: str) -> None:
    """Warn by a `LogWarning` with these words."""
    warnings.warn(LogWarning(_checks.escape_controls(words)), stacklevel=3)
