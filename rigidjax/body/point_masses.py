"""Sum mass properties over points, voxels, or the nodes of a quadrature."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import Numbers, Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.body.symmetric3 import PAIRS, from_components
from rigidjax.rotation.linalg3 import determinant


def points(
    masses: Float[ArrayLike, "n"] | Numbers, positions: Float[ArrayLike, "n 3"] | Numbers
) -> MassProperties:
    """Return the body made of point masses m at the positions r. Its second moment about the centre
    of mass c is `𝔖 = Σ m (r − c)(r − c)ᵀ` (notes, eq 60).

    **Arguments:** `masses` (n,) kg, none negative; `positions` (n, 3) in metres, body frame, at any
    distance from the origin: the positions are shifted first, so that no digit is lost. **Raises:**
    `ValueError` for a negative mass.

    >>> points([1.0, 1.0], [[1.0, 0, 0], [-1.0, 0, 0]]).inertia.moments
    Array([0., 2., 2.], dtype=float64)
    """
    masses = _checks.array_of_rows(masses, (), "masses")
    n = masses.shape[0]
    hint = f"one row for each of {n} masses"
    positions = _checks.array_of_shape(positions, (n, 3), "positions", hint=hint)
    if n == 0:
        raise ValueError("masses: wanted at least one, got none")
    _checks.check_if_known(
        _checks.require_positive, masses, "masses", "masses ≥ 0", allow_zero=True
    )
    _checks.check_if_known(_checks.require_finite, positions, "positions")
    return sum_masses(masses, positions)


def voxels(
    density: Float[ArrayLike, "nx ny nz"] | Numbers, spacing: Vector, corner: Vector
) -> MassProperties:
    """Return the body whose density is given on the cells of a box, constant in each cell.

    The result is exact for this density: the second moment of each cell about its own centre, `m
    h²/12` for a cell of mass m with the edge h, is included. **Arguments:** `density` (nx, ny, nz)
    kg/m³, none negative, indexed x, y, z; `spacing` (3,) edges of a cell, in metres; `corner` (3,)
    of cell [0, 0, 0] with the smallest x, y, z, in metres, body frame. **Raises:** `ValueError` for
    a negative density.

    >>> voxels(jnp.ones((1, 2, 3)), [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]).com
    Array([0.5, 1. , 1.5], dtype=float64)
    """
    density = _checks.numeric_array(density, "density")
    if density.ndim != 3 or density.size == 0:
        raise ValueError(f"density: wanted shape (nx, ny, nz), got {density.shape}")
    h, low = (
        _checks.array_of_shape(spacing, (3,), "spacing"),
        _checks.finite_array(corner, (3,), "corner"),
    )
    _checks.check_if_known(
        _checks.require_positive, density, "density", "values ≥ 0 (kg/m³)", allow_zero=True
    )
    _checks.check_if_known(
        _checks.require_positive, h, "spacing", "three positive edges of a cell, m"
    )
    axes = [(jnp.arange(n, dtype=density.dtype) + 0.5) * h[i] for i, n in enumerate(density.shape)]
    centres = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    masses = density.reshape(-1) * (h[0] * h[1] * h[2])
    body = sum_masses(masses, centres)
    own = body.mass * h * h / 12.0
    return MassProperties(body.mass, body.com + low, body.second_moment + jnp.diag(own))


def quadrature(
    density: Callable[[Float[Array, "3"]], Float[Array, ""]],
    place: Callable[[Float[Array, "3"]], Float[Array, "3"]],
    order: int = 12,
) -> MassProperties:
    """Return the body of density ρ that fills the image r(u) of the unit cube. The mass of the
    body, for example, is the integral `∫ ρ(r(u)) |det ∂r/∂u| d³u` over the cube.

    `order` Gauss–Legendre points in each direction are exact for polynomials of degree `2·order −
    1`. The body is differentiable in all numbers of `density` and `place`. **Arguments:** `density`
    ρ, from r (3,) m to kg/m³; `place` from u (3,) in [0, 1]³ to r (3,) m, body frame, one to one
    inside; `order`. **Raises:** `ValueError` for a result that is no body.

    >>> body = quadrature(lambda r: jnp.ones(()), lambda u: u * jnp.array([1.0, 2.0, 3.0]), 2)
    >>> round(float(body.mass), 12), round(float(body.com[2]), 12)
    (6.0, 1.5)
    """
    _checks.require_function(density, "density", "r (3,) → kg/m³")
    _checks.require_function(place, "place", "u (3,) → r (3,), m")
    order = _checks.integer(order, "order", 1)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    cube = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).reshape(-1)
    dtype = jnp.result_type(float)
    cube, weight = jnp.asarray(cube, dtype), jnp.asarray(weight, dtype)

    def element(u: Float[Array, "3"]) -> tuple[Array, Float[Array, "3"]]:
        # Return the mass per unit of volume of the cube, kg, and the position r(u), m.
        r = _checks.array_of_shape(place(u), (3,), "place(u)")
        volume = determinant(jax.jacfwd(place)(u))
        return _checks.array_of_shape(density(r), (), "density(r)") * jnp.abs(volume), r

    per_volume, positions = jax.vmap(element)(cube)
    _checks.check_if_known(_checks.require_finite, positions, "place(u)")
    _checks.check_if_known(_checks.require_finite, per_volume, "density(r) |∂r/∂u|")
    return sum_masses(per_volume * weight, positions)


def sum_masses(masses: Float[Array, "n"], positions: Float[Array, "n 3"]) -> MassProperties:
    """Return the body made of point masses, kg, at positions, m, which are not checked; the mass
    and second moment of the whole body are.
    """
    # Positions are measured from the first point: measured from a distant origin, they would make
    # the sums lose digits.
    start = jax.lax.stop_gradient(positions[0])
    from_start = positions - start[None, :]
    mass = masses.sum()
    com = (masses[:, None] * from_start).sum(axis=0) / mass
    d = from_start - com[None, :]
    second = from_components(*((masses * d[:, i] * d[:, j]).sum() for i, j in PAIRS))
    return MassProperties(mass, start + com, second)
