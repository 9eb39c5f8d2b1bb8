"""Derive equations of motion from any Lagrangian or Hamiltonian by automatic differentiation.

Such equations serve cross-checks, teaching, and problems with their own coordinates. For a rigid
body the equations of `Attitude` cost less and have no singular attitude. Equations in Euler angles
are singular at sin θ = 0, and need many small steps near this attitude. `equations_of_motion` takes
a Lagrangian; `lie_poisson` and `lie_poisson_with_direction` take a Hamiltonian.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.lagrangian.coordinates import (
    Coordinates as Coordinates,
    EulerAngleTop as EulerAngleTop,
    equations_of_motion as equations_of_motion,
    from_attitude as from_attitude,
    to_attitude as to_attitude,
)
from rigidjax.lagrangian.hamiltonian import (
    HeavyTopHamiltonian as HeavyTopHamiltonian,
    Momentum as Momentum,
    RotationalHamiltonian as RotationalHamiltonian,
    lie_poisson as lie_poisson,
    lie_poisson_with_direction as lie_poisson_with_direction,
)

__all__ = [
    "Coordinates", "EulerAngleTop", "HeavyTopHamiltonian", "Momentum", "RotationalHamiltonian",
    "equations_of_motion", "from_attitude", "lie_poisson", "lie_poisson_with_direction",
    "to_attitude",
]  # fmt: skip

define_dir_and_getattr(__name__)
