"""Derivatives of the errors of several recordings by what a fit looks for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)


@pytest.mark.oldest
def test_errors_have_the_derivatives_of_central_differences_in_both_modes():
    """Two recordings of unlike length, a shared drag, a bias with deviations."""
    made, law = [], rj.torques.Damping([0.1, 0.2, 0.3])
    for count, spin in ((9, [0.4, 1.2, -0.3]), (7, [0.2, -0.9, 0.5])):
        ts = 0.1 * jnp.arange(count, dtype=float)
        omega = rj.simulate(BODY, rj.Spin(spin), ts).ys.omega
        gyro = identify.Gyro(0.01, bias=[0.0, 0.0, 0.0])
        made.append(identify.Recording(ts, (gyro, omega)))
    drag = identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.1)
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.1, spread=0.1)
    problem = identify.Model(made, identify.PrincipalRatios(), torque=law, free=[drag, bias])

    def errors(x):
        return problem.errors(x)[0].reshape(-1)

    x, h = problem.start(BODY) + 0.1, 1e-5
    steps = h * jnp.eye(x.size)
    both = jax.jit(lambda x: (jax.jacfwd(errors)(x), jax.jacrev(errors)(x)))(x)
    moved = jax.jit(jax.vmap(errors))(jnp.concatenate([x[None] + steps, x[None] - steps]))
    wanted = (moved[: x.size] - moved[x.size :]).T / (2 * h)
    assert wanted.shape == (2 * 9 * 3, 2 + 3 + 3 + 2 * (3 + 3))
    for slope in both:
        np.testing.assert_allclose(slope, wanted, atol=1e-8 * np.abs(wanted).max())
