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
from rigidjax.rotation.linalg3 import cross

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


def bodies_of_grid() -> tuple[np.ndarray, np.ndarray]:
    """Semi-axes and moments (S, 3) of uniform ellipsoids, each over its largest."""
    b, ratio = np.meshgrid(MIDDLE, SHORT, indexing="ij")
    semi_axes = np.stack([np.ones(b.size), b.ravel(), (b * ratio).ravel()], axis=1)
    second = semi_axes**2
    moments = second.sum(axis=1, keepdims=True) - second
    return semi_axes, moments / moments[:, 2:]


def candidates(
    pair: np.ndarray,
    mode: str,
    light: Any,
    half_way: np.ndarray,
    areas: np.ndarray | None,
    count: int,
) -> list[Candidate]:
    """The best of the grid whose precession and rotation have these frequencies, in order.

    `pair` has the frequencies of the mean precession and of twice the rotation, 1/s; `mode` is the
    circulated axis; `light` times since the first, squared fluxes and ones over their noise;
    `half_way` (3,) in the world frame; `areas` M (3,) of a known ellipsoid, or `None`; `count` of
    bodies.
    """
    semi_axes, moments = bodies_of_grid()
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
        placed = (_times(q0, q[at]) for q0 in _placed(sides[at], half_way))
        out += [Candidate(moments[k], one, omega[at], float(least[k])) for one in placed]
    return out


def _placed(side: np.ndarray, half_way: np.ndarray) -> list[np.ndarray]:
    """Turns (4,) from the frame of the momentum to the world, by the best n nᵀ of rank one."""
    xx, yy, zz, xy, xz, yz = side
    _, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    n = axes[:, -1]
    first = _between(n, half_way)
    halves = [0.5 * angle for angle in ABOUT]
    about = [np.concatenate([[np.cos(half)], np.sin(half) * half_way]) for half in halves]
    return [_times(one, first) for one in about]


def _between(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The shortest turn that takes u to v or to −v, whichever is nearer."""
    v = v if u @ v >= 0 else -v
    q = np.concatenate([[1.0 + u @ v], np.cross(u, v)])
    return q / np.linalg.norm(q)


def _times(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate([[w], v])


def _rate(moments: Array, d: Array) -> Float[Array, "3"]:
    """The rate of momentum one and h²/2T = d that has no part along the middle axis."""
    a, _, c = (1.0 / moments[k] for k in range(3))
    x = jnp.clip((1.0 / d - c) / (a - c), 0.0, 1.0)
    return jnp.stack([jnp.sqrt(x), jnp.zeros_like(x), jnp.sqrt(1.0 - x)]) / moments


def _along_z(momentum: Array) -> Float[Array, "4"]:
    """An attitude in which the momentum (3,), body frame, is along z."""
    u = momentum / jnp.sqrt(jnp.sum(momentum * momentum))
    # Never opposite: the parts of `_rate` are positive.
    z = jnp.zeros_like(u).at[2].set(1.0)
    q = jnp.concatenate([1.0 + u[2:], cross(u, z)])
    return q / jnp.sqrt(jnp.sum(q * q))


def periods(moments: Array, omega: Array) -> tuple[Array, Array]:
    """Body period and mean precession period, s, of principal moments (3,)."""
    body = Inertia(jnp.diag(moments))
    return exact.body_period(body, omega), exact.precession_period(body, omega)


def _energy(moments: Array, ratio: Array, long: Array) -> tuple[Array, Array, Array]:
    """A rate whose periods have this ratio, its precession period, and whether there is one."""
    pure = jnp.where(long, moments[0], moments[2])

    def halved(_: Any, tried: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, *_ = tried
        part = 0.5 * (low + high)
        omega = _rate(moments, pure + part * (moments[1] - pure))
        rotation, precession = periods(moments, omega)
        quotient = precession / rotation / ratio
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
    z = squares * weights
    total = jnp.sum(z * z)

    def shape(given: tuple[Array, Array]) -> Any:
        body, form = given
        omega, precession, exists = _energy(body, ratio, long)
        omega = omega * (precession * pair[0])
        motion = exact.FreeBody(Inertia(jnp.diag(body)), Attitude(_along_z(body * omega), omega))

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
            gram = rows @ rows.T
            gram = gram + 1e-9 * jnp.trace(gram) * jnp.eye(6, dtype=t.dtype)
            side = rows @ z
            n = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram), side)
            misfit = jnp.where(exists, total - side @ n, jnp.inf)
            return misfit, n, states.q[0], states.omega[0]

        parts = jnp.arange(PHASES, dtype=t.dtype) / PHASES
        return jax.lax.map(phase, parts)

    return jax.lax.map(shape, (moments, forms))
