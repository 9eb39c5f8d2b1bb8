"""From two frequencies of a light curve to possible motions: a grid of bodies.

The squared brightness of an ellipsoid is nearly a quadratic form of the direction n half way
between sun and observer: `F² ∝ Σ_k M_k (n·r_k)²`, with r_k the body's axes in the world and
`M = (bc)², (ca)², (ab)²` (exactly at zero phase, for projected areas). For a given body, energy and
phase it is therefore linear in the six numbers of n nᵀ, in a frame along the angular momentum.
Least squares finds the direction of the momentum, the initial angle and the level at once; the grid
covers the shape and the phase of the rotation.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import exact
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import product4
from rigidjax.tumblers.lattice_series import remainder

# Semi-axes of the grid: b/a and c/b; phases in half a rotation.
MIDDLE, SHORT, PHASES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9), (0.5, 0.65, 0.8, 0.93), 12
# Turns about the direction half way that a start is tried with: brightness hardly sees them.
ABOUT = (0.0, math.pi / 3, 2 * math.pi / 3)
MODES = ("long", "short")


class Candidate(NamedTuple):
    """A starting motion: `moments` over the largest; `q`, `omega`, principal axes; `misfit` χ²."""

    moments: np.ndarray
    q: np.ndarray
    omega: np.ndarray
    misfit: float


def candidates(
    pair: np.ndarray, mode: str, light: Any, half_way: np.ndarray, areas: Any, count: int
) -> list[Candidate]:
    """The best of the grid whose precession and rotation have these frequencies, in order.

    `pair` has the frequencies of the mean precession and of twice the rotation, 1/s; `mode` is the
    circulated axis; `light` times since the first, squared fluxes and ones over their noise;
    `half_way` (3,) in the world frame; `areas` M (3,) of a known ellipsoid, or `None`; `count` of
    bodies.
    """
    b, ratio = np.meshgrid(MIDDLE, SHORT, indexing="ij")
    semi_axes = np.stack([np.ones(b.size), b.ravel(), (b * ratio).ravel()], axis=1)
    second = semi_axes**2
    moments = second.sum(axis=1, keepdims=True) - second
    moments = moments / moments[:, 2:]
    forms = (np.prod(semi_axes, axis=1, keepdims=True) / semi_axes) ** 2
    if areas is not None:
        forms = np.broadcast_to(areas, forms.shape)
    forms = forms / forms.mean(axis=1, keepdims=True)
    arrays = jnp.asarray(moments), jnp.asarray(forms), jnp.asarray(pair), *light
    found = _grid(jnp.asarray(mode == "long"), *arrays)
    misfits, sides, q, omega = (np.asarray(v) for v in found)
    # The best phase of each body.
    phase, least = misfits.argmin(axis=1), misfits.min(axis=1)
    out = []
    for k in np.argsort(least)[:count]:
        if not np.isfinite(least[k]):
            continue
        at = k, phase[k]
        placed = (np.array(product4(q0, q[at])) for q0 in _placed(sides[at], half_way))
        out += [Candidate(moments[k], one, omega[at], float(least[k])) for one in placed]
    return out


def _placed(side: np.ndarray, half_way: np.ndarray) -> list[tuple[Any, ...]]:
    """Turns (4,) from the frame of the momentum to the world, by the best n nᵀ of rank one."""
    xx, yy, zz, xy, xz, yz = side
    _, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    n = axes[:, -1]
    first = _turn(n, half_way if n @ half_way >= 0 else -half_way, np)
    halves = [0.5 * angle for angle in ABOUT]
    about = [(np.cos(half), *(np.sin(half) * half_way)) for half in halves]
    return [product4(one, first) for one in about]


def _turn(u: Any, v: Any, xp: Any) -> Any:
    """The shortest turn (4,) that takes one unit vector to another, which is not opposite to it."""
    q = xp.concatenate([1.0 + (u * v).sum()[None], xp.cross(u, v)])
    return q / xp.sqrt((q * q).sum())


def _rate(moments: Array, d: Array) -> Float[Array, "3"]:
    """The rate of momentum one and h²/2T = d that has no part along the middle axis."""
    a, _, c = (1.0 / moments[k] for k in range(3))
    x = jnp.clip((1.0 / d - c) / (a - c), 0.0, 1.0)
    return jnp.stack([jnp.sqrt(x), jnp.zeros_like(x), jnp.sqrt(1.0 - x)]) / moments


def _energy(moments: Array, ratio: Array, long: Array) -> tuple[Array, Array, Array]:
    """A rate whose periods have this ratio, its precession period, and whether there is one."""
    body, pure = Inertia(jnp.diag(moments)), jnp.where(long, moments[0], moments[2])

    def halved(_: Any, tried: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, *_ = tried
        part = 0.5 * (low + high)
        omega = _rate(moments, pure + part * (moments[1] - pure))
        precession = exact.precession_period(body, omega)
        quotient = precession / exact.body_period(body, omega) / ratio
        low, high = jnp.where(quotient > 1, part, low), jnp.where(quotient > 1, high, part)
        return low, high, omega, precession, quotient

    kind = moments.dtype
    zero = jnp.zeros((), kind)
    ends = jnp.asarray(1e-4, kind), jnp.asarray(1.0 - 1e-7, kind)
    # What the last try gave goes along: written out after the loop it would be compiled again.
    tried = (*ends, jnp.zeros_like(moments), zero, zero)
    _, _, omega, precession, quotient = jax.lax.fori_loop(0, 33, halved, tried)
    return omega, precession, jnp.abs(quotient - 1.0) < 1e-3


@jax.jit
def _grid(
    long: Array, moments: Array, forms: Array, pair: Array, t: Array, squares: Array, weights: Array
) -> tuple[Array, Array, Array, Array]:
    """Misfits (S, phases), n nᵀ times the level (…, 6), attitudes (…, 4) and rates (…, 3)."""
    ratio = 0.5 * pair[1] / pair[0]

    def shape(given: tuple[Array, Array]) -> Any:
        body, form = given
        omega, precession, exists = _energy(body, ratio, long)
        omega = omega * (precession * pair[0])
        h = body * omega
        # Its momentum is along z of the world; not opposite, as the parts of `_rate` are positive.
        q = _turn(h / jnp.sqrt(jnp.sum(h * h)), jnp.eye(3, dtype=h.dtype)[2], jnp)
        motion = exact.FreeBody(Inertia(jnp.diag(body)), Attitude(q, omega))

        def phase(part: Array) -> Any:
            since = part / pair[1]

            def row(q: Array) -> Array:
                m = quaternion.to_matrix(q)

                def entry(i: int, j: int) -> Any:
                    return sum(form[k] * m[i, k] * m[j, k] for k in range(3))

                # Σ M_k r_k r_kᵀ, body axes r in the world.
                twice = (2 * entry(0, 1), 2 * entry(0, 2), 2 * entry(1, 2))
                return jnp.stack([entry(0, 0), entry(1, 1), entry(2, 2), *twice])

            # The first state beside the others: by itself the motion would be compiled again.
            states: Any = jax.vmap(motion)(since + jnp.concatenate([jnp.zeros(1, t.dtype), t]))
            rows = jax.vmap(row)(states.q[1:]).T * weights[None, :]
            misfit, n = remainder(rows, squares * weights)
            return jnp.where(exists, misfit, jnp.inf), n, states.q[0], states.omega[0]

        parts = jnp.arange(PHASES, dtype=t.dtype) / PHASES
        return jax.lax.map(phase, parts)

    return jax.lax.map(shape, (moments, forms))
