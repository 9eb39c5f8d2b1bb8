"""Equations of motion from any Lagrangian by differentiation; Euler angles as the worked case.

A cross-check and for teaching, and for scenes that bring their own coordinates. For a rigid body
the equations of `Attitude` cost less and have no singular attitude: in Euler angles the equations
break at sin θ = 0, and near it steps become many and small. `lie_poisson` is the Hamiltonian side.
"""

from rigidjax._names import show
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

show(__name__)
