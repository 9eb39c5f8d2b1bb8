"""How often intervals contain the truth: 200 simulated records a scene, with torques not known.

The records of a scene are estimated together, each by itself, under `vmap`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from estimate import records

import rigidjax as rj
from rigidjax import estimate, identify

MANY, DT, NOISE = 200, 0.05, 0.02
WHITE = rj.torques.RandomTorque(2e-3)
AXES = (records.SUN, np.array([1.0, 0.0, 0.0]))


def made(key, law, directions, count):
    """What sensors read of one motion under a random torque, and its first state."""
    keys = jax.random.split(key, 3 + len(directions))
    # All as fast, so that all are followed in the same number of steps and may be stacked.
    omega = jnp.array([0.6, 2.0, 0.8]) + 0.3 * jax.random.normal(keys[0], (3,))
    omega = 2.4 * omega / jnp.linalg.norm(omega)
    start = rj.Attitude(records.START.q, omega) if directions else rj.Spin(omega)
    ts = DT * jnp.arange(count, dtype=float)
    states = records.truth(keys[1], estimate.Model(records.BODY, law), start, ts, 2).states
    read = [records.gyro(keys[2], states.omega, NOISE)]
    for world, one in zip(directions, keys[3:], strict=True):
        read.append(records.direction(one, states.q, world, NOISE))
    return ts, read, start


def stacked(trees):
    return jax.tree.map(lambda *leaf: jnp.stack(leaf) if eqx.is_array(leaf[0]) else leaf[0], *trees)


def densities(law, directions, process, count):
    """The densities of all records, with a leading axis, and the first states."""
    make = eqx.filter_jit(lambda key: made(key, law, directions, count))
    found, starts = [], []
    for key in jax.random.split(jax.random.key(7), MANY):
        ts, read, start = make(key)
        sensors = [
            identify.Gyro(NOISE),
            *(identify.Direction(world, NOISE) for world in directions),
        ]
        record = identify.Recording(ts, *zip(sensors, read, strict=True))
        problem = identify.Problem(record, identify.PrincipalRatios())
        found.append(estimate.LogDensity(identify.fit(problem, starts=1), process))
        starts.append(start)
    return stacked(found), stacked(starts)


def compared(point, start):
    """Point less truth: logarithms of moments' ratios and of the process, first rate, first turn."""
    i, true = jnp.diagonal(point.body.tensor), jnp.diagonal(records.BODY.tensor)
    out = {"ratios": jnp.log(i[:2] / i[2]) - jnp.log(true[:2] / true[2])}
    out["rate"] = point.state0.omega - start.omega
    if isinstance(start, rj.Attitude):
        between = rj.quaternion.multiply(rj.quaternion.conjugate(start.q), point.state0.q)
        out["turn"] = rj.quaternion.log(between)
    # A gyro shows accelerations: of a density, its ratio to the square of a moment.
    leaves = [jnp.log(leaf.ravel()[0]) for leaf in jax.tree.leaves(point.process)]
    out["process"] = jnp.stack([leaves[0] - 2 * jnp.log(i[2] / true[2]), *leaves[1:]])
    return out


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="Laplace's method holds the torque's density at its mode: of 95 % intervals 87 to 91 "
    "contain the ratios and the density, 93 to 94 the rates and turns",
)
@pytest.mark.parametrize("directions", [(), AXES], ids=["gyro", "gyro and directions"])
def test_intervals_contain_the_truth_as_often_as_they_say(directions):
    density, starts = densities(WHITE, directions, WHITE, 80)
    found = eqx.filter_jit(eqx.filter_vmap(estimate.refit))(density)
    assert np.mean(found.converged) > 0.97

    def errors(one, start):
        def value(x):
            return compared(one.density.unpack(x), start)

        def deviation(slope):
            return jnp.sqrt(jnp.einsum("ki,ij,kj->k", slope, one.covariance, slope))

        return value(one.x), jax.tree.map(deviation, jax.jacfwd(value)(one.x))

    value, deviation = eqx.filter_jit(eqx.filter_vmap(errors))(found, starts)
    true = np.log([np.ravel(leaf)[0] for leaf in jax.tree.leaves(WHITE)])
    value["process"] = value["process"] - true[None]
    reach = scipy.stats.norm.ppf(0.975)
    whole = np.asarray(found.converged)
    held = {
        name: float(np.mean(np.abs(error)[whole] < reach * deviation[name][whole]))
        for name, error in value.items()
    }
    assert all(0.93 <= part <= 0.97 for part in held.values()), held
