"""Whole logs with 0 to 5 throws: how much of the free flight is found, and how much else is called so.

    python tests/benchmarks/identify/bench_phases.py [COUNT]

COUNT (30) simulated logs in each row (`tests/throw_logs.py`). Flights of less than 0.1 s, between
bounces, need not be found, but are free. Then each real throw of Delft, where its folder is, with
simulated handling before and after it: its hand lets go between 0.12 and 0.03 s before the flywheel
starts, and this time does not count.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
import throw_logs

from rigidjax import identify

DELFT = Path(__file__).parents[4] / "shared" / "data" / "tudelft_throw"
SETTINGS = {
    "100 Hz": dict(rate=100.0),
    "200 Hz": dict(rate=200.0),
    "1 kHz": dict(rate=1000.0),
    "50 Hz": dict(rate=50.0),
    "sensor 15 cm from the centre": dict(rate=200.0, lever=0.15, fastest=12.0),
    "up to 34 rad/s": dict(rate=500.0, fastest=34.0),
    "slow, up to 4 rad/s": dict(rate=200.0, fastest=4.0),
    "three times the noise": dict(rate=200.0, noise=3.0),
    "full scale of the gyro at 9 rad/s": dict(rate=200.0, clip=8.73),
}


def record(t, w, f=None):
    """The recording of a gyro and, unless f is None, an accelerometer."""
    force = () if f is None else ((identify.Accelerometer(None, place=[0.0, 0.0, 0.0]), f),)
    return identify.Recording(t, (identify.Gyro(), w), *force)


def counted(phases, free, end, allowed=None):
    """How long is free, is free and found, is called free, and is called so and is not, s; spans
    that are `allowed` may be called free.
    """
    fine = np.arange(0.0, end, 2e-4)
    inside = lambda spans: np.any([(fine >= a) & (fine <= b) for a, b in spans] or [fine < 0], 0)
    called = inside([(p.start, p.end) for p in phases if p.kind == "free"])
    wanted = inside([span for span in free if span[1] - span[0] >= 0.1])
    return 2e-4 * np.array(
        [
            wanted.sum(),
            (wanted & called).sum(),
            called.sum(),
            (called & ~inside(allowed or free)).sum(),
        ]
    )


def row(name, sums):
    free, found, called, wrong = np.sum(sums, axis=0)
    print(
        f"{name:<34} {free:7.1f} s free, found {100 * found / free:5.1f} %; of the time called free "
        f"{100 * wrong / max(called, 1e-9):4.1f} % is not",
        flush=True,
    )


def main(count=30):
    for by in ("gyro and accelerometer", "gyro alone"):
        print(by)
        for name, how in SETTINGS.items():
            sums = []
            for seed in range(count):
                log = throw_logs.make(seed, seed % 6, **how)
                force = log.forces if by != "gyro alone" else None
                phases = identify.find_phases(record(log.t, log.rates, force))
                sums.append(counted(phases, log.free, log.t[-1]))
            row(name, sums)
    if DELFT.exists():
        print("Delft, in whole logs")
        row("31 throws", [delft(path) for path in sorted(DELFT.glob("*.csv"))])


def delft(path):
    """One real throw between simulated rests and handlings."""
    columns = identify.read_table(path, ["t", "wx", "wy", "wz", "ax", "ay", "az"])
    t, x = columns.pop("t"), np.stack(list(columns.values()), axis=1)
    other = throw_logs.make(len(path.name), 0, 1000.0)
    quiet = np.concatenate([other.rates, other.forces], axis=1)
    # The hand takes the body over within 0.1 s, and catches it in as much.
    blend = lambda a, b: a + throw_logs.ramp(100)[:, None] * (b - a)
    whole = np.concatenate([quiet, blend(quiet[-1], x[0]), x, blend(x[-1], quiet[0]), quiet])
    clock = 1e-3 * np.arange(len(whole))
    first = clock[len(quiet) + 100] - t[0]
    phases = identify.find_phases(record(clock, whole[:, :3], whole[:, 3:]))
    last = first + t[-1]
    return counted(phases, [(first - 0.03, last)], clock[-1], [(first - 0.12, last)])


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
