"""The right answers: stored, from another method at many digits, each with its own error."""

import functools
import json
from importlib import resources
from typing import NamedTuple


class Reference(NamedTuple):
    """Where a scene ends, and the gradient of its scalar.

    **Fields:** `end` the state as one tuple; `error` of its largest number, as estimated by the
    method that made it; `gradient`, `gradient_error` the same, empty where there is none;
    `source` words.

    >>> top = stored("heavy top")
    >>> top is None or top.error < 1e-12
    True
    """

    end: tuple[float, ...]
    error: float
    gradient: tuple[float, ...]
    gradient_error: float
    source: str


@functools.cache
def _all() -> dict[str, Reference]:
    text = resources.files("rigidjax.workprecision").joinpath("references.json").read_text()
    return {
        name: Reference(
            tuple(float(x) for x in row["end"]),
            float(row["error"]),
            tuple(float(x) for x in row["gradient"]),
            float(row["gradient_error"]),
            row["source"],
        )
        for name, row in json.loads(text).items()
    }


def stored(name: str) -> Reference | None:
    """The stored answer to the standard scene of this name, if there is one.

    They are made by `tests/workprecision/make_references.py` at 40 digits and rounded to float64.

    >>> stored("no such scene") is None
    True
    """
    return _all().get(name)
