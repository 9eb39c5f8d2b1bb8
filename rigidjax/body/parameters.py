"""Unconstrained numbers ↔ real bodies.

A log-Cholesky chart: any vector is a body with positive mass and a positive definite second
moment, so that an optimiser needs no constraint and cannot leave the bodies. Plates, rods and
points lie at infinity (a logarithm of −∞) and are approached as closely as wanted.

Source: Rucker and Wensing 2022, "Smooth parameterization of rigid-body inertia", IEEE RA-L 7:2771,
doi:10.1109/LRA.2022.3144517. The ten numbers and their order are those of pinocchio's
`LogCholeskyParameters`.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._names import show
from rigidjax._types import Mat3, Matrix, Numbers, Vec3, Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.body.symmetric3 import from_components
from rigidjax.body.validation import real_moments


def pack(body: MassProperties) -> Float[Array, "10"]:
    """Ten unconstrained numbers of a body.

    **Arguments:** `body` with a positive definite second moment. **Returns** (10,)
    `(α, d1, d2, d3, s12, s23, s13, t1, t2, t3)`: `mass = e^{2α}`, `com = t` (m, body frame),
    `𝔖 = mass · U Uᵀ` about the centre of mass, U upper triangular with `e^{d_i}` on its diagonal
    and `s_ij` (m) above it.
    Source: Rucker and Wensing 2022.

    **Raises:** `ValueError` (`equinox` error under `jit`) on the boundary: a plate, rod or point.

    >>> import rigidjax as rj
    >>> vector = pack(rj.shapes.box(2.0, [0.1, 0.2, 0.3]))
    >>> float(unpack(vector).mass)
    2.0
    """
    if not isinstance(body, MassProperties):
        raise TypeError(
            f"pack: wanted MassProperties, got {type(body).__name__}; of an Inertia use "
            "pack_second_moment(body.second_moment), or pack_shape for its ratios alone"
        )
    _checks.single(body, MassProperties, "body")
    half_log_mass = 0.5 * jnp.log(body.mass)
    shape = _factor(body.second_moment / body.mass)
    logs = _reach(half_log_mass + shape[:3]) - _reach(half_log_mass)
    return jnp.concatenate([_reach(half_log_mass)[None], logs, shape[3:], body.com])


def unpack(vector: Float[ArrayLike, "10"] | Numbers) -> MassProperties:
    """The body of ten unconstrained numbers: any ten.

    **Arguments:** `vector` (10,) as `pack` returns them. Exponents beyond what the dtype can hold
    (|α|, |α + d| over 330 in float64, 31 in float32) grow logarithmically instead, so that a far
    too long step of an optimiser gives a large body and not an infinity.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import jax.numpy as jnp
    >>> unpack(jnp.zeros(10)).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    v = _checks.floating(vector, (10,), "vector")
    alpha = _hold(v[0])
    diagonal = jnp.exp(_hold(v[0] + v[1:4]))
    return MassProperties(jnp.exp(2.0 * alpha), v[7:10], _expand(diagonal, jnp.exp(alpha) * v[4:7]))


def pack_second_moment(second_moment: Matrix) -> Float[Array, "6"]:
    """Six unconstrained numbers of a positive definite second moment.

    **Arguments:** `second_moment` (3, 3) 𝔖, kg m². **Returns** (6,)
    `(d1, d2, d3, s12, s23, s13)`, `𝔖 = U Uᵀ` as in `pack` with unit mass.

    **Raises:** `ValueError` (`equinox` error under `jit`) on the boundary.

    >>> import jax.numpy as jnp
    >>> pack_second_moment(jnp.eye(3))
    Array([0., 0., 0., 0., 0., 0.], dtype=float64)
    """
    s = _checks.floating(second_moment, (3, 3), "second_moment")
    shape = _factor(s)
    return jnp.concatenate([_reach(shape[:3]), shape[3:]])


def unpack_second_moment(vector: Float[ArrayLike, "6"] | Numbers) -> Mat3:
    """The second moment (3, 3), kg m², of six unconstrained numbers.

    **Arguments:** `vector` (6,) as `pack_second_moment` returns them.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import jax.numpy as jnp
    >>> unpack_second_moment(jnp.zeros(6))[0]
    Array([1., 0., 0.], dtype=float64)
    """
    v = _checks.floating(vector, (6,), "vector")
    return _expand(jnp.exp(_hold(v[:3])), v[3:])


def pack_shape(second_moment: Matrix) -> Float[Array, "5"]:
    """Five unconstrained numbers of a second moment up to its scale.

    Free motion sees only this: the ratios of inertia and the axes. **Arguments:** `second_moment`
    (3, 3) 𝔖, positive definite, any units. **Returns** (5,) `(d1, d2, s12, s23, s13)` of the
    factor U of determinant one.

    **Raises:** `ValueError` (`equinox` error under `jit`) on the boundary.

    >>> import jax.numpy as jnp
    >>> pack_shape(7.0 * jnp.eye(3))
    Array([0., 0., 0., 0., 0.], dtype=float64)
    """
    s = _checks.floating(second_moment, (3, 3), "second_moment")
    shape = _factor(s / (s[0, 0] + s[1, 1] + s[2, 2]))
    mean = (shape[0] + shape[1] + shape[2]) / 3.0
    return jnp.concatenate([_reach(shape[:2] - mean), jnp.exp(-mean) * shape[3:]])


def unpack_shape(vector: Float[ArrayLike, "5"] | Numbers) -> Mat3:
    """The second moment (3, 3) of trace 1 (so `Tr I = 2`) of five unconstrained numbers.

    **Arguments:** `vector` (5,) as `pack_shape` returns them.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> import jax.numpy as jnp
    >>> float(jnp.trace(unpack_shape(jnp.ones(5))))
    1.0
    """
    v = _checks.floating(vector, (5,), "vector")
    d1, d2 = _hold(v[0]), _hold(v[1])
    s = _expand(jnp.exp(jnp.stack([d1, d2, _hold(-d1 - d2)])), v[2:])
    return s / (s[0, 0] + s[1, 1] + s[2, 2])


def pack_moments(moments: Vector) -> Float[Array, "3"]:
    """Three unconstrained numbers of principal moments, the axes being known.

    **Arguments:** `moments` (3,) I1, I2, I3 in any order, kg m². **Returns** (3,)
    `½ log λ_i`, the second moments `λ1 = ½(I2 + I3 − I1)`, … (notes, eqs 76–78).

    **Raises:** `ValueError` (`equinox` error under `jit`) on the boundary or beyond it.

    >>> pack_moments([2.0, 2.0, 2.0])
    Array([0., 0., 0.], dtype=float64)
    """
    i = real_moments(_checks.floating(moments, (3,), "moments"))
    s = 0.5 * jnp.stack([(i[1] - i[0]) + i[2], (i[2] - i[1]) + i[0], (i[0] - i[2]) + i[1]])
    return _reach(0.5 * jnp.log(_interior(s)))


def unpack_moments(vector: Float[ArrayLike, "3"] | Numbers) -> Vec3:
    """Principal moments (3,), kg m², of three unconstrained numbers, always a body's.

    **Arguments:** `vector` (3,) as `pack_moments` returns them.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> unpack_moments([0.0, 0.0, 0.0])
    Array([2., 2., 2.], dtype=float64)
    """
    s = jnp.exp(2.0 * _hold(_checks.floating(vector, (3,), "vector")))
    return jnp.stack([s[1] + s[2], s[2] + s[0], s[0] + s[1]])


def _factor(s: Mat3) -> Float[Array, "6"]:
    """(log u11, log u22, log u33, u12, u23, u13) of the upper triangular U with s = U Uᵀ."""
    u33 = jnp.sqrt(_interior(s[2, 2]))
    u13, u23 = s[0, 2] / u33, s[1, 2] / u33
    u22 = jnp.sqrt(_interior(s[1, 1] - u23 * u23))
    u12 = (s[0, 1] - u13 * u23) / u22
    u11 = jnp.sqrt(_interior(s[0, 0] - u12 * u12 - u13 * u13))
    return jnp.stack([jnp.log(u11), jnp.log(u22), jnp.log(u33), u12, u23, u13])


def _expand(diagonal: Vec3, upper: Vec3) -> Mat3:
    """U Uᵀ from the diagonal of U and (u12, u23, u13)."""
    u1, u2, u3 = diagonal[0], diagonal[1], diagonal[2]
    u12, u23, u13 = upper[0], upper[1], upper[2]
    return from_components(
        u1 * u1 + u12 * u12 + u13 * u13,
        u2 * u2 + u23 * u23,
        u3 * u3,
        u12 * u2 + u13 * u23,
        u13 * u3,
        u23 * u3,
    )


def _interior(square):
    return _checks.refuse(
        square,
        (~(square > 0)).any(),
        "pack: the second moment has a zero eigenvalue (a plate, rod or point), which the chart "
        "reaches only at infinity; give the body a thickness, 1e-6 of its size will do",
    )


def _hold(exponent: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The exponent itself, but growing only logarithmically past the dtype's range."""
    return _bent(exponent, jnp.log1p)


def _reach(exponent: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The inverse of `_hold`."""
    return _bent(exponent, jnp.expm1)


def _bent(exponent: Float[Array, "*n"], bend: Callable[[Array], Array]) -> Float[Array, "*n"]:
    limit = 31.0 if exponent.dtype == jnp.float32 else 330.0
    beyond = jnp.maximum(jnp.abs(exponent) - limit, 0.0)
    return jnp.where(beyond > 0, jnp.sign(exponent) * (limit + bend(beyond)), exponent)


show(__name__)
