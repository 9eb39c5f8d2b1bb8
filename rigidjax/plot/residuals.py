"""Draw the residuals of a fit, and compare them with white noise."""

from typing import Any

import numpy as np

from rigidjax.plot.style import (
    COLOURS,
    TIMES,
    axes_of_shape,
    channels_of,
    escape_formulas,
    residuals_of,
    unit_factor,
)

# The largest number of frequencies in the power spectrum of residuals at unevenly spaced times.
_MOST = 2000


def residuals(
    fit_result: Any, *, index: int = 0, time_unit: str = "s", title: str = "", ax: Any = None
) -> Any:
    """Draw four panels for each sensor: its residuals, their histogram, correlation and spectrum.

    All panels show the residuals divided by their standard deviation, from left to right:

    - the residuals against time, mostly within ±2 for a good fit; triangles at the border of
      the panel stand for residuals beyond ±8;
    - the histogram of the residuals, with the standard normal density;
    - the autocorrelation of the residuals, which for white noise is mostly within the band ±2/√N,
      with N the number of readings;
    - the power spectrum of the residuals (Welch's estimate; Lomb's for unevenly spaced times),
      which is 1 at all frequencies for white noise. A peak is a periodic motion or torque that the
      model lacks.

    **Arguments:** `fit_result` a `rigidjax.identify.Fit`; `index` of the recording; `time_unit`
    `s`, `min`, `h` or `day`; `title`; `ax` your axes (sensors, 4), two rows for a
    `ForceTorque`. **Returns** the axes.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model())
    >>> residuals(found)[0, 2].get_xlabel()
    'lag, samples'
    """
    seconds = unit_factor(time_unit, TIMES, "time_unit")
    record, left, noises = residuals_of(fit_result, index)
    channels = channels_of([reading.sensor for reading in record.readings])
    count = len(channels)
    ax = axes_of_shape(ax, (count, 4), nrows=count, ncols=4, figsize=(10.5, 2.8 * count))
    t = np.asarray(record.t) / seconds
    for row, (index, part, unit) in zip(ax, channels, strict=True):
        reading, standardised = record.readings[index], left[index] / noises[index]
        _draw(row, t, standardised[:, part], np.asarray(reading.host_mask))
        name = type(reading.sensor).__name__
        name = name if unit == reading.sensor.unit else f"{name}, {unit}"
        row[0].set_ylabel(f"{name}\nerror / noise")
        row[0].set_xlabel(f"time, {time_unit}")
        row[3].set_xlabel(f"frequency, {'Hz' if time_unit == 's' else f'1/{time_unit}'}")
    ax[0, 0].set_title(escape_formulas(title) or "residuals of the fit", loc="left")
    return ax


def _draw(
    four_panels: np.ndarray, t: np.ndarray, standardised: np.ndarray, mask: np.ndarray
) -> None:
    """Draw the residuals of one sensor, divided by their standard deviation, in four panels: over
    time, as a histogram, as autocorrelation, and as power spectrum.
    """
    over_time, spread, memory, spectrum = four_panels
    seen = standardised[mask]
    colours, names = COLOURS[: seen.shape[1]], "xyz"[: seen.shape[1]]
    everything = seen.ravel()
    # With a scale that includes an outlier all other residuals would lie on a line: residuals
    # beyond `reach` are drawn at the border of the panel.
    reach = float(np.clip(np.abs(everything).max(initial=0.0) * 1.1, 4.0, 8.0))
    beyond = int((np.abs(everything) > reach).sum())
    shown = np.where(np.abs(seen) <= reach, seen, np.nan)
    how: dict[str, Any] = dict(ms=2.5 if mask.sum() > 100 else 5, alpha=0.7)
    for values, colour, name in zip(shown.T, colours, names, strict=True):
        over_time.plot(t[mask], values, ".", color=colour, label=name, **how)
    if beyond:
        for axis, (values, colour) in enumerate(zip(seen.T, colours, strict=True)):
            for side, mark in ((1, "^"), (-1, "v")):
                where = t[mask][side * values > reach]
                # The triangles that stand for outliers have a height of their own for each axis of
                # the sensor, since an outlier often concerns all three axes at the same time.
                at = np.full(where.size, side * reach * (0.95 - 0.09 * axis))
                over_time.plot(where, at, color=colour, marker=mark, ms=5, ls="")
        name = f"beyond ±{reach:.0f}"
        over_time.plot([], [], color="0.4", marker="^", ms=2.5, ls="", label=name)
    over_time.axhspan(-2, 2, color="0.9", zorder=0)
    # With outliers the legend has four names and would be wider than the panel in one row: it gets
    # two rows, and space above the data.
    columns, room = (2, 1.65) if beyond else (3, 1.35)
    over_time.legend(loc="upper right", ncols=columns, fontsize=8, markerscale=2, columnspacing=1)
    over_time.set_ylim(-reach, room * reach)
    # The histogram is as wide as the data: residuals far smaller than their standard deviation
    # would otherwise all lie in two or three bins.
    inside = everything[np.abs(everything) <= reach]
    low, high = (inside.min(), inside.max()) if inside.size else (-1.0, 1.0)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), 1e-3 * reach)
    count = int(np.clip(2 * np.sqrt(everything.size), 9, 41))
    # The bins reach at least from `low` to `high`, so that rounding cannot leave the largest
    # residual out.
    bins = np.linspace(min(low, middle - half), max(high, middle + half), count)
    label = f"{beyond} beyond" if beyond else None
    weights = np.full(everything.size, 1 / (everything.size * (bins[1] - bins[0])))
    spread.hist(everything, bins=bins, weights=weights, color=COLOURS[5], alpha=0.8, label=label)
    x = np.linspace(-reach, reach, 200)
    spread.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color="0.2", lw=1.4, label="normal")
    spread.set(xlabel="error / noise", ylabel="density", ylim=(0, 1.3 * spread.get_ylim()[1]))
    spread.legend(loc="upper right", fontsize=8)

    number = int(mask.sum())
    lags = np.arange(1, max(2, min(40, number // 2)))
    for values, colour in zip(seen.T, colours, strict=True):
        centred = values - values.mean()
        # The correlation of a constant series is drawn as zero.
        whole = float(centred @ centred) or 1.0
        correlation = [float(centred[:-lag] @ centred[lag:]) / whole for lag in lags]
        memory.plot(lags, correlation, ".-", color=colour, ms=4, lw=0.8)
        spectrum.plot(*power_spectrum(t[mask], values), color=colour, lw=1)
    band = 2 / np.sqrt(max(number, 1))
    memory.axhspan(-band, band, color="0.9", zorder=0)
    memory.axhline(0, color="0.6", lw=0.8)
    memory.set(xlabel="lag, samples", ylabel="correlation", ylim=(-1, 1))
    spectrum.axhline(1, color="0.6", lw=0.8)
    spectrum.set(yscale="log", ylabel="power / power of the noise")


def power_spectrum(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies, in cycles per unit of `t`, and the power there of residuals divided by
    their standard deviation: 1 for white noise. With fewer than eight times the arrays are empty.
    """
    from scipy.signal import lombscargle, welch

    gaps = np.diff(t)
    if t.size < 8:
        return np.zeros(0), np.zeros(0)
    gap = float(np.median(gaps))
    if (np.abs(gaps - gap) <= 1e-3 * gap).all():
        # Welch's estimate is the mean of the spectra of several segments, which has less noise than
        # the spectrum of the whole series.
        segment = min(t.size, max(64, min(t.size // 4, 512)))
        frequencies, density = welch(values, 1 / gap, nperseg=segment)
        return frequencies[1:], density[1:] / (2 * gap)
    span = float(t[-1] - t[0])
    frequencies = np.arange(1, min(_MOST, max(2, int(span / (2 * gap))))) / span
    return frequencies, lombscargle(t, values - values.mean(), 2 * np.pi * frequencies)
