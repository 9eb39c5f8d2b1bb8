"""Store records of measurements in tables, one line for each run, and compare two tables.

Tables are compared by errors, steps, and ratios of times, never by absolute times.
"""

import csv
import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from rigidjax import _checks

# Two tables are compared by their errors. An error below FLOOR counts as FLOOR, because errors of
# the size of round-off vary between machines.
FLOOR = 1e-13
# A change is reported if an error changes by more than the factor WORSE, a number of steps by more
# than 1 and by more than the fraction STEPS of the old number, or a time by more than the factor
# SLOWER. Each time is divided by the time of the method BASE on the same machine, since times
# differ between machines.
WORSE, STEPS, SLOWER = 3.0, 0.02, 2.0
BASE = "diffrax Dopri8"


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Hold the errors and the cost of one method at one setting on one scene.

    **Fields:** `scene`, `method` names; `group` `ours`, `jax` or `peer`; `kind` `value` or
    `gradient`; `adjoint` the way a gradient is computed; `setting` the tolerance, the number of
    equal steps, or the length of a step in s; `error` of the attitude, an angle in rad (for a point
    the relative error of its position), and for a gradient g the relative error |g − g*|/|g*|,
    where g* is the correct gradient; `error_rate` the error of the body rate Ω, divided by the
    length of the initial rate Ω0 (for a point the relative error of the velocity); `energy` the
    relative drift of the energy; `momentum` the largest drift of the conserved momenta;
    `by_inertia`, `by_rate`, `by_attitude` the relative errors of the gradient with respect to the
    inertia, the initial rate and the initial attitude (for a point `by_rate` is for the velocity
    and `by_attitude` for the position); `steps` the number of steps; `time` the median time of a
    run, and `time_low`, `time_high` the quartiles, s; `compile` the time of compilation, s;
    `memory` the bytes of temporary arrays in the compiled run. A field that does not apply is NaN.

    >>> Measurement("free-top", "closed form", "ours", "value", "", 0.0, error=1e-15).time
    nan
    """

    scene: str
    method: str
    group: str
    kind: str
    adjoint: str
    setting: float
    error: float = float("nan")
    error_rate: float = float("nan")
    energy: float = float("nan")
    momentum: float = float("nan")
    by_inertia: float = float("nan")
    by_rate: float = float("nan")
    by_attitude: float = float("nan")
    steps: float = float("nan")
    time: float = float("nan")
    time_low: float = float("nan")
    time_high: float = float("nan")
    compile: float = float("nan")
    memory: float = float("nan")

    @property
    def label(self) -> str:
        """Return one name for the method and the adjoint (the way in which a gradient is computed)
        of this measurement; for a value, which has no adjoint, the name of the method alone.
        """
        return f"{self.method}, {self.adjoint}" if self.adjoint else self.method


_WORDS = ("scene", "method", "group", "kind", "adjoint")


def require_measurements(
    records: Iterable[Measurement], name: str = "records"
) -> list[Measurement]:
    """Return the records as a list; raise a `TypeError` for what is no `Measurement`."""
    _checks.require_instance(records, Iterable, name, requirement="records")
    items = list(records)
    for record in items:
        _checks.require_instance(record, Measurement, name)
    return items


def write_csv(records: Iterable[Measurement], path: str | Path) -> None:
    """Write measurements to a CSV file, with a header line; an entry that is NaN is left empty."""
    with Path(path).open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(field.name for field in dataclasses.fields(Measurement))
        for values in map(dataclasses.astuple, records):
            shown = (f"{v:.6g}" if isinstance(v, float) and v == v else v for v in values)
            rows.writerow("" if v != v else v for v in shown)


def read_csv(path: str | Path) -> list[Measurement]:
    """Return the measurements of a file that `write_csv` wrote; raise a `ValueError` if a column is
    missing.
    """
    with Path(path).open(newline="") as file:
        rows = csv.DictReader(file)
        names = [field.name for field in dataclasses.fields(Measurement)]
        lacks = set(names) - set(rows.fieldnames or ())
        if lacks:
            words = f"{path}: wanted the columns of a file of records, lacks "
            raise ValueError(words + ", ".join(sorted(lacks)))
        return [
            Measurement(**{n: row[n] if n in _WORDS else float(row[n] or "nan") for n in names})  # pyright: ignore
            for row in rows
        ]


class Changes(NamedTuple):
    """Hold sentences about what differs between two tables of measurements."""

    accuracy: list[str]  # about errors and numbers of steps
    speed: list[str]  # about times


def changes(records: Iterable[Measurement], stored: Iterable[Measurement]) -> Changes:
    """Return what has changed since the `stored` table, for the methods of rigidjax and of diffrax.

    A change is reported if an error has become more than three times as large, or less than a third
    (an error below 1e-13 counts as 1e-13); if the number of steps differs by more than 2 % and by
    more than 1; if a measurement in `stored` with an error below 0.1 is missing in `records`,
    although `records` has others of its scene; or if the ratio of a method's median time to that of
    `diffrax Dopri8`, on the same scene at common settings, has changed by more than a factor of 2.
    """
    records, stored = require_measurements(records), require_measurements(stored, "stored")
    now = {_run_key(r): r for r in records if r.group != "peer"}
    then = {_run_key(r): r for r in stored if r.group != "peer"}
    wrong, paced = [], []
    scenes = {r.scene for r in now.values()}
    for key, old in then.items():
        new = now.get(key)
        if new is None:
            if old.scene in scenes and old.error < 0.1:
                wrong.append(f"{_described(old)}: not there any more")
            continue
        a, b = max(old.error, FLOOR), max(new.error, FLOOR)
        if not 1 / WORSE <= b / a <= WORSE or math.isnan(new.error) != math.isnan(old.error):
            wrong.append(f"{_described(old)}: error was {old.error:.2g}, is {new.error:.2g}")
        if not math.isnan(old.steps) and abs(new.steps - old.steps) > max(STEPS * old.steps, 1):
            wrong.append(f"{_described(old)}: steps were {old.steps:g}, are {new.steps:g}")
    before, after = _ratios(then, set(now)), _ratios(now, set(then))
    for label, ratio in after.items():
        if label in before and not 1 / SLOWER <= ratio / before[label] <= SLOWER:
            change = f"was {before[label]:.2g}, is {ratio:.2g}"
            paced.append(f"{', '.join(label)}: time over {BASE}'s {change}")
    return Changes(wrong, paced)


def in_base_time(records: Iterable[Measurement]) -> list[Measurement]:
    """Return the records of rigidjax and diffrax with each time divided by the median time in which
    the method `BASE` computes the value on the same scene.
    """
    records = [r for r in records if r.group != "peer"]
    middle = _median_times(records)
    bases = [middle.get((r.scene, "value", BASE), math.nan) for r in records]
    return [
        dataclasses.replace(
            r, time=r.time / base, time_low=r.time_low / base, time_high=r.time_high / base,
            compile=math.nan, memory=math.nan,
        )
        for r, base in zip(records, bases, strict=True)
    ]  # fmt: skip


def _run_key(record: Measurement) -> tuple[str, ...]:
    """Return what identifies the same run in another table."""
    return (record.scene, record.kind, record.label, f"{record.setting:.6g}")


def _described(record: Measurement) -> str:
    """Return what identifies a run, as text for a message."""
    return f"{record.scene}, {record.kind}, {record.label} at {record.setting:g}"


def _median_times(records: Iterable[Measurement]) -> dict[tuple[str, str, str], float]:
    """Return the median time of a run, s, of each (scene, kind, label), over the settings."""
    times: dict[tuple[str, str, str], list[float]] = {}
    for r in records:
        if r.time == r.time:
            times.setdefault((r.scene, r.kind, r.label), []).append(r.time)
    return {label: sorted(spent)[len(spent) // 2] for label, spent in times.items()}


def _ratios(
    records_by_key: dict[tuple[str, ...], Measurement], common_keys: set[tuple[str, ...]]
) -> dict[tuple[str, str, str], float]:
    """Return, by (scene, kind, label), the median time of a method over the common runs, divided by
    that of the method `BASE` for the value on the same scene.
    """
    middle = _median_times(record for key, record in records_by_key.items() if key in common_keys)
    return {
        label: spent / middle[label[0], "value", BASE]
        for label, spent in middle.items()
        if label[2] != BASE and middle.get((label[0], "value", BASE))
    }
