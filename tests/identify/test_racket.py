"""Real tosses of a tennis racket: flat, so that its largest moment is the sum of the others."""

import csv
from collections import defaultdict
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

TOSSES = Path(__file__).parents[3] / "shared" / "data" / "tennis_racket" / "tosses.csv"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not TOSSES.exists(), reason="the tosses are not beside this checkout"),
]


def recordings(round_):
    rows = defaultdict(list)
    with TOSSES.open() as file:
        for row in csv.DictReader(file):
            if row["round"] == round_:
                rows[row["toss"]].append([float(row[k]) for k in ("t", "wx", "wy", "wz")])
    out = []
    for toss in rows.values():
        data = np.array(toss)
        law = rj.torques.QuadraticDamping([0.0, 0.0, 0.0])
        gyro = identify.Gyro(bias=[0.0, 0.0, 0.0])
        out.append(identify.Recording(data[:, 0], (gyro, data[:, 1:]), torque=law))
    return out


def fitted(round_, starts):
    free = [
        identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.01),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    ]
    problem = identify.Model(recordings(round_), identify.Ratios(), free=free)
    return identify.fit(problem, starts=starts, progress=print)


def flatness(point):
    moments = jnp.sort(point.body.moments)
    return moments[2] / (moments[0] + moments[1])


@pytest.fixture(scope="module")
def rounds():
    return fitted("2", 3), fitted("3", 2)


def test_both_rounds_fit_from_blind_starts(rounds):
    for found in rounds:
        print(found.status, found.rms, found.correlation, found.interval(), found.values)
        assert (
            found.search.word == "found"
            and found.explanation.word != "does not explain the readings"
        )
        good = [s for s in found.starts if s.converged and s.fits]
        assert len(good) >= 2


def test_the_rounds_agree_within_their_intervals(rounds):
    two, three = (found.interval(0.95) for found in rounds)
    for name in ("I1/I3", "I2/I3"):
        print(name, two[name], three[name])
        assert two[name][0] <= three[name][1] and three[name][0] <= two[name][1]


def test_the_racket_is_flat(rounds):
    for found in rounds:
        low, high = found.interval_of(flatness)
        print("flatness", low, high)
        assert abs(flatness(found) - 1) < 0.005
