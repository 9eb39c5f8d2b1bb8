"""Compute the stable and unstable invariant manifolds of periodic orbits."""

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike
from rigidjax.frames.point import Point
from rigidjax.orbits import continuation
from rigidjax.orbits.differential_correction import (
    PeriodicOrbit,
    integrate,
    numbers_of,
    state_after,
)
from rigidjax.solve.answer.run import Ends

if TYPE_CHECKING:
    from rigidjax.orbits.reversible_scene import AbstractReversible

# The mirror image of a motion, y → −y and t → −t, is a motion, too. Its position (x, y, z) and
# velocity (vx, vy, vz) are those of the motion, multiplied by these signs.
_MIRROR = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
Branch = Literal["stable", "unstable"]
# A manifold starts at a point of the orbit. The integration to this point has these relative and
# absolute tolerances of a step.
_TIGHT = dict(rtol=1e-13, atol=1e-14)
# Inverse iteration takes this number of steps. Each step reduces the error of an eigenvector at
# least a hundredfold.
_ITERATIONS = 12


class Manifold(eqx.Module):
    """Hold motions that start near a periodic orbit, or approach it.

    **Fields:**

    - `ts`: (T,) the times since the motions were near the orbit, in the scene's unit; negative for
      a stable manifold.
    - `states`: a `Point` with axes (N, T), one motion for each phase; NaN after a collision.
    - `phases`: (N,) the points of the orbit near which the motions start or end, in periods since
      `orbit.state`.
    - `multiplier`: λ, the factor by which a small distance from the orbit, along the manifold, is
      multiplied in one period; |λ| > 1 for an unstable manifold, |λ| < 1 for a stable one.

    >>> ts, phases = jnp.array([0.0, 0.1]), jnp.array([0.0])
    >>> states = Point(jnp.zeros((1, 2, 3)), jnp.zeros((1, 2, 3)))
    >>> Manifold(ts, states, phases, jnp.asarray(2.5)).states.x.shape
    (1, 2, 3)
    """

    ts: Float[Array, " T"]
    states: Point
    phases: Float[Array, " N"]
    multiplier: Float[Array, ""]


def unstable_direction(monodromy: Float[Array, "6 6"]) -> tuple[Scalar, Float[Array, "6"]]:
    """Return the real multiplier λ of an orbit with the largest |λ|, and its unit eigenvector; both
    are NaN if no real multiplier has |λ| > 1.

    λ is computed from the traces of the monodromy matrix and of its square; inverse iteration and
    one bordered linear solve give the eigenvector.
    """
    index = continuation.stability_indices(monodromy)
    real = jnp.abs(index.imag) <= 1e-6 * jnp.abs(index)
    size = jnp.where(real, jnp.abs(index.real), 0.0)
    index = jnp.where(size[0] >= size[1], index.real[0], index.real[1])
    free = jnp.max(size) > 1
    safe = jnp.where(free, index, 2.0)
    value = safe + jnp.sign(safe) * jnp.sqrt(safe * safe - 1)
    eye = jnp.eye(6, dtype=monodromy.dtype)
    # The shift of the inverse iteration differs from the eigenvalue by the factor 1 + √eps: a shift
    # by the eigenvalue itself may make the matrix exactly singular.
    near = value * (1 + jnp.finfo(value.dtype).eps ** 0.5)
    still, shift = lax.stop_gradient((monodromy, near))

    def improve(_: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        right, left = both
        right = jnp.linalg.solve(still - shift * eye, right)
        left = jnp.linalg.solve((still - shift * eye).T, left)
        return right / jnp.sqrt(jnp.sum(right**2)), left / jnp.sqrt(jnp.sum(left**2))

    first = jnp.asarray(np.full(6, 6**-0.5), monodromy.dtype)
    right, left = lax.fori_loop(0, _ITERATIONS, improve, (first, first))
    # The bordered system (M − λ) v + m left = 0, right · v = 1 for the eigenvector v and a number m
    # is regular although M − λ is singular. Here M is the monodromy matrix, λ its eigenvalue, and
    # left and right are its eigenvectors by inverse iteration. The derivatives of v come from this
    # system.
    top = jnp.concatenate([monodromy - value * eye, left[:, None]], 1)
    last = jnp.concatenate([right, jnp.zeros(1, right.dtype)])[None]
    wanted = jnp.zeros(7, right.dtype).at[6].set(1)
    vector = jnp.linalg.solve(jnp.concatenate([top, last]), wanted)[:6]
    vector = vector / jnp.sqrt(jnp.sum(vector**2))
    vector = vector * lax.stop_gradient(jnp.where(vector[0] < 0, -1.0, 1.0))
    return jnp.where(free, value, jnp.nan), jnp.where(free, vector, jnp.nan)


def manifold_point(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    phase: Scalar,
    branch: Branch,
    side: int,
    distance: Scalar,
) -> tuple[Point, Scalar]:
    """Return a state on a manifold of an orbit and the orbit's multiplier, for arguments of
    `manifold_start`, after checks.
    """
    _checks.require_option(branch, ("stable", "unstable"), "branch")
    if isinstance(side, bool) or side not in (1, -1):
        raise ValueError(f"side: wanted 1 (to larger x at the orbit's start) or -1, got {side!r}")
    numbers_of(orbit)
    return _point(scene, orbit, phase, branch, side, distance)


@eqx.filter_jit
def _point(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    phase: Scalar,
    branch: Branch,
    side: int,
    distance: Scalar,
) -> tuple[Point, Scalar]:
    """Return a state on a manifold and the multiplier, by a compiled program."""
    value, vector = unstable_direction(scene.monodromy(orbit))
    # The stable manifold is the mirror image of the unstable manifold. A point of the stable
    # manifold with a given phase is therefore the mirror image of the point of the unstable
    # manifold with the opposite phase, which is computed first.
    turned = phase if branch == "unstable" else -phase
    turned = turned - lax.stop_gradient(jnp.floor(turned))
    later = partial(state_after, scene, t=turned * orbit.period, **_TIGHT)
    start = jnp.concatenate([orbit.state.x, orbit.state.v])
    there, along = jax.jvp(later, (start,), (vector,))
    numbers = there + side * distance * along / jnp.sqrt(jnp.sum(along * along))
    if branch == "stable":
        numbers = numbers * jnp.asarray(_MIRROR, numbers.dtype)
        value = 1 / value
    return Point(numbers[:3], numbers[3:]), value


def manifold(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    branch: Branch,
    *,
    time: ScalarLike | None = None,
    side: int = 1,
    count: int = 40,
    samples: int = 200,
    distance: ScalarLike = 1e-5,
) -> Manifold:
    """Return motions from an unstable periodic orbit, or towards it: its invariant manifolds.

    **Arguments:**

    - `orbit`: a `PeriodicOrbit`, as `periodic_orbit` returns it.
    - `branch`: `"unstable"` (the motions leave the orbit) or `"stable"` (the motions approach the
      orbit, and are computed backwards in time).
    - `time`: the duration of the motions, two periods by default.
    - `side`: 1 for the half of the manifold that goes to larger x at `orbit.state`, −1 for the
      opposite half.
    - `count`: the number N of motions, which start at equally spaced phases of the orbit.
    - `samples`: the number T of times of each motion.
    - `distance`: the distance between the start of each motion and the orbit, in (x, v). The error
      of the manifold is of the order of the square of this distance.

    Each motion starts at the given distance from a point of the orbit. The direction at
    `orbit.state` is the eigenvector of the monodromy matrix with the largest multiplier; the
    state-transition matrix maps this vector to the other points of the orbit. The stable manifold
    is the mirror image, in y → −y, of the unstable manifold. **Returns** a `Manifold`. Source:
    Koon, Lo, Marsden and Ross 2011, Dynamical Systems, the Three-Body Problem and Space Mission
    Design, sec. 7.4. **Raises:** `ValueError` for an orbit without a real multiplier of size above
    1.

    >>> moon = rj.orbits.cr3bp(0.0121505856)
    >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
    >>> moon.manifold(orbit, "unstable", count=3, samples=5).states.x.shape
    (3, 5, 3)
    """
    count, samples = _checks.integer(count, "count", 1), _checks.integer(samples, "samples", 2)
    dtype = orbit.state.x.dtype if isinstance(orbit, PeriodicOrbit) else None
    distance = _positive_number(distance, "distance", dtype)
    phases = jnp.arange(count).astype(distance.dtype) / count
    starts, value = jax.vmap(lambda p: manifold_point(scene, orbit, p, branch, side, distance))(
        phases
    )
    words = "manifold: the orbit has no multiplier that is real and of size above 1: it is stable "
    words += "to first order, or nearby motions spiral; take an orbit with an index |ν| > 1"
    value = _checks.error_if(value[0], jnp.isnan(value[0]), words)
    length = 2 * orbit.period if time is None else _positive_number(time, "time", dtype)
    ts = jnp.linspace(jnp.zeros_like(length), length, samples)
    states = _trajectories(scene, starts, ts, branch)
    return Manifold(ts if branch == "unstable" else -ts, states, phases, value)


def manifold_start(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    phase: ScalarLike,
    branch: Branch,
    *,
    side: int = 1,
    distance: ScalarLike = 1e-5,
) -> Point:
    """Return the state, near an orbit, at which the motion of a stable or unstable manifold with
    the given phase starts.

    **Arguments:** `phase` the point of the orbit, in periods since `orbit.state`, any number;
    `orbit`, `branch`, `side` and `distance` as for `manifold`. The result can be differentiated in
    forward mode, with respect to `phase`, the orbit and the scene's numbers; with such derivatives
    Newton's method finds connections between orbits.

    >>> moon = rj.orbits.cr3bp(0.0121505856)
    >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
    >>> start = moon.manifold_start(orbit, 0.0, "stable")
    >>> bool(abs(start.x[0] - orbit.state.x[0]) < 1e-5)
    True
    """
    dtype = orbit.state.x.dtype if isinstance(orbit, PeriodicOrbit) else None
    where = _checks.checked_time(phase, "phase").astype(dtype)
    away = _checks.array_of_shape(distance, (), "distance").astype(dtype)
    return manifold_point(scene, orbit, where, branch, side, away)[0]


def _positive_number(value: ScalarLike, name: str, dtype: DTypeLike | None) -> Array:
    """Return a positive number in the `dtype`, if given; errors begin with its `name`."""
    distance = _checks.array_of_shape(value, (), name)
    return _checks.require_positive(
        distance if dtype is None else distance.astype(dtype), name, "a positive number"
    )


@eqx.filter_jit
def _trajectories(scene: "AbstractReversible", starts: Point, ts: Array, branch: Branch) -> Point:
    """Return the motions from states on a manifold at the times `ts` since the start, NaN after a
    collision; those on a stable manifold run backwards.
    """
    mirror = jnp.asarray(_MIRROR, ts.dtype)
    turn = branch == "stable"

    def mirrored(state: Point) -> Point:
        # A motion on the stable manifold is replaced by its mirror image, which is integrated
        # forwards in time.
        return Point(state.x * mirror[:3], state.v * mirror[3:]) if turn else state

    def trajectory(start: Point) -> Point:
        how = dict(saveat=dfx.SaveAt(ts=ts), event=dfx.Event(Ends(scene)))
        out = integrate(scene, mirrored(start), ts[-1], 1e-11, 1e-12, **how)
        there: Any = jnp.isfinite(jnp.asarray(out.ts))[:, None]
        ys: Any = jax.tree.map(lambda leaf: jnp.where(there, leaf, jnp.nan), out.ys)
        return jax.vmap(mirrored)(ys)

    return jax.vmap(trajectory)(starts)
