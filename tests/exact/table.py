"""The tables of accuracy.md: `python tests/exact/table.py [bodies [gradients]]`, minutes to an hour.

With gmpy2 installed it takes a fifth of the time.
"""

import contextlib
import importlib.util
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)

sys.path[:0] = [str(Path(__file__).parent)]
import classes
import twin
from accuracy import (
    HEAD,
    ROUND_OFF,
    error_in_units,
    gradient_and_curvature,
    inputs,
    jacobian,
    moved,
    reverse_jacobian,
    rotated,
    true_curvature,
    true_jacobian,
    truth,
    value,
)

from rigidjax.exact.jacobi_duplication import iteration_limits

DIGITS, DERIVATIVE_DIGITS = 60, 90
CHUNK = 2000


class Values(NamedTuple):
    """Of one class: rows measured, rows left out (see the table's head); errors."""

    measured: int
    lost: int
    median: float
    largest: float
    worst: np.ndarray
    length: float  # largest ||q| − 1|
    finite: bool  # all, but for turns beyond 1/eps rad


def values(name, count, dtype, turn=False) -> Values:
    eps = ROUND_OFF[np.dtype(dtype)]
    x = inputs(name, count, classes.times(name), seed=1)
    if dtype == np.float32 and name in ("rod", "plate"):
        # Float32 takes so thin a rod for one without thickness, and a plate that is rounded to it
        # is no body in the double precision of the derivatives.
        x[:, 0] += 3e-5 * x[:, 2]
    x = (rotated(x) if turn else x).astype(dtype)
    wide = x.astype(float)
    endless = _endless(wide, dtype)
    got = _chunked(value, x)
    slopes = _chunked(jacobian, wide)
    units, rows = [], []
    with _digits() as reference:
        for row, out, j, never in zip(wide, got, slopes, endless, strict=True):
            # A tenth of a radian from rounding the input alone: the result has no digit to check.
            if never or not moved(j, row, eps)[0] <= 0.1:
                continue
            units.append(error_in_units(row, out, eps, j, reference(row)))
            rows.append(row)
    units = np.array(units or [np.nan])
    # Of more turns than the dtype can count there is no state, and that is what NaN says.
    turned = np.abs(wide[:, 13]) * np.abs(wide[:, 6:9]).max(axis=1)
    within = turned <= 1 / np.finfo(dtype).eps
    return Values(
        len(rows),
        count - len(rows),
        float(np.median(units)),
        float(np.max(units)),
        rows[int(np.argmax(units))] if rows else wide[0],
        float(np.abs(np.linalg.norm(got[within][:, HEAD], axis=1) - 1).max()),
        bool(
            np.isfinite(got[within]).all()
            and np.isnan(got[~within]).all()
            and np.isfinite(slopes).all()
        ),
    )


def _endless(x, dtype):
    """Rows that the closed form takes for the separatrix, though their motion is not on it."""
    if x[:, 3:6].any():
        return np.zeros(len(x), bool)
    order = np.argsort(x[:, :3], axis=1)
    u, w = (np.take_along_axis(a, order, 1) for a in (x[:, :3], x[:, 6:9]))
    share = classes.off_separatrix(u, w)
    return (share > 0) & (share <= iteration_limits(np.dtype(dtype)).floor)


@contextlib.contextmanager
def _digits():
    """The oracle at `DIGITS`; in gmpy2's arithmetic, where it is installed and no axes turn."""
    with mp.workdps(DIGITS):
        if importlib.util.find_spec("gmpy2") is None:
            yield truth
            return
        import gmpy2

        arithmetic = twin.mpfr()

        def reference(row):
            if row[3:6].any() or (np.diff(row[:3]) < 0).any():
                return truth(row)
            q = [gmpy2.mpfr(c) for c in row[9:13].tolist()]
            length = gmpy2.sqrt(sum(c * c for c in q))
            moments, omega = row[:3].tolist(), row[6:9].tolist()
            q0 = [c / length for c in q]
            q, omega = twin.principal(moments, q0, omega, float(row[13]), arithmetic)
            return [*q, *omega]

        with gmpy2.context(gmpy2.get_context(), precision=int(3.33 * DIGITS)):
            yield reference


class Derivatives(NamedTuple):
    """Largest and median relative error, first order forward and reverse, and second order."""

    forward: float
    forward_median: float
    reverse: float
    second: float
    second_median: float


def derivatives(name, count, turn=False) -> Derivatives:
    r = np.random.default_rng(7)
    x = inputs(name, count, (1.0, 3.0, 10.0) if name in classes.UNSTABLE else (1.0, 10.0, 100.0))
    x = rotated(x) if turn else x
    directions, weights = r.normal(size=x.shape), r.normal(size=(count, 7))
    forward, reverse = _chunked(jacobian, x), _chunked(reverse_jacobian, x)
    _, curvature = gradient_and_curvature(*(jnp.asarray(a) for a in (x, directions, weights)))
    first, back, second = [], [], []
    with mp.workdps(DERIVATIVE_DIGITS):
        for k, row in enumerate(x):
            ref = true_jacobian(row, step="1e-30").astype(float)
            size = np.abs(ref).max()
            first.append(np.abs(forward[k] - ref).max() / size)
            back.append(np.abs(reverse[k] - ref).max() / size)
            ref = true_curvature(row, directions[k], weights[k])
            second.append(np.abs(curvature[k] - ref).max() / np.abs(ref).max())
    return Derivatives(max(first), _median(first), max(back), max(second), _median(second))


def _median(errors):
    return float(np.median(errors))


def _chunked(function, x):
    parts = [np.asarray(function(jnp.asarray(p)), float) for p in _split(x)]
    return np.concatenate(parts)


def _split(x):
    return [x[k : k + CHUNK] for k in range(0, len(x), CHUNK)]


def value_line(name, count, dtype, turn):
    v = values(name, count, dtype, turn)
    if v.largest > 5:
        print(f"{name} {np.dtype(dtype).name}: {v.worst.tolist()}", file=sys.stderr, flush=True)
    label = f"{name}, turned" if turn else name
    return (
        f"| {label} | {np.dtype(dtype).name} | {v.measured} | {v.lost} | {v.median:.2f} "
        f"| {v.largest:.2f} | {v.length:.1e} | {'none' if v.finite else 'some'} |"
    )


def derivative_line(name, count, turn):
    d = derivatives(name, count, turn)
    label = f"{name}, turned" if turn else name
    return "| " + " | ".join([label, *(f"{e:.1e}" for e in d)]) + " |"


def value_head(bodies):
    return f"""## Values

{bodies} random bodies a class ({turned_count(bodies)} where turned), t = 1, 30, 1e3, 1e6 (unstable classes also
3, 10, 20; a seam has its own times). Error of attitude and Ω, the larger, over what rounding tensor,
Ω and t by one unit does, plus one unit in the result; reference {DIGITS} digits. `lost`: rows left out
because that rounding alone moves the attitude by more than 0.1, or because they are a spin about the
middle axis but for 1e-32 of it (float32: 3e-17), which the closed form never lets flip. `turned`: full tensors, the same
bodies in axes of random direction; there a unit is that of the largest entry.

| class | dtype | bodies | lost | median | max | max of \\|q\\| − 1 | NaN |
| --- | --- | --- | --- | --- | --- | --- | --- |"""


def derivative_head(count):
    return f"""## Derivatives

{count} random bodies a class, t = 1, 10, 100 (unstable classes 1, 3, 10), float64. All derivatives of
(q, Ω) by tensor (6), Ω, q and t: largest error over the largest entry of the Jacobian; the same for
a second derivative (jvp of grad, random directions in all 14 inputs). Reference: central differences,
{DERIVATIVE_DIGITS} digits.

| class | forward max | median | reverse max | second max | median |
| --- | --- | --- | --- | --- | --- |"""


def turned_count(bodies):
    return max(bodies // 10, 1)


def main(bodies=10_000, gradients=12):
    lines = [
        "# Accuracy of the closed form",
        "",
        f"Made by `python tests/exact/table.py {bodies} {gradients}`.",
        "",
        value_head(bodies),
    ]
    for turn in (False, True):
        for name in classes.NAMES:
            for dtype in (np.float64, np.float32):
                count = turned_count(bodies) if turn else bodies
                lines.append(value_line(name, count, dtype, turn))
                print(lines[-1], flush=True)
    lines += ["", derivative_head(gradients)]
    for turn in (False, True):
        for name in classes.NAMES:
            lines.append(derivative_line(name, gradients, turn))
            print(lines[-1], flush=True)
    (Path(__file__).parent / "accuracy.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
