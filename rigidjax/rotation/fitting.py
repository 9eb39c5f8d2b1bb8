"""Find the rotation that fits best: projection, alignment, Wahba's problem, the mean of rotations.

Singular values and eigenvectors are not used: their derivatives are NaN at every rotation, where
all three singular values are 1. Let R be the rotation that fits a 3×3 matrix B best, that is, with
the largest Tr(RᵀB). A change dB changes R by dR = R hat(x), where hat(x) is the matrix of the cross
product with x. The vector x solves (Tr(S) 1 − S) x = 2 vee(Rᵀ dB), where S is the symmetric part of
RᵀB, and vee gives the vector of the antisymmetric part of a matrix. The derivative is regular if R
is unique.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax._types import Mat3, Mat3Like, Quat, Scalar, Vec3, Vec3Like
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import left_jacobian_inverse, matrix_to_quaternion
from rigidjax.rotation.linalg3 import (
    cofactors,
    cross,
    determinant,
    dot,
    hat,
    power_of_two_scale,
    product,
    solve,
    vee,
)
from rigidjax.rotation.validation import (
    require_direction,
    require_rotation,
    require_unit,
)

# Newton's method of `wahba` takes three to six steps where the directions fix the rotation well.
_MOST_STEPS = 20


def project(matrix: Mat3Like) -> Mat3:
    """Return the rotation nearest to a matrix (Frobenius norm); its derivative is correct also if
    the matrix is a rotation already.

    **Arguments:** `matrix` (3, 3), det > 0. **Returns:** (3, 3) with RᵀR = 1 to round-off.
    **Raises:** `ValueError` if a known matrix is left-handed (no rotation is nearest to a mirror
    image), singular to round-off, or not finite. Traced values are not checked: under `jit`, test
    det > 0 in your own program.

    >>> project(2.0 * jnp.eye(3)).round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    matrix = _checks.array_of_shape(matrix, (3, 3), "matrix")
    if _checks.is_known(matrix):
        _checks.require_finite(matrix, "matrix")
        require_direction(matrix.reshape(9), "matrix")
        size = np.max(np.abs(np.asarray(matrix)))
        scaled = np.asarray(matrix) / size
        # The determinant is that of the matrix divided by its largest entry: without the division
        # the determinant may overflow.
        det, singular = np.linalg.det(scaled), np.linalg.svd(scaled)[1]
        if det <= 0:
            words = f"left-handed frame or singular, det = {det:.3g}; wanted det > 0, without which"
            raise ValueError(f"matrix: {words} no rotation is nearest")
        # A turn about the longest axis then changes the distance by less than its round-off.
        if singular[1] + singular[2] < float(jnp.finfo(matrix.dtype).eps) ** 0.5 * singular[0]:
            words = "all but singular: many rotations are equally near to round-off"
            raise ValueError(f"matrix: {words}; its singular values are {singular * size}")
    return nearest_rotation(matrix)


def wahba(
    body: Float[ArrayLike, "n 3"],
    world: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
) -> Mat3:
    """Return the rotation M, body → world, that minimises Σ w_i |world_i − M body_i|² (Wahba 1965).

    **Arguments:** `body`, `world` (n, 3), n ≥ 2: the same directions in both frames, any units;
    `weights` (n,), not negative, 1 if not given; the ratio of two weights may be up to 1e13 (1e5 in
    float32). The method solves the quartic of Markley 1993 (FOAM, J. Astronaut. Sci. 41, 261), then
    takes steps of Newton's method on the rotation group.

    **Raises:** an error, also under `jit`, if the directions do not determine the rotation: if
    there are fewer than two, or if all are parallel to within 5e-4 rad (float32: 4°), where half
    the digits would be lost, or if they contradict each other so that two rotations fit about
    equally well; `ValueError` for known NaN, and for directions that are all zero.

    >>> wahba(jnp.eye(3)[:2], jnp.eye(3)[:2]).round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    body = _checks.array_of_rows(body, (3,), "body")
    world = _checks.array_of_shape(world, body.shape, "world")
    w = checked_weights(weights, body[:, 0], "body")
    for name, rows in (("body", body), ("world", world)):
        require_direction(rows.reshape(-1), name)
    w, world, body = (of_order_one(x) for x in (w, world, body))
    words = "wahba: these directions do not fix the attitude; two that are not parallel are needed"
    heavy, those, these = lax.stop_gradient((w, world, body))
    best, last = _newton(w, world, body)
    # The determinant `firmness` in the loop below is (σ1 + σ2)(σ2 + σ3)(σ3 + σ1) with the singular
    # values σ of b, a sum of products of directions; σ3 has the sign of det b. The determinant is 0
    # if the directions leave the turn about some axis free.
    eps = float(jnp.finfo(w.dtype).eps)
    loose, seen, one = jnp.zeros((), bool), jnp.sign(heavy), jnp.eye(3, dtype=w.dtype)
    # The first two rows of this loop test the directions of each frame by themselves, without
    # weights. They use the identity, the best rotation from these directions to themselves; the
    # third row tests the weighted pairs, which `best` fits.
    for turn, b, least in (
        (one, _outer_sum(seen, those, those), 4 * eps**0.5),
        (one, _outer_sum(seen, these, these), 4 * eps**0.5),
        (lax.stop_gradient(best), _outer_sum(heavy, those, these), 64 * eps),
    ):
        firmness = determinant(_curvature(turn, b / jnp.sqrt((b * b).sum())))
        loose = loose | ~(firmness > least)
    best = _checks.error_if(best, loose, words)
    words = f"wahba: Newton's method did not arrive in {_MOST_STEPS} steps: the directions "
    words += "contradict each other so that two attitudes fit about equally well; look at them and "
    words += "their weights"
    return _checks.error_if(best, ~(last <= eps**0.5), words)


# `_newton` is compiled once: outside of `jit` its loop would be compiled at each call.
@partial(jax.jit, inline=True)
def _newton(
    weights: Float[Array, "n"], world: Float[Array, "n 3"], body: Float[Array, "n 3"]
) -> tuple[Mat3, Scalar]:
    """Return the rotation that solves Wahba's problem, and the size of the last step, rad, which is
    small if Newton's method has arrived.
    """
    fixed = lax.stop_gradient((weights, world, body))

    def step(state: tuple[Array, Mat3, Scalar]) -> tuple[Array, Mat3, Scalar]:
        count, rotation, _ = state
        turn = _newton_turn(rotation, *fixed)
        rotation = product(quaternion.to_matrix(quaternion.exp(turn)), rotation)
        return count + 1, rotation, jnp.max(jnp.abs(turn))

    # A step smaller than this leaves an error of round-off, as Newton's method squares errors.
    least = float(jnp.finfo(weights.dtype).eps) ** 0.5
    begin = jnp.asarray(0), _estimate(*fixed), jnp.ones((), weights.dtype)
    _, best, last = lax.while_loop(lambda s: ~(s[2] <= least) & (s[0] < _MOST_STEPS), step, begin)
    # Only these last two Newton steps are differentiated: after one step the first derivatives
    # are right, after two steps the second derivatives, too.
    for _ in range(2):
        turn = _newton_turn(best, weights, world, body)
        best = product(quaternion.to_matrix(quaternion.exp(turn)), best)
    return best, last


def _estimate(
    weights: Float[Array, "n"], world: Float[Array, "n 3"], body: Float[Array, "n 3"]
) -> Mat3:
    """Return the better of two rotations near the solution of Wahba's problem.

    The first one, from one sum over all pairs, loses the digits of light pairs beside a heavy one.
    The second one is the limit of an infinite weight of the heaviest pair: it fits this pair
    exactly, and the others by the turn about its direction.
    """
    size = weights * jnp.sqrt((world * world).sum(-1) * (body * body).sum(-1))
    heaviest = jnp.argmax(size)
    axis = world[heaviest] / jnp.sqrt(dot(world[heaviest], world[heaviest]))
    aligned = align(body[heaviest], axis)
    moved = (aligned[None] * body[:, None, :]).sum(-1)
    light = jnp.where(jnp.arange(size.size) == heaviest, 0, weights)
    along, beside = ((x * axis[None]).sum(-1) for x in (world, moved))
    across = (world * moved).sum(-1) - along * beside
    around = (jax.vmap(cross)(moved, world) * axis[None]).sum(-1)
    angle = jnp.arctan2((light * around).sum(), (light * across).sum())
    limit = product(quaternion.to_matrix(quaternion.exp(angle * axis)), aligned)
    both = nearest_rotation(_outer_sum(weights, world, body)), limit
    costs = []
    for rotation in both:
        _, ratio, apart = _turned_directions(rotation, world, body)
        costs.append((weights * (apart * apart).sum(-1) / jnp.where(ratio > 0, ratio, 1)).sum())
    return jnp.where(costs[1] < costs[0], *reversed(both))


class Turned(NamedTuple):
    """Hold directions bᵢ of the body, turned by a rotation M, beside directions aᵢ of the world."""

    moved: Float[Array, "n 3"]  # M bᵢ
    ratio: Float[Array, "n"]  # |M bᵢ|/|aᵢ|
    apart: Float[Array, "n 3"]  # M bᵢ minus aᵢ times the ratio


def _turned_directions(
    rotation: Mat3, world: Float[Array, "n 3"], body: Float[Array, "n 3"]
) -> Turned:
    """Return turned directions; `apart` is small where M fits, and so is its round-off."""
    moved = (rotation[None] * body[:, None, :]).sum(-1)
    # The derivative of the ratio of the lengths makes the derivative of the difference small, too,
    # if the length of a direction with a large weight changes.
    squares = [(x * x).sum(-1) for x in (moved, world)]
    lengths = [jnp.sqrt(jnp.where(square > 0, square, 1)) for square in squares]
    ratio = lengths[0] / lengths[1]
    return Turned(moved, ratio, moved - ratio[:, None] * world)


def _outer_sum(
    weights: Float[Array, "n"], world: Float[Array, "n 3"], body: Float[Array, "n 3"]
) -> Mat3:
    """Return the matrix Σ wᵢ aᵢ bᵢᵀ of directions aᵢ in the world and bᵢ in the body."""
    return (weights[:, None, None] * world[:, :, None] * body[:, None, :]).sum(0)


def _newton_turn(
    rotation: Mat3,
    weights: Float[Array, "n"],
    world: Float[Array, "n 3"],
    body: Float[Array, "n 3"],
) -> Vec3:
    """Return Newton's step to the M with the largest Σ wᵢ aᵢ · M bᵢ, a world rotation vector.

    The cross product of aᵢ and M bᵢ is computed from the small difference of these two vectors:
    otherwise the rounding of a direction with a large weight would turn the body about it.
    """
    moved, _, apart = _turned_directions(rotation, world, body)
    moment = (weights[:, None] * jax.vmap(cross)(apart, world)).sum(0)
    one = jnp.eye(3, dtype=weights.dtype)
    outer = _outer_sum(weights, moved, world)
    return solve(_curvature(one, outer), moment)


def align(a: Vec3Like, b: Vec3Like) -> Mat3:
    """Return the smallest rotation that turns the direction of a into the direction of b.

    **Arguments:** `a`, `b` (3,), in one frame, any lengths. **Returns:** (3, 3), R a ∥ b. If a and
    b are opposite to round-off, the rotation is half a turn about a normal to a, as near as
    possible to the basis vector along which a is smallest. For unit vectors a and b the quaternion
    is (½|m|, a × m/|m|) with m = a + b; this form keeps its digits if a and b are nearly opposite.
    **Raises:** `ValueError` for known zero or NaN.

    >>> align(jnp.array([1.0, 0, 0]), jnp.array([0, 2.0, 0])).round(12)[:, 0].tolist()
    [0.0, 1.0, 0.0]
    """
    a, b = _checks.array_of_shape(a, (3,), "a"), _checks.array_of_shape(b, (3,), "b")
    a, b = (of_order_one(require_direction(x, name)) for x, name in ((a, "a"), (b, "b")))
    a, b = a / jnp.sqrt(dot(a, a)), b / jnp.sqrt(dot(b, b))
    middle = a + b
    n2, normal = dot(middle, middle), cross(a, middle)
    # The lengths of a and b are 1 only to round-off: if a and b are opposite, their sum `middle` is
    # round-off that may lie along a.
    least = 2 * float(jnp.finfo(a.dtype).eps)
    opposite = (n2 < 1) & (dot(normal, normal) <= least * least)
    length = jnp.sqrt(jnp.where(opposite, 1, n2))
    smallest = jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(a))]
    across = smallest - dot(smallest, a) * a
    axis = jnp.where(opposite, across / jnp.sqrt(dot(across, across)), normal / length)
    w = jnp.where(opposite, 0, 0.5 * length)
    return quaternion.to_matrix(quaternion.normalise(jnp.concatenate([w[None], axis])))


def mean(matrices: Float[ArrayLike, "n 3 3"], weights: Float[ArrayLike, "n"] | None = None) -> Mat3:
    """Return the Karcher mean of rotations R_i: the rotation that minimises Σ w_i θ_i², with the
    weights w_i and the angles θ_i to R_i.

    **Arguments:** `matrices` (n, 3, 3) rotations within a quarter turn of the mean: the mean is
    then unique (Karcher 1977, doi:10.1002/cpa.3160300502); `weights` (n,), not negative.
    **Returns:** (3, 3). Its first and second derivatives come from the last two Newton steps alone.
    **Raises:** as `so3.check` for known matrices; `ValueError` for weights that are negative or all
    zero.

    >>> mean(jnp.stack([jnp.eye(3), jnp.eye(3)])).round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    matrices = _checks.array_of_rows(matrices, (3, 3), "matrices")
    _checks.check_if_known(require_rotation, matrices, "matrices")
    checked_weights(weights, matrices[:, 0, 0], "matrices")
    return quaternion.to_matrix(mean_quaternion(jax.vmap(matrix_to_quaternion)(matrices), weights))


def mean_quaternion(
    quaternions: Float[ArrayLike, "n 4"], weights: Float[ArrayLike, "n"] | None = None
) -> Quat:
    """Return the Karcher mean of unit quaternions; each may have either sign.

    **Arguments:** `quaternions` (n, 4); `weights` (n,). See `mean`. **Returns:** (4,), w ≥ 0.
    **Raises:** as `quaternion.check`, for known values.

    >>> mean_quaternion(jnp.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]])).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    q = _checks.array_of_rows(quaternions, (4,), "quaternions")
    _checks.check_if_known(require_unit, q, "quaternions")
    return _karcher_mean(q, of_order_one(checked_weights(weights, q[:, 0], "quaternions")))


# `_karcher_mean` is compiled once: outside of `jit` its loop would be compiled again at each call.
@partial(jax.jit, inline=True)
def _karcher_mean(quaternions: Float[Array, "n 4"], weights: Float[Array, "n"]) -> Quat:
    """Return the Karcher mean of rotations by Newton's method, for quaternions of any sign."""

    def newton(_: Array | int, start: Quat, q: Array, w: Array) -> Quat:
        apart = jax.vmap(lambda each: quaternion.multiply(quaternion.conjugate(start), each))(q)
        v = jax.vmap(quaternion.log)(apart)
        slope = (w[:, None, None] * jax.vmap(left_jacobian_inverse)(v)).sum(0)
        return quaternion.multiply(start, quaternion.exp(solve(slope, (w[:, None] * v).sum(0))))

    fixed_q, fixed_w = lax.stop_gradient((quaternions, weights))
    chord = (fixed_w[:, None, None] * jax.vmap(quaternion.to_matrix)(fixed_q)).sum(0)
    start = matrix_to_quaternion(nearest_rotation(chord))
    start = lax.fori_loop(0, 6, lambda i, s: newton(i, s, fixed_q, fixed_w), start)
    # Only these last two Newton steps are differentiated: after one step the first derivatives
    # are right, after two steps the second derivatives, too.
    for i in range(2):
        start = newton(i, lax.stop_gradient(start) if i == 0 else start, quaternions, weights)
    return quaternion.canonical(quaternion.normalise(start))


def of_order_one(x: Array) -> Array:
    """Return x times a power of two so that its largest entry is near 1, for a formula in which the
    scale cancels and a product could overflow.
    """
    return power_of_two_scale(jnp.max(jnp.abs(x))) * x


def checked_weights(weights: ArrayLike | None, rows: Array, description: str) -> Array:
    """Return the weights of the items in `rows`, or ones in their dtype for `None`, after checks;
    `description` names the items in messages.
    """
    if rows.shape[0] == 0:
        raise ValueError(f"{description}: wanted at least one row, got none")
    if weights is None:
        return jnp.ones_like(rows)
    w = _checks.array_of_shape(weights, rows.shape, "weights")
    if _checks.is_known(w):
        words = "numbers ≥ 0, at least one of them positive"
        _checks.require_finite(w, "weights")
        _checks.require_positive(w, "weights", words, allow_zero=True)
        _checks.error_if(w, ~(w > 0).any(), f"weights: wanted {words}")
    return w


def _root_and_zeta(b: Mat3) -> tuple[Scalar, Scalar]:
    """Return λ, the sum of the singular values of b, of Frobenius norm 1, in which the least one is
    negative if det b is; and ζ = ½ (λ² − 1) λ − det b (Markley 1993).

    λ is the largest root of a quartic equation, found by Newton's method.
    """
    det, adjugate = determinant(b), cofactors(b)
    flat = 4 * (adjugate * adjugate).sum()

    def newton(_: Array | int, root: Scalar) -> Scalar:
        excess = root * root - 1
        slope = 4 * root * excess - 8 * det
        return root - (excess * excess - 8 * det * root - flat) / jnp.where(slope > 0, slope, 1)

    # Newton's method for the quartic equation starts at √3, which is not below the largest root,
    # and comes down to this root without overshooting.
    root = lax.fori_loop(0, 40, newton, jnp.full_like(det, np.sqrt(3)))
    return root, 0.5 * (root * root - 1) * root - det


def _curvature(rotation: Mat3, b: Mat3) -> Mat3:
    """Return the matrix Tr(S) 1 − S, where S is the symmetric part of Rᵀb: minus the second
    derivative of Tr((R exp(x))ᵀ b) by a rotation vector x, at x = 0.
    """
    m = product(rotation.T, b)
    s = 0.5 * (m + m.T)
    return (s[0, 0] + s[1, 1] + s[2, 2]) * jnp.eye(3, dtype=rotation.dtype) - s


@jax.custom_jvp
def nearest_rotation(b: Mat3) -> Mat3:
    """Return the rotation R nearest to a matrix b: that with the largest Tr(Rᵀb)."""
    b = of_order_one(b)
    b = b / jnp.sqrt((b * b).sum())
    root, zeta = _root_and_zeta(b)
    kappa = 0.5 * (root * root - 1)
    rough = ((kappa + 1) * b + root * cofactors(b) - product(b, product(b.T, b))) / zeta
    q = matrix_to_quaternion(rough)
    # The root of Markley's quartic equation may have only half its digits. Newton steps on the
    # rotation group then give all digits of the rotation.
    for _ in range(3):
        r = quaternion.to_matrix(q)
        turn = solve(_curvature(r, b), 2 * vee(product(r.T, b)))
        q = quaternion.normalise(quaternion.multiply(q, quaternion.exp(turn)))
    # The matrix of a quaternion is orthogonal to ten units of round-off. The first term of the
    # series of (RᵀR)^(−½) makes it orthogonal to two.
    r = quaternion.to_matrix(q)
    return r + product(r, 0.5 * (jnp.eye(3, dtype=r.dtype) - product(r.T, r)))


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[Mat3], tangents: tuple[PyTree, ...]) -> tuple[Mat3, Mat3]:
    """Return the nearest rotation and its tangent, by the equation in the head of this module."""
    (b,), (db,) = primals, tangents
    r = nearest_rotation(b)
    # The entries of `b` may have any size: `b` and `db` are multiplied by a common factor, which
    # does not change the rotation or its derivative.
    scale = power_of_two_scale(jnp.max(jnp.abs(b)))
    b, db = scale * b, scale * db
    return r, product(r, hat(solve(_curvature(r, b), 2 * vee(product(r.T, db)))))
