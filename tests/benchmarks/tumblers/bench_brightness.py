"""Tumblers from their brightness alone, blind: how many of 100 are found, and what is said of each.

    python tests/benchmarks/tumblers/bench_brightness.py [how many] [first]

Right is: both periods to 0.1 % and both ratios of moments to 5 %. Then: with which status, whether
a wrong alias was ever called "ok", and for those that are not right whether it is another motion or
this one with errors that the data do not do better (deviations of the fit).
"""

import sys
import time
from collections import Counter
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[2] / "tumblers"))

from simulated import HOUR, off, problem, tumbler

from rigidjax import tumblers


def main(count: int, first: int) -> None:
    said: Counter[tuple[str, str]] = Counter()
    print("  # mode   rotation precession phase amplitude | periods   ratios  what      status")
    began = time.process_time()
    for seed in range(first, first + count):
        one = tumbler(seed, ("long", "short")[seed % 2])
        found = tumblers.fit_light_curve(problem(one.recording))
        times, ratios = off(one, found.aliases[0])
        right = times < 1e-3 and ratios < 0.05
        # The same motion, less precisely.
        near = found.aliases[0].mode == one.mode and times < 2e-2 and ratios < 0.3
        what = "right" if right else ("imprecise" if near else "WRONG")
        listed = any(
            max(off(one, alias)) < 0.05 and off(one, alias)[0] < 1e-3 for alias in found.aliases
        )
        if what == "WRONG" and listed:
            what = "rival"
        status = found.status if found.ok else f"{found.search.word}, {found.explanation.word}"
        said[what, status] += 1
        print(
            f"{seed:3d} {one.mode:5s} {one.rotation / HOUR:7.2f} h {one.precession / HOUR:7.2f} h "
            f"{one.phase:5.0f} {one.amplitude:9.3f} | {times:.1e} {ratios:7.4f}  {what:9s} {status} "
            f"{found.fit.chi2:.0f}/{found.fit.dof}, deviation of the periods "
            f"{found.deviations[:2].max():.1e}",
            flush=True,
        )
    spent = time.process_time() - began
    print(f"\n{spent / count:.1f} s of one core for each, with compiling")
    for (what, status), number in sorted(said.items()):
        print(f"{number:4d} {what}, said to be {status}")


if __name__ == "__main__":
    main(*(int(v) for v in (*sys.argv[1:], *("100", "0")[len(sys.argv) - 1 :])))
