"""Print lines, warnings and errors of the command line."""

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from rigidjax import _checks
from rigidjax.cli.logs.errors import LogWarning


def print_line(line: str) -> None:
    """Print a line with its control characters escaped."""
    try:
        print(_checks.escape_controls(line), flush=True)
    except OSError:
        # The program that reads the output has ended, as `head` does, or a disk is full. The run
        # goes on without printing, since its files must still be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(message: object) -> int:
    """Print an error in one line, and return the exit code 2."""
    print(f"error: {_checks.escape_controls(message)}", file=sys.stderr)
    return 2


@contextlib.contextmanager
def print_warnings(strict: bool) -> Iterator[None]:
    """Print each `UserWarning` of a `with` block in one line; raise the first `LogWarning` if
    `strict`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error" if strict else "always", LogWarning)
        usual = warnings.showwarning

        def show(
            message: Warning | str, category: type[Warning], *_place: Any, **_options: Any
        ) -> None:
            if issubclass(category, UserWarning):
                print_line(str(message))
            else:
                usual(message, category, *_place, **_options)

        warnings.showwarning = show
        yield
