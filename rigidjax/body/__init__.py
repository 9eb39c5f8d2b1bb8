"""Describe bodies: inertia, mass, second moments; see also `rj.shapes`, `rj.volumes`,
`rj.parameters`.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.body.divergence import divergence as divergence
from rigidjax.body.draws import Draw as Draw, sample as sample
from rigidjax.body.energy import (
    angular_momentum as angular_momentum,
    ellipsoid as ellipsoid,
    kinetic_energy as kinetic_energy,
    kinetic_energy_about as kinetic_energy_about,
    kinetic_energy_of_matrix_rate as kinetic_energy_of_matrix_rate,
    spatial_angular_momentum as spatial_angular_momentum,
)
from rigidjax.body.inertia import Inertia as Inertia, MassProperties as MassProperties
from rigidjax.body.inertials import (
    read_inertials as read_inertials,
    write_inertials as write_inertials,
)
from rigidjax.body.principal_axes import matrix_function as matrix_function, principal as principal

__all__ = [
    "Draw", "Inertia", "MassProperties", "angular_momentum", "divergence", "ellipsoid",
    "kinetic_energy", "kinetic_energy_about", "kinetic_energy_of_matrix_rate",
    "matrix_function", "principal", "read_inertials", "sample", "spatial_angular_momentum",
    "write_inertials",
]  # fmt: skip

define_dir_and_getattr(__name__)
