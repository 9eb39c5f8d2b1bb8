"""Describe scenes that are symmetric under time reversal, with their periodic orbits, families and
stability.
"""

import abc

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point
from rigidjax.orbits import continuation, differential_correction, manifolds
from rigidjax.orbits.differential_correction import PeriodicOrbit


class AbstractReversible(AbstractScene):
    """Define a scene whose equations do not change under (t, y) → (−t, −y).

    Here t is the time and y the second coordinate. Such scenes are `ThreeBody` and `Hill`.

    An orbit that crosses the xz-plane at a right angle twice is then periodic (Roy and Ovenden
    1955, doi:10.1093/mnras/115.3.296).
    """

    @abc.abstractmethod
    def approach(
        self, t: ScalarLike, state: Point
    ) -> tuple[Float[Array, " distances"], Float[Array, " collision_distances"]]:
        """Return two arrays (k,) for the k bodies: the distance of the particle from each body; and
        the distance that counts as a collision with this body.
        """

    @abc.abstractmethod
    def jacobi_constant(self, state: Point) -> Scalar:
        """Return Jacobi's constant C of `state`, which is conserved along the motion."""

    def conserved(self, t: ScalarLike, state: Point) -> dict[str, Scalar]:
        return {"jacobi": self.jacobi_constant(state)}

    def ends(self, t: ScalarLike, state: Point) -> Bool[Array, ""]:
        """Return whether the particle has collided with one of the bodies."""
        gaps, least = self.approach(t, state)
        return jnp.any(gaps <= least)

    def end_words(self, t: ScalarLike, state: Point) -> str:
        """Return words that say with which body, when and at which distance the particle collided.

        They are used in the message of the error with which a run ends.
        """
        gaps = self.approach(t, state)[0]
        if not _checks.is_known(gaps):
            return "the particle collided with one of the scene's bodies"
        near, when = np.asarray(gaps), float(np.asarray(t))
        which = f"body {int(near.argmin()) + 1} of the scene"
        return f"collision with {which} at t = {when:.9g}, distance {near.min():.3g}"

    def monodromy(self, orbit: PeriodicOrbit) -> Float[Array, "6 6"]:
        """Return the monodromy matrix of an orbit: the state-transition matrix over one period.

        Its eigenvalues are 1, 1 and two pairs λ, 1/λ.
        """
        return self.transition(orbit.state, orbit.period)

    def stability_indices(self, orbit: PeriodicOrbit) -> Complex[Array, "2"]:
        """Return the two stability indices ν = ½(λ + 1/λ) of an orbit, the larger real part first.

        The `monodromy` matrix has the eigenvalues 1, 1 and two pairs λ, 1/λ; each pair gives one
        index.

        The orbit is stable to first order if both indices are real with |ν| ≤ 1. For many orbits
        use `jax.vmap(scene.stability_indices)(scene.family(…))`. Source: Howell 1984,
        doi:10.1007/BF01358403; from traces: Bray and Goudas 1967, Adv. Astron. Astrophys. 5, 71.
        """
        return continuation.stability_indices(self.monodromy(orbit))

    # The first argument of each of these functions is a scene, so that the functions serve here as
    # methods of the scene.
    transition = differential_correction.transition_matrix
    periodic_orbit = differential_correction.periodic_orbit
    family = continuation.family
    family_slope = continuation.family_slope
    follow = continuation.follow
    manifold = manifolds.manifold
    manifold_start = manifolds.manifold_start
    bifurcation = continuation.bifurcation
