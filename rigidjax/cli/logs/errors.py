"""The error of a log that cannot be read."""

from rigidjax import _checks


class LogError(ValueError):
    """A log that cannot be read; the message names the file and, where known, line and column."""

    def __str__(self) -> str:
        # Names out of a file must not move the cursor of the terminal that shows them.
        return _checks.printable(super().__str__())
