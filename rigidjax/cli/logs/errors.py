"""The error of a log that cannot be read, and the warning of one that is not read whole."""

import warnings

from rigidjax import _checks


class LogError(ValueError):
    """A log that cannot be read; the message names the file and, where known, line and column."""

    def __str__(self) -> str:
        # Names out of a file must not move the cursor of the terminal that shows them.
        return _checks.printable(super().__str__())


class LogWarning(UserWarning):
    """A log of which a part is left out, or whose units are doubtful; the command prints it."""


def warn(words: str) -> None:
    """Warn with a `LogWarning` of these words."""
    warnings.warn(LogWarning(_checks.printable(words)), stacklevel=3)
