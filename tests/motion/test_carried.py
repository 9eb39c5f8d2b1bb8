"""A body along a given path: the splines beside a path known in closed form, the wrench of Newton."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax.motion.torques import Carried, LoggedMotion


def path(t):
    """Place, velocity, acceleration (world); attitude, rate, its derivative (body), by hand.

    The frame turns by a about z and then by b about its own x.
    """
    a, da, dda = 0.8 * np.sin(2 * t), 1.6 * np.cos(2 * t), -3.2 * np.sin(2 * t)
    b, db, ddb = 0.5 * np.cos(3 * t), -1.5 * np.sin(3 * t), -4.5 * np.cos(3 * t)
    x = np.stack([0.3 * np.sin(2 * t), 0.1 * t, 0.2 * np.cos(t)], -1)
    v = np.stack([0.6 * np.cos(2 * t), 0.1 + 0 * t, -0.2 * np.sin(t)], -1)
    acc = np.stack([-1.2 * np.sin(2 * t), 0 * t, -0.2 * np.cos(t)], -1)
    q = Rotation.from_euler("ZX", np.stack([a, b], -1)).as_quat(scalar_first=True)
    s, c = np.sin(b), np.cos(b)
    omega = np.stack([db, s * da, c * da], -1)
    alpha = np.stack([ddb, s * dda + c * db * da, c * dda - s * db * da], -1)
    return x, v, acc, q, omega, alpha


def in_body(q, vectors):
    return Rotation.from_quat(q, scalar_first=True).inv().apply(vectors)


T = np.linspace(0.0, 4.0, 401)


@pytest.fixture(scope="module")
def logged():
    x, _, acc, q, omega, alpha = path(T)
    # A log may write q or −q.
    q = q * np.where(np.arange(T.size) % 7 < 3, 1.0, -1.0)[:, None]
    return LoggedMotion(T, x, q), LoggedMotion(T, x, q, omega, in_body(q, acc), alpha)


def test_the_path_between_samples(logged):
    t = np.linspace(0.3, 3.7, 57)
    wanted = path(t)
    poses, whole = (jax.jit(jax.vmap(motion))(jnp.asarray(t)) for motion in logged)
    # The errors of a cubic spline with steps h of a path of 3 rad/s: h⁴, h³, h² for derivatives.
    for one, bounds in ((poses, (1e-8, 1e-6, 1e-3)), (whole, (1e-8, 1e-6, 1e-6))):
        for got, right, bound in (
            (one.x, wanted[0], bounds[0]), (one.v, wanted[1], bounds[1]),
            (one.a, wanted[2], bounds[2]), (one.omega, wanted[4], bounds[1]),
            (one.alpha, wanted[5], 10 * bounds[2]),
        ):  # fmt: skip
            np.testing.assert_allclose(got, right, rtol=0, atol=bound)
        turn = np.abs(np.sum(np.asarray(one.q) * wanted[3], axis=1))
        np.testing.assert_allclose(turn, 1.0, rtol=0, atol=1e-12)


def test_at_the_samples_a_log_is_what_it_says(logged):
    now = jax.jit(jax.vmap(logged[1]))(jnp.asarray(T))
    wanted = path(T)
    for got, right in ((now.x, wanted[0]), (now.a, wanted[2]), (now.omega, wanted[4])):
        np.testing.assert_allclose(got, right, rtol=0, atol=1e-13)
    np.testing.assert_allclose(now.alpha, wanted[5], rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_ends_have_velocities_and_accelerations(logged, dtype):
    # At the last sample round-off must not decide on which side of the end the time is.
    for motion in logged:
        ends = jnp.asarray([0.0, 4.0, 4.1], dtype)
        now = jax.jit(jax.vmap(motion))(ends)
        wanted = path(np.array([0.0, 4.0, 4.0]))
        for got, right in ((now.v, wanted[1]), (now.a, wanted[2]), (now.omega, wanted[4])):
            np.testing.assert_allclose(got, right, rtol=0, atol=0.05)


def test_noisy_poses_at_uneven_times_are_smoothed():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 4.0, 401))
    x, _, _, q, _, _ = path(t)
    shaken = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(
        2e-4 * rng.normal(size=x.shape)
    )
    motion = LoggedMotion.from_poses(
        t, x + 1e-4 * rng.normal(size=x.shape), shaken.as_quat(scalar_first=True)
    )
    inside = np.linspace(0.5, 3.5, 41)
    got, wanted = once(jax.vmap(motion))(jnp.asarray(inside)), path(inside)
    # A second difference of the poses would be off by 1e-4 · √6 / (0.01)² = 2.4 m/s².
    assert np.abs(got.a - wanted[2]).max() < 0.05
    assert np.abs(got.omega - wanted[4]).max() < 0.01
    assert np.abs(got.alpha - wanted[5]).max() < 0.15


def test_the_wrench_is_that_of_newton_and_euler_about_the_centre_of_mass(logged):
    body = rj.MassProperties(1.3, [0.05, -0.02, 0.1], jnp.diag(jnp.array([0.01, 0.004, 0.02])))
    x, v, acc, q, omega, alpha = path(T[123])
    turn, tensor = Rotation.from_quat(q, scalar_first=True), np.asarray(body.inertia.tensor)
    com = np.asarray(body.com)
    lifted = acc + turn.apply(np.cross(alpha, com) + np.cross(omega, np.cross(omega, com)))
    state = rj.Rigid(x, v, q, omega)
    wrench = Carried(logged[1])(T[123], state, body)
    np.testing.assert_allclose(wrench.force, 1.3 * lifted, rtol=1e-11)
    turning = tensor @ alpha + np.cross(omega, tensor @ omega)
    np.testing.assert_allclose(wrench.torque, turning, rtol=1e-11, atol=1e-13)


def test_a_simulated_body_follows_the_path_under_its_own_wrench(logged):
    body = rj.MassProperties(1.3, [0.0, 0.0, 0.0], jnp.diag(jnp.array([0.01, 0.004, 0.02])))
    x, v, _, q, omega, _ = path(T)
    start = rj.Rigid(x[0], v[0], q[0], omega[0])
    sol = rj.simulate(body, start, T[[0, 100]], Carried(logged[1]), rtol=1e-9)
    np.testing.assert_allclose(sol.ys.x[-1], x[100], rtol=0, atol=1e-6)
    np.testing.assert_allclose(sol.ys.omega[-1], omega[100], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(q=np.full((401, 4), 0.4)), "unit length"),
        (dict(q=np.ones((400, 4)) / 2), "got shapes"),
        (dict(omega=np.ones((400, 3))), "as many rows"),
        (dict(t=np.r_[T[:-1], 5.0]), "evenly spaced"),
        (dict(x=np.ones((401, 2))), "x: wanted"),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_a_wrong_log_is_refused_in_words(given, words):
    x, _, _, q, _, _ = path(T)
    with pytest.raises(ValueError, match=words):
        LoggedMotion(**{"t": T, "x": x, "q": q, **given})


def test_too_few_poses_are_refused():
    x, _, _, q, _, _ = path(T[:11])
    with pytest.raises(ValueError, match="12 or more"):
        LoggedMotion.from_poses(T[:11], x, q)
