"""Row D9: by the times of a table, gradients through `simulate` are those of differences.

Pulses that are stepped over, and the times of a pulse: tests/motion/test_schedules.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, OMEGA

import rigidjax as rj

TORQUES = np.array([[0.0, 0.0, 3.0], [2.0, 0.0, 0.0], [0.0, -1.0, 1.0]])


@pytest.mark.slow
def test_the_slope_by_the_times_of_a_table():
    def end(times):
        law = rj.torques.Tabulated(times, TORQUES)
        ts = [0.0, 3.0]
        return rj.simulate(BODY, rj.Spin(OMEGA), ts, law, rtol=1e-11, atol=1e-13).ys.omega[-1]

    times, weights = jnp.array([0.7, 1.1, 2.3]), jnp.array([0.3, -1.0, 0.7])
    found = jax.grad(lambda times: weights @ end(times))(times)
    step = 1e-4
    wanted = [
        weights @ (end(times + step * e) - end(times - step * e)) / (2 * step) for e in np.eye(3)
    ]
    assert np.abs(wanted).min() > 0.05
    np.testing.assert_allclose(found, wanted, atol=1e-6)
