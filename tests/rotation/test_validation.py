"""What users get wrong: each mistake, its words, in and out of jit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.rotation import quaternion, so3

EYE = np.eye(3)
FLIPPED = np.diag([1.0, 1.0, -1.0])
BENT = EYE + np.array([[0, 1e-2, 0], [0, 0, 0], [0, 0, 0]])
HOLE = np.where(EYE == 1, EYE, 0) + np.array([[0, 0, 0], [0, 0, np.nan], [0, 0, 0]])

MATRICES = [
    (FLIPPED, "left-handed frame"),
    (BENT, "not orthogonal"),
    (2 * EYE, "not orthogonal"),
    (HOLE, "contains NaN or infinity"),
]
QUATERNIONS = [
    (np.zeros(4), "zero quaternion"),
    (np.array([1.0, 1.0, 0.0, 0.0]), "not a unit quaternion"),
    (np.array([1.0, np.nan, 0.0, 0.0]), "contains NaN or infinity"),
]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("bad", "words"), MATRICES)
def test_bad_matrices(bad, words, dtype, unhooked):
    bad = bad.astype(dtype)
    for f in (so3.check, so3.log, quaternion.from_matrix):
        with pytest.raises(ValueError, match=words):
            f(bad)
    with pytest.raises(RuntimeError, match=words):
        jax.block_until_ready(eqx.filter_jit(so3.check)(jnp.asarray(bad)))
    with pytest.raises(ValueError, match=words):
        so3.check(np.stack([EYE.astype(dtype), bad]))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("bad", "words"), QUATERNIONS)
def test_bad_quaternions(bad, words, dtype, unhooked):
    bad = jnp.asarray(bad, dtype)
    with pytest.raises(ValueError, match=words):
        quaternion.check(bad)
    with pytest.raises(RuntimeError, match=words):
        jax.block_until_ready(eqx.filter_jit(quaternion.check)(bad))


def test_messages_say_what_came_and_what_to_do(unhooked):
    with pytest.raises(ValueError, match=r"M0: left-handed frame, det = -1; .* axis flipped"):
        so3.check(FLIPPED, name="M0")
    with pytest.raises(ValueError, match=r"is 0\.01 \(limit 1e-06\); so3\.project"):
        so3.check(BENT)
    with pytest.raises(ValueError, match=r"length is 1\.41421 .* quaternion\.normalise"):
        quaternion.check(QUATERNIONS[1][0])
    with pytest.raises(ValueError, match=r"at index \(1, 2\)"):
        so3.check(HOLE)
    with pytest.raises(ValueError, match="left-handed frame or singular, det = -1"):
        so3.project(FLIPPED)


def test_what_is_nearly_a_rotation_passes():
    """1e-7 off in float64 and 1e-4 in float32; quaternions come back normalised."""
    for dtype, off in ((np.float64, 1e-7), (np.float32, 1e-4)):
        np.testing.assert_array_equal(
            so3.check((EYE * (1 + off)).astype(dtype)), EYE * dtype(1 + off)
        )
        q = quaternion.check(jnp.array([1 + off, 0, 0, 0], dtype))
        assert q.dtype == dtype and float(q[0]) == 1
        assert quaternion.check(jnp.tile(q, (5, 1))).shape == (5, 4)


def test_wrong_shapes_and_types(unhooked):
    with pytest.raises(ValueError, match=r"q: wanted shape \(4,\), got \(3,\); .*scalar first"):
        quaternion.log(np.zeros(3))
    with pytest.raises(ValueError, match=r"v: wanted shape \(3,\), got \(5, 3\); .*jax\.vmap"):
        so3.exp(np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"matrix: wanted shape \(3, 3\), got \(4, 4\)"):
        so3.log(np.eye(4))
    for dtype in (jnp.float16, jnp.bfloat16):
        with pytest.raises(TypeError, match="half precision cannot hold a rotation"):
            quaternion.exp(jnp.zeros(3, dtype))
    with pytest.raises(TypeError, match="wanted an array of numbers, got str"):
        so3.exp("north")
    # Whole numbers are promoted.
    np.testing.assert_allclose(so3.exp(np.array([0, 0, 1])), so3.exp(np.array([0.0, 0.0, 1.0])))
    assert quaternion.exp([0, 0, 1]).dtype == jnp.result_type(float)


def test_known_quaternions_within_a_compiled_function():
    turn = jnp.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    both = jnp.stack([jnp.array([1.0, 0.0, 0.0, 0.0]), turn])
    found = jax.jit(lambda w: so3.mean_quaternion(both, w))(jnp.ones(2))
    np.testing.assert_allclose(found, [np.cos(0.1), np.sin(0.1), 0, 0], atol=1e-15)
    large = 1e200 * both
    with pytest.raises(ValueError, match="its length is inf"):
        jax.jit(lambda w: so3.mean_quaternion(large, w))(jnp.ones(2))
