"""Tumblers that are no ellipsoids, found by a fit of ellipsoids: status, errors, intervals.

    python tests/benchmarks/tumblers/bench_real_shapes.py [how many] [first] [rough] [noise] [told]

Convex polyhedra about ellipsoids (`simulated.polyhedron`): distances are moved by `rough` (0.05: by
5 %). Magnitudes with `noise` (0.02: 2 %); the fit is told so where `told` is 1. For each status: how many, how
often both periods are right to 2 %, the median error of the periods and ratios of moments of
those, and how often each of the four true numbers is inside its 95 % interval.
"""

import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tumblers"))

from simulated import apart, of_unknown_noise, problem, tumbler

from rigidjax import tumblers

NAMES = ("rotation", "precession", "first ratio", "second ratio")


def main(count: int, first: int, rough: float, noise: float, told: int) -> None:
    said = []
    for seed in range(first, first + count):
        one = tumbler(seed, ("long", "short")[seed % 2], rough, noise)
        recording = one.recording if told else of_unknown_noise(one)
        found = tumblers.fit_light_curve(problem(recording))
        error, deviations = apart(one, found.aliases[0]), found.deviations
        right = found.aliases[0].mode == one.mode and np.abs(error[:2]).max() < 2e-2
        said.append(
            (
                found.status if found.ok else f"{found.search.word}, {found.explanation.word}",
                right,
                error,
                deviations,
            )
        )
        print(
            f"{seed:3d} {one.mode:5s} {said[-1][0]:9s} {'right' if right else 'WRONG'} errors in % "
            f"{np.array2string(100 * error, precision=3, suppress_small=True)}, deviations "
            f"{np.array2string(100 * deviations, precision=3, suppress_small=True)}",
            flush=True,
        )
    print()
    for status in dict.fromkeys(one[0] for one in said):
        rows = [one for one in said if one[0] == status]
        good = [(error, deviations) for _, right, error, deviations in rows if right]
        print(f"{len(rows):3d} {status}, both periods right of {len(good)}; of these:")
        if good:
            error, deviations = (np.abs(np.array(v)) for v in zip(*good, strict=True))
            inside = np.mean(error < 1.96 * deviations, axis=0)
            for name, e, d, share in zip(
                NAMES, np.median(error, axis=0), np.median(deviations, axis=0), inside, strict=True
            ):
                print(f"    {name:12s} error {e:.2%}, deviation {d:.2%}, inside 95 %: {share:.0%}")


if __name__ == "__main__":
    given = (*sys.argv[1:], *("20", "0", "0.05", "0.02", "0")[len(sys.argv) - 1 :])
    main(int(given[0]), int(given[1]), float(given[2]), float(given[3]), int(given[4]))
