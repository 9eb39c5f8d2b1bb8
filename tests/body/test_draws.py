"""Random bodies: always possible, of the spread that was asked for, as simulators take them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidjax as rj

KEYS = jax.random.split(jax.random.key(3), 20000)
TURN = Rotation.from_euler("xyz", [0.4, -0.5, 0.6]).as_matrix()
SECOND = TURN @ np.diag([1.0, 4.0, 9.0]) @ TURN.T
BOX = rj.MassProperties(2.0, [0.1, -0.2, 0.3], SECOND)
draws_of = jax.jit(jax.vmap(rj.body.sample, (None, 0, None)))


def rebuilt(draws):
    r = Rotation.from_quat(draws.q, scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", r, draws.moments, r)


@pytest.mark.parametrize("spread", [0.02, 0.5, 4.0])
@pytest.mark.parametrize(
    "body",
    [
        BOX,
        rj.MassProperties(1.0, [0.0, 0, 0], np.diag([0.0, 1.0, 2.0])),
        rj.MassProperties(1.0, [0.0, 0, 0], np.diag([0.0, 0.0, 2.0])),
        rj.Inertia.from_principal(1.0, 2.0, 3.0),
        rj.Inertia.from_principal(1.0, 1.0, 1.0),
    ],
    ids=["box", "plate", "rod", "flat", "ball"],
)
def test_every_draw_is_possible_however_wide(body, spread):
    draws = draws_of(body, KEYS, spread)
    low, middle, high = np.asarray(draws.moments).T
    # MuJoCo asks for this in its own arithmetic, without a tolerance.
    assert (low >= 0).all() and (low <= middle).all() and (low + middle >= high).all()
    assert np.isfinite(high).all()
    np.testing.assert_allclose(np.linalg.norm(draws.q, axis=1), 1.0, rtol=1e-15)
    if isinstance(body, rj.MassProperties):
        assert (np.asarray(draws.body.mass) > 0).all()
        tensors = np.asarray(draws.body.inertia.tensor)
    else:
        tensors = np.asarray(draws.body.tensor)
    size = np.trace(tensors, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(rebuilt(draws) / size, tensors / size, atol=1e-14)


def test_the_spread_is_that_of_mass_centre_and_second_moments():
    draws = draws_of(BOX, KEYS, jnp.array([0.03, 0.004, 0.01]))
    mass, com = np.asarray(draws.body.mass), np.asarray(draws.body.com)
    off = 4.0 / np.sqrt(2 * len(KEYS))  # four deviations of a deviation
    np.testing.assert_allclose(np.log(mass).std(), 0.03, rtol=off)
    np.testing.assert_allclose(com.std(axis=0), 0.004, rtol=off)
    np.testing.assert_allclose(com.mean(axis=0), BOX.com, atol=4 * 0.004 / np.sqrt(len(KEYS)))
    shape = np.asarray(draws.body.second_moment) / mass[:, None, None]
    shape = TURN.T @ shape @ TURN
    np.testing.assert_allclose(np.log(np.diagonal(shape, axis1=1, axis2=2)).std(0), 0.01, rtol=off)
    # exp(W/2) 𝔖 exp(W/2) to first order: W_12 of variance 0.01²/2, times the mean of 1 and 4 (/2 kg).
    np.testing.assert_allclose(shape[:, 0, 1].std(), 0.01 / 2**0.5 * 2.5 / 2, rtol=off)
    apart = np.corrcoef(np.c_[np.log(mass), com, shape[:, 0, 0], shape[:, 0, 1]].T)
    assert abs(apart - np.eye(6)).max() < 5 / np.sqrt(len(KEYS))


def test_one_number_is_relative_to_the_size():
    draws = draws_of(BOX, KEYS, 0.01)
    wanted = draws_of(BOX, KEYS, jnp.array([0.01, 0.01 * np.sqrt(14.0 / 2.0), 0.01]))
    for one, other in zip(jax.tree.leaves(draws), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_axes_of_the_file_do_not_matter():
    """The distribution is the same in other axes: the same moments, if the body is turned."""
    inertia = rj.Inertia.from_principal(5.0, 10.0, 13.0)
    turned = rj.Inertia(TURN @ np.asarray(inertia.tensor) @ TURN.T)
    one, other = (np.log(draws_of(body, KEYS, 0.1).moments) for body in (inertia, turned))
    off = 5 / np.sqrt(len(KEYS))
    np.testing.assert_allclose(one.mean(axis=0), other.mean(axis=0), atol=0.1 * off)
    np.testing.assert_allclose(np.cov(one.T), np.cov(other.T), atol=0.1**2 * off)


def test_derivatives_by_the_spread_are_finite_at_zero():
    def trace(spread):
        return rj.body.sample(BOX, KEYS[0], spread).moments.sum()

    slope = jax.jit(jax.grad(trace))
    for spread in (0.0, 0.2):
        ends = trace(spread + 1e-5), trace(spread), trace(spread + 2e-5)
        numeric = (4 * ends[0] - 3 * ends[1] - ends[2]) / 2e-5
        np.testing.assert_allclose(slope(spread), numeric, rtol=1e-6)


@pytest.mark.parametrize("spread", [-0.1, np.nan, 11.0, [0.1, -0.1, 0.1], [0.1, 0.1, 11.0]])
def test_a_spread_that_is_none_is_refused(spread):
    with pytest.raises(ValueError, match="spread: wanted numbers from 0 to 10"):
        rj.body.sample(BOX, KEYS[0], jnp.array(spread))
