"""Numbers near the ends of the floating point range: right, or refused; never NaN unsaid."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj

Q = np.array([0.3, -0.5, 0.4, 0.7])
A = np.array([0.2, -0.9, 0.5])
B = np.array([1.0, 0.3, -0.4])
M = np.array([[1.0, 0.2, 0.1], [-0.3, 0.9, 0.2], [0.1, 0.2, 1.4]])
# Maps for which the length of the argument does not matter.
LENGTHLESS = {
    "normalise": (rj.quaternion.normalise, Q),
    "log": (rj.quaternion.log, Q),
    "angle": (rj.quaternion.angle, Q),
    "about_axis": (lambda a: rj.quaternion.about_axis(a, 0.7), A),
    "so3.about_axis": (lambda a: rj.so3.about_axis(a, 0.7), A),
    "align": (lambda a: rj.so3.align(a, jnp.asarray(B, a.dtype)), A),
    "project": (rj.so3.project, M),
    "wahba": (lambda m: rj.so3.wahba(m, m * jnp.asarray([[1, -1, -1]], m.dtype)), M),
    "mean": (lambda w: rj.so3.mean_quaternion(UNITS.astype(w.dtype), w), np.array([1.0, 2.0, 0.5])),
    "euler": (lambda q: rj.euler.from_quaternion(q, "ZYX"), Q),
    "rodrigues": (rj.rodrigues.from_quaternion, Q),
}
UNITS = jnp.stack([rj.quaternion.exp(jnp.asarray(v)) for v in (A, 0.5 * A, 0.3 * B)])
SIZES = {jnp.float64: (1e-306, 1e-200, 1e160, 1e200, 1.2e308), jnp.float32: (1e-36, 1e25, 2.3e38)}


SLOW = ("mean", "project", "wahba")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in LENGTHLESS]
)
def test_any_length_gives_the_same_rotation_and_its_derivative(name):
    f, x = LENGTHLESS[name]
    slope = jax.jit(lambda x: (f(x), jax.jacfwd(f)(x)))
    for dtype, sizes in SIZES.items():
        x = jnp.asarray(x / np.abs(x).max(), dtype)
        tight = 2000 * float(jnp.finfo(dtype).eps)
        wanted, change = slope(x)
        for size in sizes:
            large = jnp.asarray(size, dtype) * x
            np.testing.assert_allclose(f(large), wanted, atol=tight, err_msg=f"{size}")
            found, moved = slope(large)
            np.testing.assert_allclose(found, wanted, atol=tight)
            if size > 1:
                # The derivative is smaller by as much; its unit here is 1/size.
                if float(1 / jnp.asarray(size, dtype)) > float(jnp.finfo(dtype).tiny):
                    moved = np.asarray(moved, float) * size
                    np.testing.assert_allclose(moved, change, atol=10 * tight, err_msg=f"{size}")
                else:
                    assert np.isfinite(moved).all()


def test_large_parameters():
    for size in (1e100, 1e200, 1e306):
        sigma = size * jnp.asarray(A / np.abs(A).max())
        for f in (rj.mrp.to_quaternion, jax.jit(rj.mrp.to_quaternion)):
            np.testing.assert_allclose(f(sigma), [-1, 0, 0, 0], atol=1e-15)
        small = rj.mrp.shadow(sigma)
        np.testing.assert_array_equal(rj.mrp.switch(sigma), small)
        direction = A / np.linalg.norm(A)
        at_one = np.asarray(sigma) / size
        np.testing.assert_allclose(size * small, -at_one / (at_one @ at_one), rtol=1e-14)
        np.testing.assert_allclose(
            rj.rodrigues.to_quaternion(sigma), [0, *direction], rtol=1e-14, atol=1e-14
        )
        assert np.isfinite(jax.jacfwd(rj.mrp.to_quaternion)(sigma)).all()
        assert np.isfinite(jax.jacrev(rj.rodrigues.to_quaternion)(sigma)).all()
    # Ordinary ones are what they were.
    sigma = jnp.asarray(3 * A)
    s = 9 * A @ A
    np.testing.assert_allclose(
        rj.mrp.to_quaternion(sigma), [(1 - s) / (1 + s), *(6 * A / (1 + s))], rtol=1e-15
    )
    np.testing.assert_allclose(rj.mrp.shadow(sigma), -3 * A / s, rtol=1e-15)
    # |σ|² of small ones is no number, the shadow is.
    np.testing.assert_allclose(rj.mrp.shadow(1e-200 * A), -1e200 * A / (A @ A), rtol=1e-14)


HUGE = [
    (lambda: rj.quaternion.exp(1e200 * A), "v: a turn by 9e\\+199 rad; beyond 4.5e\\+15 rad"),
    (lambda: rj.so3.exp(1e16 * A), "v: a turn by 9e\\+15 rad"),
    (lambda: rj.so3.exp(jnp.asarray(1e8 * A, jnp.float32)), "beyond 8.4e\\+06 rad .*float32"),
    (lambda: rj.so3.left_jacobian(1e200 * A), "v: a turn by"),
    (lambda: rj.so3.left_jacobian_inverse(1e200 * A), "v: a turn by"),
    (lambda: rj.quaternion.about_axis(A, 1e300), "angle: a turn by 1e\\+300 rad"),
    (lambda: rj.quaternion.advance(Q, A, 1e300), r"dt \* omega: a turn by"),
    (lambda: rj.quaternion.interpolate(UNITS[0], UNITS[1], 1e300), "s times the turn: a turn by"),
    (lambda: rj.so3.interpolate(np.eye(3), rj.so3.exp(A), 1e300), "s times the turn: a turn by"),
    (lambda: rj.euler.to_quaternion([1e300, 0.0, 0.0]), "angles: a turn by"),
    (lambda: rj.quaternion.exp([0.0, np.nan, 0.0]), r"v: contains NaN or infinity at index \(1,\)"),
    (lambda: rj.quaternion.normalise(np.zeros(4)), "q: wanted a direction, got zero"),
    (lambda: rj.quaternion.normalise([1.0, 0, np.inf, 0]), "q: contains NaN or infinity"),
    (lambda: rj.quaternion.log(np.zeros(4)), "q: wanted a direction, got zero"),
    (lambda: rj.quaternion.angle(np.zeros(4)), "q: wanted a direction, got zero"),
    (lambda: rj.quaternion.about_axis(np.zeros(3), 1.0), "axis: wanted a direction, got zero"),
    (lambda: rj.euler.from_quaternion(np.zeros(4)), "q: wanted a direction, got zero"),
    (lambda: rj.so3.align(np.zeros(3), A), "a: wanted a direction, got zero"),
    (lambda: rj.mrp.shadow(np.zeros(3)), "sigma: wanted a direction, got zero"),
    (lambda: rj.mrp.to_quaternion([np.inf, 0, 0]), "sigma: contains NaN or infinity"),
    (lambda: rj.rodrigues.to_quaternion([np.inf, 0, 0]), "g: contains NaN or infinity"),
    (lambda: rj.so3.log(1e200 * np.eye(3)), "matrix: not orthogonal"),
    (lambda: rj.so3.check(1e308 * np.ones((3, 3))), "matrix: "),
    (lambda: rj.quaternion.check(1e200 * Q), "q: not a unit quaternion"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "words"), HUGE)
@pytest.mark.usefixtures("unhooked")
def test_what_is_beyond_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_up_to_where_a_traced_angle_gives_a_rotation():
    norms = eqx.filter_jit(lambda v: jnp.sum(rj.quaternion.exp(v) ** 2))
    for size in (1e16, 1e100, 1e150):
        np.testing.assert_allclose(norms(size * jnp.asarray(A)), 1.0, rtol=1e-14)
