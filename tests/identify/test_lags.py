"""Fits of recordings whose torque has states of its own."""

import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import identify, torques

BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
TS = np.linspace(0.0, 4.0, 81)
DRIVE = torques.Held(TS, np.repeat(np.random.default_rng(0).normal(size=27), 3))


class Push(torques.AbstractTorque):
    feels = rj.motion.HasSpin
    source: torques.Lagged

    @property
    def jump_times(self):
        return self.source.jump_times

    def __call__(self, t, state, body):
        return jnp.stack([0.3, 0.2, 1.0]) * self.source(t)


LAG = identify.Free(lambda s: s.torque.source.time, "lag", scale=0.1, positive=True)


def model(start):
    law = Push(torques.Lagged(DRIVE, 0.15))
    omega = rj.simulate(BODY, rj.Spin([0.1, 0.2, 0.3]), TS, law).ys.omega
    read = np.asarray(omega) + 1e-3 * np.random.default_rng(1).normal(size=omega.shape)
    record = identify.Recording(TS, (identify.Gyro(1e-3), read))
    guess = Push(torques.Lagged(DRIVE, start))
    return identify.Model(record, identify.Principal(1.5), torque=guess, free=[LAG])


def test_moments_and_a_motors_lag_come_back():
    found = identify.fit(model(0.1), starts=1)
    assert found.ok
    for name, value in {"Ix": 1.0, "Iy": 2.0, "Iz": 2.5, "lag": 0.15}.items():
        low, high = found.interval(0.999)[name]
        assert low < value < high
        assert high - low < 0.02 * value
