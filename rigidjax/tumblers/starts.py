"""Find possible motions that have two given frequencies of a light curve, on a grid of bodies.

The squared brightness F² of an ellipsoid is nearly a quadratic form of the direction n half way
between sun and observer: `F² ∝ Σ_k M_k (n·r_k)²`, with r_k the body's axes in the world and `M =
(bc)², (ca)², (ab)²` for the semi-axes a, b, c. This relation is exact if the sun is behind the
observer and the brightness is the projected area. For a given body, energy and phase of the
rotation F² is therefore linear in the six numbers of the matrix n nᵀ, written in a frame whose z
axis is along the angular momentum. A linear least-squares fit finds the direction of the momentum,
the initial angle about the momentum and the level of brightness together. The grid covers the shape
of the body and the phase of its rotation.
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax import exact
from rigidjax._types import Scalar
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import quaternion_product
from rigidjax.tumblers.lattice_series import Light, remainder

# The grid has the ratios b/a of the semi-axes in MIDDLE, the ratios c/b in SHORT, and PHASES phases
# in half a rotation.
MIDDLE, SHORT, PHASES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9), (0.5, 0.65, 0.8, 0.93), 12
# These are angles of rotations, rad, about the direction n half way between sun and observer. Such
# a rotation hardly changes the brightness, so that the fit on the grid does not determine its
# angle: each start is tried with all of these angles.
ABOUT = (0.0, math.pi / 3, 2 * math.pi / 3)
MODES = ("long", "short")


class Candidate(NamedTuple):
    """Hold a starting motion of the search."""

    moments: Float[np.ndarray, "3"]  # the principal moments divided by the largest
    q: Float[np.ndarray, "4"]  # the initial attitude of the principal axes
    omega: Float[np.ndarray, "3"]  # the initial rate along these axes, rad/s
    chi2: float


class GridMotions(NamedTuple):
    """Hold motions of bodies that start at phases which divide half a rotation evenly.

    The frame of the angular momentum has its z axis along the momentum.
    """

    chi2: Float[Array, "bodies phases"]  # infinite for a body that has no such motion
    form: Float[Array, "bodies phases 6"]  # xx, yy, zz, xy, xz, yz of n nᵀ times the level
    q: Float[Array, "bodies phases 4"]  # principal axes → frame of the angular momentum, initial
    omega: Float[Array, "bodies phases 3"]  # the initial rate, rad/s, principal axes


def best_candidates(
    pair: Float[np.ndarray, "2"],
    mode: str,
    light: Light,
    bisector: Float[np.ndarray, "3"],
    areas: Float[np.ndarray, "3"] | None,
    body_count: int,
) -> list[Candidate]:
    """Return, on a grid of bodies and phases, the best motions that have a given pair of
    frequencies, the smallest χ² first, of `body_count` bodies.

    - `pair`: the frequency of the mean precession, and twice that of the rotation, 1/s.
    - `mode`: "long" or "short", as in `Alias`.
    - `light`: of the squared fluxes, with times in s, `z` not yet divided by the noise.
    - `bisector`: the direction n half way between sun and observer, world frame.
    - `areas`: (bc)², (ca)², (ab)² of an ellipsoid whose semi-axes a, b, c are known, or `None`.
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
    motions = _grid_motions(jnp.asarray(mode == "long"), *arrays)
    chi2, sides, q, omega = (np.asarray(v) for v in motions)
    # Each body is used with the phase of its smallest χ².
    phase, least = chi2.argmin(axis=1), chi2.min(axis=1)
    out = []
    for k in np.argsort(least)[:body_count]:
        if not np.isfinite(least[k]):
            continue
        at = k, phase[k]
        # The eigenvector of the largest eigenvalue of the fitted matrix n nᵀ is n, or −n, in the
        # frame of the angular momentum. Rotate it to n in the world, and then about n by each angle
        # of `ABOUT`, which the fit does not determine.
        xx, yy, zz, xy, xz, yz = sides[at]
        n = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))[1][:, -1]
        first = _shortest_rotation(n, bisector if n @ bisector >= 0 else -bisector, np)
        for half in (0.5 * angle for angle in ABOUT):
            to_world = quaternion_product((np.cos(half), *(np.sin(half) * bisector)), first)
            attitude = np.array(quaternion_product(to_world, q[at]))
            out.append(Candidate(moments[k], attitude, omega[at], float(least[k])))
    return out


def _shortest_rotation(u: Any, v: Any, xp: ModuleType) -> Any:
    """Return the quaternion of the shortest rotation from the unit vector u to the unit vector v,
    which is not opposite to u; `xp` is `numpy` or `jax.numpy`.
    """
    q = xp.concatenate([1.0 + (u * v).sum()[None], xp.cross(u, v)])
    return q / xp.sqrt((q * q).sum())


class Rate(NamedTuple):
    """Hold a free motion of angular momentum 1; it means nothing unless it `exists`."""

    omega: Float[Array, "3"]  # principal axes
    precession: Scalar  # the precession period
    exists: Bool[Array, ""]


def _rate_of_ratio(
    moments: Float[Array, "3"], period_ratio: Array, is_long_axis_mode: Array
) -> Rate:
    """Return the motion with a given ratio of precession period to rotation period, by bisection of
    the energy; the moments ascend.
    """
    body, pure = Inertia(jnp.diag(moments)), jnp.where(is_long_axis_mode, moments[0], moments[2])

    def bisect(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high = state[:2]
        part = 0.5 * (low + high)
        # The rate for h²/2T = `level` with h = 1, when its component along the middle axis is zero.
        level = pure + part * (moments[1] - pure)
        a, _, c = (1.0 / moments[k] for k in range(3))
        x = jnp.clip((1.0 / level - c) / (a - c), 0.0, 1.0)
        omega = jnp.stack([jnp.sqrt(x), jnp.zeros_like(x), jnp.sqrt(1.0 - x)]) / moments
        precession = exact.precession_period(body, omega)
        quotient = precession / exact.body_period(body, omega) / period_ratio
        low, high = jnp.where(quotient > 1, part, low), jnp.where(quotient > 1, high, part)
        return low, high, omega, precession, quotient

    kind = moments.dtype
    zero = jnp.zeros((), kind)
    ends = jnp.asarray(1e-4, kind), jnp.asarray(1.0 - 1e-7, kind)
    # The loop carries the results of the last trial. If they were computed after the loop, their
    # code would be compiled a second time.
    state = (*ends, jnp.zeros_like(moments), zero, zero)
    _, _, omega, precession, quotient = jax.lax.fori_loop(0, 33, bisect, state)
    return Rate(omega, precession, jnp.abs(quotient - 1.0) < 1e-3)


@jax.jit
def _grid_motions(
    is_long_axis_mode: Array,
    moments: Float[Array, "bodies 3"],
    forms: Float[Array, "bodies 3"],
    pair: Float[Array, "2"],
    t: Float[Array, " times"],
    squared_flux: Float[Array, " times"],
    weights: Float[Array, " times"],
) -> GridMotions:
    """Return the motions with the frequencies `pair` of bodies with given moments, ascending, and
    `forms` M = (bc)², (ca)², (ab)² up to a common factor.

    In `GridMotions` the level is the factor by which Σ_k M_k (n·r_k)² is multiplied to give the
    squared fluxes.
    """
    ratio = 0.5 * pair[1] / pair[0]

    def shape(one: tuple[Array, Array]) -> GridMotions:
        body, form = one
        omega, precession, exists = _rate_of_ratio(body, ratio, is_long_axis_mode)
        omega = omega * (precession * pair[0])
        h = body * omega
        # The attitude q turns the angular momentum to the z axis of the world. The momentum is not
        # opposite to z, because none of its components is negative.
        q = _shortest_rotation(h / jnp.sqrt(jnp.sum(h * h)), jnp.eye(3, dtype=h.dtype)[2], jnp)
        motion = exact.FreeBody(Inertia(jnp.diag(body)), Attitude(q, omega))

        def phase(part: Array) -> Any:
            since = part / pair[1]

            def row_of_quadratic_form(q: Array) -> Array:
                m = quaternion.to_matrix(q)

                def entry(i: int, j: int) -> Any:
                    return sum(form[k] * m[i, k] * m[j, k] for k in range(3))

                # The model of the squared flux is n·Q n with Q = Σ M_k r_k r_kᵀ, where r_k are the
                # principal axes of the body (the columns of m) and M_k the numbers of `form`. It is
                # linear in the six entries xx, yy, zz, xy, xz, yz of n nᵀ. The coefficients of
                # these entries are returned.
                twice = (2 * entry(0, 1), 2 * entry(0, 2), 2 * entry(1, 2))
                return jnp.stack([entry(0, 0), entry(1, 1), entry(2, 2), *twice])

            # The first state is computed together with all other states. Computed alone, it would
            # need a second compilation.
            states: Any = jax.vmap(motion)(since + jnp.concatenate([jnp.zeros(1, t.dtype), t]))
            rows = jax.vmap(row_of_quadratic_form)(states.q[1:]).T * weights[None, :]
            chi2, n = remainder(rows, squared_flux * weights)
            chi2 = jnp.where(exists, chi2, jnp.inf)
            return GridMotions(chi2, n, states.q[0], states.omega[0])

        parts = jnp.arange(PHASES, dtype=t.dtype) / PHASES
        return jax.lax.map(phase, parts)

    return jax.lax.map(shape, (moments, forms))
