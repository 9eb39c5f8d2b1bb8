"""Ranks of the truth among draws by NUTS, of simulated records whose truth is drawn from the prior.

Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788): the ranks are uniform where prior,
likelihood and sampler belong together. So every free number has a proper prior here, and the truth
is drawn from the same.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from identify.filtering import records

import rigidjax as rj
from rigidjax import identify

TS = 0.03 * jnp.arange(40, dtype=float)
NOISE = 0.02
# The prior of the first rate is a reading of another gyro at the first time, rad/s.
RATE, RATE_SPREAD = jnp.array([0.3, 0.7, 0.4]), 0.05
BIAS_SPREAD = 0.05
CHART = identify.PrincipalRatios()
PRIOR = identify.Entropic(rj.Inertia.from_principal(4.0 / 11, 8.0 / 11, 10.0 / 11), 40.0)
# Of the logarithm of the torque's density.
LAW, LAW_SPREAD = rj.torques.RandomTorque(0.05 / 11), 0.5
RECORDS, BINS = 200, 10
SAMPLER = identify.Nuts(samples=150, warmup=60)
# Every third draw of two chains.
THIN = 3


def drawn_body(key):
    """The chart's numbers, drawn from the entropic prior: a cell of a fine grid, and a place in it."""
    cell = 0.02
    line = cell * jnp.arange(-150.0, 150.0)
    centre = identify.Model(record(np.ones((TS.size, 3))), CHART).start(PRIOR.guess)
    points = centre[:2][None] + jnp.stack(jnp.meshgrid(line, line), axis=-1).reshape(-1, 2)
    log = jax.vmap(lambda x: -0.5 * jnp.sum(PRIOR.residuals(CHART.body(x), to_scale=False) ** 2))
    # Of the numbers of a body those whose root has no negative eigenvalue: a flat body, which the
    # prior forbids, is between these and the others.
    inside = (points > -1.0).all(axis=1) & (points.sum(axis=1) < 1.0)
    first, second = jax.random.split(key)
    index = jax.random.categorical(first, jnp.where(inside, log(points), -jnp.inf))
    return points[index] + cell * (jax.random.uniform(second, (2,)) - 0.5)


def record(read):
    first = jnp.broadcast_to(RATE, (TS.size, 3))
    return identify.Recording(
        TS,
        (identify.Gyro(NOISE, bias=[0.0, 0.0, 0.0]), read),
        (identify.Gyro(RATE_SPREAD), first, TS == TS[0]),
    )


@eqx.filter_jit
def made(key, body, process):
    """What the gyro reads of a motion that is drawn from the prior, and what is true of it."""
    keys = jax.random.split(key, 5)
    omega = RATE + RATE_SPREAD * jax.random.normal(keys[0], (3,))
    bias = jnp.zeros(3) if process else BIAS_SPREAD * jax.random.normal(keys[1], (3,))
    truth = {"body": body, "rate": omega}
    law = rj.torques.RandomTorque(0.0)
    if not process:
        truth["bias"] = bias
    else:
        log = LAW_SPREAD * jax.random.normal(keys[2])
        law = rj.torques.RandomTorque(LAW.density * jnp.exp(log))
        truth["process"] = log[None]
    states = records.truth(keys[3], law, rj.Spin(omega), TS, 2, body=CHART.body(body)).states
    return records.gyro(keys[4], states.omega + bias[None], NOISE), truth


def density_of(read, process):
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=BIAS_SPREAD, prior=BIAS_SPREAD)
    free = [] if process else [bias]
    law = LAW if process else None
    model = identify.Model(record(read), CHART, process=law, free=free, prior=PRIOR)
    if not process:
        return identify.LogDensity(identify.fit(model, starts=1))
    first = identify.fit(model, starts=1, max_steps=1)
    return identify.LogDensity(first, deviation=LAW_SPREAD)


def numbers(point):
    out = {"body": point.x[:2], "rate": point.state0.omega}
    if "bias" in point.values:
        out["bias"] = point.values["bias"]
    if point.process is not None:
        out["process"] = jnp.log(point.process.density / LAW.density)[:1]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("process", [False, True], ids=["plain", "white torque"])
def test_the_truth_has_any_rank_among_draws_by_nuts(process):
    pytest.importorskip("blackjax")
    began = time.process_time()
    ranks, effective = [], []
    for key in jax.random.split(jax.random.key(11), RECORDS):
        mine = jax.random.split(key, 3)
        read, truth = made(mine[0], drawn_body(mine[1]), process)
        density = density_of(read, process)
        # blackjax leans on the promotions that our tests forbid.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            found = identify.posterior(density, mine[2], sampler=SAMPLER, chains=2)
        effective.append(float(jnp.min(found.ess)))
        draws = found.map(numbers)
        # 99 draws: 100 ranks.
        few = {name: np.concatenate(np.asarray(d)[:, ::THIN])[1:] for name, d in draws.items()}
        ranks.append({name: np.sum(d < np.asarray(truth[name]), axis=0) for name, d in few.items()})
    print(
        f"{time.process_time() - began:.0f} s; independent draws: least {min(effective):.0f}, "
        f"median {np.median(effective):.0f}"
    )
    ranks = {name: np.stack([r[name] for r in ranks]) for name in ranks[0]}
    p = {name: [chance(one) for one in r.T] for name, r in ranks.items()}
    print(p)
    assert np.median(effective) > 100
    # The least of so many is below 0.01 more often: Bonferroni's bound.
    each = [value for values in p.values() for value in values]
    assert min(each) > 0.01 / len(each), p


def chance(ranks):
    """The probability of a χ² as large, of the ranks 0 to 99 in bins, if they are uniform."""
    return float(scipy.stats.chisquare(np.histogram(ranks, BINS, (0, 100))[0]).pvalue)
