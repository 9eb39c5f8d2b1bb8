"""A body on a torsion bar, beside the harmonic motion in mpmath."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import rigidjax as rj


def ours(x):
    bar = rj.suspensions.TorsionBar([0.0, 1.0, 1.0], x[1])
    body = rj.Inertia(x[0] * jnp.diag(jnp.array([1.0, 1.5, 2.0])))
    turn = bar.swing(body, rj.Turn(x[2], x[3]))(x[4])
    return jnp.stack([turn.angle, turn.rate, bar.period(body, x[2])])


def exact(x):
    inertia, stiffness, angle, rate, t = x
    nu = mp.sqrt(stiffness / (mp.mpf(7) / 4 * inertia))
    c, s = mp.cos(nu * t), mp.sin(nu * t)
    return angle * c + rate * s / nu, rate * c - angle * nu * s, 2 * mp.pi / nu


def test_motion_period_and_derivatives():
    x = jnp.array([0.02, 0.5, 0.3, -1.2, 2.5])
    found, first = jax.jit(lambda x: (ours(x), jax.jacrev(ours)(x)))(x)
    with mp.workdps(40):
        numbers = [mp.mpf(float(v)) for v in x]
        np.testing.assert_allclose(found, [float(v) for v in exact(numbers)], rtol=1e-13)
        for i in range(3):
            for j in range(5):
                moved = lambda d, i=i, j=j: exact(
                    [v + d * (n == j) for n, v in enumerate(numbers)]
                )[i]
                slope = float(mp.diff(moved, 0))
                np.testing.assert_allclose(first[i, j], slope, rtol=1e-12, atol=1e-14)


def test_without_stiffness_it_turns_on():
    found = jax.jit(jax.jacfwd(ours))(jnp.array([0.02, 0.0, 0.3, -1.2, 2.5]))
    # To first order in κ: γ'' = −κ (γ₀ + γ̇₀ t)/M.
    want = -(0.3 * 2.5**2 / 2 - 1.2 * 2.5**3 / 6) / 0.035
    np.testing.assert_allclose(found[0, 1:], [want, 1.0, 2.5, -1.2], rtol=1e-13)


def test_simulate_closed_form_steps_and_a_body_with_mass():
    bar, ts = rj.suspensions.TorsionBar([0.0, 0.0, 1.0], 0.4), np.linspace(0.0, 3.0, 5)
    rod = rj.shapes.box(2.0, [0.5, 0.01, 0.01])
    start = rj.Turn(0.4, 2.0)
    closed = rj.simulate(rod, start, ts, bar)
    steps = rj.simulate(rod.inertia, start, ts, bar, solver=rj.solvers.DormandPrince8(), rtol=1e-12)
    np.testing.assert_allclose(closed.ys.angle, steps.ys.angle, atol=1e-10)
    assert isinstance(bar.state(rod, start), rj.Rigid)
    assert isinstance(bar.state(rod.inertia, start), rj.Attitude)
    assert closed.drift["energy"] < 1e-14 and closed.error.relative[-1] < 1e-13
    lossy = rj.suspensions.TorsionBar([0.0, 0.0, 1.0], 0.4, rj.suspensions.Friction(0.01))
    moment = float(rod.inertia.tensor[2, 2])
    ended = rj.simulate(rod, rj.Turn(0.4, 0.0), ts, lossy, rtol=1e-11).ys.angle
    gamma = 0.005 / moment
    nu = np.sqrt(0.4 / moment - gamma**2)
    want = 0.4 * np.exp(-gamma * ts) * (np.cos(nu * ts) + gamma / nu * np.sin(nu * ts))
    np.testing.assert_allclose(ended, want, atol=1e-9)
    with pytest.raises(ValueError, match="stiffness: wanted κ ≥ 0"):
        rj.suspensions.TorsionBar([0.0, 0.0, 1.0], -0.4)


def test_float32_and_batches():
    bar = rj.suspensions.TorsionBar(np.float32([0.0, 0.0, 1.0]), np.float32(0.4))
    body = rj.Inertia(jnp.eye(3, dtype=jnp.float32))
    one = lambda a: rj.simulate(body, rj.Turn(a, a), jnp.array([0.0, 1.0], jnp.float32), bar).ys
    many = jax.vmap(one)(jnp.array([0.1, 0.2], jnp.float32))
    assert many.angle.shape == (2, 2) and many.angle.dtype == jnp.float32
