"""Checks of the time column."""

from pathlib import Path

import numpy as np

from rigidjax.cli.logs.errors import LogError


def increasing(path: str | Path, t: np.ndarray, name: str) -> None:
    """Raise `LogError` unless there are at least four times and they increase."""
    if t.size < 4:
        raise LogError(f"{path}: wanted at least 4 samples, got {t.size}")
    if not np.isfinite(t).all():
        raise LogError(
            f"{path}: column {name!r}: row {int(np.argmin(np.isfinite(t))) + 1} is empty"
        )
    falling = np.flatnonzero(np.diff(t) <= 0)
    if falling.size:
        row = int(falling[0]) + 1
        raise LogError(
            f"{path}: column {name!r}: row {row + 1}: time {t[row]:g} is not above the "
            f"{t[row - 1]:g} before it"
        )
