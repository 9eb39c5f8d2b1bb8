"""Draw a record and its phases."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.plot import style
from rigidjax.plot.style import COLOURS, LINE_STYLES, RATES, escape_formulas

_SHADES = {
    "free": COLOURS[2], "swing": COLOURS[5], "rest": "0.5", "motors": COLOURS[4],
    "full scale": COLOURS[1], "gap": COLOURS[3],
}  # fmt: skip


def phases(
    recording: Any,
    found: Sequence[Any],
    *,
    rate_unit: str = "rad/s",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw the readings of each sensor and each input against time, and shade the phases.

    **Arguments:** `recording` a `rigidjax.identify.Recording`; `found` its phases, as
    `rigidjax.identify.find_phases` returns them; `rate_unit` `rad/s`, `deg/s`, `rpm` or `deg/day`;
    `title`; `ax` axes, one for each sensor and input. **Returns** the axes.

    >>> t = 0.01 * np.arange(100)
    >>> rates = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    >>> record = rj.identify.Recording(t, (rj.identify.Gyro(0.01), rates))
    >>> phases(record, rj.identify.find_phases(record))[0].get_ylabel()
    'Gyro, rad/s'
    """
    rate = style.unit_factor(rate_unit, RATES, "rate_unit")
    if isinstance(recording, type) or not hasattr(recording, "readings"):
        raise TypeError(f"recording: wanted a Recording, got {type(recording).__name__}")
    t, panels = np.asarray(recording.t), []
    for reading in recording.readings:
        is_rate, seen = reading.sensor.unit == "rad/s", reading.host_mask
        values = np.asarray(reading.values).reshape(t.size, -1) * (rate if is_rate else 1.0)
        unit = rate_unit if is_rate else reading.sensor.unit
        label = f"{type(reading.sensor).__name__}, {unit}"
        panels.append((label, t[seen], values[seen], "xyz"))
    for name, source in recording.inputs.items():
        values = jax.vmap(source)(jnp.asarray(t)) if callable(source) else source
        panels.append((escape_formulas(name), t, np.asarray(values).reshape(t.size, -1), ""))
    count = len(panels)
    ax = style.axes_of_shape(ax, (count,), nrows=count, sharex=True, figsize=(9.0, 2.2 * count))
    for one, (label, times, values, names) in zip(ax, panels, strict=True):
        for k, column in enumerate(values.T):
            how = dict(color=COLOURS[k % 7], ls=LINE_STYLES[k % 3], lw=0.9)
            one.plot(times, column, label=names[k : k + 1] or None, **how)
        said = set()
        for phase in found:
            if (shade := _SHADES.get(phase.kind)) is not None:
                # Each kind of phase stands once in the legend of the first axes.
                word = phase.kind if one is ax[0] and phase.kind not in said else None
                said.add(phase.kind)
                one.axvspan(phase.start, phase.end, color=shade, alpha=0.25, lw=0, label=word)
        one.set_ylabel(label)
        one.margins(x=0)
        one.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=2.6)
    ax[-1].set_xlabel("time, s")
    if title:
        ax[0].set_title(escape_formulas(title))
    return ax
