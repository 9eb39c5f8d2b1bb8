"""Compute principal axes as a fixed frame, which is never differentiated.

In this frame the off-diagonal entries of the inertia tensor are exactly zero in value, but their
tangents (the changes in a derivative) are not.
"""

import jax
import jax.numpy as jnp

from rigidjax._types import Mat3, Scalar, Vec3
from rigidjax.exact.components3 import Six, Triple
from rigidjax.rotation.barrier import batch_as, compiled_as_one_kernel

# Jacobi's cyclic method converges quadratically; a 3×3 matrix needs four or five sweeps from
# anywhere.
_SWEEPS = 6


def principal_frame(tensor: Mat3) -> tuple[Six, Mat3]:
    """Return two things: the entries of the inertia tensor in principal axes, with the moments
    ascending; and the rotation matrix A whose columns are these axes.

    The method is Jacobi's, in which small moments keep their digits. A is held fixed in
    derivatives.
    """
    columns, moments = _jacobi(jax.lax.stop_gradient(tensor))
    axes = jnp.stack([jnp.stack(row) for row in columns])
    return tensor_in_axes(tensor, axes, moments), axes


@jax.custom_jvp
def tensor_in_axes(tensor: Mat3, axes: Mat3, moments: Triple) -> Six:
    """Return `AᵀIA`, where A = `axes` are principal axes of I = `tensor`.

    Its value is the diagonal matrix of `moments`; its derivative is a full symmetric matrix.
    """
    zero = jnp.zeros_like(tensor[0, 0])
    return batch_as((*moments, zero, zero, zero), (tensor, axes, moments))


@tensor_in_axes.defjvp
def _tensor_in_axes_jvp(primals, tangents):
    # Take the change of a symmetric matrix, so that a gradient is symmetric.
    axes, change = primals[1], 0.5 * (tangents[0] + tangents[0].T)
    # Sum products of entries: on a GPU a product of matrices is rounded to ten bits in float32.
    turned = jnp.sum(axes[:, :, None] * change[:, None], axis=0)
    m = jnp.sum(turned[:, None] * axes.T[None], axis=2)
    return tensor_in_axes(*primals), (m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])


def components_along(axes: Mat3, v: Vec3 | Triple) -> Triple:
    """Return the components of `v` along the columns of `axes`."""
    return tuple(axes[0, i] * v[0] + axes[1, i] * v[1] + axes[2, i] * v[2] for i in range(3))


def combine_columns(axes: Mat3, v: Triple) -> Triple:
    """Return the vector with the components `v` along the columns of `axes`.

    This is the inverse of `components_along`.
    """
    return tuple(axes[i, 0] * v[0] + axes[i, 1] * v[1] + axes[i, 2] * v[2] for i in range(3))


@compiled_as_one_kernel
def _jacobi(m: Mat3) -> tuple[list[list[Scalar]], Triple]:
    """Return the rows of the matrix whose columns are principal axes of m, and the moments, by
    Jacobi's method.
    """
    one, zero = jnp.ones_like(m[0, 0]), jnp.zeros_like(m[0, 0])
    # Subtract a shift from nearly equal moments: it is exact by Sterbenz' lemma, and so the moments
    # keep their differences.
    least = jnp.minimum(jnp.minimum(m[0, 0], m[1, 1]), m[2, 2])
    most = jnp.maximum(jnp.maximum(m[0, 0], m[1, 1]), m[2, 2])
    shift = jnp.where(2.0 * least >= most, least, zero)
    d = (m[0, 0] - shift, m[1, 1] - shift, m[2, 2] - shift)
    o = tuple(0.5 * (m[i, j] + m[j, i]) for i, j in ((1, 2), (0, 2), (0, 1)))
    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))

    def rotate(_, state):
        # Always rotate the last two axes, then move each axis on by one place: only one rotation is
        # then compiled.
        d, o, axes = _rotate(*state)
        return tuple((x[1], x[2], x[0]) for x in (d, o, axes))

    # Each entry axes[i] is the i-th axis, a column of the matrix.
    d, _, axes = jax.lax.fori_loop(0, 3 * _SWEEPS, rotate, (d, o, axes))
    for i, j in ((0, 1), (1, 2), (0, 1)):
        d, axes = _exchange_to_ascending(d, axes, i, j)
    columns = _orthonormalise([[axes[j][i] for j in range(3)] for i in range(3)])
    return columns, tuple(c + shift for c in d)


def _orthonormalise(a):
    """Return the matrix A(3 − AᵀA)/2, which makes a product A of many rotations orthonormal to
    round-off again (Higham 1986).
    """
    excess = [
        [
            a[0][i] * a[0][j] + a[1][i] * a[1][j] + a[2][i] * a[2][j] - float(i == j)
            for j in range(3)
        ]
        for i in range(3)
    ]
    return [
        [a[i][j] - 0.5 * sum(a[i][k] * excess[k][j] for k in range(3)) for j in range(3)]
        for i in range(3)
    ]


def _rotate(d, o, axes):
    """Return the state after a rotation of the last two axes that makes their off-diagonal entry
    zero.

    `d` holds the diagonal entries, `o[k]` the off-diagonal entry of the two axes other than k, and
    `axes` the axes.
    """
    (first, second, third), (x, y, z), (u, v, w) = d, o, axes
    none = x == 0
    cot = 0.5 * (third - second) / jnp.where(none, 1.0, x)
    size = jnp.abs(cot)
    # For a tiny x, √(1 + cot²) overflows in float32; then t = 1/(2 cot).
    t = 1.0 / (size + jnp.where(size > 1e15, size, jnp.sqrt(1.0 + jnp.minimum(size, 1e15) ** 2)))
    t = jnp.where(none, 0.0, jnp.where(cot < 0, -t, t))
    c = 1.0 / jnp.sqrt(1.0 + t * t)
    s = t * c
    turned = [tuple(c * p - s * q for p, q in zip(v, w, strict=True))]
    turned.append(tuple(s * p + c * q for p, q in zip(v, w, strict=True)))
    d = (first, second - t * x, third + t * x)
    # The off-diagonal entry (first, second) is z, and the entry (first, third) is y.
    return d, (jnp.zeros_like(x), s * z + c * y, c * z - s * y), (u, *turned)


def _exchange_to_ascending(d, axes, i, j):
    """Return the diagonal `d` and the `axes`; if d[i] > d[j], the entries and axes i and j are
    exchanged, and one of the two axes is reversed.
    """
    wrong = d[i] > d[j]
    d, axes = list(d), list(axes)
    d[i], d[j] = jnp.where(wrong, d[j], d[i]), jnp.where(wrong, d[i], d[j])
    a, b = axes[i], axes[j]
    axes[i] = tuple(jnp.where(wrong, y, x) for x, y in zip(a, b, strict=True))
    axes[j] = tuple(jnp.where(wrong, -x, y) for x, y in zip(a, b, strict=True))
    return tuple(d), tuple(axes)
