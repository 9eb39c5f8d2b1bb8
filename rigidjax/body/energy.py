"""Kinetic energy and angular momentum of a turning body, and its ellipsoids.

The notes write the energy of rotation in three forms. Printed eqs 61–65 lack the factor ½ that
eqs 57 and 73–75 have; here all three have it and agree.

Poinsot: free motion rolls the energy ellipsoid on a fixed plane; the rate in the body frame stays
on the curve where the two ellipsoids of Ω meet. Source: Landau and Lifshitz, Mechanics, § 37.
"""

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
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.body.principal_axes import principal
from rigidjax.body.validation import unit_quaternion
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot, product


def kinetic_energy(body: Inertia | MassProperties, state: HasSpin | Vector) -> Scalar:
    """Kinetic energy of a body in a state of motion, J.

    **Arguments:** `body` an `Inertia` about the point it turns about, or `MassProperties`;
    `state` anything with `.omega` (Ω, rad/s, body frame), or Ω (3,) itself. Translation counts,
    too, for `MassProperties` and a state that moves (`.v`, m/s, of the centre of mass, world
    frame).

    `T = ½ m |v|² + ½ Ω·IΩ`. Source: notes, eqs 75 and 79, in any body axes.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> kinetic_energy(Inertia.from_principal(1.0, 2.0, 3.0), [1.0, 1.0, 1.0])
    Array(3., dtype=float64)
    """
    omega = _omega(state)
    energy = 0.5 * dot(omega, apply(_tensor(body), omega))
    if isinstance(body, MassProperties) and isinstance(state, HasPose):
        energy = energy + 0.5 * body.mass * dot(state.v, state.v)
    return energy


def kinetic_energy_about(
    body: MassProperties, q: Quaternion, velocity: Vector, omega: Vector
) -> Scalar:
    """Kinetic energy by the velocity of a point other than the centre of mass, J.

    `T = ½ m |V|² + m V·R(Ω × c) + ½ Ω·I_o Ω`: the notes drop the cross term by choosing the origin
    at the centre of mass (eqs 54–57).

    **Arguments:** `body`; the point is its origin, the zero of `com`. `q` (4,)
    (w, x, y, z), body → world; `velocity` (3,) V of that point, m/s, world frame; `omega` (3,) Ω,
    rad/s, body frame.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> ball = MassProperties(1.0, [1.0, 0, 0], [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    >>> kinetic_energy_about(ball, [1.0, 0, 0, 0], [0.0, 1, 0], [0.0, 0, 1])
    Array(2., dtype=float64)
    """
    _checks.single(body, MassProperties, "body")
    velocity, omega = _vector(velocity, "velocity"), _vector(omega, "omega")
    about_origin = body.inertia_about(jnp.zeros_like(body.com)).tensor
    swing = quaternion.rotate(unit_quaternion(q), cross(omega, body.com))
    return (
        0.5 * body.mass * dot(velocity, velocity)
        + body.mass * dot(velocity, swing)
        + 0.5 * dot(omega, apply(about_origin, omega))
    )


def kinetic_energy_of_matrix_rate(second_moment: Matrix, matrix_rate: Matrix) -> Scalar:
    """Energy of rotation `½ Tr(Ṁ 𝔖 Ṁᵀ)`, J (notes, eq 63 with its missing ½).

    **Arguments:** `second_moment` (3, 3) 𝔖, kg m², body frame; `matrix_rate` (3, 3) dM/dt, 1/s, of
    the rotation matrix body → world.

    >>> kinetic_energy_of_matrix_rate(jnp.eye(3), jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
    Array(1., dtype=float64)
    """
    s = _checks.floating(second_moment, (3, 3), "second_moment")
    rate = _checks.floating(matrix_rate, (3, 3), "matrix_rate")
    return 0.5 * jnp.sum(product(rate, s) * rate)


def kinetic_energy_of_generator(second_moment: Matrix, generator: Matrix) -> Scalar:
    """Energy of rotation `½ Tr(J'ᵀ J' 𝔖)`, J (notes, eq 65 with its missing ½).

    **Arguments:** `second_moment` (3, 3) 𝔖, kg m², body frame; `generator` (3, 3) J' = hat(Ω), 1/s.

    >>> kinetic_energy_of_generator(jnp.eye(3), jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
    Array(1., dtype=float64)
    """
    s = _checks.floating(second_moment, (3, 3), "second_moment")
    generator = _checks.floating(generator, (3, 3), "generator")
    return 0.5 * jnp.sum(product(generator.T, generator) * s.T)


def kinetic_energy_of_moments(second_moments: Vector, omega: Vector) -> Scalar:
    """Energy of rotation `½((λ2+λ3)Ω1² + (λ3+λ1)Ω2² + (λ1+λ2)Ω3²)`, J (notes, eqs 73–75).

    **Arguments:** `second_moments` (3,) λ, eigenvalues of 𝔖, kg m²; `omega` (3,) Ω along the same
    principal axes, rad/s.

    >>> kinetic_energy_of_moments([1.0, 2.0, 3.0], [1.0, 0.0, 0.0])
    Array(2.5, dtype=float64)
    """
    s, omega = _vector(second_moments, "second_moments"), _vector(omega, "omega")
    moments = jnp.stack([s[1] + s[2], s[2] + s[0], s[0] + s[1]])
    return 0.5 * dot(moments, omega * omega)


def angular_momentum(body: Inertia | MassProperties, state: HasSpin | Vector) -> Vec3:
    """Angular momentum in the body frame, `Π = IΩ`, (3,), kg m²/s.

    **Arguments:** `body` an `Inertia` about the point it turns about, or `MassProperties` (then
    about the centre of mass); `state` anything with `.omega`, or Ω (3,) itself, rad/s, body frame.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> angular_momentum(Inertia.from_principal(1.0, 2.0, 3.0), [1.0, 1.0, 1.0])
    Array([1., 2., 3.], dtype=float64)
    """
    return apply(_tensor(body), _omega(state))


def spatial_angular_momentum(body: Inertia | MassProperties, state: HasAttitude) -> Vec3:
    """Angular momentum in the world frame, `R Π`, (3,), kg m²/s: constant for a free body.

    **Arguments:** as `angular_momentum`; `state` has `.q` (4,), body → world, and `.omega`. The
    orbital part `m x × v` about the world's origin is added for `MassProperties` and a state that
    moves (`.x`, `.v`).

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype, or a state without attitude.

    >>> from rigidjax import Attitude
    >>> turned = Attitude([0.0, 1.0, 0, 0], [0.0, 0, 1])
    >>> spatial_angular_momentum(Inertia.from_principal(1.0, 2.0, 3.0), turned)[2]
    Array(-3., dtype=float64)
    """
    if not isinstance(state, HasAttitude):
        raise TypeError(
            f"spatial_angular_momentum: wanted a state with an attitude (.q), got "
            f"{type(state).__name__}; in the body frame use angular_momentum"
        )
    _checks.single(state, HasAttitude, "state")
    momentum = quaternion.rotate(state.q, angular_momentum(body, state))
    if isinstance(body, MassProperties) and isinstance(state, HasPose):
        momentum = momentum + body.mass * cross(state.x, state.v)
    return momentum


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
    principal axes → body axes. It moves exactly as the body does, and is a picture of its inertia.

    >>> import rigidjax as rj
    >>> equal_ellipsoid(rj.shapes.ellipsoid(3.0, [1.0, 2.0, 3.0]))[0]
    Array([1., 2., 3.], dtype=float64)
    """
    _checks.single(body, MassProperties, "body")
    second_moments, q = principal(body.second_moment)
    return jnp.sqrt(5.0 * second_moments / body.mass), q


def _omega(state):
    return _vector(state.omega if isinstance(state, HasSpin) else state, "omega")


def _not_negative(value: ScalarLike, name: str, unit: str) -> Scalar:
    number = _checks.floating(value, (), name)
    return _checks.sign(number, name, f"a number ≥ 0, {unit}", zero=True)


def _vector(value, name):
    return _checks.floating(value, (3,), name)


def _tensor(body: Inertia | MassProperties) -> Mat3:
    hint = "Inertia.from_tensor makes one of a matrix"
    return tensor_of(_checks.single(body, (Inertia, MassProperties), "body", hint=hint))
