"""Draw charts of error and time. matplotlib is imported only when a chart is drawn."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from rigidjax._checks import escape_formulas
from rigidjax.workprecision.pareto import first_answers, pareto_front
from rigidjax.workprecision.record import Measurement, require_measurements

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKS = "osv^<>DPX*hp8d"
_COLOURS = {"ours": "tab20", "jax": "Set2", "peer": "Dark2"}


def draw(records: Iterable[Measurement], *, title: str | None = None) -> Any:
    """Draw the time of a run against its error, log–log, for all methods of the `records`, for
    values and for gradients, with the Pareto front.

    Each scene has a row of panels, from left to right: the time of a run; the time of a first
    answer (compilation and one run), if it is known; and the error of each value against the
    tolerance or accuracy that was asked for. The grey band is the Pareto front of error and time of
    all methods; rings mark the points on this front. The coloured band is the Pareto front of the
    methods in JAX alone. Error bars are the quartiles of the time.

    **Arguments:** `records` as `measure` returns them; `title` of the figure.

    **Returns** a `matplotlib` figure.

    **Raises:** `ModuleNotFoundError` if matplotlib is missing (`pip install '.[view]'`);
    `ValueError` if there is nothing to draw.
    """
    records = [r for r in require_measurements(records) if r.error == r.error]
    if not records:
        raise ValueError("draw: wanted records with an error and a time, got none")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(r.scene for r in records))
    kinds = [k for k in ("value", "gradient") if any(r.kind == k for r in records)]
    runs = [("", records)]
    if any(r.compile == r.compile for r in records):
        runs.append((", first answer", first_answers(records)))
    panels = [(kind, words, times) for words, times in runs for kind in kinds]
    asked = [r for r in records if r.kind == "value" and 0 < r.setting < 1]
    columns = len(panels) + bool(asked)
    figure, axes = plt.subplots(
        len(names), columns, figsize=(6.6 * columns, 5.4 * len(names)), squeeze=False,
        layout="constrained",
    )  # fmt: skip
    labels = list(dict.fromkeys((r.label, r.group) for r in records))
    for row, name in zip(axes, names, strict=True):
        if asked:
            _draw_tolerance(row[-1], [r for r in asked if r.scene == name], labels)
            row[-1].set_title(escape_formulas(f"{name}: asked and reached"), fontsize=10)
        for axis, (kind, words, times) in zip(row, panels, strict=False):
            of = [r for r in times if (r.scene, r.kind) == (name, kind)]
            if not of:
                axis.set_axis_off()
                continue
            _draw_time(axis, of, labels)
            what = "error of the attitude, rad" if kind == "value" else "relative error"
            if name in ("foucault", "arenstorf") and kind == "value":
                what = "relative error of the place"
            axis.set(xlabel=what, ylabel="compile and run, ms" if words else "time, ms")
            axis.set_title(escape_formulas(f"{name}: {kind}{words}"), fontsize=10)
    if title:
        figure.suptitle(escape_formulas(title))
    return figure


def _errors_and_times(records: list[Measurement]) -> tuple[list[float], list[float]]:
    """Return the errors, at least 1e-16 since they are drawn on a logarithmic axis, and the median
    times of a run, ms.
    """
    return [max(r.error, 1e-16) for r in records], [1e3 * r.time for r in records]


def _styled(
    records: list[Measurement], labels: list[tuple[str, str]]
) -> Iterator[tuple[list[Measurement], dict[str, Any]]]:
    """Yield, for each method (by its label and group), its measurements in the order of their
    settings, and the style of its curve, as arguments of matplotlib.
    """
    import matplotlib as mpl

    for i, (label, group) in enumerate(labels):
        of = sorted((r for r in records if r.label == label), key=lambda r: r.setting)
        if not of:
            continue
        same, colours = [name for name, g in labels if g == group], mpl.colormaps[_COLOURS[group]]
        yield (
            of,
            dict(
                label=escape_formulas(label), color=colours(same.index(label) % colours.N),
                marker=_MARKS[i % len(_MARKS)], markersize=4,
                linewidth=1.6 if group == "ours" else 0.9,
                linestyle="-" if group == "ours" else "--" if group == "jax" else ":",
            ),
        )  # fmt: skip


def _draw_tolerance(
    axis: "Axes", records: list[Measurement], labels: list[tuple[str, str]]
) -> None:
    """Draw the error that each method reached against the tolerance or accuracy that was asked
    for.
    """
    for of, how in _styled(records, labels):
        axis.plot([r.setting for r in of], [max(r.error, 1e-16) for r in of], **how)
    wanted = sorted(r.setting for r in records)
    axis.plot(wanted, wanted, color="0.6", linewidth=6, alpha=0.3, zorder=0, label="as asked")
    axis.set(xlabel="tolerance or accuracy asked for", ylabel="error reached")
    _log_scales(axis)


def _draw_time(axis: "Axes", records: list[Measurement], labels: list[tuple[str, str]]) -> None:
    """Draw the time of a run against the error for each method, with the Pareto fronts."""
    for of, how in _styled(records, labels):
        bars = [
            [max(1e3 * (r.time - r.time_low), 0.0) for r in of],
            [max(1e3 * (r.time_high - r.time), 0.0) for r in of],
        ]
        axis.errorbar(*_errors_and_times(of), bars, elinewidth=0.6, **how)
    for best, colour, what in (
        (pareto_front(records), "0.6", "front"),
        (pareto_front(r for r in records if r.group != "peer"), "tab:cyan", "front in JAX"),
    ):
        band: dict[str, Any] = dict(color=colour, linewidth=6, alpha=0.3, zorder=0, label=what)
        axis.plot(*_errors_and_times(best), "-", **band)
    ringed: dict[str, Any] = dict(color="k", markerfacecolor="none", markersize=9, zorder=5)
    axis.plot(*_errors_and_times(pareto_front(records)), "o", **ringed)
    _log_scales(axis)


def _log_scales(axis: "Axes") -> None:
    """Set logarithmic scales, with smaller errors to the right, and add a grid and a legend."""
    axis.set(xscale="log", yscale="log")
    # The error axis is reversed: a better method is further to the right and further down.
    axis.invert_xaxis()
    axis.grid(alpha=0.3, which="major")
    axis.legend(fontsize=6, ncols=3, loc="upper left", bbox_to_anchor=(0, -0.13), frameon=False)
