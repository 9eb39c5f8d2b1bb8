"""A fast tumble that the gyro cannot follow: a third of its readings at full scale or lost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identify.filtering import records

import rigidjax as rj
from rigidjax import identify

COUNT, RATE = 1000, 2000 * np.pi / 180


def angle(p, q):
    """Between two attitudes, degrees."""
    turn = rj.quaternion.multiply(rj.quaternion.conjugate(p), q)
    return float(np.degrees(np.linalg.norm(rj.quaternion.log(turn))))


@pytest.mark.slow
def test_the_equations_of_motion_see_through_saturation():
    ts = 0.002 * jnp.arange(COUNT + 1, dtype=float)
    axis = np.array([0.4, 0.8, 0.5])
    start = rj.Attitude([1.0, 0, 0, 0], RATE * axis / np.linalg.norm(axis))
    process = rj.torques.RandomTorque(1e-3)
    keys = jax.random.split(jax.random.key(0), 3)
    real = records.truth(keys[0], process, start, ts, 4).states
    # 0.1 rad/s on each reading: a cheap gyro at such a rate.
    read = np.asarray(records.gyro(keys[1], real.omega, 0.1))
    limit = 25.0
    clipped = np.clip(read, -limit, limit)
    seen = np.asarray(jax.random.uniform(keys[2], (COUNT + 1,)) > 0.1)
    lost = (np.abs(clipped) >= limit).any(axis=1) | ~seen
    assert lost.mean() > 0.3
    record = identify.Recording(ts, (identify.Gyro(0.1, limit=limit), clipped, seen))
    guess = rj.Attitude([1.0, 0, 0, 0], start.omega * 1.01)
    model = records.known(record, process)
    first = identify.first_belief(model, state=guess, rate=1.0, attitude=0.005)
    found = identify.filter(model, first)
    end = jax.tree.map(lambda leaf: leaf[-1], found.states)
    off = angle(end.q, real.q[-1])
    # What integrating the readings gives, the last one held where one is missing.
    q, last = start.q, clipped[0]
    for k in range(COUNT):
        last = clipped[k] if seen[k] else last
        q = rj.quaternion.advance(q, jnp.asarray(last), ts[k + 1] - ts[k])
    blind = angle(q, real.q[-1])
    print(f"lost {100 * lost.mean():.0f} %, off {off:.2f}°, integrated {blind:.0f}°")
    assert off < 3 and blind > 30
    deviation = np.degrees(np.linalg.norm(found.belief.deviation[-1, :3]))
    assert off < 3 * deviation < 9
