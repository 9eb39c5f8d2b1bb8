"""Write a fit as a table for the terminal, as JSON, and as a self-contained page of HTML."""

import base64
import dataclasses
import html
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidjax import _checks, _show
from rigidjax._names import define_dir_and_getattr
from rigidjax.identify.answer.result import Fit, require_one_fit

Row = tuple[str, float, float, float, str]


def rows(fit: Fit, rate_unit: str = "rad/s") -> list[Row]:
    """Return all results of a fit as rows (name, value, low, high, unit), where low and high are
    the ends of the 95 % interval.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `rate_unit`: the unit of all angular rates, such as initial rates and biases of gyros:
      `rad/s`, `deg/s` or `deg/day`.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> name, value, low, high, unit = rows(result)[0]
    >>> name, round(value, 1), low < value < high
    ('Ix/Iz', 3.1, True)
    """
    require_one_fit(fit)
    bounds = fit.interval(0.95)
    out: list[Row] = []
    for quantity in fit.quantities:
        low, high = bounds[quantity.name]
        scale, unit = _show.shown_unit(quantity.unit, rate_unit)
        name = quantity.name
        if name.startswith("Ω"):
            axis, *where = name.split(" ", 1)
            name = " ".join([axis, "at the start", *where])
        out.append((name, quantity.value * scale, low * scale, high * scale, unit))
    return out


def table(lines: list[Row]) -> str:
    """Return `lines` as a table of text, with each number rounded by the width of its interval.

    **Arguments:** `lines` one or more rows (name, value, low, high, unit), such as those that
    `rows` returns.

    >>> print(table([("I1", 1.23456, 1.2, 1.27, "kg m²")]))
                 value  95 % interval
    I1          1.2346  1.2000 … 1.2700 kg m²
    """
    for line in _checks.require_instance(
        lines, (list, tuple), "lines", requirement="a list of rows"
    ):
        if not isinstance(line, tuple) or len(line) != 5:
            raise TypeError(f"lines: wanted rows (name, value, low, high, unit), got {line!r}")
    if not lines:
        raise ValueError("lines: wanted at least one row, got none")
    wide = max(len(name) for name, *_ in lines)
    out = [f"{'':{wide}}  {'value':>14}  95 % interval"]
    for name, value, low, high, unit in lines:
        shown = numbers(value, low, high)
        out.append(f"{name:{wide}}  {shown[0]:>14}  {_interval(shown)} {unit}".rstrip())
    return "\n".join(out)


def numbers(value: float, low: float, high: float) -> list[str]:
    """Return three texts: `value`, `low` and `high`, rounded by the width of the interval.

    **Arguments:** `value` the number; `low` and `high` the ends of the interval of this number, in
    the same unit.

    >>> numbers(1.23456, 1.2, 1.27)
    ['1.2346', '1.2000', '1.2700']
    """
    value = _checks.python_float(value, "value")
    low, high = _checks.python_float(low, "low"), _checks.python_float(high, "high")
    wholes = [abs(number) for number in (value, low, high) if np.isfinite(number)]
    size, gaps = max(wholes, default=0.0), (value - low, high - value)
    fixed = size == 0 or 1e-3 <= size < 1e6
    near = min((gap for gap in gaps if 0 < gap < np.inf), default=0.0)

    def shown(number: float, gap: float) -> str:
        if not np.isfinite(number):
            return str(number)
        top = _power_of_ten(size if fixed else number)
        # The number is shown to two digits after the first digit of the uncertainty, or with six
        # digits if there is no uncertainty.
        last = _power_of_ten(2 * min(gap, 8e307)) - 2 if 0 < gap < np.inf else top - 5
        last = min(max(last, top - 12), top - 2)
        return f"{number:.{max(-last, 0)}f}" if fixed else f"{number:.{top - last}e}"

    ends = (near, near, near) if fixed else (near, *gaps)
    return [shown(number, gap) for number, gap in zip((value, low, high), ends, strict=True)]


def _power_of_ten(number: float) -> int:
    """Return the power of ten of the first digit of `number`, such as 2 for 345; 0 for zero."""
    return int(np.floor(np.log10(abs(number)))) if number else 0


def _interval(texts: list[str]) -> str:
    """Return "low … high" of the texts (value, low, high), or "not determined" for NaN."""
    return "not determined" if "nan" in texts[1:] else f"{texts[1]} … {texts[2]}"


def verdict(fit: Fit) -> str:
    """Return in words whether the search of a fit found the best point, whether the model explains
    the readings, what to try, and what the data do not determine.

    **Arguments:** `fit` a result of `rigidjax.identify.fit`.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> verdict(result).splitlines()[0]
    'status: ok'
    """
    require_one_fit(fit)
    good = [start for start in fit.starts if start.converged and start.fits]
    lines = ["status: ok"] if fit.ok else [f"search: {fit.search}", f"model: {fit.explanation}"]
    lines += [str(cause) for cause in fit.causes] + [fit.advice]
    lines.append(
        f"starts: {len(good)} of {len(fit.starts)} reached a motion that fits as well as the best"
        + (", all the same one" if fit.ok and len(good) > 1 else "")
    )
    lines += [f"- {line}" for line in fit.identifiability]
    lines += [fit.place] if fit.place else []
    if fit.x.dtype == np.float32:
        lines.append(
            "A fit is better in float64: this one was computed in float32, with seven digits. "
            "jax.config.update('jax_enable_x64', True) at the start of the program, before any "
            "array is made, gives float64."
        )
    return "\n".join(lines)


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
    starts = _html_rows(
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
<table><tr><th>sensor</th><th>rms error an axis</th><th>unit</th></tr>{_html_rows(sizes)}</table>
<table><tr><th>start</th><th>misfit</th><th></th><th></th></tr>{starts}</table>
{pictures}
</html>
"""
    Path(path).write_text(page, encoding="utf-8", errors="backslashreplace")


def as_html(fit: Fit, rate_unit: str = "rad/s", more: Sequence[Row] = ()) -> str:
    """Return a fit as HTML, for a page or a notebook: its status, a table of its quantities, and
    the verdict, which says in words whether the fit can be trusted, and what to try.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `rate_unit`: the unit of all angular rates: `rad/s`, `deg/s` or `deg/day`.
    - `more`: rows (name, value, low, high, unit) of further quantities.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> as_html(result).startswith("<p") and "Ix/Iz" in as_html(result)
    True
    """
    lines = _html_rows(
        (name, (shown := numbers(*three))[0], _interval(shown), unit)
        for name, *three, unit in (*rows(fit, rate_unit), *more)
    )
    head, *words = verdict(fit).splitlines()
    said = "".join(f"<li>{html.escape(line.removeprefix('- '))}</li>" for line in words)
    colour = "#009E73" if fit.ok else "#D55E00"
    return f"""<p style="color: {colour}; font-weight: 600">{html.escape(head)}</p>
<table><tr><th></th><th>value</th><th>95 % interval</th><th>unit</th></tr>{lines}</table>
<p>Covariance: {html.escape(fit.covariance_kind)}.</p>
<ul>{said}</ul>"""


def _html_rows(lines: Iterable[tuple[str, ...]]) -> str:
    """Return lines of cells as rows (`tr`) of a table of HTML."""
    cells = ("".join(f"<td>{html.escape(cell)}</td>" for cell in line) for line in lines)
    return "".join(f"<tr>{line}</tr>" for line in cells)


__all__ = [
    "Row", "as_dict", "as_html", "numbers", "rows", "table", "verdict", "write_html", "write_json",
]  # fmt: skip

define_dir_and_getattr(__name__)
