"""Find the Pareto front of error and time, and the quickest method for an error."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rigidjax import _checks
from rigidjax.workprecision.record import Measurement, require_measurements

# The errors, in rad for an attitude and else relative, for which methods are compared by default.
WANTED = (1e-4, 1e-7, 1e-10)


def pareto_front(records: Iterable[Measurement]) -> list[Measurement]:
    """Return the measurements, of one scene and one kind, on the Pareto front of error and time, in
    the order of falling error.

    A record is on the front if no method reaches the error of the record in less time than the
    record; the time of a method is interpolated log–log between its settings.
    """
    records = [r for r in require_measurements(records) if r.error == r.error and r.time == r.time]
    kinds = {(r.scene, r.kind) for r in records}
    if len(kinds) > 1:
        words = "pareto_front: wanted records of one scene and one kind (value or gradient), got "
        raise ValueError(f"{words}{sorted(kinds)}; select the records before the call")
    curves = [[r for r in records if r.label == n] for n in dict.fromkeys(r.label for r in records)]
    best: list[Measurement] = []
    for record in sorted(records, key=lambda r: (r.time, r.error)):
        if best and record.error >= best[-1].error:
            continue
        if not any(time_to(curve, record.error) < (1 - 1e-9) * record.time for curve in curves):
            best.append(record)
    return best


def first_answers(records: Iterable[Measurement]) -> list[Measurement]:
    """Return the measurements with the time of compilation added: the time until a user has a first
    answer.
    """
    return [
        dataclasses.replace(r, time=r.time + c, time_low=r.time_low + c, time_high=r.time_high + c)
        for r in require_measurements(records)
        for c in [r.compile if r.compile == r.compile else 0.0]
    ]


def time_to(records: Iterable[Measurement], error: float) -> float:
    """Return the time, s, in which a method reaches an error, interpolated log–log between its
    settings.

    The result is the time of the quickest setting if even this setting reaches the error, and NaN
    if no setting reaches it.
    """
    error = _checks.positive_float(error, "error")
    rungs = sorted(
        (r for r in require_measurements(records) if r.error == r.error), key=lambda r: r.time
    )
    # A slower setting may have a larger error: only records with a smaller error than all quicker
    # records are used.
    least, seen = math.inf, []
    for record in rungs:
        if record.error < least:
            least = record.error
            seen.append((max(record.error, 1e-17), record.time))
    if not seen or least > error:
        return math.nan
    if seen[0][0] <= error:
        return seen[0][1]
    for (e0, t0), (e1, t1) in itertools.pairwise(seen):
        if e0 > error >= e1:
            share = math.log(e0 / error) / math.log(e0 / e1)
            return math.exp((1 - share) * math.log(t0) + share * math.log(t1))
    return math.nan


class Choice(NamedTuple):
    """Hold the quickest methods for one scene (a motion to run) and one wanted error; the function
    `table` shows this as a row.

    **Fields:** `scene` the name of the scene; `wanted` the wanted error; `method` the quickest of
    our methods, and `time`, s; `gradient` our quickest method for a gradient with the relative
    error `wanted`, and `gradient_time`, s; `default` and `default_gradient`, the times of
    `simulate` with its defaults, s (for a free body the times of the closed form, which `simulate`
    then applies); `peer` the quickest method outside rigidjax if it is quicker than `method`, and
    `peer_time`, s (an empty text and NaN if there is none).

    >>> Choice._fields[:2]
    ('scene', 'wanted')
    """

    scene: str
    wanted: float
    method: str
    time: float
    gradient: str
    gradient_time: float
    default: float
    default_gradient: float
    peer: str
    peer_time: float


def choose(records: Iterable[Measurement], wanted: Sequence[float] = WANTED) -> list[Choice]:
    """Return, for each scene and each wanted error, our quickest method and, if there is one, a
    quicker method of another package (diffrax included).

    **Arguments:** `records` of any scenes, as `measure` returns them; `wanted` the wanted errors,
    rad for an attitude, else relative.

    >>> choose([])
    []
    """
    records = require_measurements(records)
    choices = []
    for scene, error in itertools.product(dict.fromkeys(r.scene for r in records), wanted):
        of = [r for r in records if r.scene == scene]
        values, slopes = (times_by_method(of, k, error) for k in ("value", "gradient"))
        ours = {r.label for r in of if r.group == "ours"}

        def quickest(
            times: dict[str, float], own: bool = True, ours: set[str] = ours
        ) -> tuple[str, float]:
            return next(((n, t) for n, t in times.items() if (n in ours) == own), ("", math.nan))

        best, elsewhere = quickest(values), quickest(values, own=False)
        if elsewhere[1] >= best[1]:
            elsewhere = "", math.nan
        default = "closed form" if any(r.method == "closed form" for r in of) else "simulate"
        its = [t for n, t in slopes.items() if n.split(", ")[0] == default]
        defaults = values.get(default, math.nan), min(its, default=math.nan)
        choices.append(Choice(scene, error, *best, *quickest(slopes), *defaults, *elsewhere))
    return choices


def times_by_method(records: Iterable[Measurement], kind: str, error: float) -> dict[str, float]:
    """Return the times, s, in which the methods of one scene reach an error, by label, the quickest
    first; methods that do not reach it are left out.
    """
    of = [r for r in records if r.kind == kind]
    times = {
        label: time_to([r for r in of if r.label == label], error)
        for label in dict.fromkeys(r.label for r in of)
    }
    reached = {label: t for label, t in times.items() if t == t}
    return dict(sorted(reached.items(), key=lambda item: item[1]))


def table(lines: Iterable[Choice]) -> str:
    """Return a table in Markdown with a row for each of the `lines`. These are the results of
    `choose`: the quickest methods for each scene and wanted error.

    >>> print(table([]).splitlines()[0][:28])
    | scene | wanted error, rad
    """
    head = (
        "| scene | wanted error, rad | method | µs | gradient by | µs | "
        "`simulate` as it stands, µs (gradient) | quicker elsewhere |"
    )
    rows = [head, "| --- | --- | --- | --- | --- | --- | --- | --- |"]
    if isinstance(lines, str) or not isinstance(lines, Iterable):
        raise TypeError(f"lines: wanted what choose returns, got {type(lines).__name__}")
    for c in lines:
        _checks.require_instance(c, Choice, "lines", requirement="lines of choose")
        peer = f"{c.peer}, {_micro(c.peer_time)}" if c.peer else ""
        rows.append(
            f"| {c.scene} | {c.wanted:.0e} | {c.method or 'none'} | {_micro(c.time)} "
            f"| {c.gradient or 'none'} | {_micro(c.gradient_time)} | {_micro(c.default)} "
            f"({_micro(c.default_gradient)}) | {peer} |"
        )
    return "\n".join(rows)


def _micro(seconds: float) -> str:
    """Return a time as text in µs with three digits, or a dash for NaN."""
    return "–" if seconds != seconds else f"{seconds * 1e6:.3g}"
