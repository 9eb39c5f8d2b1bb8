"""Scenes that are symmetric under time reversal: their periodic orbits, families, stability."""

import abc
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point
from rigidjax.orbits import continuation, differential_correction, manifolds, state_transition
from rigidjax.orbits.differential_correction import PeriodicOrbit
from rigidjax.orbits.manifolds import Manifold


class AbstractReversible(AbstractScene):
    """A scene that does not change under (t, y) → (−t, −y): `ThreeBody` and `Hill`.

    An orbit that crosses the xz-plane at a right angle twice is then periodic (Roy and Ovenden
    1955, doi:10.1093/mnras/115.3.296).
    """

    @abc.abstractmethod
    def approach(self, t: ScalarLike, state: Point) -> tuple[Array, Array]:
        """Distances from the bodies (k,), and those at which a run ends, named as a collision."""

    def ends(self, t: ScalarLike, state: Point) -> Bool[Array, ""]:
        """Whether the particle has collided with one of the bodies: there a run ends."""
        gaps, least = self.approach(t, state)
        return jnp.any(gaps <= least)

    def end_words(self, t: ScalarLike, state: Point) -> str:
        """A collision in words: with which body, when, and how near."""
        gaps = self.approach(t, state)[0]
        if not _checks.known(gaps):
            return "the particle collided with one of the scene's bodies"
        near, when = np.asarray(gaps), float(np.asarray(t))
        return (
            f"collision with body {int(near.argmin()) + 1} of the scene at t = {when:.9g}, "
            f"distance {near.min():.3g}"
        )

    def transition(
        self, state: Point, t: ScalarLike, *, rtol: float = 1e-13, atol: float = 1e-14
    ) -> Float[Array, "6 6"]:
        """The state-transition matrix ∂(x, v)(t)/∂(x, v)(0) (6, 6), by forward differentiation.

        **Arguments:** `state` the start; `t` when. Its determinant is 1.
        """
        _checks.instance(state, Point, "state", wanted="a Point(x, v)")
        t = _checks.finite(_checks.floating(t, (), "t"), "t")
        numbers = jnp.concatenate([state.x, state.v])
        return state_transition.transition(self, numbers, t, rtol, atol)

    def monodromy(self, orbit: PeriodicOrbit) -> Float[Array, "6 6"]:
        """The transition matrix over one period; its eigenvalues say whether the orbit is stable.

        Two of the six are 1, the others come as λ, 1/λ (Szebehely 1967, sec. 8.6).
        """
        return self.transition(orbit.state, orbit.period)

    def stability_indices(self, orbit: PeriodicOrbit) -> Complex[Array, "2"]:
        """The two ν = ½(λ + 1/λ) of the multipliers that are not 1, larger real part first.

        The orbit is stable to first order where both are real and |ν| ≤ 1. Many:
        `jax.vmap(scene.stability_indices)(scene.family(…))`.

        Source: Howell 1984, doi:10.1007/BF01358403; from traces: Bray and Goudas 1967, Adv.
        Astron. Astrophys. 5, 71.
        """
        return continuation.stability_indices(self.monodromy(orbit))

    def periodic_orbit(
        self, guess: PeriodicOrbit, *, hold: str = "x", tolerance: float | None = None
    ) -> PeriodicOrbit:
        """The periodic orbit near `guess`, by differentiable correction.

        For orbits symmetric about the xz-plane: Lyapunov, halo, Arenstorf's and most others in use.
        They cross it at a right angle (y = v_x = v_z = 0) twice a period. Newton's method on three
        of (x, z, v_y, T/2) makes y, v_x, v_z vanish at the half period.

        **Arguments:** `guess` a `PeriodicOrbit(state, period)` whose state crosses at a right
        angle; `hold` which of `"x"`, `"z"`, `"vy"`, `"period"` stays as guessed: this labels the
        orbit within its family (`"x"` for Lyapunov orbits, `"z"` for halo orbits); `tolerance`
        largest |y|, |v_x|, |v_z| left at the half period, 1e-12 unless given (1e-4 in float32).

        **Returns** a `PeriodicOrbit`. Its derivatives with respect to μ and the held number are
        those of the family, by the implicit function theorem, forward and reverse.

        Source: Howell 1984, doi:10.1007/BF01358403.

        **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) if Newton does not converge.

        >>> from rigidjax import orbits
        >>> moon = orbits.cr3bp(0.0121505856)
        >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
        >>> round(float(orbit.period), 4)
        2.712
        """
        return differential_correction.correct(self, guess, hold, tolerance)

    def family(
        self,
        orbit: PeriodicOrbit,
        values: Float[ArrayLike, " members"] | Sequence[float],
        *,
        hold: str = "x",
    ) -> PeriodicOrbit:
        """The members of the family of `orbit` at which `hold` has these values, one by one.

        Each is found from the one before and its tangent, and corrected as by `periodic_orbit`.

        **Arguments:** `orbit` one near the first of them; `values` (N,), neighbours near one
        another; `hold` `"x"`, `"z"`, `"vy"` or `"period"`, which may not turn back on the way
        (there `follow` goes on).

        **Returns** a `PeriodicOrbit` with a leading axis; its derivatives with respect to μ and
        `values` are those of the family, forward and reverse.

        **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) saying where it was lost.

        >>> from rigidjax import orbits
        >>> moon = orbits.cr3bp(0.0121505856)
        >>> start = moon.lyapunov_guess(1, 0.01)
        >>> found = moon.family(start, start.state.x[0] - jnp.array([0.0, 0.01]))
        >>> [round(float(p), 3) for p in found.period]
        [2.712, 2.811]
        """
        return continuation.at_values(self, orbit, values, hold)

    def family_slope(self, orbit: PeriodicOrbit, *, hold: str = "x") -> PeriodicOrbit:
        """How start and period of an orbit change along its family, per unit of `hold`.

        **Arguments:** `orbit` a member of it; `hold` as in `family`. **Returns** the derivatives in
        the shape of an orbit: `.period` is d period/d hold. Exact (implicit function theorem).

        **Raises:** `ValueError` where the family turns back in `hold`.

        >>> from rigidjax import orbits
        >>> hill, start = orbits.hill(), Point([0.3, 0, 0], [0.0, 1.6, 0])
        >>> orbit = hill.periodic_orbit(orbits.PeriodicOrbit(start, 1.2))
        >>> round(float(hill.family_slope(orbit).period), 3)
        12.076
        """
        return continuation.slope(self, orbit, hold)

    def follow(
        self, orbit: PeriodicOrbit, step: ScalarLike, count: int, *, rising: str = "x"
    ) -> PeriodicOrbit:
        """The next `count` members of a family, at equal steps of arclength, past its folds.

        Pseudo-arclength continuation in (x, z, v_y, T/2): each start lies at `step` along the
        tangent, and Newton's method goes back across it (Keller 1977, in
        Applications of Bifurcation Theory).

        **Arguments:** `orbit` a member, not returned; `step` arclength, its sign the way;
        `rising` the number that grows at first when `step` is positive.

        **Returns** a `PeriodicOrbit` with a leading axis. To differentiate one give it to
        `periodic_orbit`. **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) saying after
        how many members it was lost.
        """
        return continuation.follow(self, orbit, step, count, rising)

    def manifold(
        self,
        orbit: PeriodicOrbit,
        which: str,
        *,
        time: ScalarLike | None = None,
        side: int = 1,
        count: int = 40,
        samples: int = 200,
        distance: ScalarLike = 1e-5,
    ) -> Manifold:
        """Motions that leave an unstable periodic orbit, or come to it: its invariant manifolds.

        **Arguments:** `orbit` as of `periodic_orbit`; `which` `"unstable"` (they leave it) or
        `"stable"` (they come to it: the times go back); `time` how far to follow them, two periods
        unless given; `side` 1 for the branch that goes to larger x at the orbit's start, −1 for the
        other; `count` N motions, from equal phases of the orbit; `samples` T times of each;
        `distance` of the starts from the orbit, in (x, v): its square is what they are off.

        The direction is the eigenvector of the monodromy whose multiplier is the largest, carried
        along the orbit by the transition matrix; the stable manifold is the mirror image, in
        y → −y, of the unstable one.

        **Returns** a `Manifold`. Source: Koon, Lo, Marsden and Ross 2011, Dynamical Systems, the
        Three-Body Problem and Space Mission Design, sec. 7.4.

        **Raises:** `ValueError` where the orbit has no such multiplier; for another word.

        >>> from rigidjax import orbits
        >>> moon = orbits.cr3bp(0.0121505856)
        >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
        >>> moon.manifold(orbit, "unstable", count=3, samples=5).states.x.shape
        (3, 5, 3)
        """
        return manifolds.manifold(self, orbit, which, time, side, count, samples, distance)

    def manifold_start(
        self,
        orbit: PeriodicOrbit,
        phase: ScalarLike,
        which: str,
        *,
        side: int = 1,
        distance: ScalarLike = 1e-5,
    ) -> Point:
        """Where the motion of a manifold begins that belongs to a phase of the orbit.

        **Arguments:** `phase` in periods from the orbit's start, of any size; others as for
        `manifold`. Derivatives, by `phase`, by the orbit and by the scene's numbers, are in
        forward mode: connections between orbits are found with them by Newton's method.

        >>> from rigidjax import orbits
        >>> moon = orbits.cr3bp(0.0121505856)
        >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
        >>> start = moon.manifold_start(orbit, 0.0, "stable")
        >>> bool(abs(start.x[0] - orbit.state.x[0]) < 1e-5)
        True
        """
        dtype = orbit.state.x.dtype if isinstance(orbit, PeriodicOrbit) else None
        where = _checks.floating(phase, (), "phase")
        if _checks.known(where):
            where = _checks.finite(where, "phase")
        where = where.astype(dtype)
        away = _checks.floating(distance, (), "distance").astype(dtype)
        return manifolds.branch(self, orbit, where, which, side, away)[0]

    def bifurcation(
        self,
        orbit: PeriodicOrbit,
        other: PeriodicOrbit,
        *,
        index: int = 1,
        value: float = 1.0,
        hold: str = "x",
    ) -> PeriodicOrbit:
        """The member of a family between two others at which a stability index takes a value.

        At 1 a family of the same period branches off, or the family turns; at −1 one of twice the
        period; at cos(2πp/q) one of q times the period. `index` 1 of planar Lyapunov orbits is that
        across the plane, and 1 is where the halo orbits begin.

        **Arguments:** `orbit`, `other` two members near each other, between which the index passes
        the value; `index` 0 or 1 of `stability_indices`; `value` of it; `hold` the number of the
        family that is searched in, `"x"`, `"z"`, `"vy"` or `"period"`. Works on the host.

        Source: Howell 1984, doi:10.1007/BF01358403; Robin and Markellos 1980,
        doi:10.1007/BF01231183.

        **Raises:** `ValueError` where the value does not lie between, or the indices are complex.
        """
        value = _checks.number(value, "value")
        if not np.isfinite(value):
            raise ValueError(f"value: wanted a finite number, got {value}")
        return manifolds.bifurcation(self, orbit, other, index, value, hold)
