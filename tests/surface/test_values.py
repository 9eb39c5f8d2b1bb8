"""Public functions of drawn arguments against a second way of computing them: `values.py`."""

import jax
import pytest
from surface import values, values_table as values_table
from surface.values import WAYS, WITHOUT

# Quick to compile, some of each kind.
SAMPLE = (
    "elliptic.ellippi",
    "rotation.so3.wahba",
    "rotation.euler.from_quaternion rotation.euler.from_matrix (ZYX)",
    "rotation.so3.left_jacobian_inverse rotation.so3.right_jacobian_inverse",
    "body.shapes.torus body.volumes.torus",
    "body.shapes.mesh",
    "body.divergence",
    "motion.torques.GravityGradient motion.torques.GravityGradient.energy",
    "orbits.ThreeBody.lagrange_points",
)
# Draws of a row of the sample, and of one of all; how many calls these are to be, a public function
# and a set of arguments each.
FEW, MANY, CALLS = 20, 6, 2000


def looked_at(key, count):
    row = WAYS[key]
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        found = list(values.judged(key, values.draws_of(row, count)))
    return found, [one.what for one in found if one.ratio > 1]


def test_every_public_name_has_a_second_way_or_a_reason():
    covered = {name for row in WAYS.values() for name in row.names}
    assert values.wanted() - covered - set(WITHOUT) == set()
    assert (covered | set(WITHOUT)) - values.wanted() == set()
    assert covered & set(WITHOUT) == set()


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("key", SAMPLE)
def test_a_sample(key):
    _, wrong = looked_at(key, FEW)
    assert wrong == []


@pytest.mark.long
@pytest.mark.usefixtures("unhooked")
def test_all():
    calls, vague, wrong = 0, 0, []
    for key, row in WAYS.items():
        found, bad = looked_at(key, MANY)
        calls += len(found) * len(row.names)
        vague += sum(one.vague for one in found) * len(row.names)
        wrong += bad
    print(f"{calls} calls, of {vague} the arguments leave less than three digits")
    assert wrong == []
    assert calls - vague > CALLS and vague < 0.05 * calls
