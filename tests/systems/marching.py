"""The plainest integrator there is, so that equations are tested without the solvers."""

import jax
import jax.numpy as jnp


def rk4(field, y0, t, steps):
    """The state at t by `steps` classical Runge–Kutta steps of `field(t, y, args)` on any tree."""
    h = t / steps

    def add(y, *terms):
        return jax.tree.map(lambda a, *ks: a + sum(ks), y, *terms)

    def times(c, k):
        return jax.tree.map(lambda a: c * a, k)

    def step(y, i):
        s = i * h
        k1 = field(s, y, None)
        k2 = field(s + h / 2, add(y, times(h / 2, k1)), None)
        k3 = field(s + h / 2, add(y, times(h / 2, k2)), None)
        k4 = field(s + h, add(y, times(h, k3)), None)
        total = add(k1, times(2, k2), times(2, k3), k4)
        return add(y, times(h / 6, total)), None

    return jax.lax.scan(step, y0, jnp.arange(steps, dtype=jnp.result_type(float)))[0]
