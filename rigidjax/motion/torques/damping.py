"""Torques against the spin: linear (viscous) and quadratic (in a fluid)."""

from typing import ClassVar

from jaxtyping import Array, Float

from rigidjax._types import HasSpin, ScalarLike, Vec3
from rigidjax.body._types import Vector
from rigidjax.motion.torques.base import AbstractTorque, given, length_or_zero


class Damping(AbstractTorque):
    """Linear damping `τ = −c Ω`, component by component.

    **Arguments:** `coefficient` (3,) c along the body axes, N m s/rad. A sphere of inertia I then
    slows as exp(−c t/I). For a ball in a viscous fluid c = 8πηr³ (Kirchhoff 1876; Lamb,
    Hydrodynamics, §334).

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> Damping([0.1, 0.1, 0.1]).coefficient.shape
    (3,)
    """

    feels: ClassVar[type] = HasSpin
    coefficient: Float[Array, "3"]

    def __init__(self, coefficient: Vector):
        self.coefficient = given(
            coefficient, (3,), "coefficient", hint="one number for each body axis"
        )

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return -self.coefficient * state.omega


class QuadraticDamping(AbstractTorque):
    """Quadratic damping `τ = −c |Ω| Ω`, component by component.

    **Arguments:** `coefficient` (3,) c along the body axes, N m s²/rad². A body turning about a
    principal axis then slows as Ω0/(1 + c Ω0 t/I): drag at a large Reynolds number (Newton,
    Principia, Book II, Section II).

    At Ω = 0 the first derivative is right, and zero; a second does not exist there.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> QuadraticDamping([0.1, 0.1, 0.1]).coefficient.shape
    (3,)
    """

    feels: ClassVar[type] = HasSpin
    coefficient: Float[Array, "3"]

    def __init__(self, coefficient: Vector):
        self.coefficient = given(
            coefficient, (3,), "coefficient", hint="one number for each body axis"
        )

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return -length_or_zero(state.omega) * self.coefficient * state.omega
