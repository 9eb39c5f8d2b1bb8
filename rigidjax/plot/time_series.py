"""Draw the attitude and the body rate against time."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import HasSpin
from rigidjax.plot import style
from rigidjax.plot.style import (
    COLOURS,
    LINE_STYLES,
    RATES,
    TIMES,
    escape_formulas,
    host_rows,
)
from rigidjax.rotation import euler


def motion(
    ts: Float[ArrayLike, " times"],
    states: HasSpin,
    *,
    attitude: str = "quaternion",
    time_unit: str = "s",
    rate_unit: str = "rad/s",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw the body rate against time, and above it the attitude if the states have one.

    The lines of the three components (or angles) are solid, dashed and dash-dotted in this order,
    and the line of the scalar part w of the quaternion is dotted, so that the lines can be told
    apart in grey.

    **Arguments:** `ts` (T,) s; `states` of one body with a leading time axis, such as `sol.ys`;
    `attitude` the form of the attitude: `quaternion` (w, x, y, z), `axes` (the world z component of
    each body axis) or `angles` (3-1-3, notes eq 31, deg); `time_unit` `s`, `min`, `h`, `day`;
    `rate_unit` `rad/s`, `deg/s`, `rpm`, `deg/day`; `title`; `ax` two axes (one for a `Spin`).
    **Returns** the axes, (2,) or (1,).

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    >>> sol = rj.simulate(body, rj.Spin([0, 1, 0.1]), [0.0, 1.0, 2.0])
    >>> motion(sol.ts, sol.ys)[0].get_ylabel()
    'body rate Ω, rad/s'
    """
    turned = style.unit_factor(rate_unit, RATES, "rate_unit")
    seconds = style.unit_factor(time_unit, TIMES, "time_unit")
    _checks.require_instance(
        states, HasSpin, "states", requirement="a Spin, an Attitude or a Rigid"
    )
    omega = host_rows(states.omega, 3, "states.omega") * turned
    t = style.host_times(ts, omega.shape[0]) / seconds
    both = hasattr(states, "q")
    count = 2 if both else 1
    ax = style.axes_of_shape(ax, (count,), nrows=count, sharex=True, figsize=(7.2, 2.6 * count))
    if both:
        _draw_attitude(ax[0], t, style.host_attitudes(states), attitude)
    for values, name, colour, dashes in zip(omega.T, "xyz", COLOURS[:3], LINE_STYLES, strict=True):
        ax[-1].plot(t, values, color=colour, ls=dashes, label=f"Ω{name}", lw=1.4)
    ax[-1].set(xlabel=f"time, {time_unit}", ylabel=f"body rate Ω, {rate_unit}")
    for one in ax:
        one.margins(x=0)
        one.grid(alpha=0.3)
        # The legend is beside the axes: inside the axes it would cover a curve.
        one.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=2.6)
    if title:
        ax[0].set_title(escape_formulas(title))
    return ax


def _draw_attitude(ax: Any, t: np.ndarray, q: np.ndarray, form: str) -> None:
    """Draw attitudes, body → world, in a form of `motion`, over `t` in the picture's unit."""
    _checks.require_option(form, ("quaternion", "axes", "angles"), "attitude")
    if form == "quaternion":
        names, lines, label = [f"q{n}" for n in "wxyz"], q.T, "attitude q"
    elif form == "axes":
        names = [f"{n}' · z" for n in "xyz"]
        lines, label = style.rotation_matrices(q)[:, 2, :].T, "body axes along world z"
    else:
        names, label = ["φ", "θ", "ψ"], "3-1-3 angles, deg"
        degrees = np.degrees(np.asarray(jax.vmap(euler.from_quaternion)(jnp.asarray(q))))
        # Where an angle jumps from 180° to −180° the curve is interrupted: a line across the whole
        # picture would look like a motion.
        degrees[1:][np.abs(np.diff(degrees, axis=0)) > 180] = np.nan
        lines = degrees.T
    colours, line_styles = COLOURS[:3], LINE_STYLES
    if len(names) == 4:
        colours, line_styles = (COLOURS[6], *colours), (":", *line_styles)
    for values, name, colour, dashes in zip(lines, names, colours, line_styles, strict=True):
        ax.plot(t, values, color=colour, ls=dashes, label=name, lw=1.4)
    ax.set_ylabel(label)
