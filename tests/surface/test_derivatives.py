"""Derivatives of every public differentiable function, four ways, also where formulas degenerate.

See `sweep.py` for the ways and `cases.py` for functions and points.
"""

import jax
import pytest
from surface import cases, sweep

# Short to compile, and each a kind of degenerate point.
SAMPLE = {
    "quaternion.log": cases.rotations,
    "elliptic.rc": cases.numbers,
    "body.parameters.pack_moments": cases.bodies,
}


def check(case):
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        assert sweep.problems(case) == []


@pytest.mark.parametrize("name", SAMPLE)
def test_a_sample(name):
    check(next(case for case in SAMPLE[name]() if case.name == name))


@pytest.mark.slow
@pytest.mark.parametrize("group", cases.GROUPS)
def test_all(group):
    found = {}
    for case in cases.GROUPS[group]():
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            wrong = sweep.problems(case)
        if wrong:
            found[case.name] = wrong
        jax.clear_caches()
    assert found == {}
