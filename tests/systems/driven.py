"""A body driven along a tumble that is known at every time: Euler angles as functions of time.

The torque that does it, τ(t) = I dΩ/dt + Ω × IΩ, depends on time and on nothing else.
"""

import jax
import jax.numpy as jnp

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations

MOMENTS = (0.7, 1.2, 1.6)


def angles(t):
    return (1.1 * t + 0.3 * jnp.sin(t), 1.0 + 0.5 * jnp.sin(1.3 * t), 0.7 * t + 0.4 * jnp.cos(t))


def rates(t):
    return (1.1 + 0.3 * jnp.cos(t), 0.65 * jnp.cos(1.3 * t), 0.7 - 0.4 * jnp.sin(t))


def omega(t):
    """Body rates of the sequence 3-1-3 (notes, eqs 81–83)."""
    (_, theta, psi), (dphi, dtheta, dpsi) = angles(t), rates(t)
    return jnp.stack(
        [
            dphi * jnp.sin(theta) * jnp.sin(psi) + dtheta * jnp.cos(psi),
            dphi * jnp.sin(theta) * jnp.cos(psi) - dtheta * jnp.sin(psi),
            dphi * jnp.cos(theta) + dpsi,
        ]
    )


def attitude(t):
    """exp(φ e3) exp(θ e1) exp(ψ e3) as a quaternion, in half angles (notes, eq 31)."""
    phi, theta, psi = (0.5 * a for a in angles(t))
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack(
        [
            c * jnp.cos(phi + psi),
            s * jnp.cos(phi - psi),
            s * jnp.sin(phi - psi),
            c * jnp.sin(phi + psi),
        ]
    )


class Driver(rj.torques.AbstractTorque):
    feels = rj.motion.HasSpin
    rate_free = True
    moments: jax.Array

    def __call__(self, t, state, body):
        w, dw = jax.jvp(omega, (t,), (jnp.ones_like(t),))
        return self.moments * dw + jnp.cross(w, self.moments * w)


def start(t):
    return rj.Attitude(attitude(t), omega(t))


def field(dtype=jnp.float64):
    moments = jnp.asarray(MOMENTS, dtype)
    return AttitudeEquations(rj.Inertia(jnp.diag(moments)), Driver(moments))


attitude_at, attitudes = jax.jit(attitude), jax.jit(jax.vmap(attitude))


def error(q, t):
    """Distance of attitudes, up to the sign that quaternions leave open."""
    q, right = jnp.asarray(q), attitudes(t) if jnp.ndim(t) else attitude_at(t)
    return jnp.minimum(jnp.linalg.norm(q - right, axis=-1), jnp.linalg.norm(q + right, axis=-1))
