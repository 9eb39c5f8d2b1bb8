"""A fit as a table for the terminal."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rigidjax.identify.fit import Fit

Row = tuple[str, float, float, float, str]


def rows(fit: "Fit", rate_unit: str = "rad/s") -> list[Row]:
    """Ratios and first body rate as rows (name, value, low, high, unit), 95 % intervals.

    **Arguments:** `fit`; `rate_unit` one of `rad/s`, `deg/s`, `deg/day`.
    """
    scale = {"rad/s": 1.0, "deg/s": 180 / np.pi, "deg/day": 86400 * 180 / np.pi}[rate_unit]
    bounds = fit.interval(0.95)
    ratios = np.exp(np.asarray(fit.problem.body.logs(fit.body)))
    out: list[Row] = []
    for name, value in zip(fit.problem.body.log_names, ratios, strict=True):
        out.append((name, float(value), *bounds[name], ""))
    for axis, value in zip("xyz", np.asarray(fit.state0.omega), strict=True):
        low, high = bounds[f"Ω{axis}"]
        out.append((f"Ω{axis} at the start", value * scale, low * scale, high * scale, rate_unit))
    return out


def table(lines: list[Row]) -> str:
    """Rows of (name, value, low, high, unit) as text, digits as the interval allows."""
    wide = max(len(name) for name, *_ in lines)
    out = [f"{'':{wide}}  {'value':>14}  95 % interval"]
    for name, value, low, high, unit in lines:
        digits = _decimals(high - low)
        shown = [f"{number:.{digits}f}" for number in (value, low, high)]
        out.append(f"{name:{wide}}  {shown[0]:>14}  {shown[1]} … {shown[2]} {unit}".rstrip())
    return "\n".join(out)


def _decimals(width: float) -> int:
    if not np.isfinite(width) or width <= 0:
        return 6
    return int(np.clip(2 - np.floor(np.log10(width)), 0, 12))


def verdict(fit: "Fit") -> str:
    """What is well and what is weakly determined, and whether the starts agree, in words."""
    good = [start for start in fit.starts if start.converged and start.fits]
    lines = [f"status: {fit.status}"]
    lines.append(
        f"starts: {len(good)} of {len(fit.starts)} reached a motion that explains the data"
        + (", all the same one" if fit.ok and len(good) > 1 else "")
    )
    lines += [f"- {line}" for line in fit.identifiability]
    return "\n".join(lines)
