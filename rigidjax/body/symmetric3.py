"""Compute with symmetric 3×3 matrices on components, as `rigidjax.rotation.linalg3` does."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax._types import Mat3
from rigidjax.rotation.linalg3 import (
    apply as apply,
    cofactors,
    determinant,
    entries,
    product as product,
)


@jax.custom_jvp
def inverse(a: Mat3) -> Mat3:
    """Return the inverse of a symmetric matrix with trace > 0, by cofactors; it is infinite if an
    eigenvalue is zero.

    The matrix is divided by its trace first, so that the products of entries such as 1e-20 or 1e37
    kg m² neither underflow nor overflow.
    """
    # All entries come from one `lax.split`: an entry taken by an index would be compiled as a
    # kernel of its own.
    xx, _, _, _, yy, _, _, _, zz = entries(a)
    scale = xx + yy + zz
    unit = a / scale
    return cofactors(unit) / determinant(unit) / scale


@inverse.defjvp
def _inverse_jvp(primals: tuple[Mat3], tangents: tuple[PyTree, ...]) -> tuple[Mat3, Mat3]:
    """Return the inverse and its tangent −A⁻¹ dA A⁻¹."""
    (a,), (da,) = primals, tangents
    out = inverse(a)
    scale = a[0, 0] + a[1, 1] + a[2, 2]
    return out, -product(product(out * scale, da / scale), out)


# The row and column of each of the six entries, in the order of the arguments of `from_components`.
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def from_components(
    xx: Float[ArrayLike, ""],
    yy: Float[ArrayLike, ""],
    zz: Float[ArrayLike, ""],
    xy: Float[ArrayLike, ""],
    xz: Float[ArrayLike, ""],
    yz: Float[ArrayLike, ""],
) -> Mat3:
    """Return the symmetric matrix of six entries."""
    return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])


def outer(a: Float[Array, "3"], b: Float[Array, "3"]) -> Mat3:
    """Return the matrix a bᵀ."""
    return a[:, None] * b[None, :]


# `to_inertia` is compiled as one program: outside of `jit`, JAX would otherwise
# compile each of its operations as a program of its own.
@jax.jit
def to_inertia(
    second_moment: Float[Array, "*batch 3 3"],
) -> Float[Array, "*batch 3 3"]:
    """Return the inertia tensor `Tr(𝔖) 1 − 𝔖` (notes, eqs 76–78), whose diagonal is computed as 𝔖22
    + 𝔖33, …, so that no digit cancels.
    """
    x, y, z = second_moment[..., 0, 0], second_moment[..., 1, 1], second_moment[..., 2, 2]
    return _negative_matrix(second_moment, jnp.stack([y + z, z + x, x + y], axis=-1))


def to_second_moment(tensor: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the second moment `½ Tr(I) 1 − I` of an inertia tensor (notes, eqs 76–78 solved)."""
    x, y, z = tensor[..., 0, 0], tensor[..., 1, 1], tensor[..., 2, 2]
    return _negative_matrix(
        tensor, 0.5 * jnp.stack([(y - x) + z, (z - y) + x, (x - z) + y], axis=-1)
    )


def _negative_matrix(a: Array, diagonal: Array) -> Array:
    """Return −A, but with the given entries on the diagonal."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=bool), a.shape)
    return jnp.where(eye, jnp.broadcast_to(diagonal[..., None], a.shape), 0.0 - a)
