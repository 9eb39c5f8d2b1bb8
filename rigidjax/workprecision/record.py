"""What is measured, one line for each run, and its file."""

import csv
import dataclasses
from collections.abc import Iterable
from pathlib import Path

from rigidjax import _checks


@dataclasses.dataclass(frozen=True)
class Record:
    """One method at one setting on one scene: what it got wrong and what it cost.

    **Fields:** `scene`, `method` names; `group` `ours`, `jax` or `peer`; `kind` `value` or
    `gradient`; `adjoint` how a gradient was taken; `setting` the tolerance, or the number of equal
    steps; `error` of the attitude, an angle in rad (of a point its place, relative), and of a
    gradient relative, |g − g*|/|g*|; `error_rate` of Ω relative to |Ω0| (of a point the velocity);
    `energy`, `momentum` the larger drift of the conserved ones, relative; `by_inertia`, `by_rate`,
    `by_attitude` the parts of a gradient's error, each relative to its own part (of a point the
    last two: velocity, place); `steps`; `time`, `time_low`, `time_high` median and quartiles, s;
    `compile` s; `memory` bytes of the compiled run's temporaries. NaN where it does not apply.

    >>> Record("free-top", "closed form", "ours", "value", "", 0.0, error=1e-15).time
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
        """Method and adjoint as one name."""
        return f"{self.method}, {self.adjoint}" if self.adjoint else self.method


_WORDS = ("scene", "method", "group", "kind", "adjoint")


def listed(records: Iterable[Record], name: str = "records") -> list[Record]:
    """The records as a list; `TypeError` where something else is among them.

    >>> listed(())
    []
    """
    _checks.instance(records, Iterable, name, wanted="records")
    found = list(records)
    for record in found:
        _checks.instance(record, Record, name)
    return found


def write_csv(records: Iterable[Record], path: str | Path) -> None:
    """Keep records in a file, one line each under a header; NaN is left empty.

    **Arguments:** `records`; `path` of the file, written over.

    **Raises:** `OSError` where the file cannot be written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "records.csv"
    >>> write_csv([Record("a", "b", "ours", "value", "", 1e-6, error=1e-7)], path)
    >>> read_csv(path)[0].error
    1e-07
    """
    with Path(path).open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(field.name for field in dataclasses.fields(Record))
        for record in records:
            rows.writerow(_written(value) for value in dataclasses.astuple(record))


def read_csv(path: str | Path) -> list[Record]:
    """The records of a file that `write_csv` wrote.

    **Arguments:** `path` of the file.

    **Raises:** `ValueError` for another file, with what it lacks; `OSError` where there is none.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_csv([], folder + "/records.csv")
    ...     read_csv(folder + "/records.csv")
    []
    """
    with Path(path).open(newline="") as file:
        rows = csv.DictReader(file)
        lacks = {field.name for field in dataclasses.fields(Record)} - set(rows.fieldnames or ())
        if lacks:
            raise ValueError(
                f"{path}: wanted the columns of a file of records, lacks {', '.join(sorted(lacks))}"
            )
        names = [field.name for field in dataclasses.fields(Record)]
        return [
            Record(**{n: row[n] if n in _WORDS else float(row[n] or "nan") for n in names})  # pyright: ignore
            for row in rows
        ]


def _written(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if value != value else f"{value:.6g}"
