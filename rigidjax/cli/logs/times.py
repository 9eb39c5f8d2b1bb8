"""Check the time column of a log, and choose the rows in a window whose times increase."""

import bisect
from pathlib import Path

import numpy as np

from rigidjax.cli.logs.errors import LogError, warn
from rigidjax.cli.logs.units import TIME_UNITS, UNITS

# If at least this number of successive rows do not fit into the increasing times of the log, but
# have increasing times themselves, the clock was set back.
_RESTART = 5
# A log must have at least this number of rows.
_FEWEST = 4
# The range _USUAL_STEPS holds the steps between two times, s, that loggers of moving bodies have; a
# step outside of the range _ODD_STEPS is doubtful.
_USUAL_STEPS = (1e-5, 1.0)
_ODD_STEPS = (1e-7, 1e3)
# Times 0, 1, 2, … s are believed if the body turns by less than this, rad, from one to the next.
_SLOW = 0.1
# A gap longer than this many median steps means that the clock was set, or that the logger was off.
_GAP = 1e5


def since_first(t: np.ndarray) -> np.ndarray:
    """Return the times counted from the first time stamp."""
    # Times since 1970, in seconds or nanoseconds, are so large that float64 has few digits left for
    # the steps between them.
    finite = np.flatnonzero(np.isfinite(t))
    return t - (t[finite[0]] if finite.size else 0.0)


def unwrapped(path: str | Path, t: np.ndarray) -> np.ndarray:
    """Return the counts of a clock that go on where its 16 or 32 bits begin again at zero; it
    **warns** of it.
    """
    finite = t[np.isfinite(t)]
    steps = np.diff(finite)
    for bits in (16, 32):
        wraps = steps < -(2.0 ** (bits - 1))
        if not wraps.any() or not ((finite >= 0) & (finite < 2.0**bits) & (finite % 1 == 0)).all():
            continue
        # The step over zero must be one of the usual ones, or the clock was set back.
        if (steps[wraps] + 2.0**bits <= 10 * np.median(steps)).all():
            warn(
                f"{path}: the clock begins again at 2^{bits}, {wraps.sum()} times: it is counted on"
            )
            t = t.copy()
            t[np.isfinite(t)] += 2.0**bits * np.concatenate([[0], np.cumsum(wraps)])
            return t
    return t


def increasing(t: np.ndarray) -> np.ndarray:
    """Return a mask that keeps as many of the times `t` as possible, such that the kept times
    increase.

    The kept times are a longest increasing subsequence, found by patience sorting: a time that is
    repeated, backward, far too large or missing (NaN) costs its own row only.
    """
    if (np.diff(t) > 0).all() and np.isfinite(t).all():
        return np.ones(t.shape, bool)
    # For each length, `ends` has the smallest last time of all increasing subsequences of this
    # length, and `rows` has the row of this time.
    ends: list[float] = []
    rows: list[int] = []
    before = np.full(t.shape, -1)
    for row in np.flatnonzero(np.isfinite(t)).tolist():
        length = bisect.bisect_left(ends, t[row])
        before[row] = rows[length - 1] if length else -1
        if length == len(ends):
            ends.append(t[row])
            rows.append(row)
        elif t[row] < ends[length]:
            ends[length], rows[length] = t[row], row
    keep = np.zeros(t.shape, bool)
    row = rows[-1] if rows else -1
    while row >= 0:
        keep[row] = True
        row = before[row]
    return keep


def increasing_rows(
    path: str | Path, t: np.ndarray, time_column: str, window: tuple[float, float] | None
) -> np.ndarray:
    """Return the indices of the rows in the window whose times `t`, s since the first time stamp,
    increase.

    It **warns** of rows in the window that are left out because their time is repeated, backward or
    missing. **Raises** `LogError` for fewer than four rows, if half of the times do not increase,
    and for a clock that was set back.
    """
    if window is not None and not window[0] < window[1]:
        raise LogError(f"{path}: window: wanted FROM below TO, got {window[0]:g} {window[1]:g}")
    finite = np.isfinite(t)
    # A row whose time is missing (NaN) is in the window if the last row with a time before it is in
    # the window.
    place = np.maximum.accumulate(np.where(finite, np.arange(t.size), 0))
    near = t[place] if t.size else t
    inside = np.ones(t.shape, bool)
    if window is not None:
        inside = (near >= window[0] - 1e-12) & (near <= window[1] + 1e-12)
        if inside.sum() < _FEWEST:
            least, most = (np.nanmin(t), np.nanmax(t)) if finite.any() else (np.nan, np.nan)
            raise LogError(
                f"{path}: wanted at least {_FEWEST} samples between {window[0]:g} and "
                f"{window[1]:g} s from the first stamp, got {inside.sum()}; the log goes from "
                f"{least:g} to {most:g} s"
            )
    rows = np.flatnonzero(inside)
    keep = increasing(t[rows])
    if rows.size < _FEWEST:
        raise LogError(f"{path}: wanted at least {_FEWEST} samples, got {rows.size}")
    # The clock was set back if successive rows that are not kept have times that form a second
    # increasing series.
    lost = np.flatnonzero(~keep)
    for run in np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1):
        if run.size >= _RESTART and (np.diff(t[rows[run]]) > 0).all():
            # These rows are either the end of the series before the clock was set back, or the
            # beginning of the series after it.
            first, after = run[0], run[-1] + 1
            row = rows[first if first and t[rows[first]] <= t[rows[first - 1]] else after]
            raise LogError(
                f"{path}: column {time_column!r}: the clock was set back at row {row + 1}, from "
                f"{t[row - 1]:g} to {t[row]:g} s; make two logs of it, or choose a part by --window"
            )
    bad = rows[lost]
    if 2 * bad.size >= rows.size or keep.sum() < _FEWEST:
        raise LogError(
            f"{path}: column {time_column!r}: the times of {bad.size} of {rows.size} rows are "
            f"repeated, backward or missing (row {bad[0] + 1} is the first)"
        )
    if bad.size:
        shown = ", ".join(str(row + 1) for row in bad[:5]) + (", …" if bad.size > 5 else "")
        warn(
            f"{path}: column {time_column!r}: {bad.size} of {rows.size} rows are left out: their "
            f"times are repeated, backward or missing (row{'s' if bad.size > 1 else ''} {shown})"
        )
    return rows[keep]


def warn_of_steps(path: str | Path, t: np.ndarray, time_unit: str, typical_rate: float) -> None:
    """Warn of a long gap in the times `t`, s, and of times that are plainly not in their unit.

    The typical body rate, rad/s, is zero without a gyro.
    """
    steps = np.diff(t)
    step = float(np.median(steps))
    if steps.max() > _GAP * step:
        row = int(np.argmax(steps))
        warn(
            f"{path}: no time between {t[row]:.6g} and {t[row + 1]:.6g} s, other steps are "
            f"{step:.3g} s; choose a part by --window"
        )
    counts = (t - t[0]) / UNITS[time_unit]
    if (
        time_unit == "s"
        and np.median(np.diff(counts)) == 1
        and (counts == np.round(counts)).all()
        and not 0 < typical_rate < _SLOW
    ):
        warn(
            f"{path}: the step between two times is exactly 1 s: are they the numbers of rows or "
            "frames? name the column of the times, or divide by the number of frames a second"
        )
        return
    turns = step * typical_rate / (2 * np.pi)
    if _ODD_STEPS[0] <= step <= _ODD_STEPS[1] and turns < 1:
        return
    low, high = _USUAL_STEPS
    others = [
        u
        for u in TIME_UNITS
        if low <= step * UNITS[u] / UNITS[time_unit] <= high and u != time_unit
    ]
    turned = f", in which the body turns {turns:.3g} times" if turns >= 1 else ""
    advice = f"; is it in {' or '.join(others)}? give --time-unit" if others else ""
    warn(f"{path}: the step between two times is {step:.3g} s{turned}{advice}")
