"""Compute principal axes as a fixed frame, which is never differentiated.

In this frame the off-diagonal entries of the inertia tensor are exactly zero in value, but their
tangents (the changes in a derivative) are not.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rigidjax._types import Mat3, Scalar, Vec3
from rigidjax.exact.components3 import SymmetricEntries, Triple
from rigidjax.rotation.barrier import compiled_as_one_kernel, match_batch_axes

# The number of sweeps of Jacobi's cyclic method for eigenvalues; one sweep is three rotations. The
# method converges quadratically: four or five sweeps are enough for any symmetric 3×3 matrix, and
# six leave a margin.
_SWEEPS = 6


def principal_tensor_and_axes(tensor: Mat3) -> tuple[SymmetricEntries, Mat3]:
    """Return two things: the inertia tensor in principal axes, as the six entries (11, 22, 33, 12,
    13, 23), of which the first three are the moments in ascending order; and the rotation matrix A
    (3, 3) whose columns are these axes.

    `tensor` (3, 3) is the inertia tensor in the body frame. The method is Jacobi's, in which small
    moments keep their digits. Derivatives treat A as a constant, because the axes have no
    derivative where two moments are equal.
    """
    columns, moments = _axes_and_moments(jax.lax.stop_gradient(tensor))
    axes = jnp.stack([jnp.stack(row) for row in columns])
    return tensor_in_axes(tensor, axes, moments), axes


@jax.custom_jvp
def tensor_in_axes(tensor: Mat3, axes: Mat3, moments: Triple) -> SymmetricEntries:
    """Return the six entries (11, 22, 33, 12, 13, 23) of the inertia tensor in principal axes,
    `AᵀIA`.

    - `tensor`: (3, 3) the inertia tensor I, body frame.
    - `axes`: (3, 3) the matrix A whose columns are the principal axes of I.
    - `moments`: the three principal moments.

    In value the result is the diagonal matrix of the `moments`. Its change for a change δI of the
    tensor is AᵀδI A, with A held fixed: this is a full symmetric matrix.
    """
    zero = jnp.zeros_like(tensor[0, 0])
    return match_batch_axes((*moments, zero, zero, zero), (tensor, axes, moments))


@tensor_in_axes.defjvp
def _tensor_in_axes_jvp(
    primals: tuple[Mat3, Mat3, Triple], tangents: tuple[PyTree, ...]
) -> tuple[SymmetricEntries, SymmetricEntries]:
    """Return two things: the six entries (11, 22, 33, 12, 13, 23) of the inertia tensor I in
    principal axes, AᵀIA; and their change for a change of the tensor, with the axes A held fixed.
    By this rule JAX differentiates `tensor_in_axes`.

    - `primals`: I (3, 3), body frame; the matrix A (3, 3) whose columns are the principal axes; and
      the three principal moments.
    - `tangents`: the changes of these three inputs, of which the first one is used.
    """
    # Take the symmetric part of the change of the tensor, so that a gradient is a symmetric matrix.
    axes, change = primals[1], 0.5 * (tangents[0] + tangents[0].T)
    # Write the two products of matrices as sums over their entries: on a GPU a product of matrices
    # is rounded to ten bits in float32.
    turned = jnp.sum(axes[:, :, None] * change[:, None], axis=0)
    m = jnp.sum(turned[:, None] * axes.T[None], axis=2)
    return tensor_in_axes(*primals), (m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])


def components_along(axes: Mat3, vector: Vec3 | Triple) -> Triple:
    """Return the three components of a vector along the columns of the matrix `axes` (3, 3)."""
    return tuple(
        axes[0, i] * vector[0] + axes[1, i] * vector[1] + axes[2, i] * vector[2] for i in range(3)
    )


def combine_columns(axes: Mat3, components: Triple) -> Triple:
    """Return the three entries of the vector that has the given `components` along the columns of
    the matrix `axes` (3, 3).

    This is the inverse of `components_along`.
    """
    return tuple(
        axes[i, 0] * components[0] + axes[i, 1] * components[1] + axes[i, 2] * components[2]
        for i in range(3)
    )


@compiled_as_one_kernel
def _axes_and_moments(matrix: Mat3) -> tuple[list[list[Scalar]], Triple]:
    """Return the principal axes and moments of an inertia tensor, by Jacobi's method.

    - `matrix`: (3, 3), the tensor, symmetric.

    **Returns** two things: a matrix as a list of its three rows, whose columns are the three
    principal axes; and the three moments (the eigenvalues) in ascending order.
    """
    one, zero = jnp.ones_like(matrix[0, 0]), jnp.zeros_like(matrix[0, 0])
    # If no diagonal entry is more than twice the least one, subtract the least one from all three.
    # This subtraction is exact by Sterbenz' lemma, and so the differences of nearly equal moments
    # keep their digits.
    least = jnp.minimum(jnp.minimum(matrix[0, 0], matrix[1, 1]), matrix[2, 2])
    most = jnp.maximum(jnp.maximum(matrix[0, 0], matrix[1, 1]), matrix[2, 2])
    shift = jnp.where(2.0 * least >= most, least, zero)
    d = (matrix[0, 0] - shift, matrix[1, 1] - shift, matrix[2, 2] - shift)
    o = tuple(0.5 * (matrix[i, j] + matrix[j, i]) for i, j in ((1, 2), (0, 2), (0, 1)))
    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))

    def rotate(_, state):
        # Always rotate the last two axes, then exchange the three axes cyclically, so that the next
        # rotation is of another pair: only one rotation is then compiled.
        d, o, axes = _rotate_last_two_axes(*state)
        return tuple((x[1], x[2], x[0]) for x in (d, o, axes))

    # After the loop `axes` has the three principal axes, each as three components: they are the
    # columns, not the rows, of the matrix that is returned.
    d, _, axes = jax.lax.fori_loop(0, 3 * _SWEEPS, rotate, (d, o, axes))
    for i, j in ((0, 1), (1, 2), (0, 1)):
        d, axes = _exchange_to_ascending(d, axes, i, j)
    columns = _orthonormalise([[axes[j][i] for j in range(3)] for i in range(3)])
    return columns, tuple(c + shift for c in d)


def _orthonormalise(matrix: list[list[Scalar]]) -> list[list[Scalar]]:
    """Return the orthonormal matrix nearest to a matrix A that is already orthonormal except for
    round-off, by one step A(3 − AᵀA)/2, where 3 is three times the unit matrix (Higham 1986).

    - `matrix`: A, 3×3, as a list of its three rows; the result has the same form.

    The step is needed because A is a product of many rotations, and their rounding errors add up.
    """
    excess = [
        [
            matrix[0][i] * matrix[0][j]
            + matrix[1][i] * matrix[1][j]
            + matrix[2][i] * matrix[2][j]
            - float(i == j)
            for j in range(3)
        ]
        for i in range(3)
    ]
    return [
        [matrix[i][j] - 0.5 * sum(matrix[i][k] * excess[k][j] for k in range(3)) for j in range(3)]
        for i in range(3)
    ]


def _rotate_last_two_axes(
    diagonal: Triple, off_diagonal: Triple, axes: tuple[Triple, ...]
) -> tuple[Triple, Triple, tuple[Triple, ...]]:
    """Return the three arguments after one rotation of Jacobi's method for eigenvalues: it turns
    the axes 2 and 3 so that the off-diagonal entry (2, 3) of the symmetric matrix becomes zero.

    - `diagonal`: the three diagonal entries of the matrix, in the axes before this rotation.
    - `off_diagonal`: the entries (23, 13, 12) of the same matrix.
    - `axes`: the three axes before this rotation, each as three components.
    """
    (first, second, third), (x, y, z), (u, v, w) = diagonal, off_diagonal, axes
    none = x == 0
    cot = 0.5 * (third - second) / jnp.where(none, 1.0, x)
    size = jnp.abs(cot)
    # The tangent t of the angle of rotation is the smaller root of t² + 2bt − 1 = 0, where b is the
    # cotangent `cot` of twice the angle. If the off-diagonal entry x is tiny, b² overflows in
    # float32; then |t| is 1/(2|b|).
    t = 1.0 / (size + jnp.where(size > 1e15, size, jnp.sqrt(1.0 + jnp.minimum(size, 1e15) ** 2)))
    t = jnp.where(none, 0.0, jnp.where(cot < 0, -t, t))
    c = 1.0 / jnp.sqrt(1.0 + t * t)
    s = t * c
    turned = [tuple(c * p - s * q for p, q in zip(v, w, strict=True))]
    turned.append(tuple(s * p + c * q for p, q in zip(v, w, strict=True)))
    diagonal = (first, second - t * x, third + t * x)
    # The rotation makes the off-diagonal entry (2, 3), which is x, zero, and turns the entries
    # (1, 3) and (1, 2), which are y and z, into each other.
    return diagonal, (jnp.zeros_like(x), s * z + c * y, c * z - s * y), (u, *turned)


def _exchange_to_ascending(
    eigenvalues: Sequence[Scalar], axes: Sequence[Triple], i: int, j: int
) -> tuple[Triple, tuple[Triple, ...]]:
    """Return two things after a comparison of the eigenvalues i and j: the three eigenvalues; and
    their three axes, each as three components.

    If eigenvalue i is larger than eigenvalue j, the two eigenvalues and their axes are exchanged,
    and one of the two axes is reversed, so that the axes stay right-handed.

    - `eigenvalues`, `axes`: the three eigenvalues and their three axes before the comparison.
    - `i`, `j`: two indices, 0 to 2.
    """
    wrong = eigenvalues[i] > eigenvalues[j]
    eigenvalues, axes = list(eigenvalues), list(axes)
    eigenvalues[i], eigenvalues[j] = (
        jnp.where(wrong, eigenvalues[j], eigenvalues[i]),
        jnp.where(wrong, eigenvalues[i], eigenvalues[j]),
    )
    a, b = axes[i], axes[j]
    axes[i] = tuple(jnp.where(wrong, y, x) for x, y in zip(a, b, strict=True))
    axes[j] = tuple(jnp.where(wrong, -x, y) for x, y in zip(a, b, strict=True))
    return tuple(eigenvalues), tuple(axes)
