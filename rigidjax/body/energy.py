"""Compute the kinetic energy and angular momentum of a turning body, and its ellipsoids.

The notes write the energy of rotation in three forms. The printed eqs 61–65 lack the factor ½ of
eqs 57 and 73–75; in this module all three forms have the factor and agree. `kinetic_energy` of
`Inertia.from_second_moment(jnp.diag(λ))` is eqs 73–75, in principal axes.
"""

from typing import Literal

import jax.numpy as jnp

from rigidjax import _checks
from rigidjax._types import (
    HasAttitude,
    HasPose,
    HasSpin,
    Mat3,
    Matrix,
    Quat,
    Quaternion,
    Scalar,
    ScalarLike,
    Vec3,
    Vector,
)
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.body.principal_axes import principal
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot, product

_HINT = "Inertia.from_tensor takes a matrix"


def kinetic_energy(body: Inertia | MassProperties, state: HasSpin | Vector) -> Scalar:
    """Return the kinetic energy of a body in a state of motion, J: `T = ½ m |v|² + ½ Ω·IΩ`.

    **Arguments:** `body`, an `Inertia` about the point that the body turns about, or
    `MassProperties`; `state` anything with `.omega` (Ω, rad/s, body frame), or Ω (3,) itself. The
    first term, with the mass m and the velocity v of the centre of mass, is added only for
    `MassProperties` and a state with a velocity (`.v`, m/s, world frame). Source: notes, eqs 75 and
    79, in any body axes.

    >>> kinetic_energy(Inertia.from_principal(1.0, 2.0, 3.0), [1.0, 1.0, 1.0])
    Array(3., dtype=float64)
    """
    omega = _rate(state)
    energy = 0.5 * dot(omega, apply(_tensor(body), omega))
    if isinstance(body, MassProperties) and isinstance(state, HasPose):
        energy = energy + 0.5 * body.mass * dot(state.v, state.v)
    return energy


def kinetic_energy_about(
    body: MassProperties, q: Quaternion, velocity: Vector, omega: Vector
) -> Scalar:
    """Return the kinetic energy from the velocity of a point other than the centre of mass, J.

    `T = ½ m |V|² + m V·R(Ω × c) + ½ Ω·I_o Ω`, with the mass m, the rotation matrix R of `q`, the
    centre of mass c as seen from the point, and the inertia tensor I_o about the point. The notes
    (eqs 54–57) have no cross term: their origin is the centre of mass.

    **Arguments:** `body`; the point is its origin, the zero of `com`. `q` (4,) (w, x, y, z), body →
    world; `velocity` (3,) V of that point, in metres per second, world frame; `omega` (3,) Ω,
    rad/s, body frame.

    >>> ball = MassProperties(1.0, [1.0, 0, 0], [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    >>> kinetic_energy_about(ball, [1.0, 0, 0, 0], [0.0, 1, 0], [0.0, 0, 1])
    Array(2., dtype=float64)
    """
    body = validation.require_single_body(body, MassProperties, "body")
    velocity = _checks.array_of_shape(velocity, (3,), "velocity")
    omega = _checks.array_of_shape(omega, (3,), "omega")
    about_origin = body.inertia_about(jnp.zeros_like(body.com)).tensor
    swing = quaternion.rotate(validation.unit_attitude(q), cross(omega, body.com))
    return (
        0.5 * body.mass * dot(velocity, velocity)
        + body.mass * dot(velocity, swing)
        + 0.5 * dot(omega, apply(about_origin, omega))
    )


def kinetic_energy_of_matrix_rate(second_moment: Matrix, matrix_rate: Matrix) -> Scalar:
    """Return the kinetic energy of rotation, in joules, from the rate Ṁ of the rotation matrix M
    and the second moment 𝔖: `½ Tr(Ṁ 𝔖 Ṁᵀ) = ½ Tr(J'ᵀ J' 𝔖)` with `J' = Mᵀ Ṁ` (notes, eqs 63, 65
    with the factor ½).

    **Arguments:** `second_moment` (3, 3) 𝔖, kg m², body frame; `matrix_rate` (3, 3), 1/s: either Ṁ
    = dM/dt, where M is body → world, or J', which is the matrix hat(Ω) of the cross product with
    the body rate Ω; both give the same energy.

    >>> kinetic_energy_of_matrix_rate(jnp.eye(3), jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
    Array(1., dtype=float64)
    """
    s = _checks.array_of_shape(second_moment, (3, 3), "second_moment")
    s = validation.require_symmetric_or_nan(s, "second_moment")
    rate = _checks.array_of_shape(matrix_rate, (3, 3), "matrix_rate")
    return 0.5 * jnp.sum(product(rate, s) * rate)


def angular_momentum(body: Inertia | MassProperties, state: HasSpin | Vector) -> Vec3:
    """Return the angular momentum in the body frame, `Π = IΩ`, (3,), kg m²/s.

    **Arguments:** `body`, an `Inertia` about the point that the body turns about, or
    `MassProperties` (then about the centre of mass); `state` anything with `.omega`, or Ω (3,)
    itself, rad/s, body frame.

    >>> angular_momentum(Inertia.from_principal(1.0, 2.0, 3.0), [1.0, 1.0, 1.0])
    Array([1., 2., 3.], dtype=float64)
    """
    return apply(_tensor(body), _rate(state))


def spatial_angular_momentum(body: Inertia | MassProperties, state: HasAttitude) -> Vec3:
    """Return the angular momentum in the world frame, (3,), kg m²/s, which is constant for a free
    body: `R Π`, with the momentum Π in the body frame and the rotation matrix R of the attitude.

    **Arguments:** as `angular_momentum`; `state` has `.q` (4,), body → world, and `.omega`. For
    `MassProperties` and a state with `.x` and `.v`, the orbital part `m x × v` about the world's
    origin is added. **Raises:** `TypeError` for a state without attitude.

    >>> turned = rj.Attitude([0.0, 1.0, 0, 0], [0.0, 0, 1])
    >>> spatial_angular_momentum(Inertia.from_principal(1.0, 2.0, 3.0), turned)[2]
    Array(-3., dtype=float64)
    """
    hint = "in the body frame use angular_momentum"
    wanted = "a state with an attitude (.q)"
    _checks.require_unbatched_instance(state, HasAttitude, "state", requirement=wanted, hint=hint)
    momentum = quaternion.rotate(state.q, angular_momentum(body, state))
    if isinstance(body, MassProperties) and isinstance(state, HasPose):
        momentum = momentum + body.mass * cross(state.x, state.v)
    return momentum


def ellipsoid(
    body: Inertia | MassProperties,
    kind: Literal["energy", "momentum", "mass"],
    size: ScalarLike | None = None,
) -> tuple[Vec3, Quat]:
    """Return the ellipsoid of all rates Ω with one energy or momentum, or the solid ellipsoid with
    the inertia of the body.

    **Arguments:** `body`, with the inertia tensor I and the principal moments I_k; `kind` and
    `size`:

    - `"energy"`: `½ Ω·IΩ = T`, semi-axes `√(2T/I_k)` rad/s; `size` T ≥ 0, J;
    - `"momentum"`: `|IΩ| = h`, semi-axes `h/I_k` rad/s; `size` h ≥ 0, kg m²/s;
    - `"mass"`: the uniform solid ellipsoid with the mass, centre and 𝔖 of the body, of
      `MassProperties`, without a `size`; semi-axes `√(5 λ_k/m)`, in metres, with the eigenvalues
      λ_k of 𝔖 and the mass m. This ellipsoid moves exactly as the body does.

    **Returns** `(semi_axes, q)`: the semi-axes (3,), in the order of ascending moments I_k (for
    `"mass"`: in ascending order), and the rotation (4,) principal axes → body axes. In free motion
    Ω stays on the intersection of the ellipsoids of energy and momentum (Poinsot; Landau and
    Lifshitz, Mechanics, § 37). **Raises:** `ValueError` for a moment I_k that is zero, and for a
    negative `size`; `TypeError` for a `size` that is missing or not wanted.

    >>> ellipsoid(Inertia.from_principal(1.0, 2.0, 2.0), "energy", 4.0)[0]
    Array([2.82842712, 2.        , 2.        ], dtype=float64)
    >>> ellipsoid(rj.shapes.ellipsoid(3.0, [1.0, 2.0, 3.0]), "mass")[0]
    Array([1., 2., 3.], dtype=float64)
    """
    _checks.require_option(kind, ("energy", "momentum", "mass"), "kind")
    if (size is None) != (kind == "mass"):
        words = {"mass": "no size", "energy": "the energy, J", "momentum": "the momentum, kg m²/s"}
        raise TypeError(f"size: wanted {words[kind]} for the ellipsoid of {kind}, got {size!r}")
    if kind == "mass":
        solid = validation.require_single_body(body, MassProperties, "body")
        second_moments, q = principal(solid.second_moment)
        return jnp.sqrt(5.0 * second_moments / solid.mass), q
    one = _checks.require_unbatched_instance(body, (Inertia, MassProperties), "body", hint=_HINT)
    moments, q = Inertia(tensor_of(one)).require_invertible().principal()
    wanted = "a number ≥ 0, J" if kind == "energy" else "a number ≥ 0, kg m²/s"
    size = _checks.require_positive(
        _checks.array_of_shape(size, (), "size"), "size", wanted, allow_zero=True
    )
    return (jnp.sqrt(2.0 * size / moments) if kind == "energy" else size / moments), q


def _rate(state: HasSpin | Vector) -> Vec3:
    """Return the body rate, rad/s, of a state of motion, or the rate itself."""
    return _checks.array_of_shape(
        state.omega if isinstance(state, HasSpin) else state, (3,), "omega"
    )


def _tensor(body: Inertia | MassProperties) -> Mat3:
    """Return the checked inertia tensor, kg m²; that of `MassProperties` is about its com."""
    return tensor_of(
        validation.require_single_body(body, (Inertia, MassProperties), "body", hint=_HINT)
    )
