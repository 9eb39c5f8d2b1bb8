"""Vectors and 3×3 matrices, written on components (floor 1).

`@` on 3×3 matrices is slow in gradients on CPU and runs in TF32 on some GPUs; these do neither.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Vec3, Vec3Like


def cross(a: Vec3Like, b: Vec3Like) -> Vec3:
    """Vector product a × b.

    **Arguments:** `a`, `b` (3,), in one frame, any units.

    >>> cross(jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])).tolist()
    [0.0, 0.0, 1.0]
    """
    a, b = _checks.floating(a, (3,), "a"), _checks.floating(b, (3,), "b")
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def hat(w: Vec3Like) -> Mat3:
    """The matrix J with J y = w × y (notes, eqs 41–43, 49).

    **Arguments:** `w` (3,), any units and frame; J acts in the same frame.

    >>> hat(jnp.array([1.0, 2.0, 3.0])).tolist()
    [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    """
    x, y, z = _checks.floating(w, (3,), "w")
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def vee(matrix: Mat3Like) -> Vec3:
    """The vector w of an antisymmetric matrix; of any matrix, w_i = ½ Tr(A J_iᵀ) (notes, eq 53).

    **Arguments:** `matrix` (3, 3). A symmetric part is dropped, as the projection of eqs 52, 53
    does.

    >>> vee(hat(jnp.array([1.0, 2.0, 3.0]))).tolist()
    [1.0, 2.0, 3.0]
    """
    m = _checks.floating(matrix, (3, 3), "matrix")
    return 0.5 * jnp.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])


def basis(dtype: object = float) -> Float[Array, "3 3 3"]:
    """The matrices J_1, J_2, J_3 with J_i y = e_i × y (notes, eqs 41, 42; 52, 53: ½ Tr(J_iᵀJ_j) = δ_ij).

    Eq 16 of the notes prints J_3 transposed, that is −J_3 of eq 42; eq 42 holds.

    >>> basis()[2].tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    e = jnp.eye(3, dtype=dtype)
    return jnp.stack([hat(e[0]), hat(e[1]), hat(e[2])])


def product(a: Mat3Like, b: Mat3Like) -> Mat3:
    """Matrix product a b on components: full precision on every device, cheap in gradients.

    **Arguments:** `a`, `b` (3, 3).

    >>> product(jnp.eye(3), 2.0 * jnp.eye(3)).tolist()
    [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]
    """
    a, b = _checks.floating(a, (3, 3), "a"), _checks.floating(b, (3, 3), "b")
    return a[:, 0:1] * b[0:1] + a[:, 1:2] * b[1:2] + a[:, 2:3] * b[2:3]


def apply(a: Mat3Like, y: Vec3Like) -> Vec3:
    """Matrix times vector a y on components.

    **Arguments:** `a` (3, 3), `y` (3,).

    >>> apply(2.0 * jnp.eye(3), jnp.array([1.0, 2.0, 3.0])).tolist()
    [2.0, 4.0, 6.0]
    """
    a, y = _checks.floating(a, (3, 3), "a"), _checks.floating(y, (3,), "y")
    return a[:, 0] * y[0] + a[:, 1] * y[1] + a[:, 2] * y[2]


def solve(a: Mat3Like, y: Vec3Like) -> Vec3:
    """Solve a x = y by cofactors (Cramer's rule).

    **Arguments:** `a` (3, 3), well conditioned; `y` (3,).

    >>> solve(2.0 * jnp.eye(3), jnp.array([2.0, 4.0, 6.0])).tolist()
    [1.0, 2.0, 3.0]
    """
    a, y = _checks.floating(a, (3, 3), "a"), _checks.floating(y, (3,), "y")
    columns = a[:, 0], a[:, 1], a[:, 2]
    rows = cross(columns[1], columns[2]), cross(columns[2], columns[0])
    last = cross(columns[0], columns[1])
    determinant = dot(columns[0], rows[0])
    return jnp.stack([dot(rows[0], y), dot(rows[1], y), dot(last, y)]) / determinant


def determinant(a: Mat3Like) -> Float[Array, ""]:
    """Determinant of a 3×3 matrix: +1 for a rotation, −1 for a reflection (notes, eq 10).

    **Arguments:** `a` (3, 3).

    >>> float(determinant(jnp.eye(3)))
    1.0
    """
    a = _checks.floating(a, (3, 3), "a")
    return dot(a[:, 0], cross(a[:, 1], a[:, 2]))


def dot(a: Vec3Like, b: Vec3Like) -> Float[Array, ""]:
    """Scalar product a · b.

    **Arguments:** `a`, `b` (3,), in one frame.

    >>> float(dot(jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])))
    6.0
    """
    a, b = _checks.floating(a, (3,), "a"), _checks.floating(b, (3,), "b")
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
