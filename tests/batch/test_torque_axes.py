"""Laws of which bodies share some numbers and have others of their own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import torques

RATES = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])
BODY = rj.Inertia.from_principal(1.0, 1.0, 1.0)
STATES = rj.Spin(np.ones((3, 3)))
# Damping of each body's own, and a torque that all share.
BOTH = torques.Sum(
    torques.ConstantTorque([0.3, 0.0, 0.0]), jax.vmap(torques.Damping)(jnp.asarray(RATES))
)


def run(law, axes):
    return rj.batch.rollout(BODY, STATES, 0.02, 50, law, torque_axes=axes).omega


@pytest.mark.parametrize(
    "axes",
    [
        lambda law: law.parts[1],
        lambda law: law.parts[1].coefficient,
        lambda law: (law.parts[1].coefficient,),
    ],
)
def test_a_selector_says_which_numbers_are_each_bodys_own(axes):
    """The speed of a sphere under drag and a torque in closed form, body by body."""
    fade = np.exp(-RATES)
    push = np.array([0.3, 0.0, 0.0])
    np.testing.assert_allclose(run(BOTH, axes), fade + push / RATES * (1 - fade), rtol=1e-8)


def test_the_same_as_a_tree_of_axes():
    tree = jax.tree.map(lambda _: None, BOTH)
    tree = eqx.tree_at(lambda law: law.parts[1].coefficient, tree, 0, is_leaf=lambda a: a is None)
    np.testing.assert_array_equal(run(BOTH, tree), run(BOTH, lambda law: law.parts[1]))


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        (lambda law: law.speed, "torque_axes: the function selects a part that the torque does not have"),
        (lambda law: law.parts[7], "torque_axes: the function selects a part that the torque does not have"),
        (lambda law: None, "wanted a function that picks arrays of the law"),
        (lambda law: "no", "wanted a function that picks arrays of the law"),
        (lambda law: law.parts[2], r"wanted 3 rows in torque.parts\[2\].coefficient, got shape \(\)"),
        ("speed", "wanted 0 and None, or a function"),
    ],
)  # fmt: skip
def test_mistakes_are_named(axes, words):
    law = torques.Sum(*BOTH.parts, torques.Drag(0.1))
    with pytest.raises(ValueError, match=words):
        run(law, axes)
