"""Row D4: when a body spun about its middle axis, δ off it, first flips."""

import jax
import jax.numpy as jnp
import numpy as np
from systems.tumble import Nothing

import rigidjax as rj

BODY = rj.Inertia.from_principal(1.0, 2.0, 3.0)
# First zero of Ω2 from Ω0 = (0, 1, δ), by 60 digits (shared notes, failures.md, section 2d).
DELTAS = np.array([1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14])
TIMES = np.array(
    [
        9.4255178968436496622, 17.402483478546878418, 25.378872335690177766, 33.355261075340701009,
        41.331649814973493878, 49.308038554606284377, 57.284427294239074875,
    ]
)  # fmt: skip


def off(delta, t, torque, **options):
    """By how much the flip is early or late, s: Ω2 over its rate at the time that is right."""
    start = rj.Spin(jnp.stack([jnp.zeros_like(delta), jnp.ones_like(delta), delta]))
    ts = jnp.stack([jnp.zeros_like(t), t])
    omega = rj.simulate(BODY, start, ts, torque, **options).ys.omega[-1]
    return omega[1] / (omega[0] * omega[2])


def test_the_closed_form():
    late = jax.jit(jax.vmap(lambda d, t: off(d, t, None)))(jnp.asarray(DELTAS), jnp.asarray(TIMES))
    np.testing.assert_array_less(np.abs(late), 1e-12 * TIMES)


def test_a_solver_with_its_tolerance_scaled():
    def late(delta, t):
        return off(delta, t, Nothing(), rtol=1e-12, atol=1e-26, throw=False)

    found = np.abs(jax.vmap(late)(jnp.asarray(DELTAS), jnp.asarray(TIMES)))
    np.testing.assert_array_less(found, 1e-6 * 1e-8 / DELTAS + 1e-11)


def test_a_tolerance_that_is_not_scaled_makes_the_time_up():
    """What the docstring of `simulate` warns of: δ = 1e-8 below atol = 1e-6."""
    delta, t = jnp.asarray(1e-8), jnp.asarray(TIMES[3])
    rough = abs(float(off(delta, t, Nothing(), rtol=1e-6, atol=1e-6)))
    scaled = abs(float(off(delta, t, Nothing(), rtol=1e-6, atol=1e-14)))
    assert scaled < 0.05 and rough > 5 * scaled
    assert "Scale `atol`" in rj.simulate.__doc__
