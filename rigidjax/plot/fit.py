"""Draw a fit together with its data."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PyTree

from rigidjax._types import Quat, Vec3
from rigidjax.plot.style import (
    COLOURS,
    LINE_STYLES,
    MARKERS,
    RATES,
    TIMES,
    Channels,
    channels_of,
    escape_formulas,
    pyplot,
    residuals_of,
    unit_factor,
)
from rigidjax.rotation import quaternion
from rigidjax.solve import simulate


def fit(
    fit_result: Any,
    *,
    index: int = 0,
    time_unit: str = "s",
    rate_unit: str = "rad/s",
    title: str = "",
) -> Any:
    """Draw, for each sensor, the data and the fit in the upper row and the residuals in the lower
    row.

    The components along x, y and z can be told apart in grey: their lines are solid, dashed and
    dash-dotted, their points circles, squares and triangles.

    **Arguments:** `fit_result` a `rigidjax.identify.Fit`; `index` of the recording; `time_unit`
    `s`, `min`, `h` or `day`; `rate_unit` `rad/s`, `deg/s`, `rpm` or `deg/day`; `title`. **Returns**
    the matplotlib figure.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model())
    >>> fit(found).axes[-1].get_xlabel()
    'time, s'
    """
    plt = pyplot()
    seconds = unit_factor(time_unit, TIMES, "time_unit")
    rate = unit_factor(rate_unit, RATES, "rate_unit")
    record, left, _ = residuals_of(fit_result, index)
    channels = channels_of([reading.sensor for reading in record.readings])
    count = len(channels)
    size, how = (max(6.2 * count, 7.5), 6), dict(squeeze=False, layout="constrained")
    figure, axes = plt.subplots(2, count, figsize=size, sharex=True, height_ratios=(2, 1), **how)
    dense, model, body, state0 = None, fit_result.model, fit_result.body, fit_result.state0
    for part in (
        part
        for part in model.parts
        if part.recordings_slice.start <= index < part.recordings_slice.stop
    ):
        model, state0, index = part.model, state0[part.name], index - part.first
    # For a free body and few readings the line between the readings is made smooth.
    if model.torque is None and record.t.shape[0] <= 300:
        if model.count > 1:
            state0 = jax.tree.map(lambda leaf: leaf[index], state0)
        if isinstance(body, dict):
            body = body[model.body_names[index]]
        times = np.linspace(record.t[0], record.t[-1], 800)
        dense = times, simulate(body, state0, times).ys
    units = seconds, rate, rate_unit
    for column, one in enumerate(channels):
        upper, lower = axes[:, column]
        reading, errors = record.readings[one.sensor], left[one.sensor]
        _draw_sensor(upper, lower, record.t, reading, errors, dense, units, one)
        lower.axhline(0, color="0.6", lw=0.8)
        lower.set_xlabel(f"time, {time_unit}")
        upper.margins(x=0.02, y=0.2)
        upper.legend(loc="upper right", ncols=3, fontsize="small", handlelength=2.6)
        upper.set_title(f"{type(reading.sensor).__name__}: points read, lines fitted", fontsize=10)
    if title:
        figure.suptitle(escape_formulas(title))
    return figure


def _draw_sensor(
    upper_axes: Any,
    lower_axes: Any,
    ts: ArrayLike,
    reading: Any,
    errors: np.ndarray,
    dense_states: tuple[np.ndarray, PyTree] | None,
    units: tuple[float, float, str],
    channels: Channels,
) -> None:
    """Draw the readings of at most three channels of one sensor and the fitted line in the upper
    axes, and the residuals, in the unit of the sensor, in the lower axes.

    With dense times, s, and states the line is smooth; else it joins the predictions. The units are
    the number of s in that of time, the factor from rad/s to that of rates, and the name of the
    latter.
    """
    (seconds, rate, rate_unit), seen, sensor = units, reading.host_mask, reading.sensor
    t = np.asarray(ts) / seconds
    values = np.asarray(reading.values).reshape(len(t), -1)
    scale, unit, line_t = 1.0, channels.unit, t
    if sensor.components > 3:
        values, errors = values[:, channels.part], errors[:, channels.part]
    names: tuple[str, ...] = ("x", "y", "z")[: values.shape[1]]
    if sensor.reading_shape == (4,):
        read, scale = np.asarray(_body_z(values)), 180 / np.pi
        # The predicted attitude is the attitude read, turned back by the residual, which is a
        # rotation vector in body axes.
        line = np.asarray(_body_z(_turned_back(values, errors)))
        names = tuple(f"{axis} of body z" for axis in "xyz")
        upper_axes.set_ylabel("body z axis in world axes")
        unit = "deg (body axes)"
        if dense_states is not None:
            line_t = dense_states[0] / seconds
            line = np.asarray(_body_z(dense_states[1].q))
    else:
        if sensor.unit == "rad/s":
            scale, unit, names = rate, rate_unit, ("Ωx", "Ωy", "Ωz")
        whole = errors.shape == values.shape
        read = values * scale if sensor.unit != "rad" else values
        line = (values - errors) * scale if whole else None
        upper_axes.set_ylabel(
            "body rate, " + unit if sensor.unit == "rad/s" else f"reading, {unit}"
        )
        bare = getattr(sensor, "bias", None) is None and getattr(sensor, "scale", None) is None
        if dense_states is not None and sensor.unit == "rad/s" and bare:
            line_t, line = dense_states[0] / seconds, np.asarray(dense_states[1].omega) * scale
    lower_axes.set_ylabel(f"error, {unit}")
    many = seen.sum() > 100
    styles = zip(names, COLOURS, LINE_STYLES, MARKERS, strict=False)
    for axis, (name, colour, dashes, marker) in enumerate(styles):
        mark: dict[str, Any] = dict(color=colour, marker=marker, ls="", ms=2 if many else 5)
        if line is not None:
            whole = slice(None) if line_t is not t else seen
            how: dict[str, Any] = dict(color=colour, ls=dashes, lw=1.2, label=name)
            upper_axes.plot(line_t[whole], line[whole, axis], **how)
        upper_axes.plot(t[seen], read[seen, axis], alpha=0.6, **mark)
        if axis < errors.shape[1]:
            lower_axes.plot(t[seen], errors[seen, axis] * scale, alpha=0.7, **mark)


@jax.jit
@jax.vmap
def _turned_back(q: Quat, rotation_vector: Vec3) -> Quat:
    """Return the attitudes that turns by `rotation_vector`, rad, body axes, take to `q`."""
    return quaternion.multiply(q, quaternion.exp(-rotation_vector))


@jax.jit
@jax.vmap
def _body_z(q: Quat) -> Vec3:
    """Return the body z axis in world axes."""
    return quaternion.rotate(q, jnp.eye(3, dtype=q.dtype)[2])
