"""Print states, bodies, torques and other objects with their numbers."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from rigidjax import _checks

# An array with more numbers than this is printed as its dtype and shape.
MOST = 16
# For each unit in which reports show angular rates: the factor that converts rad/s to this unit.
_RATE_UNITS = {"rad/s": 1.0, "deg/s": 180 / np.pi, "deg/day": 86400 * 180 / np.pi}


def fields_as_text(self: Any) -> str:
    """Return the text that `print` shows for an object with fields, such as a state or a torque:
    the name of its class, and each field with its numbers, `Name(field=numbers, …)`. A field that
    is `None` or a class is left out; a traced or large array is shown by its dtype and shape.
    """
    fields = [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self) if f.repr]
    fields = [(name, value) for name, value in fields if not isinstance(value, type | None)]
    parts = ", ".join(f"{name}={as_text(value)}" for name, value in fields)
    return f"{type(self).__name__}({parts})"


def as_text(value: object) -> str:
    """Return the numbers of an array as text, and those in a Module or a tuple. For an array that
    JAX traces, or that has more than `MOST` numbers, the text is its dtype and shape; any other
    `value` is written as Equinox does.
    """
    if type(value) is tuple:
        parts = [as_text(part) for part in value]
        return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
    if isinstance(value, eqx.Module):
        plain = type(value).__repr__ is eqx.Module.__repr__
        return fields_as_text(value) if plain else repr(value)
    is_array = isinstance(value, (jax.Array, np.ndarray))
    if not is_array or isinstance(value, Tracer) or value.size > MOST:
        return eqx.tree_pformat(value)
    return _nested_as_text(np.asarray(value).tolist())


def time_as_text(t: Any, duration: Any, digits: int = 6) -> str:
    """Return the time `t` of a record as text, rounded by less than 10^(1 − `digits`) times the
    `duration` of the record.

    A time that is large beside the duration, such as seconds since 1970, is written with more
    digits.

    - `t`: one number, s
    - `duration`: one number, s, the time from the first to the last reading of the record
    - `digits`: how many significant digits are written for a time that is not longer than the
      duration
    """
    t, duration = float(t), float(duration)
    more = np.log10(abs(t) / duration) if duration > 0 and 0 < abs(t) < np.inf else 0.0
    return f"{t:.{digits + max(0, int(np.ceil(more)))}g}"


def _nested_as_text(value: object) -> str:
    """Return a number, or nested lists of numbers, as text, with six digits for each float."""
    if isinstance(value, list):
        return f"[{', '.join(map(_nested_as_text, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def scale_and_unit_to_show(unit: str, rate_unit: str) -> tuple[float, str]:
    """Return two things: the factor by which a value is multiplied before a report shows it; and
    the unit of the product. Only values in rad/s are converted; for any other unit the factor is 1.

    - `unit`: the unit of the value
    - `rate_unit`: the unit in which angular rates are shown: `rad/s`, `deg/s` or `deg/day`
    """
    scale = _RATE_UNITS[_checks.require_option(rate_unit, tuple(_RATE_UNITS), "rate_unit")]
    return (float(scale), rate_unit) if unit == "rad/s" else (1.0, unit)
