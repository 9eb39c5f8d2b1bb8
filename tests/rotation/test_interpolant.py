"""The interpolant: through its knots, C¹, on the group, fourth order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

from rigidjax.rotation import AttitudeInterpolant, quaternion, so3

A, B = jnp.array([0.3, -0.2, 0.9]), jnp.array([-1.0, 0.4, 0.1])


def attitude(t):
    return quaternion.multiply(quaternion.exp(t * A), quaternion.exp(jnp.sin(t) * B))


def body_rate(t):
    q = attitude(t)
    return jnp.cos(t) * B + quaternion.rotate_inverse(quaternion.exp(jnp.sin(t) * B), A) + 0 * q[1:]


def through(n):
    ts = jnp.linspace(0.0, 3.0, n)
    signs = jnp.where(jnp.arange(n) % 2 == 0, 1.0, -1.0)[:, None]
    return AttitudeInterpolant(ts, signs * jax.vmap(attitude)(ts), jax.vmap(body_rate)(ts))


def apart(path, t):
    return quaternion.angle(quaternion.multiply(quaternion.conjugate(attitude(t)), path(t)))


def test_knots_rates_and_continuity():
    path = jax.jit(lambda: through(7))()

    @jax.jit
    @jax.vmap
    def at(t):
        q, dq = jax.jvp(path, (t,), (1.0,))
        omega = path.omega(t)
        return q, dq, quaternion.rate(q, omega), omega, path.omega(t - 1e-9), apart(path, t)

    _, _, _, omega, before, error = at(path.ts)
    assert np.max(error) < 1e-15
    np.testing.assert_allclose(omega, path.omegas, atol=1e-14)
    np.testing.assert_allclose(before, path.omegas, atol=1e-7)
    # omega is the derivative of the attitude, and the attitude is a rotation.
    q, dq, rate, *_ = (np.asarray(part) for part in at(jnp.linspace(0.2, 2.9, 7)))
    np.testing.assert_allclose(dq, rate, atol=1e-14)
    np.testing.assert_allclose((q * q).sum(1), 1, atol=1e-15)


@pytest.mark.slow
def test_order():
    ts = jnp.linspace(0.05, 2.95, 37)
    worst = jax.jit(lambda path: jax.vmap(lambda t: apart(path, t))(ts).max())
    errors = [float(worst(through(n))) for n in (9, 17, 33)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 4, atol=0.4)


def test_gradient_through_coincident_knots():
    """At rest between equal attitudes: d(middle)/d(last) is ½ 1, not NaN."""

    def middle(v):
        qs = jnp.stack([jnp.eye(4)[0], quaternion.exp(v)])
        return quaternion.log(
            AttitudeInterpolant(jnp.array([0.0, 1.0]), qs, jnp.zeros((2, 3)))(0.5)
        )

    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(once(mode(middle))(jnp.zeros(3)), 0.5 * np.eye(3), atol=1e-15)


def test_constant_rate_is_exact_in_float32_too():
    w = jnp.array([0.0, 0.5, -1.0], jnp.float32)
    ts = jnp.array([0.0, 1.0, 2.5], jnp.float32)
    path = AttitudeInterpolant(
        ts, jax.vmap(lambda t: quaternion.exp(t * w))(ts), jnp.tile(w, (3, 1))
    )
    got = path(np.float32(2.0))
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(so3.log(quaternion.to_matrix(got)), 2 * w, atol=1e-6)


def test_mistakes(unhooked):
    q, w = jnp.tile(jnp.eye(4)[0], (2, 1)), jnp.zeros((2, 3))
    with pytest.raises(ValueError, match="ts: wanted increasing times"):
        AttitudeInterpolant([1.0, 0.0], q, w)
    with pytest.raises(ValueError, match="ts: wanted two times or more"):
        AttitudeInterpolant([1.0], q, w)
    with pytest.raises(ValueError, match="qs: not a unit quaternion"):
        AttitudeInterpolant([0.0, 1.0], 2 * q, w)
    with pytest.raises(ValueError, match=r"omegas: wanted shape \(2, 3\)"):
        AttitudeInterpolant([0.0, 1.0], q, jnp.zeros((3, 3)))
