"""The public surface: nothing in it without a good call, and no call of it ends in raw words.

The table is in `calls_*.py`, what replaces an argument in `replace.py`, who judges in `judge.py`,
what is found and accepted in `accepted.py`. The whole runs as a user runs: in a process where
nothing checks types (`python -m surface.fuzz`, from `tests`).
"""

import collections
import contextlib
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import pytest
from surface import accepted, fuzz, public, table as table
from surface.calls import TABLE, WITHOUT

TESTS = Path(__file__).parents[1]
# One of each kind: numbers, a body and a state, a law, a frame, a sensor, a function for an argument.
SAMPLE = (
    "elliptic.rf",
    "rotation.so3.cross",
    "rotation.quaternion.angle",
    "Inertia",
    "kinetic_energy",
    "motion.torques.HeavyTop",
    "lagrangian.lie_poisson",
    "frames.AboutAxis",
    "identify.Gyro",
    "identify.FixedSteps",
)
TRANSFORMED = ("rotation.so3.cross", "kinetic_energy")


def names() -> set[str]:
    return {name.partition(" (")[0] for name in TABLE}


def test_every_public_callable_has_a_good_call_or_a_reason():
    functions = set(public.functions())
    assert functions - names() - set(WITHOUT) == set()
    assert (names() | set(WITHOUT)) - functions - set(public.methods()) == set()
    assert names() & set(WITHOUT) == set()


def test_every_reason_is_one():
    for row, place, came, why in accepted.ACCEPTED:
        assert row and place and came and len(why.split()) > 3
    assert all(len(why.split()) > 1 for why in WITHOUT.values())


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("name", SAMPLE)
def test_a_sample_of_wrong_arguments_is_answered_in_words(name):
    found = list(tried(name, transforms=False))
    assert found == []


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("name", TRANSFORMED)
def test_a_sample_of_good_calls_passes_every_transform(name):
    with usual():
        assert list(fuzz.transformed(TABLE[name], collections.Counter())) == []


def tried(name, transforms):
    with usual():
        yield from fuzz.failures_of(TABLE[name], collections.Counter(), transforms)


@contextlib.contextmanager
def usual():
    """What a user has who has set nothing."""
    with (
        warnings.catch_warnings(),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
    ):
        warnings.simplefilter("ignore")
        yield


@pytest.mark.slow
def test_the_whole_surface(tmp_path):
    report = tmp_path / "fuzz.json"
    paths = [str(TESTS.parent), str(TESTS)]
    subprocess.run(
        [sys.executable, "-m", "surface.fuzz", "--json", str(report)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "Agg"},
        check=True,
    )
    out = json.loads(report.read_text())
    print(out["counts"])
    assert out["failures"] == []
    assert out["counts"]["rows"] == len(TABLE)
