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
from rigidjax.tumblers.lattice_series import least_squares_remainder

# The grid has the ratios b/a of the semi-axes in MIDDLE, the ratios c/b in SHORT, and PHASES phases
# in half a rotation.
MIDDLE, SHORT, PHASES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9), (0.5, 0.65, 0.8, 0.93), 12
# These are angles of rotations, rad, about the direction n half way between sun and observer. Such
# a rotation hardly changes the brightness, so that the fit on the grid does not determine its
# angle: each start is tried with all of these angles.
ABOUT = (0.0, math.pi / 3, 2 * math.pi / 3)
MODES = ("long", "short")


class Candidate(NamedTuple):
    """Hold a starting motion of the search.

    **Fields:** `moments` (3,) the principal moments divided by the largest moment; `q` (4,) the
    initial attitude of the principal axes; `omega` (3,) the initial rate along these axes, rad/s;
    `misfit` χ² of the motion.
    """

    moments: np.ndarray
    q: np.ndarray
    omega: np.ndarray
    misfit: float


def candidate_motions(
    pair: np.ndarray,
    mode: str,
    light: tuple[Array, Array, Array],
    bisector: np.ndarray,
    areas: np.ndarray | None,
    count: int,
) -> list[Candidate]:
    """Return the best motions, on a grid of bodies and phases, that have a given pair of
    frequencies.

    The motions are in the order of their misfits.

    **Arguments:**

    - `pair`: (2,) two frequencies, 1/s: that of the mean precession, and twice that of the
      rotation.
    - `mode`: "long" or "short", for a momentum that circulates in the body about the axis of the
      smallest or of the largest moment.
    - `light`: three arrays (T,): the times since the first time, s; the squared fluxes; and one
      over the noise of the squared fluxes.
    - `bisector`: (3,) the direction n half way between sun and observer, world frame.
    - `areas`: (3,) the numbers (bc)², (ca)², (ab)² of an ellipsoid whose semi-axes a, b, c are
      known, or `None`.
    - `count`: the number of bodies of the grid for which motions are returned.
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
    motions = _fit_motions_on_grid_of_phases(jnp.asarray(mode == "long"), *arrays)
    misfits, sides, q, omega = (np.asarray(v) for v in motions)
    # Each body is used with the phase of its smallest misfit.
    phase, least = misfits.argmin(axis=1), misfits.min(axis=1)
    out = []
    for k in np.argsort(least)[:count]:
        if not np.isfinite(least[k]):
            continue
        at = k, phase[k]
        in_world = (
            np.array(quaternion_product(q0, q[at]))
            for q0 in _rotations_from_momentum_frame_to_world(sides[at], bisector)
        )
        out += [Candidate(moments[k], one, omega[at], float(least[k])) for one in in_world]
    return out


def _rotations_from_momentum_frame_to_world(
    fitted_entries: np.ndarray, bisector: np.ndarray
) -> list[tuple[Any, ...]]:
    """Return the quaternions (4,), one for each angle of `ABOUT`, that rotate the frame of the
    angular momentum to the world frame.

    The z axis of the frame of the angular momentum is along the momentum. Let n be the unit vector
    half way between sun and observer. Each rotation maps the components of n (or of −n, which a
    matrix n nᵀ cannot tell from n) in the frame of the momentum to its components in the world. The
    rotations differ in the angle of a further rotation about n. The `fitted_entries` do not
    determine this angle: `ABOUT` has three values of it, rad.

    - `fitted_entries`: (6,) the entries xx, yy, zz, xy, xz, yz of the fitted matrix n nᵀ in the
      frame of the momentum, whose eigenvector of the largest eigenvalue is taken as n.
    - `bisector`: (3,) the unit vector n in the world frame.
    """
    xx, yy, zz, xy, xz, yz = fitted_entries
    _, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    n = axes[:, -1]
    first = _shortest_rotation(n, bisector if n @ bisector >= 0 else -bisector, np)
    halves = [0.5 * angle for angle in ABOUT]
    about = [(np.cos(half), *(np.sin(half) * bisector)) for half in halves]
    return [quaternion_product(one, first) for one in about]


def _shortest_rotation(u: Any, v: Any, xp: ModuleType) -> Any:
    """Return the quaternion (4,) of the shortest rotation from the unit vector `u` (3,) to the unit
    vector `v` (3,), which is not opposite to u.

    `xp` is the module of the arrays, `numpy` or `jax.numpy`.
    """
    q = xp.concatenate([1.0 + (u * v).sum()[None], xp.cross(u, v)])
    return q / xp.sqrt((q * q).sum())


def _rate_at_unit_momentum(moments: Array, momentum2_over_2energy: Array) -> Float[Array, "3"]:
    """Return the body rate (3,), in principal axes, of a free motion with the angular momentum h =
    1.

    The kinetic energy T follows from the given h²/2T. The rate is that at a time at which its
    component along the axis of the middle moment is zero.

    - `moments`: (3,) the principal moments, ascending.
    - `momentum2_over_2energy`: h²/2T, a number between the smallest and the largest moment.
    """
    a, _, c = (1.0 / moments[k] for k in range(3))
    x = jnp.clip((1.0 / momentum2_over_2energy - c) / (a - c), 0.0, 1.0)
    return jnp.stack([jnp.sqrt(x), jnp.zeros_like(x), jnp.sqrt(1.0 - x)]) / moments


def _rate_with_period_ratio(
    moments: Array, period_ratio: Array, is_long_axis_mode: Array
) -> tuple[Float[Array, "3"], Scalar, Bool[Array, ""]]:
    """Return three things for a free motion with a given ratio of precession period to rotation
    period: the body rate (3,), in principal axes; the precession period; and whether there is such
    a motion.

    The angular momentum is 1, and the energy is found by bisection. The first two results have no
    meaning if the third is false.

    - `moments`: (3,) the principal moments, ascending.
    - `period_ratio`: the wanted precession period divided by the rotation period.
    - `is_long_axis_mode`: true for a motion in the long-axis mode, in which the momentum circulates
      in the body about the axis of the smallest moment; false for the short-axis mode, with the
      axis of the largest moment.
    """
    body, pure = Inertia(jnp.diag(moments)), jnp.where(is_long_axis_mode, moments[0], moments[2])

    def bisect(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high = state[:2]
        part = 0.5 * (low + high)
        omega = _rate_at_unit_momentum(moments, pure + part * (moments[1] - pure))
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
    return omega, precession, jnp.abs(quotient - 1.0) < 1e-3


@jax.jit
def _fit_motions_on_grid_of_phases(
    is_long_axis_mode: Array,
    moments: Array,
    forms: Array,
    pair: Array,
    t: Array,
    squared_flux: Array,
    weights: Array,
) -> tuple[
    Float[Array, "bodies phases"],
    Float[Array, "bodies phases 6"],
    Float[Array, "bodies phases 4"],
    Float[Array, "bodies phases 3"],
]:
    """Return four arrays for the motions of S bodies, each started at P phases, which divide half a
    rotation into P equal parts (P = `PHASES`).

    The four arrays are the misfits χ² (S, P); the six fitted entries xx, yy, zz, xy, xz, yz of the
    matrix n nᵀ times the level (S, P, 6); the initial attitudes (S, P, 4), principal axes → frame
    of the angular momentum; and the initial rates (S, P, 3), rad/s, principal axes.

    The frame of the angular momentum has its z axis along the momentum. In this frame n is the
    direction half way between sun and observer, and r_k are the principal axes. The level is the
    factor by which the model Σ_k M_k (n·r_k)² is multiplied to give the squared fluxes. All motions
    have the same `pair` of frequencies. A body that has no motion with this `pair` has the misfit
    infinity.

    - `is_long_axis_mode`: true for motions in the long-axis mode, false for the short-axis mode.
    - `moments`: (S, 3) the principal moments of each body, ascending.
    - `forms`: (S, 3) the numbers M = (bc)², (ca)², (ab)² of each body with the semi-axes a, b, c,
      divided by a common factor.
    - `pair`: (2,) two frequencies, 1/s: that of the mean precession, and twice that of the
      rotation.
    - `t`: (T,) the times of the readings since the first, s.
    - `squared_flux`: (T,) the squared fluxes.
    - `weights`: (T,) one over the noise of the squared fluxes.
    """
    ratio = 0.5 * pair[1] / pair[0]

    def shape(one: tuple[Array, Array]) -> tuple[Array, ...]:
        body, form = one
        omega, precession, exists = _rate_with_period_ratio(body, ratio, is_long_axis_mode)
        omega = omega * (precession * pair[0])
        h = body * omega
        # The attitude q turns the angular momentum to the z axis of the world. The momentum is not
        # opposite to z, because none of its components is negative.
        q = _shortest_rotation(h / jnp.sqrt(jnp.sum(h * h)), jnp.eye(3, dtype=h.dtype)[2], jnp)
        motion = exact.FreeBody(Inertia(jnp.diag(body)), Attitude(q, omega))

        def phase(part: Array) -> tuple[Array, ...]:
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
            misfit, n = least_squares_remainder(rows, squared_flux * weights)
            return jnp.where(exists, misfit, jnp.inf), n, states.q[0], states.omega[0]

        parts = jnp.arange(PHASES, dtype=t.dtype) / PHASES
        return jax.lax.map(phase, parts)

    return jax.lax.map(shape, (moments, forms))
