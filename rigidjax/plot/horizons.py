"""Draw the errors of predictions against the prediction horizon."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.plot.style import COLOURS, axes_of_shape, escape_formulas

_KINDS = {"x": "position, m", "v": "velocity, m/s", "q": "attitude, rad"}
_KINDS["omega"] = "body rate, rad/s"
_MEASURES = {
    "mean_absolute": "mean |error| of a component",
    "mean_norm": "mean length of the error",
    "rms": "rms error",
}


def horizons(
    results: Any,
    *,
    step: float | None = None,
    measure: str = "mean_absolute",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw open-loop errors against the prediction horizon, in one panel for each part of the
    state.

    **Arguments:** `results` a `Horizons`, which holds the errors of predictions for each number of
    steps from the start, as `identify.predict_windows` and `Windows.held_horizons` return it, or
    several `Horizons` by name, to compare models or windows, for example with the prediction that
    the state stays as it is at the start; `step` the time between samples, in seconds: if it is
    given, the horizon is shown as a time instead of a number of steps; `measure` `mean_absolute`
    (of a component), `mean_norm` or `rms` (of the vector); `title`; `ax` your axes, one for each
    part of the state. Both scales are linear, since errors start at zero. **Returns** the axes, one
    for each of position, velocity, attitude and body rate that the state has. **Raises**
    `TypeError` for something that is no `Horizons`; `ValueError` for an empty dictionary, for
    `Horizons` with different parts of the state, and for a `step` that is not positive.

    >>> t = np.arange(8.0)
    >>> cut = rj.identify.windows(t, rj.Spin(np.ones((8, 3)) * t[:, None]), length=3)
    >>> horizons({"held": cut.held_horizons()})[0].get_ylabel()
    'body rate, rad/s'
    """
    named = dict(results) if isinstance(results, Mapping) else {"": results}
    if not named:
        raise ValueError("results: wanted at least one Horizons, got none")
    for one in named.values():
        if not all(hasattr(one, name) for name in ("steps", *_MEASURES)) or isinstance(one, type):
            words = "results: wanted a Horizons of rigidjax.identify, or some by name, got "
            raise TypeError(words + _checks.type_name(one))
    _checks.require_option(measure, tuple(_MEASURES), "measure")
    scale = 1.0 if step is None else _checks.positive_float(step, "step", "a positive time, s")
    kinds = [kind for kind in _KINDS if kind in getattr(next(iter(named.values())), measure)]
    for name, one in named.items():
        if sorted(getattr(one, measure)) != sorted(kinds):
            others = f"{name!r} with {sorted(getattr(one, measure))}"
            raise ValueError(f"results: wanted the same kinds of errors, got {kinds} and {others}")
    count = len(kinds)
    ax = axes_of_shape(ax, (count,), ncols=count, figsize=(3.4 * count + 0.6, 3.2))
    for one_ax, kind in zip(ax, kinds, strict=True):
        for (name, one), colour in zip(named.items(), COLOURS * len(named), strict=False):
            errors = _checks.host_array(getattr(one, measure)[kind], f"results: {kind}")
            steps_ahead = np.concatenate(
                [[0.0], scale * _checks.host_array(one.steps, "results: steps")]
            )
            line = np.concatenate([[0.0], errors])
            one_ax.plot(
                steps_ahead, line, color=colour, lw=1.4, label=escape_formulas(name) or None
            )
        one_ax.set(xlabel="steps ahead" if step is None else "time ahead, s", ylabel=_KINDS[kind])
        one_ax.margins(x=0)
        one_ax.set_ylim(bottom=0.0)
        one_ax.grid(alpha=0.3)
    if any(named):
        ax[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    said = _MEASURES[measure]
    ax[0].set_title(escape_formulas(f"{title}: {said}" if title else said), loc="left")
    return ax
