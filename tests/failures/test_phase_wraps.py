"""Phase wraps: a record of attitudes that jumps by a turn, or by a sign, is the same record (R10, I3).

Quaternions that change sign from sample to sample, Euler angles that wrap at ±π and that do not: the
fit ends at the same body; of the signs, at the same bits.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

TS = jnp.linspace(0.0, 6.0, 40)
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
MOTION = rj.simulate(BODY, rj.Attitude([1.0, 0, 0, 0], [0.9, 1.6, -0.7]), TS).ys


def fitted(q):
    record = identify.Recording(TS, (identify.AttitudeSensor(0.01), q))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)


@pytest.mark.slow
def test_signs_and_turns_do_not_matter():
    rng = np.random.default_rng(3)
    turns = jax.vmap(rj.quaternion.exp)(0.01 * rng.normal(size=(40, 3)))
    q = np.asarray(jax.vmap(rj.quaternion.multiply)(MOTION.q, turns))
    flipped = q * rng.choice([-1.0, 1.0], size=(40, 1))
    # Once round and wrapped: angles of the same attitudes, some of them beyond ±π.
    angles = np.asarray(jax.vmap(lambda p: rj.euler.from_quaternion(p, "zyx"))(q))
    assert np.abs(np.diff(angles[:, 0])).max() > 5
    unwrapped = np.unwrap(angles, axis=0) + 2 * np.pi
    again = np.asarray(jax.vmap(lambda a: rj.euler.to_quaternion(a, "zyx"))(unwrapped))
    plain, signs, wraps = (fitted(x) for x in (q, flipped, again))
    assert plain.ok and signs.ok and wraps.ok
    for a, b in zip(jax.tree.leaves(plain.x), jax.tree.leaves(signs.x), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(wraps.body.moments, plain.body.moments, rtol=1e-6)
