"""Ellipsoids of a body: of energy, of momentum, and the uniform one that equals it.

Poinsot: free motion rolls the energy ellipsoid on a fixed plane; in the body the rate stays on the
curve where the two ellipsoids of Ω meet. Source: Landau and Lifshitz, Mechanics, § 37.
"""

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import Quat, Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.principal_axes import principal


def energy_ellipsoid(inertia: Inertia, energy: ScalarLike) -> tuple[Vec3, Quat]:
    """The rates Ω of one energy: `½ Ω·IΩ = T`, an ellipsoid of semi-axes `√(2T/I_k)`.

    **Arguments:** `inertia`; `energy` T ≥ 0, J. **Returns** `(semi_axes, q)`: (3,) rad/s in the
    order of ascending moments, and (4,) the rotation principal axes → body axes.

    **Raises:** `ValueError` for a zero moment or a negative number (`equinox` error under `jit`).

    >>> energy_ellipsoid(Inertia.from_principal(1.0, 2.0, 2.0), 4.0)[0]
    Array([2.82842712, 2.        , 2.        ], dtype=float64)
    """
    moments, q = _checks.single(inertia, Inertia, "inertia").invertible().principal()
    twice = 2.0 * _not_negative(energy, "energy", "J")
    return jnp.sqrt(twice / moments), q


def momentum_ellipsoid(inertia: Inertia, momentum: ScalarLike) -> tuple[Vec3, Quat]:
    """The rates Ω of one angular momentum: `|IΩ| = h`, an ellipsoid of semi-axes `h/I_k`.

    **Arguments:** `inertia`; `momentum` h ≥ 0, kg m²/s. **Returns** `(semi_axes, q)` as
    `energy_ellipsoid`.

    **Raises:** `ValueError` for a zero moment or a negative number (`equinox` error under `jit`).

    >>> momentum_ellipsoid(Inertia.from_principal(1.0, 2.0, 2.0), 4.0)[0]
    Array([4., 2., 2.], dtype=float64)
    """
    moments, q = _checks.single(inertia, Inertia, "inertia").invertible().principal()
    return _not_negative(momentum, "momentum", "kg m²/s") / moments, q


def equal_ellipsoid(body: MassProperties) -> tuple[Vec3, Quat]:
    """The uniform solid ellipsoid of the same mass, centre and 𝔖: semi-axes `√(5 λ_k/m)`.

    **Arguments:** `body`. **Returns** `(semi_axes, q)`: (3,) m, ascending, and (4,) the rotation
    principal axes → body axes. It moves exactly as the body does: a way to see inertia.

    >>> import rigidjax as rj
    >>> equal_ellipsoid(rj.shapes.ellipsoid(3.0, [1.0, 2.0, 3.0]))[0]
    Array([1., 2., 3.], dtype=float64)
    """
    _checks.single(body, MassProperties, "body")
    second_moments, q = principal(body.second_moment)
    return jnp.sqrt(5.0 * second_moments / body.mass), q


def _not_negative(value: ScalarLike, name: str, unit: str) -> Scalar:
    number = _checks.floating(value, (), name)
    return _checks.refuse(number, ~(number >= 0), f"{name}: wanted a number ≥ 0, {unit}")
