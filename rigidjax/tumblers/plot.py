"""Draw light curves against time, and folded with a period."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax.plot.style import COLOURS, TIMES, axes_of_shape, escape_formulas, unit_factor

# The colour of a point shows its cycle, from the first to the last, in this colour map.
_MAP = "viridis"


def light_curve(
    ts: Float[ArrayLike, " times"],
    values: Float[ArrayLike, " values"],
    periods: float | Sequence[float] | Float[ArrayLike, " periods"] = (),
    *,
    model: Float[ArrayLike, " predictions"] | None = None,
    quantity: str = "mag",
    time_unit: str = "h",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw a light curve against time, and below it one more picture for each period: the light
    curve folded with the period.

    The folded light curve of a body that turns about a principal axis is a single curve. The folded
    light curve of a tumbler is a band, since a second period changes the curve from cycle to cycle.
    The colour of a point shows its cycle, the number of periods that have passed.

    **Arguments:**

    - `ts`: (T,) the times, s.
    - `values`: (T,) the readings, in the unit that `quantity` names; NaN for a gap.
    - `periods`: one period, several or none, s.
    - `model`: (T,) the prediction of a motion at `ts`, such as `values - fit.residuals[0][:, 0]`,
      or `None`.
    - `quantity`: `mag` (bright is up) or `flux`.
    - `time_unit`: `s`, `min`, `h` or `day`.
    - `title`: the title of the picture.
    - `ax`: matplotlib axes, one for the light curve and one for each period, or `None` for new
      axes.

    **Returns** the axes, an array of length 1 + the number of periods. **Raises** `ValueError` for
    shapes that do not fit, for values that are all NaN or infinite, for a period that is not
    positive, and for another `quantity` or `time_unit`; `ModuleNotFoundError` without matplotlib.

    >>> t = np.linspace(0.0, 7200.0, 50)
    >>> light_curve(t, 15 + 0.1 * np.cos(2 * np.pi * t / 3600), 3600.0)[1].get_xlabel()
    'phase, in periods of 1 h'
    """
    seconds = unit_factor(time_unit, TIMES, "time_unit")
    _checks.require_option(quantity, ("mag", "flux"), "quantity")
    t, read = _checks.host_array(ts, "ts"), _checks.host_array(values, "values")
    if t.ndim != 1 or read.shape != t.shape:
        raise ValueError(f"values: wanted (T,) as ts has, got shapes {t.shape} and {read.shape}")
    if not np.isfinite(read).any():
        raise ValueError("values: nothing to draw, every value is NaN or infinite")
    predicted = None if model is None else _checks.host_array(model, "model")
    if predicted is not None and predicted.shape != t.shape:
        raise ValueError(f"model: wanted (T,) as ts has, got {predicted.shape}")
    several = np.atleast_1d(_checks.host_array(periods, "periods"))
    if several.ndim != 1:
        raise ValueError(f"periods: wanted one period or a list of them, got shape {several.shape}")
    folds = [_checks.positive_float(period, "periods", "positive periods, s") for period in several]
    count = 1 + len(folds)
    ax = axes_of_shape(ax, (count,), nrows=count, figsize=(7.2, 2.5 * count))
    label = "magnitude" if quantity == "mag" else "flux"
    ax[0].plot(t / seconds, read, ".", color=COLOURS[6], ms=3, label="read")
    if predicted is not None:
        # No line is drawn over a gap, in which the brightness is not known.
        wide = np.append(np.diff(t) > 10 * np.median(np.diff(t)), False)
        line = np.where(wide, np.nan, predicted)
        ax[0].plot(t / seconds, line, color=COLOURS[1], lw=1.0, label="motion")
        # The legend is beside the picture, since inside the picture it would cover data.
        ax[0].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    ax[0].set(xlabel=f"time, {time_unit}", ylabel=label)
    for one, period in zip(ax[1:], folds, strict=True):
        turns = (t - t[0]) / period
        # Two periods are drawn: the second period shows that the end of the first joins its start.
        both, cycle = np.concatenate([turns % 1.0, turns % 1.0 + 1.0]), np.tile(turns // 1.0, 2)
        if predicted is not None:
            one.plot(both, np.tile(predicted, 2), ".", color=COLOURS[1], ms=1.5, alpha=0.6)
        dots = one.scatter(both, np.tile(read, 2), c=cycle, s=8, cmap=_MAP, lw=0)
        one.set_xlim(0.0, 2.0)
        one.figure.colorbar(dots, ax=one, label="cycle", pad=0.01)
        one.set(xlabel=f"phase, in periods of {period / seconds:.6g} {time_unit}", ylabel=label)
    for one in ax:
        one.grid(alpha=0.3)
        if quantity == "mag" and not one.yaxis_inverted():
            one.invert_yaxis()
    if title:
        ax[0].set_title(escape_formulas(title))
    return ax


__all__ = ["light_curve"]

define_dir_and_getattr(__name__)
