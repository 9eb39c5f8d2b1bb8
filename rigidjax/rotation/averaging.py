"""The mean of rotations."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Quat, Vec3
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import matrix_to_quaternion
from rigidjax.rotation.linalg3 import dot, hat, product, solve
from rigidjax.rotation.stumpff import inverse_kernel
from rigidjax.rotation.validation import rotation_matrix, unit_quaternion
from rigidjax.rotation.wahba import nearest, of_order_one, weights_of


def mean(matrices: Float[ArrayLike, "n 3 3"], weights: Float[ArrayLike, "n"] | None = None) -> Mat3:
    """The Karcher mean: the rotation least in Σ w_i |angle to R_i|².

    **Arguments:** `matrices` (n, 3, 3) rotations, within a quarter turn of the mean, where it is
    unique (Karcher 1977, doi:10.1002/cpa.3160300502); `weights` (n,), not negative.

    **Returns:** (3, 3), with first and second derivatives from the last two Newton steps alone.
    **Raises:** as `so3.check`, if the matrices are known now; `ValueError` for weights that make no
    mean.

    >>> mean(jnp.stack([jnp.eye(3), jnp.eye(3)])).round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    matrices = _checks.rows(matrices, (3, 3), "matrices")
    if _checks.known(matrices) and matrices.size:
        rotation_matrix(matrices, "matrices")
    weights_of(weights, matrices[:, 0, 0], "matrices")
    return quaternion.to_matrix(mean_quaternion(jax.vmap(matrix_to_quaternion)(matrices), weights))


def mean_quaternion(
    quaternions: Float[ArrayLike, "n 4"], weights: Float[ArrayLike, "n"] | None = None
) -> Quat:
    """The Karcher mean of unit quaternions; each may have either sign.

    **Arguments:** `quaternions` (n, 4); `weights` (n,). See `mean`. **Returns:** (4,), w ≥ 0.
    **Raises:** as `quaternion.check`, if they are known now.

    >>> mean_quaternion(jnp.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]])).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    q = _checks.rows(quaternions, (4,), "quaternions")
    if _checks.known(q) and q.size:
        unit_quaternion(q, "quaternions")
    return _karcher(q, of_order_one(weights_of(weights, q[:, 0], "quaternions")))


# Compiled once: called from the prompt, the loop would be compiled anew each time.
@partial(jax.jit, inline=True)
def _karcher(q: Float[Array, "n 4"], w: Float[Array, "n"]) -> Quat:

    def newton(_: Any, start: Quat, q: Array, w: Array) -> Quat:
        apart = jax.vmap(lambda each: quaternion.multiply(quaternion.conjugate(start), each))(q)
        v = jax.vmap(quaternion.log)(apart)
        slope = (w[:, None, None] * jax.vmap(_left_jacobian_inverse)(v)).sum(0)
        return quaternion.multiply(start, quaternion.exp(solve(slope, (w[:, None] * v).sum(0))))

    fixed_q, fixed_w = lax.stop_gradient((q, w))
    chord = (fixed_w[:, None, None] * jax.vmap(quaternion.to_matrix)(fixed_q)).sum(0)
    start = matrix_to_quaternion(nearest(chord))
    start = lax.fori_loop(0, 6, lambda i, s: newton(i, s, fixed_q, fixed_w), start)
    # Each Newton step from the solution doubles the order to which derivatives are right.
    for i in range(2):
        start = newton(i, lax.stop_gradient(start) if i == 0 else start, q, w)
    return quaternion.canonical(quaternion.normalise(start))


def _left_jacobian_inverse(v: Vec3) -> Mat3:
    h = hat(v)
    return jnp.eye(3, dtype=v.dtype) - 0.5 * h + inverse_kernel(dot(v, v)) * product(h, h)
