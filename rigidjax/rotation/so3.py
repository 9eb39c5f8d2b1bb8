"""Compute with rotation matrices M, active, body → world, and their tangent vectors.

`exp` and `log` take and return one rotation; batch with `jax.vmap`. Every kernel is a smooth
function of θ²: values and derivatives of any order are correct at θ = 0. Range: as in
`rigidjax.quaternion`.
"""

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Mat3, Mat3Like, Scalar, ScalarLike, Vec3, Vec3Like
from rigidjax.rotation import kernels, quaternion
from rigidjax.rotation.fitting import (
    align as align,
    mean as mean,
    mean_quaternion as mean_quaternion,
    project as project,
    wahba as wahba,
)
from rigidjax.rotation.kernels import hat_polynomial, matrix_to_quaternion, vector_to_matrix
from rigidjax.rotation.linalg3 import (
    apply as apply,
    basis as basis,
    components,
    cross as cross,
    determinant as determinant,
    dot as dot,
    hat as hat,
    product as product,
    solve as solve,
    squared_length,
    vee as vee,
)
from rigidjax.rotation.stumpff import stumpff
from rigidjax.rotation.validation import require_rotation, require_turn


def exp(v: Vec3Like) -> Mat3:
    """Return the rotation by |v| about v: 1 + A hat v + B (hat v)² (notes, eqs 15, 17, 18).

    **Arguments:** `v` (3,) rotation vector, rad; hat v is the matrix of the cross product with v. A
    = sin θ/θ and B = (1 − cos θ)/θ² (Rodrigues 1840) are both computed from θ/2. The angle θ = |v|
    has an error of ε|v|, where ε is the unit of round-off. **Raises:** as `quaternion.exp`.

    >>> exp(jnp.array([0.0, 0.0, jnp.pi / 2])).round(12)[0].tolist()
    [0.0, -1.0, 0.0]
    """
    return vector_to_matrix(require_turn(_checks.array_of_shape(v, (3,), "v"), "v"))


def log(matrix: Mat3Like) -> Vec3:
    """Return the shortest rotation vector of a rotation matrix, rad, |v| ≤ π.

    **Arguments:** `matrix` (3, 3) rotation. **Returns:** (3,), computed by the quaternion of the
    matrix; values and derivatives are correct to round-off from 0 to π. At a half turn the first
    nonzero component is positive. **Raises:** as `check` for known values.

    >>> bool(abs(log(exp(jnp.array([0.1, 0.2, 0.3]))) - jnp.array([0.1, 0.2, 0.3])).max() < 1e-15)
    True
    """
    return quaternion.log(quaternion.from_matrix(matrix))


def left_jacobian(v: Vec3Like) -> Mat3:
    """Return the left Jacobian J_l, with exp(v + dv) = exp(J_l dv) exp(v) to first order: J_l dv is
    the small turn in the world frame.

    **Arguments:** `v` (3,) rotation vector, rad. J_l = 1 + B hat v + C (hat v)², with the matrix
    hat v of the cross product with v, θ = |v|, B = (1 − cos θ)/θ², C = (θ − sin θ)/θ³ (Chirikjian
    2012, doi:10.1007/978-0-8176-4944-9; Solà 2018, eq 145). **Raises:** as `exp`.

    >>> left_jacobian(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    parts = components(require_turn(_checks.array_of_shape(v, (3,), "v"), "v"))
    t = squared_length(parts)
    return hat_polynomial(parts, stumpff(2, t), stumpff(3, t))


def right_jacobian(v: Vec3Like) -> Mat3:
    """Return the right Jacobian J_r of `v` (3,), rad, with exp(v + dv) = exp(v) exp(J_r dv) to
    first order; it is the transpose of the left Jacobian of v (Solà 2018, eq 143).

    >>> right_jacobian(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return left_jacobian(-_checks.array_of_shape(v, (3,), "v"))


def left_jacobian_inverse(v: Vec3Like) -> Mat3:
    """Return the inverse of the left Jacobian: 1 − ½ hat v + g (hat v)², with θ = |v| and g = (1 −
    (θ/2) cot(θ/2))/θ².

    **Arguments:** `v` (3,) rotation vector, rad, |v| < 2π; hat v is the matrix of the cross product
    with v (Solà 2018, eq 146).

    >>> left_jacobian_inverse(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return kernels.left_jacobian_inverse(require_turn(_checks.array_of_shape(v, (3,), "v"), "v"))


def right_jacobian_inverse(v: Vec3Like) -> Mat3:
    """Return the inverse of the right Jacobian of a rotation vector `v` (3,), rad, |v| < 2π: 1 + ½
    hat v + g (hat v)², with g as in `left_jacobian_inverse`.

    >>> right_jacobian_inverse(jnp.zeros(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return left_jacobian_inverse(-_checks.array_of_shape(v, (3,), "v"))


def distance(a: Mat3Like, b: Mat3Like) -> Scalar:
    """Return the angle of the rotation from a to b, rad, in [0, π].

    **Arguments:** `a`, `b` (3, 3) rotations. The angle is computed by atan2 of the quaternion of
    aᵀb, and is right from 1e-12 to π (arccos of the trace is useless below 1e-8). At a = b the
    angle has no derivative: zero is taken in its place, the subgradient of least length. For a loss
    take |log(aᵀb)|², which is smooth. **Raises:** `ValueError` for NaN, and for matrices far from a
    rotation.

    >>> round(float(distance(jnp.eye(3), exp(jnp.array([0.0, 3e-9, 0.0]))) * 1e9), 9)
    3.0
    """
    a, b = _checks.array_of_shape(a, (3, 3), "a"), _checks.array_of_shape(b, (3, 3), "b")
    return quaternion.angle(matrix_to_quaternion(_turn_between(a, b)))


def _turn_between(a: Mat3, b: Mat3) -> Mat3:
    """Return aᵀb; raise `ValueError` if it is known and not finite or far from a rotation."""
    between = product(a.T, b)
    if _checks.is_known(between):
        _checks.require_finite(between, "aᵀb")
        large = jnp.abs(between).max() > 2
        _checks.error_if(between, large, "aᵀb: wanted rotations a and b, got entries above 2")
    return between


def about_axis(axis: Vec3Like, angle: ScalarLike) -> Mat3:
    """Return the rotation exp(γ J_y) by an angle γ about a unit axis y, where J_y is the matrix of
    the cross product with y (notes, eqs 17, 18).

    **Arguments:** `axis` (3,) along y, of any length; `angle` γ, rad, right-handed about `axis`.
    **Raises:** as `quaternion.about_axis`.

    >>> about_axis(jnp.array([0.0, 0.0, 2.0]), jnp.pi / 2).round(12)[0].tolist()
    [0.0, -1.0, 0.0]
    """
    return quaternion.to_matrix(quaternion.about_axis(axis, angle))


def adjoint(matrix: Mat3Like) -> Mat3:
    """Return the adjoint matrix Ad_M (3, 3) of a rotation M, with M hat(w) Mᵀ = hat(Ad_M w) for
    every vector w: it is the `matrix` (3, 3) M itself (notes, eq 48 with Mᵀ).

    >>> adjoint(jnp.eye(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return _checks.array_of_shape(matrix, (3, 3), "matrix")


def to_world(matrix: Mat3Like, y: Vec3Like) -> Vec3:
    """Return the world components M y of a vector with the body components `y` (3,); `matrix` M (3,
    3) is the rotation body → world (notes, eqs 8, 21).

    >>> to_world(jnp.eye(3), jnp.array([1.0, 2.0, 3.0])).tolist()
    [1.0, 2.0, 3.0]
    """
    return apply(_checks.array_of_shape(matrix, (3, 3), "matrix"), y)


def to_body(matrix: Mat3Like, y: Vec3Like) -> Vec3:
    """Return the body components Mᵀ y of a vector with the world components `y` (3,); `matrix` M
    (3, 3) is the rotation body → world (notes, eqs 8, 22).

    >>> to_body(jnp.eye(3), jnp.array([1.0, 2.0, 3.0])).tolist()
    [1.0, 2.0, 3.0]
    """
    return apply(_checks.array_of_shape(matrix, (3, 3), "matrix").T, y)


def conjugate(turn: Mat3Like, matrix: Mat3Like) -> Mat3:
    """Return the rotation M T Mᵀ (3, 3): the `turn` T (3, 3), given in the body frame, expressed in
    the world frame by the rotation `matrix` M (3, 3), body → world (notes, eqs 25, 26).

    >>> conjugate(jnp.eye(3), jnp.eye(3)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    matrix = _checks.array_of_shape(matrix, (3, 3), "matrix")
    turn = _checks.array_of_shape(turn, (3, 3), "turn")
    return product(matrix, product(turn, matrix.T))


def rate(matrix: Mat3Like, omega: Vec3Like) -> Mat3:
    """Return the rate dM/dt = M hat(Ω) (3, 3), 1/s, of the rotation `matrix` M (3, 3), body →
    world, at the angular velocity `omega` Ω (3,), rad/s, body frame (notes, eq 50).

    >>> rate(jnp.eye(3), jnp.array([0.0, 0.0, 2.0]))[1].tolist()
    [2.0, 0.0, 0.0]
    """
    matrix = _checks.array_of_shape(matrix, (3, 3), "matrix")
    return product(matrix, hat(_checks.array_of_shape(omega, (3,), "omega")))


def body_rate(matrix: Mat3Like, rate: Mat3Like) -> Vec3:
    """Return the angular velocity Ω, body frame, of a rotation matrix M and its rate Ṁ = dM/dt:
    Ω_i = ½ Tr(Mᵀ Ṁ J_iᵀ), where J_i is the i-th matrix of `basis` (notes, eqs 48–50, 80).

    **Arguments:** `matrix` (3, 3), body → world; `rate` (3, 3), 1/s. **Returns:** (3,) rad/s, body
    frame; the symmetric part of MᵀṀ is dropped.

    >>> body_rate(jnp.eye(3), hat(jnp.array([1.0, 2.0, 3.0]))).tolist()
    [1.0, 2.0, 3.0]
    """
    rate = _checks.array_of_shape(rate, (3, 3), "rate")
    return vee(product(_checks.array_of_shape(matrix, (3, 3), "matrix").T, rate))


def world_rate(matrix: Mat3Like, rate: Mat3Like) -> Vec3:
    """Return the angular velocity w, world frame, of a rotation matrix M and its rate Ṁ = dM/dt:
    hat(w) = Ṁ Mᵀ (notes, eqs 36–42, 50).

    **Arguments:** `matrix` (3, 3), body → world; `rate` (3, 3), 1/s. **Returns:** (3,) rad/s, world
    frame.

    >>> world_rate(jnp.eye(3), hat(jnp.array([1.0, 2.0, 3.0]))).tolist()
    [1.0, 2.0, 3.0]
    """
    rate = _checks.array_of_shape(rate, (3, 3), "rate")
    return vee(product(rate, _checks.array_of_shape(matrix, (3, 3), "matrix").T))


def interpolate(a: Mat3Like, b: Mat3Like, s: ScalarLike) -> Mat3:
    """Return the rotation at the fraction s of the shortest turn from a (s = 0) to b (s = 1): a
    exp(s log(aᵀb)).

    **Arguments:** `a`, `b` (3, 3) rotations; `s` dimensionless, also beyond [0, 1]. **Raises:** as
    `distance`.

    >>> interpolate(jnp.eye(3), exp(jnp.array([0.0, 0.0, 2.0])), 0.5).round(6)[0].tolist()
    [0.540302, -0.841471, 0.0]
    """
    a, b = _checks.array_of_shape(a, (3, 3), "a"), _checks.array_of_shape(b, (3, 3), "b")
    v = quaternion.log(matrix_to_quaternion(_turn_between(a, b)))
    part = require_turn(_checks.array_of_shape(s, (), "s").astype(v.dtype) * v, "s times the turn")
    return product(a, vector_to_matrix(part))


def uniform(key: PRNGKeyArray, dtype: DTypeLike = float) -> Mat3:
    """Return a random rotation matrix (3, 3), uniformly distributed (Haar measure). **Arguments:**
    `key` of `jax.random`; `dtype` float32 or float64.

    >>> import jax
    >>> uniform(jax.random.key(0)).shape
    (3, 3)
    """
    return quaternion.to_matrix(quaternion.uniform(key, dtype))


def check(
    matrix: Float[ArrayLike, "*batch 3 3"], *, name: str = "matrix"
) -> Float[Array, "*batch 3 3"]:
    """Return a matrix that a user gives unchanged if it is a rotation; refuse any other matrix.

    **Arguments:** `matrix` (..., 3, 3); `name` the name of the matrix in messages. **Raises:**
    `ValueError` (under `jit` `equinox.error_if`) for NaN, for a left-handed frame (det < 0), and if
    an entry of |MᵀM − 1| is above 1e-6 (float32: 1e-3), where M is the matrix. `project` gives the
    nearest rotation.

    >>> check(jnp.eye(3)).shape
    (3, 3)
    """
    return require_rotation(_checks.array_of_shape(matrix, (3, 3), name, batched=True), name)


__all__ = [
    "about_axis", "adjoint", "align", "apply", "basis", "body_rate", "check", "conjugate", "cross",
    "determinant", "distance", "dot", "exp", "hat", "interpolate", "left_jacobian",
    "left_jacobian_inverse", "log", "mean", "mean_quaternion", "product", "project", "rate",
    "right_jacobian", "right_jacobian_inverse", "solve", "to_body", "to_world", "uniform", "vee",
    "wahba", "world_rate",
]  # fmt: skip

define_dir_and_getattr(__name__)
