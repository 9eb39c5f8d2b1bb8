"""Run the Python blocks of pages, and write what they print below them.

python tests/pages.py [PAGE ...] renews the outputs of the pages; without names those of all.
`tests/test_pages.py` runs the same blocks, and compares what they print with what the pages say.
"""

import contextlib
import io
import math
import re
import sys
import tempfile
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
# `notebooks/reference` is made from the docstrings, whose examples run in `test_doctests.py`.
PAGES = sorted((ROOT / "notebooks").glob("*.md")) + sorted((ROOT / "notebooks/guide").glob("*.md"))
FENCE = re.compile(r"^(```+)(\S*)[^\n]*\n(.*?)^\1", re.S | re.M)
# A Python block, and the output that the page shows right below it.
_BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n```output\n(.*?)^```\n)?", re.S | re.M)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")


def text_of(path):
    return path.read_text(encoding="utf-8")


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def blocks(path):
    """Return the Python blocks of a page, each with the output shown below it ("" for none).

    Each block begins with as many empty lines as make a traceback name its line of the page.
    """
    text = text_of(path)
    return [
        ("\n" * (text.count("\n", 0, found.start()) + 1) + found[1], found[2] or "")
        for found in _BLOCK.finditer(text)
    ]


def run(path, parts=slice(None)):
    """Run some blocks of a page in a new folder. Return the page's names and what each block printed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cache = jax.config.values["jax_compilation_cache_dir"]
    names = {"__name__": "__main__"}
    printed = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        try:
            for block, _ in blocks(path)[parts]:
                with contextlib.redirect_stdout(io.StringIO()) as stream:
                    exec(compile(block, name_of(path), "exec"), names)
                lines = (line.rstrip() for line in stream.getvalue().splitlines())
                printed.append("".join(f"{line}\n" for line in lines))
        finally:
            jax.config.update("jax_compilation_cache_dir", cache)
            # JAX keeps the folder in which it wrote first, which a page may have chosen.
            compilation_cache.reset_cache()
            plt.close("all")
    return names, printed


def alike(shown, printed):
    """Return whether two outputs have the same words, and numbers that agree as far as is shown.

    A number may differ by one unit of its last digit, by 1e-4 of itself, or by 1e-9, which covers
    errors of round-off. A whole number may differ by 3 %: steps are counted otherwise elsewhere.
    Spaces do not count.
    """
    words, others = ("".join(_NUMBER.sub("#", text).split()) for text in (shown, printed))
    if words != others:
        return False
    for a, b in zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True):
        mantissa, _, exponent = a.partition("e")
        whole = not exponent and "." not in mantissa
        digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        least = 1e-9 if whole else max(1e-9, 1.01 * digit)
        if not math.isclose(float(a), float(b), rel_tol=0.03 if whole else 1e-4, abs_tol=least):
            return False
    return True


def renew(path):
    """Write below each block what it prints; an output that is alike stays as it is."""
    if not blocks(path):
        return
    _, printed = run(path)
    outputs = iter(printed)

    def shown(found):
        now = next(outputs)
        if found[2] and alike(found[2], now):
            return found[0]
        output = f"\n```output\n{now}```\n" if now else ""
        return f"```python\n{found[1]}```\n{output}"

    path.write_text(_BLOCK.sub(shown, text_of(path)), encoding="utf-8")


if __name__ == "__main__":
    for page in [Path(name).resolve() for name in sys.argv[1:]] or [README, *PAGES]:
        renew(page)
