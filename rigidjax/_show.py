"""Print states and bodies with their numbers."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from rigidjax import _checks

# An array with more numbers than this is printed as its shape.
MOST = 16
# The units in which reports show angular rates, in rad/s.
_RATE_UNITS = {"rad/s": 1.0, "deg/s": 180 / np.pi, "deg/day": 86400 * 180 / np.pi}


def fields_as_text(self: Any) -> str:
    """Return `Name(field=numbers, …)`; a traced or large array is shown by its shape."""
    fields = [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self) if f.repr]
    fields = [(name, value) for name, value in fields if value is not None]
    parts = ", ".join(f"{name}={as_text(value)}" for name, value in fields)
    return f"{type(self).__name__}({parts})"


def as_text(value: object) -> str:
    """Return the numbers of an array as text; of a traced array, and of an array with more than
    `MOST` numbers, return the shape.
    """
    is_array = isinstance(value, (jax.Array, np.ndarray))
    if not is_array or isinstance(value, Tracer) or value.size > MOST:
        return eqx.tree_pformat(value)
    return _nested_as_text(np.asarray(value).tolist())


def time_as_text(t: Any, span: Any, digits: int = 6) -> str:
    """Return the time `t` as text, so that differences of `span` (the duration of the record) keep
    `digits` digits.

    A time that is large beside the span, such as seconds since 1970, has more digits.
    """
    t, span = float(t), float(span)
    more = np.log10(abs(t) / span) if span > 0 and 0 < abs(t) < np.inf else 0.0
    return f"{t:.{digits + max(0, int(np.ceil(more)))}g}"


def _nested_as_text(value: object) -> str:
    """Return a number, or nested lists of numbers, as text, with six digits for each float."""
    if isinstance(value, list):
        return f"[{', '.join(map(_nested_as_text, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def shown_unit(unit: str, rate_unit: str) -> tuple[float, str]:
    """Return the factor by which a value with `unit` is multiplied to be shown, and the unit then.

    **Arguments:** `unit` of the value; `rate_unit` the unit in which angular rates are shown:
    `rad/s`, `deg/s` or `deg/day`. Only values in rad/s are converted.
    """
    scale = _RATE_UNITS[_checks.require_option(rate_unit, tuple(_RATE_UNITS), "rate_unit")]
    return (float(scale), rate_unit) if unit == "rad/s" else (1.0, unit)
