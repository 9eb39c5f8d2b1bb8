"""Makes rigidjax/workprecision/references.json: `python tests/workprecision/make_references.py`.

Bulirsch and Stoer's extrapolation (Hairer, Nørsett and Wanner I, II.9) at 40 digits, on the plain
equations of the scenes: no code of the solvers is used. Each end is worked out at two tolerances,
1e-22 and 1e-28; the difference is the stated error. Gradients are central differences in 40 digits at
two steps. With gmpy2 installed it takes some minutes, with mpmath alone about six times as long.
"""

import json
import sys
import time
from pathlib import Path

try:
    import gmpy2 as mp

    mp.get_context().precision = 135
    number = mp.mpfr
except ModuleNotFoundError:
    import mpmath as mp

    mp.mp.prec = 135
    number = mp.mpf

import jax

jax.config.update("jax_enable_x64", True)

from rigidjax.workprecision import scenes
from rigidjax.workprecision.scene import A, B, C

COLUMNS = 14
FILE = Path(__file__).parents[2] / "rigidjax" / "workprecision" / "references.json"


def midpoint(f, t, y, big, n):
    h = big / n
    before, now = y, [a + h * k for a, k in zip(y, f(t, y), strict=True)]
    for i in range(1, n):
        k = f(t + i * h, now)
        before, now = now, [a + 2 * h * s for a, s in zip(before, k, strict=True)]
    return now


def extrapolated(f, t, y, big):
    """End of one big step by n = 2, 4, … midpoint rules, and the last two columns' difference."""
    table = []
    for j in range(COLUMNS):
        n = 2 * (j + 1)
        row = [midpoint(f, t, y, big, n)]
        for k in range(j):
            ratio = number(n * n) / (4 * (j - k) ** 2) - 1
            row.append([a + (a - b) / ratio for a, b in zip(row[k], table[j - 1][k], strict=True)])
        table.append(row)
    best, second = table[-1][-1], table[-1][-2]
    return best, max(abs(a - b) for a, b in zip(best, second, strict=True))


def solve(f, y, end, tolerance):
    t, end = number(0), number(end)
    big = end / 64
    order = 2 * COLUMNS - 1
    while t < end:
        big = min(big, end - t)
        new, error = extrapolated(f, t, y, big)
        factor = 0.9 * float(tolerance / max(error, number("1e-60"))) ** (1 / order)
        if error <= tolerance:
            t, y = t + big, new
        big = big * number(min(max(factor, 0.2), 3.0))
    return y


def start(scene, numbers):
    if scene.body is None:
        return list(numbers)
    length = mp.sqrt(sum(a * a for a in numbers[9:]))
    return [a / length for a in numbers[9:]] + list(numbers[6:9])


def loss(scene, end):
    one, two = (number(s) for s in scene.size)
    a, b, c = ([number(x) for x in v] for v in (A, B, C))
    dot = lambda u, v: sum(x * y for x, y in zip(u, v, strict=True))
    if scene.body is None:
        return dot(a, end[:3]) / one + dot(c, end[3:]) / two
    from rigidjax.workprecision.equations import to_body_axes

    length = mp.sqrt(sum(x * x for x in end[:4]))
    w, x, y, z = (p / length for p in end[:4])
    return dot(a, to_body_axes((w, -x, -y, -z), *b)) + dot(c, end[4:]) / two


def run(scene, numbers, tolerance):
    f = scene.plain(numbers, mp.sin, mp.cos, mp.sqrt, number=number)
    return solve(f, start(scene, numbers), scene.end, number(tolerance))


def reference(scene, slopes=True):
    numbers = [number(float(x)) for x in scene.numbers]
    best, rough = run(scene, numbers, "1e-28"), run(scene, numbers, "1e-22")
    error = max(abs(a - b) for a, b in zip(best, rough, strict=True))
    gradient, off = [], number(0)
    for i in range(len(numbers) if slopes else 0):
        found = []
        for step in ("1e-13", "2e-13"):
            h = number(step)
            up = [x + h if j == i else x for j, x in enumerate(numbers)]
            down = [x - h if j == i else x for j, x in enumerate(numbers)]
            ends = [loss(scene, run(scene, x, "1e-32")) for x in (up, down)]
            found.append((ends[0] - ends[1]) / (2 * h))
        gradient.append((4 * found[0] - found[1]) / 3)
        off = max(off, abs(found[0] - found[1]))
    return {
        "end": [f"{x:.25g}" for x in best],
        "error": f"{float(error):.1e}",
        "gradient": [f"{x:.20g}" for x in gradient],
        "gradient_error": f"{float(off):.1e}",
        "source": "extrapolation at 40 digits",
    }


def main(names):
    found = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name in names or scenes():
        begin = time.perf_counter()
        found[name] = reference(
            scenes()[name](), slopes=name not in ("spinning-top-1e3", "spinning-top-1e4")
        )
        FILE.write_text(json.dumps(found, indent=1) + "\n")
        print(
            f"{name}: {time.perf_counter() - begin:.0f} s, error {found[name]['error']}, "
            f"gradient's {found[name]['gradient_error']}",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
