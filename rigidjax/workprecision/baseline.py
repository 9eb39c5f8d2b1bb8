"""What moved since a stored table: errors, steps, and ratios of times. Never absolute times."""

import dataclasses
import math
from collections.abc import Iterable

from rigidjax.workprecision.record import Record, listed

# Errors at round-off wander: nothing below this has moved.
FLOOR = 1e-13
WORSE, STEPS, SLOWER = 3.0, 0.02, 2.0
BASE = "diffrax Dopri8"


def moved(records: Iterable[Record], stored: Iterable[Record]) -> tuple[list[str], list[str]]:
    """What differs between two tables: (what is wrong, what is only slower or quicker), in words.

    Compared line by line, as far as both have it, peers left out: an error more than three times as
    large or as small, steps by more than 2 %; and the median time over that of `diffrax Dopri8` on
    the same scene, each at its finest common settings, by more than a factor of 2.

    **Arguments:** `records` as measured now; `stored` those to compare with.

    >>> was = Record("s", "m", "ours", "value", "", 1e-6, error=1e-7, steps=100.0)
    >>> moved([was], [was])
    ([], [])
    """
    records, stored = listed(records), listed(stored, "stored")
    now = {_key(r): r for r in records if r.group != "peer"}
    then = {_key(r): r for r in stored if r.group != "peer"}
    wrong, paced = [], []
    scenes = {r.scene for r in now.values()}
    for key, old in then.items():
        new = now.get(key)
        if new is None:
            if old.scene in scenes and old.error < 0.1:
                wrong.append(f"{_name(old)}: not there any more")
            continue
        a, b = max(old.error, FLOOR), max(new.error, FLOOR)
        if not 1 / WORSE <= b / a <= WORSE or math.isnan(new.error) != math.isnan(old.error):
            wrong.append(f"{_name(old)}: error was {old.error:.2g}, is {new.error:.2g}")
        if not math.isnan(old.steps) and abs(new.steps - old.steps) > max(STEPS * old.steps, 1):
            wrong.append(f"{_name(old)}: steps were {old.steps:g}, are {new.steps:g}")
    before, after = _ratios(then, set(now)), _ratios(now, set(then))
    for label, ratio in after.items():
        if label in before and not 1 / SLOWER <= ratio / before[label] <= SLOWER:
            scene, kind, method = label
            paced.append(
                f"{scene}, {kind}, {method}: time over {BASE}'s was {before[label]:.2g}, is "
                f"{ratio:.2g}"
            )
    return wrong, paced


def kept(records: Iterable[Record]) -> list[Record]:
    """What a stored table keeps: no peers, no absolute times but multiples of the base's median.

    >>> kept([Record("s", BASE, "jax", "value", "", 1e-6, error=1e-7, time=3.0)])[0].time
    1.0
    """
    records = [r for r in records if r.group != "peer"]
    found = []
    for record in records:
        here = (r for r in records if (r.scene, r.kind, r.label) == (record.scene, "value", BASE))
        spent = sorted(r.time for r in here if r.time == r.time)
        base = spent[len(spent) // 2] if spent else math.nan
        found.append(
            dataclasses.replace(
                record, time=record.time / base, time_low=record.time_low / base,
                time_high=record.time_high / base, compile=math.nan, memory=math.nan,
            )
        )  # fmt: skip
    return found


def _key(record: Record) -> tuple[str, ...]:
    return (record.scene, record.kind, record.label, f"{record.setting:.6g}")


def _name(record: Record) -> str:
    return f"{record.scene}, {record.kind}, {record.label} at {record.setting:g}"


def _ratios(table: dict, common: set) -> dict[tuple[str, str, str], float]:
    """Median over common settings of each label's time, over that of the base."""
    times: dict[tuple[str, str, str], list[float]] = {}
    for key, record in table.items():
        if key in common and record.time == record.time:
            times.setdefault((record.scene, record.kind, record.label), []).append(record.time)
    middle = {label: sorted(spent)[len(spent) // 2] for label, spent in times.items()}
    found = {}
    for (scene, kind, label), spent in middle.items():
        base = middle.get((scene, "value", BASE))
        if base and label != BASE:
            found[scene, kind, label] = spent / base
    return found
