"""Times as loggers write them: repeated, backward, missing, far off, in other units."""

import itertools
import re
import warnings

import numpy as np
import pytest

from rigidjax.cli.logs.errors import LogError, LogWarning
from rigidjax.cli.logs.times import increasing, increasing_rows, warn_of_steps

NAN = np.nan


def longest(t):
    """The most rows with increasing times, by trying all subsets."""
    finite = [k for k in range(len(t)) if np.isfinite(t[k])]
    return next(
        size
        for size in range(len(finite), -1, -1)
        for rows in itertools.combinations(finite, size)
        if (np.diff(np.asarray(t)[list(rows)]) > 0).all()
    )


@pytest.mark.parametrize("seed", range(40))
def test_as_few_rows_as_possible_are_left_out(seed):
    rng = np.random.default_rng(seed)
    t = np.where(rng.random(9) < 0.15, NAN, rng.integers(0, 9, 9).astype(float))
    keep = increasing(t)
    assert (np.diff(t[keep]) > 0).all() and np.isfinite(t[keep]).all()
    assert keep.sum() == longest(t)


T = 0.25 * np.arange(60)


def changed(**rows):
    t = T.copy()
    for row, value in rows.items():
        t[int(row[1:])] = value
    return t


ONE_BAD = {
    "repeated": (changed(r7=T[6]), [7]),
    "backward": (changed(r30=T[11]), [30]),
    "missing": (changed(r0=NAN, r59=NAN), [0, 59]),
    "far ahead": (changed(r12=1e9), [12]),
    "far back": (changed(r12=-4e9), [12]),
    "two of each": (changed(r3=T[2], r9=1.7e12, r20=NAN, r41=T[17], r42=T[18]), [3, 9, 20, 41, 42]),
}  # fmt: skip


@pytest.mark.parametrize("case", ONE_BAD)
def test_a_bad_stamp_costs_its_own_row_and_is_named(case):
    t, bad = ONE_BAD[case]
    shown = ", ".join(str(row + 1) for row in bad)
    words = f"log: column 'time': {len(bad)} of 60 rows are left out.*rows? {shown}\\)"
    with pytest.warns(LogWarning, match=words):
        rows = increasing_rows("log", t, "time", None)
    assert sorted({*range(60)} - {*rows.tolist()}) == bad


def test_many_bad_rows_are_counted_and_the_first_five_named():
    t = T.copy()
    t[2::3] = t[1::3]
    with pytest.warns(LogWarning, match=r"20 of 60 rows .*rows 3, 6, 9, 12, 15, …\)"):
        assert increasing_rows("log", t, "time", None).size == 40


@pytest.mark.parametrize("case", [name for name in ONE_BAD if name != "missing"])
def test_a_bad_stamp_outside_the_window_is_no_matter(case):
    t, bad = ONE_BAD[case]
    low = T[max(bad) + 1]
    rows = increasing_rows("log", t, "time", (low, 14.0))
    np.testing.assert_array_equal(rows, np.flatnonzero((low <= T) & (T <= 14.0)))


def test_a_missing_stamp_inside_the_window_is_told_and_one_outside_is_not():
    t = changed(r5=NAN, r30=NAN)
    with pytest.warns(LogWarning, match=r"1 of 17 rows .*row 31\)"):
        rows = increasing_rows("log", t, "time", (6.0, 10.0))
    assert rows.tolist() == [k for k in range(24, 41) if k != 30]


def test_an_empty_window_is_told_with_the_range_there_is():
    for window in ((15.0, 20.0), (-5.0, -1.0)):
        words = r"wanted at least 4 samples between .* from the first stamp, got .; the log goes from 0 to 14.75 s"
        with pytest.raises(LogError, match=words):
            increasing_rows("log", T, "time", window)
    for window in ((3.0, 3.0), (4.0, 1.0), (NAN, 1.0)):
        with pytest.raises(LogError, match="window: wanted FROM below TO"):
            increasing_rows("log", T, "time", window)


@pytest.mark.parametrize("second", [T, T[:20], T + 0.01, T[:20] + 0.01, 3.0 + T])
@pytest.mark.parametrize("order", [1, -1])
def test_two_logs_in_one_file_are_not_mixed(second, order):
    t = np.concatenate([T, second][::order])
    row = (T if order == 1 else second).size
    with pytest.raises(LogError, match=f"the clock was set back at row {row + 1}, from .*--window"):
        increasing_rows("log", t, "time", None)


def test_a_part_before_the_clock_is_set_back_can_be_chosen():
    t = np.concatenate([T, 10.0 + T])
    np.testing.assert_array_equal(increasing_rows("log", t, "time", (0.0, 9.9)), np.arange(40))


def test_a_log_without_times_is_refused():
    for t in (np.full(20, NAN), np.full(20, 3.0), T[:3], np.zeros(0)):
        with pytest.raises(LogError, match=r"are repeated, backward or missing|at least 4 samples"):
            increasing_rows("log", t, "time", None)


@pytest.mark.parametrize(
    ("step", "unit", "rate", "words"),
    [
        (2e7, "s", 0.0, "the step between two times is 2e+07 s; is it in ns? give --time-unit"),
        (5e3, "s", 0.0, "is 5e+03 s; is it in us? give --time-unit"),
        (4.0, "s", 3.0, "is 4 s, in which the body turns 1.91 times; is it in ms? give"),
        (4e-12, "ns", 0.0, "the step between two times is 4e-12 s; is it in s? give"),
        (3e5, "s", 0.0, "is 3e+05 s; is it in us or ns? give --time-unit"),
    ],
)
def test_times_that_are_plainly_in_another_unit_are_remarked_upon(step, unit, rate, words):
    with pytest.warns(LogWarning, match=re.escape(words)):
        warn_of_steps("log", step * np.arange(50), unit, rate)


@pytest.mark.parametrize(("step", "rate"), [(2e-4, 300.0), (0.02, 20.0), (60.0, 1e-3), (1.0, 0.02)])
def test_usual_times_are_not_remarked_upon(step, rate):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_steps("log", step * np.arange(50), "s", rate)


@pytest.mark.parametrize("rate", [0.0, 2.0, 300.0])
@pytest.mark.parametrize("left_out", [[], [7], [20, 21, 40]])
def test_numbers_of_frames_are_no_times(rate, left_out):
    t = np.delete(np.arange(50.0), left_out)
    with pytest.warns(LogWarning, match="is exactly 1 s: are they the numbers of rows or frames"):
        warn_of_steps("log", t, "s", rate)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_steps("log", 1.001 * t, "s", min(rate, 5.0))
        warn_of_steps("log", 1e-3 * t, "ms", rate)


def test_a_clock_that_was_set_forward_is_told():
    with pytest.warns(
        LogWarning, match=r"no time between 14.75 and 1.7e\+09 s, other steps are 0.25"
    ):
        warn_of_steps("log", np.concatenate([T, 1.7e9 + T]), "s", 0.0)
