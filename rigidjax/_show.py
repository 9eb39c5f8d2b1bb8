"""Print states, bodies, torques and other objects with their numbers."""

import dataclasses
from typing import Any, NamedTuple

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
    """Return what `print` shows for an object with fields: `Name(field=numbers, …)`, without fields
    that are `None` or a class.
    """
    fields = [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self) if f.repr]
    fields = [(name, value) for name, value in fields if not isinstance(value, type | None)]
    parts = ", ".join(f"{name}={as_text(value)}" for name, value in fields)
    return f"{type(self).__name__}({parts})"


def as_text(value: object) -> str:
    """Return the numbers of an array, a Module or a tuple as text, the dtype and shape of a traced
    or large array; anything else as Equinox writes it.
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
    return _nested(np.asarray(value).tolist())


def time_as_text(t: Any, duration: Any, digits: int = 6) -> str:
    """Return a time of a record as text, rounded by less than 10^(1 − `digits`) times the duration
    of the record, s: one that is large beside it, such as seconds since 1970, gets more digits.
    """
    t, duration = float(t), float(duration)
    more = np.log10(abs(t) / duration) if duration > 0 and 0 < abs(t) < np.inf else 0.0
    return f"{t:.{digits + max(0, int(np.ceil(more)))}g}"


def _nested(value: object) -> str:
    """Return a number, or nested lists of numbers, as text, with six digits for each float."""
    if isinstance(value, list):
        return f"[{', '.join(map(_nested, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Shown(NamedTuple):
    """Hold the factor by which a value is multiplied before it is shown, and the unit then."""

    scale: float
    unit: str


def shown_unit(unit: str, rate_unit: str) -> Shown:
    """Return the unit in which a report shows a value, and the factor to it: rates in rad/s are
    converted to `rate_unit`, all else stays.
    """
    scale = _RATE_UNITS[_checks.require_option(rate_unit, tuple(_RATE_UNITS), "rate_unit")]
    return Shown(float(scale), rate_unit) if unit == "rad/s" else Shown(1.0, unit)
