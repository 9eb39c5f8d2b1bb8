"""States inside a step, from its slopes: dense output of a Runge–Kutta method, on the group.

y(θ) = y0 + Σ φ_r(θ) F_r with φ = θ, θ (1−θ), θ² (1−θ), … Source: Hairer, Nørsett and Wanner (1993),
II.6, doi:10.1007/978-3-540-78862-1.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Axes

Project = Callable[[Array], Array]


def width(number: int) -> int:
    """How many times a step looks at together, of that number in a run.

    One step's share of them where there are fifty steps: each costs a step some work, there or not,
    and a step with more in it is taken again. Between 4 and 16 was measured to be quickest.
    """
    return min(number, max(4, min(number // 50, 16)))


def states(project: Project, ts: Array, t: Array, h: Array, y: Array, rows: Array) -> Array:
    """The states (W, n, *bodies) at times `ts` (W, *bodies) inside the step from `t`.

    **Arguments:** `rows` (r, n, *bodies) of dense output, as `runge_kutta.dense_rows` gives them.
    """
    return jax.vmap(project)(_along(_theta(ts, t, h), y, rows))


def moved_states(
    project: Project,
    step: tuple[Array, Array, Array, Array, Array],
    along: tuple[Array, Array, Array, Array, Array],
    axes: Axes,
) -> Array:
    """The tangents (W, n, *directions, *bodies) of `states`, by all of its numbers."""
    (ts, t, h, y, rows), (of_ts, of_t, of_h, of_y, of_rows) = step, along
    theta = _theta(ts, t, h)
    # The slope once, not once a direction.
    found, rate = jax.jvp(lambda theta: _along(theta, y, rows), (theta,), (jnp.ones_like(theta),))
    powers = _powers(theta.astype(y.dtype), rows.shape[0])
    if axes.directions:
        rate, powers, theta = (
            jnp.expand_dims(a, axis) for a, axis in ((rate, 2), (powers, 2), (theta, 1))
        )
    safe = lift(jnp.where(h == 0, 1, h), of_ts)
    of_theta = (of_ts - of_t[None] - theta * of_h[None]) / safe
    moved = jnp.sum(jnp.expand_dims(powers, 2) * jnp.expand_dims(of_rows, 1), 0)
    moved = of_y[None] + moved + rate * jnp.expand_dims(of_theta.astype(y.dtype), 1)

    def projected(y: Array, moved: Array) -> Array:
        return axes.over(lambda d: jax.jvp(project, (y,), (d,))[1], 1, 1)(moved)

    return jax.vmap(projected)(found, moved)


def _theta(ts: Array, t: Array, h: Array) -> Array:
    return (ts - t[None]) / jnp.where(h == 0, 1, h)[None]


def _powers(theta: Array, count: int) -> Array:
    powers = [theta]
    for i in range(1, count):
        powers.append(powers[-1] * (theta if i % 2 == 0 else 1 - theta))
    return jnp.stack(powers)


def _along(theta: Array, y: Array, rows: Array) -> Array:
    """The states (W, n, *bodies) at θ (W, *bodies), not projected."""
    weights: Any = _powers(theta.astype(y.dtype), rows.shape[0])
    return y[None] + jnp.sum(jnp.expand_dims(weights, 2) * jnp.expand_dims(rows, 1), 0)
