"""Row D14: where errors have grown past the tolerance, gradients are worth nothing; that is said."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj

# The chaotic top of failures.md, section 2d.
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.2)
TOP = rj.torques.HeavyTop(1.0, [1.0, 0.4, 0.7], [0.0, 0.0, -1.0])
Q = np.array([0.29457358, 0.51677653, 0.16788989, 0.78611794])
START = rj.Attitude(Q / np.linalg.norm(Q), [1.40904798, 2.72002574, -1.26857553])


def run(end, **options):
    ts = jnp.linspace(0.0, end, 5)
    return rj.simulate(BODY, START, ts, TOP, **options)


def test_growth_is_the_derivative_of_the_end_by_the_start():
    out = run(4.0, rtol=1e-11, atol=1e-13)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = out.growth
    np.testing.assert_allclose(found[0], 1.0, rtol=1e-12)
    # By differences: along the direction that grows the most, no other grows more.
    size = float(jnp.linalg.norm(out.ys.omega, axis=1).max())

    def end(turn, push):
        q = rj.quaternion.multiply(START.q, rj.quaternion.exp(turn))
        start = rj.Attitude(q, START.omega + size * push)
        ys = rj.simulate(BODY, start, out.ts, TOP, rtol=1e-11, atol=1e-13).ys
        return np.concatenate([ys.q[-1], ys.omega[-1] / size])

    step = 1e-5
    # dq = ½ q ⊗ δ: a turn of 2 moves q by 1.
    columns = [
        (end(2 * a[:3], a[3:]) - end(-2 * a[:3], -a[3:])) / (2 * step) for a in step * np.eye(6)
    ]
    wanted = np.linalg.norm(np.stack(columns, axis=1), ord=2)
    np.testing.assert_allclose(found[-1], wanted, rtol=1e-5)


def test_a_long_run_is_said_to_be_lost():
    out = run(120.0, rtol=1e-7, atol=1e-9)
    with pytest.warns(UserWarning, match="gradients through them mean nothing"):
        found = out.growth
    assert float(found[-1]) > 1e7
    # The same tolerance is good for the first quarter.
    assert float(found[1]) * 1e-7 < 1


@pytest.mark.slow
def test_a_regular_motion_grows_as_time_does():
    body, ts = rj.Inertia.from_principal(1.0, 1.5, 2.0), jnp.array([0.0, 50.0, 100.0])
    out = rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], [1.0, 0.1, 0.2]), ts)
    grown = out.growth
    assert 1.5 < float(grown[2] / grown[1]) < 2.5
    assert jax.tree.leaves(grown)[0].shape == ts.shape
