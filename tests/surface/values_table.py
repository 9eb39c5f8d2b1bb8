"""All rows of the fuzz of values: importing this makes `values.WAYS` whole."""

import sys
import time
import traceback

from surface import (
    values_bodies as values_bodies,
    values_frames as values_frames,
    values_identify as values_identify,
    values_motion as values_motion,
    values_numbers as values_numbers,
    values_solve as values_solve,
    values_suspensions as values_suspensions,
)
from surface.values import WAYS, draws_of, judged


def main(only: list[str]) -> None:
    """Say how near each row comes to its bound."""
    counts = [0, 0, 0]
    for key, row in WAYS.items():
        if only and not any(word in key for word in only):
            continue
        before = time.process_time()
        try:
            found = list(judged(key, draws_of(row)))
        except Exception:
            print(f"{key}: {traceback.format_exc()[-500:]}")
            continue
        bad = [one for one in found if one.ratio > 1]
        worst = max(one.ratio for one in found)
        counts[0] += len(found) * len(row.names)
        counts[1] += sum(one.vague for one in found) * len(row.names)
        counts[2] += len(bad)
        took = time.process_time() - before
        print(f"{key}: {worst:.2g} of the bound, {sum(o.vague for o in found)} vague, {took:.2f} s")
        for one in bad[:2]:
            print("   ", one.what[:1500])
    print("calls, vague, wrong:", counts, "CPU s:", round(time.process_time(), 1))


if __name__ == "__main__":
    main(sys.argv[1:])
