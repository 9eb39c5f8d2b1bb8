"""Small changes of states: round trips, names, derivatives at zero beside SciPy and mpmath."""

import itertools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax.identify.filtering.steps import ExtendedState
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.manifold import (
    dimension,
    leaf_names,
    minus,
    minus_small,
    parts_by_name,
    plus,
    rotation_slices,
    tangent_to_vector,
    vector_to_tangent,
)

Q = np.array([0.5, -0.1, 0.7, 0.3])
Q = Q / np.linalg.norm(Q)
RATE, PLACE, SPEED = [0.3, -1.2, 2.0], [4.0, 5.0, -6.0], [-7.0, 8.0, 0.9]
ATTITUDE = rj.Attitude(Q, RATE)
# Each state, the size of a change, where its turn is, and its parts.
STATES = {
    "array": (jnp.arange(2.0), 2, None, ("",)),
    "Spin": (rj.Spin(RATE), 3, None, ("omega",)),
    "Attitude": (ATTITUDE, 6, 0, ("q", "omega")),
    "Rigid": (rj.Rigid(PLACE, SPEED, Q, RATE), 12, 6, ("x", "v", "q", "omega")),
    "Point": (rj.frames.Point(PLACE, SPEED), 6, None, ("x", "v")),
    "Coupled": (
        Coupled(ATTITUDE, (jnp.arange(2.0), jnp.asarray(7.0))),
        9,
        0,
        ("motion.q", "motion.omega", "own.0", "own.1"),
    ),
    "ExtendedState": (
        ExtendedState(ATTITUDE, (jnp.ones(3),), (jnp.ones((2, 2)),)),
        13,
        0,
        ("motion.q", "motion.omega", "torques.0", "walks.0"),
    ),
}
KINDS = pytest.mark.parametrize("kind", STATES)


def change_of(state, size=0.4):
    return size * jax.random.normal(jax.random.key(3), (dimension(state),))


def q_of(state):
    return np.asarray(getattr(state, "motion", state).q)


@KINDS
def test_size_and_names(kind):
    state, size, at, wanted = STATES[kind]
    assert dimension(state) == size
    assert leaf_names(state) == wanted
    assert rotation_slices(state) == (() if at is None else (slice(at, at + 3),))
    change = change_of(state)
    cut = parts_by_name(state, jnp.stack([change, 2 * change]))
    assert tuple(cut) == wanted
    np.testing.assert_array_equal(np.concatenate(list(cut.values()), 1)[1], 2 * change)


@KINDS
def test_there_and_back(kind):
    state, _, at, _ = STATES[kind]
    change = change_of(state)
    there = plus(state, change)
    np.testing.assert_allclose(minus(there, state), change, atol=1e-14)
    same = plus(state, jnp.zeros_like(change))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), same, state))
    if at is None:
        sums = jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(state)]) + change
        np.testing.assert_array_equal(jnp.concatenate(jax.tree.leaves(there)), sums)
        return
    # The turn is SciPy's, in body axes; the sign of q does not matter.
    # A copy: older SciPy takes no array that cannot be written to.
    turn = Rotation.from_rotvec(np.array(change[at : at + 3]))
    turned = Rotation.from_quat(Q, scalar_first=True) * turn
    wanted = turned.as_quat(scalar_first=True)
    np.testing.assert_allclose(q_of(there), wanted * np.sign(wanted @ q_of(there)), atol=1e-15)
    other = jax.tree.map(lambda a: -a if a.shape == (4,) else a, there)
    np.testing.assert_allclose(minus(other, state), change, atol=1e-14)
    half = np.linalg.norm(change[at : at + 3]) / 2
    change = change.at[at : at + 3].multiply(np.sin(half) / half)
    np.testing.assert_allclose(minus_small(other, state), change, atol=1e-14)


@KINDS
def test_tangents(kind):
    state, *_ = STATES[kind]
    change = change_of(state)
    along = jax.jvp(lambda e: plus(state, e), (jnp.zeros_like(change),), (change,))[1]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15),
        vector_to_tangent(state, change),
        along,
    )
    np.testing.assert_allclose(tangent_to_vector(state, along), change, atol=1e-15)
    back = jax.jvp(lambda y: minus(y, state), (state,), (along,))[1]
    np.testing.assert_allclose(back, change, atol=1e-14)


def product(p, q):
    (a, b, c, d), (e, f, g, h) = p, q
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


def turned_by(q, v):
    """q exp(v) by mpmath, from the definition of both."""
    angle = mp.sqrt(sum(x * x for x in v))
    part = mp.mpf(1) / 2 if angle == 0 else mp.sin(angle / 2) / angle
    return product(q, [mp.cos(angle / 2), *(part * x for x in v)])


def shown_by(q, p):
    """The rotation vector from q to p by mpmath."""
    w, *u = product([q[0], *(-x for x in q[1:])], p)
    length = mp.sqrt(sum(x * x for x in u))
    return [2 * mp.atan2(length, w) / length * x for x in u]


@pytest.mark.parametrize("kind", [kind for kind in STATES if STATES[kind][2] is not None])
def test_first_and_second_derivatives_at_zero(kind):
    """Of ⊕, and of both ⊖ along a straight line in the numbers of the state, beside mpmath."""
    state, _, at, _ = STATES[kind]
    change = change_of(state, 1.0)
    turn = [mp.mpf(float(x)) for x in change[at : at + 3]]
    q = [mp.mpf(float(x)) for x in Q]

    def path(s):
        return plus(state, s * change)

    def straight(s):
        return jax.tree.map(lambda a, b: a + s * b, state, vector_to_tangent(state, change))

    with mp.workdps(40):
        for order in (1, 2):
            wanted = [
                mp.diff(lambda s, i=i: turned_by(q, [s * x for x in turn])[i], 0, order)
                for i in range(4)
            ]
            found = q_of(derivative(path, order)(0.0))
            np.testing.assert_allclose(found, np.array(wanted, float), atol=1e-13)
        rate = [mp.diff(lambda s, i=i: turned_by(q, [s * x for x in turn])[i], 0) for i in range(4)]
        away = [
            mp.diff(
                lambda s, i=i: shown_by(q, [a + s * b for a, b in zip(q, rate, strict=True)])[i],
                mp.mpf("1e-15"),
                order,
            )
            for order in (1, 2)
            for i in range(3)
        ]
    wanted = np.array(away, float).reshape(2, 3)
    for order, back in itertools.product((1, 2), (minus, minus_small)):
        found = derivative(lambda s, back=back: back(straight(s), state), order)(0.0)
        np.testing.assert_allclose(found[at : at + 3], wanted[order - 1], atol=1e-12)
        rest = np.delete(found, slice(at, at + 3))
        right = np.delete(change, slice(at, at + 3)) if order == 1 else 0.0
        np.testing.assert_allclose(rest, right, atol=1e-13)


def derivative(function, order):
    for _ in range(order):
        function = jax.jacfwd(function)
    return jax.jit(function)
