"""Write a fit as a table for the terminal, as JSON, and as a self-contained page of HTML."""

import base64
import dataclasses
import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidjax import _show
from rigidjax._names import define_dir_and_getattr
from rigidjax.identify.answer.result import (
    Fit,
    as_html as as_html,
    require_one_fit,
    rows as rows,
    verdict as verdict,
)
from rigidjax.identify.answer.table import (
    Row,
    html_rows,
    numbers as numbers,
    table as table,
)


def as_dict(fit: Fit, files: Sequence[str] = (), more: Sequence[Row] = ()) -> dict[str, Any]:
    """Return all results of a fit as plain numbers and text, for JSON; infinity and NaN become
    `null`.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `files`: the names of the files that were read.
    - `more`: rows (name, value, low, high, unit) of further quantities.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> as_dict(result)["status"]
    'ok'
    """

    def plain(number: float) -> float | None:
        return float(number) if np.isfinite(number) else None

    require_one_fit(fit)
    bounds = fit.interval(0.95)
    reported = [(one.name, one.value, *bounds[one.name], one.unit) for one in fit.quantities]
    return {
        "files": list(files),
        "status": fit.status,
        "search": {"answer": fit.search.word, "reasons": list(fit.search.reasons)},
        "model": {"answer": fit.explanation.word, "reasons": list(fit.explanation.reasons)},
        "causes": [dataclasses.asdict(cause) for cause in fit.causes],
        "advice": fit.advice,
        "quantities": {
            name: {"value": plain(value), "interval_95": [plain(low), plain(high)], "unit": unit}
            for name, value, low, high, unit in (*reported, *more)
        },
        "rms": {
            f"{index} {name}": {"value": plain(rms), "axes": list(map(plain, axes)), "unit": unit}
            for index, ((name, axes, unit), rms) in enumerate(
                zip(_component_rms(fit), fit.rms, strict=True)
            )
        },
        "noise": [
            np.where(np.isfinite(noise), noise, None).tolist()  # pyright: ignore
            for noise in map(np.asarray, fit.noise)
        ],
        "held_out": None if fit.held_out is None else dataclasses.asdict(fit.held_out),
        "chi2": plain(fit.chi2),
        "degrees_of_freedom": fit.dof,
        "correlation_samples": plain(fit.correlation),
        "covariance": fit.covariance_kind,
        "starts": [
            {"misfit": plain(s.cost), "converged": s.converged, "fits": s.fits} for s in fit.starts
        ],
        "identifiability": list(fit.identifiability),
        "undetermined": [
            {
                "words": one.in_words,
                "changes": {
                    name: {"change": plain(change), "unit": "relative" if ratio else unit}
                    for name, change, unit, ratio in zip(
                        one.names, one.changes, one.units, one.relative, strict=True
                    )
                },
            }
            for one in fit.undetermined_combinations
        ],
    }


class _Rms(NamedTuple):
    """Hold the root mean square errors of the components of a sensor."""

    name: str
    axes: list[float]
    unit: str


def _component_rms(fit: Fit) -> list[_Rms]:
    """Return the errors of each sensor, without readings that are masked or at full scale."""
    out = []
    for error, reading in zip(fit.residuals, fit.model.records.readings, strict=True):
        mask = reading.usable
        squares = np.where(mask, np.asarray(error).reshape(mask.shape) ** 2, 0.0)
        mean = squares.sum(axis=(0, 1)) / np.maximum(mask.sum(axis=(0, 1)), 1)
        out.append(_Rms(type(reading.sensor).__name__, np.sqrt(mean).tolist(), reading.sensor.unit))
    return out


def write_json(
    fit: Fit, path: str | Path, files: Sequence[str] = (), more: Sequence[Row] = ()
) -> None:
    """Write all results of a fit to a file as JSON, in the form that `as_dict` returns.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `path`: the path of the file. A file that exists is overwritten.
    - `files`: the names of the files that were read.
    - `more`: rows (name, value, low, high, unit) of further quantities.

    >>> import json, tempfile
    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_json(result, folder + "/fit.json")
    ...     json.loads(Path(folder, "fit.json").read_text())["status"]
    'ok'
    """
    text = json.dumps(as_dict(fit, files, more), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name may contain bytes that are not valid UTF-8. These bytes are written as escapes.
    Path(path).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def write_html(
    fit: Fit,
    path: str | Path,
    *,
    title: str = "Identification",
    figures: Sequence[Any] = (),
    rate_unit: str = "rad/s",
    files: Sequence[str] = (),
    more: Sequence[Row] = (),
) -> None:
    """Write a fit as one page of HTML, with its status, a table of the quantities, the verdict in
    words, the errors, the starts and figures.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `path`: the path of the file. A file that exists is overwritten.
    - `title`: the title of the page.
    - `figures`: figures of matplotlib, such as those of `rigidjax.plot.fit`.
    - `rate_unit`: the unit of all angular rates: `rad/s`, `deg/s` or `deg/day`.
    - `files`: the names of the files that were read.
    - `more`: rows (name, value, low, high, unit) of further quantities.

    >>> import tempfile
    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_html(result, folder + "/fit.html")
    ...     Path(folder, "fit.html").read_text(encoding="utf-8")[:15].lower()
    '<!doctype html>'
    """
    require_one_fit(fit)
    sizes = []
    for name, axes, unit in _component_rms(fit):
        scale, shown = _show.shown_unit(unit, rate_unit)
        sizes.append((name, " ".join(f"{scale * x:.3g}" for x in axes), shown))
    starts = html_rows(
        (
            str(number),
            f"{start.cost:.6g}",
            "converged" if start.converged else "not converged",
            "explains the data" if start.fits else "does not explain the data",
        )
        for number, start in enumerate(fit.starts, 1)
    )
    pictures = ""
    for index, figure in enumerate(figures, 1):
        figure.savefig(buffer := io.BytesIO(), format="png", dpi=110)
        shown = base64.b64encode(buffer.getvalue()).decode("ascii")
        pictures += f'<img alt="figure {index}" src="data:image/png;base64,{shown}">'
    read = ", ".join(html.escape(str(name)) for name in files)
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto;
padding: 0 1rem }}
table {{ border-collapse: collapse }} td, th {{ padding: .2rem .8rem; text-align: left;
border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums }}
img {{ max-width: 100%; margin: 1rem 0 }}
</style>
<h1>{html.escape(title)}</h1>
<p>{read}</p>
{as_html(fit, rate_unit, more)}
<table><tr><th>sensor</th><th>rms error an axis</th><th>unit</th></tr>{html_rows(sizes)}</table>
<table><tr><th>start</th><th>cost</th><th></th><th></th></tr>{starts}</table>
{pictures}
</html>
"""
    Path(path).write_text(page, encoding="utf-8", errors="backslashreplace")


__all__ = [
    "as_dict", "as_html", "numbers", "rows", "table", "verdict", "write_html", "write_json",
]  # fmt: skip

define_dir_and_getattr(__name__)
