"""Compute principal axes as a fixed frame, which is never differentiated.

In this frame the off-diagonal entries of the inertia tensor are exactly zero in value, but their
tangents are not.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rigidjax._types import Mat3, Scalar, Vec3
from rigidjax.exact.components3 import SymmetricEntries, Triple
from rigidjax.rotation.barrier import match_batch_axes, one_kernel

# The number of sweeps of Jacobi's cyclic method for eigenvalues; one sweep is three rotations. The
# method converges quadratically: four or five sweeps are enough for any symmetric 3×3 matrix, and
# six leave a margin.
_SWEEPS = 6


class PrincipalAxes(NamedTuple):
    """Hold an inertia tensor in principal axes, and the matrix with these axes as columns."""

    inertia: SymmetricEntries  # with ascending moments
    axes: Mat3


def principal_axes(tensor: Mat3) -> PrincipalAxes:
    """Return the principal axes by Jacobi's method, in which small moments keep their digits.

    Derivatives treat the axes as constants, because they have no derivative where two moments are
    equal.
    """
    columns, moments = _jacobi(jax.lax.stop_gradient(tensor))
    axes = jnp.stack([jnp.stack(row) for row in columns])
    return PrincipalAxes(tensor_in_axes(tensor, axes, moments), axes)


@jax.custom_jvp
def tensor_in_axes(tensor: Mat3, axes: Mat3, moments: Triple) -> SymmetricEntries:
    """Return the inertia tensor AᵀIA in the principal axes, the columns of A = `axes`.

    In value the result is the diagonal matrix of the `moments`. Its tangent for δI is AᵀδI A, with
    A held fixed: a full symmetric matrix.
    """
    zero = jnp.zeros_like(tensor[0, 0])
    return match_batch_axes((*moments, zero, zero, zero), (tensor, axes, moments))


@tensor_in_axes.defjvp
def _tensor_in_axes_jvp(
    primals: tuple[Mat3, Mat3, Triple], tangents: tuple[PyTree, ...]
) -> tuple[SymmetricEntries, SymmetricEntries]:
    """Return the tensor in principal axes and its tangent, with the axes held fixed."""
    # Take the symmetric part of the change of the tensor, so that a gradient is a symmetric matrix.
    axes, change = primals[1], 0.5 * (tangents[0] + tangents[0].T)
    # Write the two products of matrices as sums over their entries: on a GPU a product of matrices
    # is rounded to ten bits in float32.
    turned = jnp.sum(axes[:, :, None] * change[:, None], axis=0)
    m = jnp.sum(turned[:, None] * axes.T[None], axis=2)
    return tensor_in_axes(*primals), (m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])


def components_along(axes: Mat3, vector: Vec3 | Triple) -> Triple:
    """Return the components of a vector along the columns of `axes`."""
    return tuple(
        axes[0, i] * vector[0] + axes[1, i] * vector[1] + axes[2, i] * vector[2] for i in range(3)
    )


def combine_columns(axes: Mat3, components: Triple) -> Triple:
    """Return the vector with the `components` along the columns of `axes`."""
    return tuple(
        axes[i, 0] * components[0] + axes[i, 1] * components[1] + axes[i, 2] * components[2]
        for i in range(3)
    )


@one_kernel
def _jacobi(matrix: Mat3) -> tuple[list[list[Scalar]], Triple]:
    """Return the matrix, as its three rows, whose columns are the principal axes of a symmetric
    tensor, and the ascending moments, by Jacobi's method.
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
        # Turn the axes 2 and 3 so that the off-diagonal entry (2, 3), which is x, becomes zero.
        (first, second, third), (x, y, z), (u, v, w) = state
        none = x == 0
        cot = 0.5 * (third - second) / jnp.where(none, 1.0, x)
        size = jnp.abs(cot)
        # The tangent t of the angle of rotation is the smaller root of t² + 2bt − 1 = 0, where b is
        # the cotangent `cot` of twice the angle. If the off-diagonal entry x is tiny, b² overflows
        # in float32; then |t| is 1/(2|b|).
        root = jnp.where(size > 1e15, size, jnp.sqrt(1.0 + jnp.minimum(size, 1e15) ** 2))
        t = 1.0 / (size + root)
        t = jnp.where(none, 0.0, jnp.where(cot < 0, -t, t))
        c = 1.0 / jnp.sqrt(1.0 + t * t)
        s = t * c
        two = tuple(c * p - s * q for p, q in zip(v, w, strict=True))
        three = tuple(s * p + c * q for p, q in zip(v, w, strict=True))
        # The entries (1, 3) and (1, 2), which are y and z, turn into each other. The three axes are
        # then exchanged cyclically, so that the next rotation is of another pair: only one rotation
        # is compiled.
        diagonal = (second - t * x, third + t * x, first)
        off_diagonal = (s * z + c * y, c * z - s * y, jnp.zeros_like(x))
        return diagonal, off_diagonal, (two, three, u)

    # After the loop `axes` has the three principal axes, each as three components: they are the
    # columns, not the rows, of the matrix that is returned.
    diagonal, _, axes = jax.lax.fori_loop(0, 3 * _SWEEPS, rotate, (d, o, axes))
    d, axes = list(diagonal), list(axes)
    for i, j in ((0, 1), (1, 2), (0, 1)):
        # Exchange two moments that do not ascend, and their axes, of which one is reversed, so that
        # the axes stay right-handed.
        wrong, a, b = d[i] > d[j], axes[i], axes[j]
        d[i], d[j] = jnp.where(wrong, d[j], d[i]), jnp.where(wrong, d[i], d[j])
        axes[i] = tuple(jnp.where(wrong, y, x) for x, y in zip(a, b, strict=True))
        axes[j] = tuple(jnp.where(wrong, -x, y) for x, y in zip(a, b, strict=True))
    # The matrix A of the axes is a product of many rotations, whose rounding errors add up. Replace
    # it by the nearest orthonormal matrix, by one step A(3 − AᵀA)/2, where 3 is three times the
    # unit matrix (Higham 1986).
    m = [[axes[j][i] for j in range(3)] for i in range(3)]
    excess = [[sum(r[i] * r[j] for r in m) - float(i == j) for j in range(3)] for i in range(3)]
    columns = [
        [m[i][j] - 0.5 * sum(m[i][k] * excess[k][j] for k in range(3)) for j in range(3)]
        for i in range(3)
    ]
    return columns, tuple(c + shift for c in d)
