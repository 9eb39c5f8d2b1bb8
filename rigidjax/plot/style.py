"""Provide what all pictures share: colours, axes, the import of matplotlib, checks of arguments."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax._checks import escape_formulas as escape_formulas
from rigidjax.rotation import quaternion

# Okabe and Ito's colours, distinct also for colour-blind readers (2008, "Color Universal Design").
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
AXES = "xyz"
# The components along x, y and z differ in line style and marker, too: a picture is often printed
# in grey, where colours of equal brightness cannot be told apart.
LINE_STYLES = ("-", "--", "-.")
MARKERS = ("o", "s", "^")
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0}
RATES = {"rad/s": 1.0, "deg/s": 180 / np.pi, "rpm": 30 / np.pi, "deg/day": 86400 * 180 / np.pi}


def pyplot() -> Any:
    """Return `matplotlib.pyplot`, imported at the call; raise `ModuleNotFoundError`, which names
    the extra `view`, without it.
    """
    return _checks.import_library("matplotlib.pyplot", "view", "plot")


def unit_factor(unit: str, units: dict[str, float], name: str) -> float:
    """Return the factor of a unit of `TIMES` (s in each) or `RATES` (from rad/s to each); raise an
    error for an unknown unit.
    """
    return units[_checks.require_option(unit, tuple(units), name)]


class Residuals(NamedTuple):
    """Hold the residuals of one recording."""

    recording: Any
    # For each sensor the residuals and their standard deviations, in its unit.
    errors: list[np.ndarray]
    noises: list[np.ndarray]


def residuals_of(fit_result: Any, index: object) -> Residuals:
    """Return a recording of a fit with its residuals; raise `TypeError` for no `Fit`, `ValueError`
    for a batch of fits or an index without a recording.
    """
    if np.shape(getattr(fit_result, "chi2", 0.0)) != ():
        raise ValueError(
            "fit_result: wanted one Fit, got one with leading axes; draw them one by one"
        )
    wanted = ("model", "x", "residuals")
    if isinstance(fit_result, type) or not all(hasattr(fit_result, name) for name in wanted):
        raise TypeError(
            f"fit_result: wanted a Fit of rigidjax.identify, got {type(fit_result).__name__}"
        )
    index, count = _checks.integer(index, "index", 0), fit_result.model.count
    if index >= count:
        raise ValueError(f"index: wanted one of {count} recordings, from 0, got {index}")
    record, which = fit_result.model.recordings[index], ... if count == 1 else index
    parts = fit_result.model.parts
    mine = next(
        (part.sensors_slice for part in parts if index < part.recordings_slice.stop), slice(None)
    )
    errors = [np.asarray(e[which])[: record.t.shape[0]] for e in fit_result.residuals[mine]]
    noises = [
        np.hypot(noise[which], 0.0 if one.jitter_error is None else one.jitter_error)
        for noise, one in zip(fit_result.noise[mine], record.readings, strict=True)
    ]
    return Residuals(record, errors, noises)


class Channels(NamedTuple):
    """Hold components of a sensor that are drawn in one panel, at most three, and their unit."""

    sensor: int  # its index
    part: slice
    unit: str


def channels_of(sensors: Sequence[Any]) -> list[Channels]:
    """Return the components of all sensors in panels: those of a force and of a torque are two."""
    out = []
    for index, sensor in enumerate(sensors):
        starts, units = range(0, sensor.components, 3), sensor.unit.split(", ")
        for number, start in enumerate(starts):
            unit = units[number] if len(units) == len(starts) else sensor.unit
            out.append(Channels(index, slice(start, start + 3), unit))
    return out


def axes_2d_or_new(ax: Any, **options: Any) -> Any:
    """Return `ax`, or new two-dimensional axes; `options` are those of `pyplot.subplots`."""
    if ax is not None:
        return ax
    return pyplot().subplots(layout="constrained", **{"figsize": (6.4, 4.4), **options})[1]


def axes_3d_or_new(ax: Any) -> Any:
    """Return `ax`, or new 3-D axes if it is `None`; raise `TypeError` for flat ones."""
    if ax is None:
        figure = pyplot().figure(layout="constrained", figsize=(6.0, 5.6))
        return figure.add_subplot(projection="3d")
    if not hasattr(ax, "zaxis"):
        raise TypeError("ax: wanted 3-D axes, got flat ones; make them with projection='3d'")
    return ax


def axes_of_shape(ax: Any, shape: tuple[int, ...], **options: Any) -> Any:
    """Return `ax` as an array of axes of this shape, or new axes if it is `None`; raise
    `ValueError` for another shape.
    """
    if ax is None:
        ax = np.reshape(pyplot().subplots(layout="constrained", **options)[1], shape)
    ax = np.atleast_1d(np.asarray(ax, dtype=object))
    if ax.shape != shape:
        words = f"{shape[0]} axes" + (" in a row" if "ncols" in options else "")
        words = words if len(shape) == 1 else f"{shape} axes, one row for each sensor"
        raise ValueError(f"ax: wanted {words}, got shape {ax.shape}")
    return ax


def draw_legend_below(ax: Any, *entries: Any, distance: float = 0.16) -> None:
    """Draw the legend below the axes, at a `distance` in heights of the axes."""
    place = dict(loc="upper center", bbox_to_anchor=(0.5, -distance))
    ax.legend(*entries, **place, ncols=3, fontsize=8, frameon=False)


def host_times(ts: object, count: int, words_about_count: str = "the states have") -> np.ndarray:
    """Return the times as NumPy float64; raise `ValueError` unless there are `count` of them."""
    t = _checks.host_array(ts, "ts")
    if t.shape != (count,):
        raise ValueError(f"ts: wanted ({count},) as {words_about_count}, got {t.shape}")
    return t


def host_rows(values: object, column_count: int, name: str) -> np.ndarray:
    """Return values of one body over time as NumPy float64; raise `ValueError` for another shape,
    or if no value is finite.
    """
    out = _checks.host_array(values, name)
    if out.ndim != 2 or out.shape[1] != column_count:
        hint = "; draw one body of a batch at a time" if out.ndim == 3 else ""
        raise ValueError(f"{name}: wanted shape (times, {column_count}), got {out.shape}{hint}")
    if not np.isfinite(out).any():
        raise ValueError(f"{name}: nothing to draw, every value is NaN or infinite")
    return out


def host_attitudes(states: Any) -> np.ndarray:
    """Return attitudes of one body over time in NumPy; raise `TypeError` for other states."""
    if not hasattr(states, "q"):
        got = type(states).__name__
        raise TypeError(f"states: wanted states with an attitude (Attitude, Rigid), got {got}")
    return host_rows(states.q, 4, "states.q")


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (T, 3, 3), body → world, of the quaternions `q` (T, 4)."""
    unit = jnp.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
    return np.asarray(jax.vmap(quaternion.to_matrix)(unit), dtype=float)


def sphere_points(longitude: np.ndarray, colatitude: np.ndarray) -> np.ndarray:
    """Return points (3, …) on the unit sphere; colatitude, rad, is counted from the z axis."""
    ring, height = np.sin(colatitude), np.cos(colatitude)
    return np.stack(np.broadcast_arrays(np.cos(longitude) * ring, np.sin(longitude) * ring, height))


def viewpoint(ax: Any) -> np.ndarray:
    """Return the unit vector from the middle of 3-D axes towards the viewer."""
    up, around = np.radians([ax.elev, ax.azim])
    return np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])


def draw_on_sphere(
    ax: Any, path: np.ndarray, *, hidden_style: dict[str, Any] | None = None, **style: Any
) -> None:
    """Draw a line (T, 3) on the unit sphere, its hidden part in the `hidden_style`."""
    front, label = path @ viewpoint(ax) > 0, style.pop("label", None)
    for seen, more in ((front, {"label": label}), (~front, hidden_style or {"alpha": 0.25})):
        # The visible and the hidden part of the line overlap by one point, so that no gap opens
        # between the two.
        wide = seen | np.roll(seen, 1) | np.roll(seen, -1)
        wide[0], wide[-1] = seen[0], seen[-1]
        line = np.where(wide[:, None], path, np.nan)
        ax.plot(*line.T, **{**style, **more})


def sphere_grid() -> np.ndarray:
    """Return a grid of points (3, 49, 25) on the unit sphere, by longitude and colatitude."""
    return sphere_points(np.linspace(0, 2 * np.pi, 49)[:, None], np.linspace(0, np.pi, 25))


def draw_sphere(ax: Any, colour: str, alpha: float) -> None:
    """Draw the unit sphere as a translucent surface."""
    ax.plot_surface(*sphere_grid(), color=colour, alpha=alpha, linewidth=0, rstride=1, cstride=1)


def set_equal_scales(ax: Any, half_width: float, labels: tuple[str, str, str]) -> None:
    """Set equal scales, from −`half_width` to `half_width`, with few ticks, on all three axes."""
    from matplotlib.ticker import MaxNLocator

    limits = (-half_width, half_width)
    ax.set(xlim=limits, ylim=limits, zlim=limits)
    ax.set_box_aspect((1, 1, 1))
    for axis, label in zip((ax.xaxis, ax.yaxis, ax.zaxis), labels, strict=True):
        # The outer ticks are left out: at the corners of the cube the number at such a tick would
        # cover a number of the next axis.
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], prune="both"))
        axis.set_label_text(label)
        axis.labelpad = 4
        axis.set_tick_params(labelsize=8, pad=0)
