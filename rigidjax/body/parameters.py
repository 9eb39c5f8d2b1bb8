"""Convert unconstrained numbers to real bodies, and back.

The second moment 𝔖 is proportional to the square of a symmetric matrix, (1 + V)², where 1 is the
unit matrix and V has the trace zero. Every vector of numbers then describes a real body, and an
optimiser needs no constraint. Plates and rods are no exception: for them 1 + V has a zero
eigenvalue. If 1 + V has a negative eigenvalue, another vector, without a negative eigenvalue,
describes the same body; `pack` returns this other vector.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr
from rigidjax._types import Mat3, Matrix, Numbers, Scalar, Vec3, Vector
from rigidjax.body.inertia import MassProperties
from rigidjax.body.principal_axes import eigensystem
from rigidjax.body.symmetric3 import apply, from_components, product
from rigidjax.body.validation import require_physical_moments, require_second_moment
from rigidjax.rotation.linalg3 import cross

# A body counts as flat if its least principal second moment is below this fraction of the sum of
# its three principal second moments.
FLAT = 1e-3


def pack(body: MassProperties) -> Float[Array, "10"]:
    """Return ten unconstrained numbers that describe a body.

    **Arguments:** `body`, also a plate or a rod. **Returns** (10,) `(α, ρ, d1, d2, s12, s23, s13,
    t1, t2, t3)`: `mass = e^{2α}`, and `com = t` (m, body frame). The six numbers from ρ to s13
    describe `𝔖 / mass`, in m², as `pack_second_moment` does for a second moment; 𝔖 is the second
    moment about the centre of mass, and ρ is the logarithm of a length in metres. **Raises:**
    `ValueError` (`equinox` error under `jit`) for a point mass, whose 𝔖 is zero.

    >>> vector = pack(rj.shapes.box(2.0, [0.1, 0.2, 0.3]))
    >>> round(float(unpack(vector).mass), 12)
    2.0
    """
    hint = "for an Inertia use pack_second_moment(body.second_moment), or pack_shape"
    _checks.require_unbatched_instance(body, MassProperties, "body", hint=hint)
    alpha = _limit_exponent(0.5 * jnp.log(body.mass), jnp.expm1)
    shape = _six_numbers(body.second_moment / body.mass)
    return jnp.concatenate([alpha[None], shape, body.com])


def unpack(vector: Float[ArrayLike, "10"] | Numbers) -> MassProperties:
    """Return the body that ten unconstrained numbers describe; any ten numbers describe a body.

    **Arguments:** `vector` (10,) as `pack` returns it. An exponent α or α + ρ beyond ±330 (in
    float32 ±31) is replaced by one that grows only logarithmically, since the mass or size would
    overflow: a step of an optimiser that is much too long gives a large body, not an infinite one.

    >>> unpack(jnp.zeros(10)).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """
    v = _checks.array_of_shape(vector, (10,), "vector")
    alpha = _limit_exponent(v[0])
    size = 3.0 * jnp.exp(2.0 * _limit_exponent(alpha + v[1]))
    return MassProperties(jnp.exp(2.0 * alpha), v[7:10], size * _from_shape(v[2:7]))


def pack_second_moment(second_moment: Matrix) -> Float[Array, "6"]:
    """Return six unconstrained numbers that describe a second moment.

    **Arguments:** `second_moment` (3, 3) 𝔖, kg m², positive semi-definite. **Returns** (6,) `(ρ,
    d1, d2, s12, s23, s13)`: `Tr 𝔖 = 3 e^{2ρ}`, and the other five as in `pack_shape`. **Raises:**
    `ValueError` (`equinox` error under `jit`) for an invalid or zero second moment.

    >>> pack_second_moment(jnp.eye(3))
    Array([0., 0., 0., 0., 0., 0.], dtype=float64)
    """
    return _six_numbers(_checks.array_of_shape(second_moment, (3, 3), "second_moment"))


def unpack_second_moment(vector: Float[ArrayLike, "6"] | Numbers) -> Mat3:
    """Return the second moment (3, 3), kg m², that a `vector` (6,) of `pack_second_moment`
    describes; any six numbers describe a second moment.

    >>> unpack_second_moment(jnp.zeros(6))[0]
    Array([1., 0., 0.], dtype=float64)
    """
    v = _checks.array_of_shape(vector, (6,), "vector")
    return 3.0 * jnp.exp(2.0 * _limit_exponent(v[0])) * _from_shape(v[1:])


def pack_shape(second_moment: Matrix) -> Float[Array, "5"]:
    """Return five unconstrained numbers that describe a second moment up to a factor, as free
    motion determines it.

    **Arguments:** `second_moment` (3, 3) 𝔖, positive semi-definite, any units. **Returns** (5,)
    `(d1, d2, s12, s23, s13)`: the root √𝔖 scaled to trace 3 is `1 + V`, where V is symmetric with
    the diagonal `(d1, d2, −d1 − d2)` and the other entries `s_ij`. **Raises:** `ValueError`
    (`equinox` error under `jit`) for an invalid or zero second moment.

    >>> pack_shape(jnp.diag(jnp.array([4.0, 4.0, 0.0])))  # a plate
    Array([0.5, 0.5, 0. , 0. , 0. ], dtype=float64)
    """
    return _six_numbers(_checks.array_of_shape(second_moment, (3, 3), "second_moment"))[1:]


def unpack_shape(vector: Float[ArrayLike, "5"] | Numbers) -> Mat3:
    """Return the second moment (3, 3) that a `vector` (5,) of `pack_shape` describes, scaled to
    trace 1; the trace of the inertia tensor is then 2.

    >>> float(jnp.trace(unpack_shape(jnp.ones(5))))
    1.0
    """
    return _from_shape(_checks.array_of_shape(vector, (5,), "vector"))


def pack_moments(moments: Vector) -> Float[Array, "3"]:
    """Return three unconstrained numbers that describe principal moments whose axes are known.

    **Arguments:** `moments` (3,) I1, I2, I3 in any order, kg m². **Returns** (3,) `(ρ, d1, d2)` as
    in `pack_second_moment`, for the principal second moments `λ1 = ½(I2 + I3 − I1)`, … (notes, eqs
    76–78). **Raises:** `ValueError` (`equinox` error under `jit`) for moments that no body has, and
    for moments of zero.

    >>> pack_moments([2.0, 2.0, 2.0])
    Array([0., 0., 0.], dtype=float64)
    """
    i = require_physical_moments(_checks.array_of_shape(moments, (3,), "moments"))
    s = 0.5 * jnp.stack([(i[1] - i[0]) + i[2], (i[2] - i[1]) + i[0], (i[0] - i[2]) + i[1]])
    total = _positive_trace(s[0] + s[1] + s[2])
    root = jnp.sqrt(jnp.maximum(_divide_by_large(s, total), 0.0))
    size = _limit_exponent(0.5 * jnp.log(total / 3.0), jnp.expm1)
    return jnp.stack([size, *(3.0 * root[:2] / (root[0] + root[1] + root[2]) - 1.0)])


def unpack_moments(vector: Float[ArrayLike, "3"] | Numbers) -> Vec3:
    """Return the principal moments (3,), kg m², that a `vector` (3,) of `pack_moments` describes;
    any three numbers describe the moments of a real body.

    >>> unpack_moments([0.0, 0.0, 0.0])
    Array([2., 2., 2.], dtype=float64)
    """
    v = _checks.array_of_shape(vector, (3,), "vector")
    root = jnp.stack([1.0 + v[1], 1.0 + v[2], 1.0 - v[1] - v[2]])
    root = root / jax.lax.stop_gradient(jnp.max(jnp.abs(root)))
    a, b, c = root * root / jnp.sum(root * root)
    s = 3.0 * jnp.exp(2.0 * _limit_exponent(v[0]))
    return s * jnp.stack([b + c, c + a, a + b])


def curvature_rows_near_flat_body(
    shape: Float[ArrayLike, "5"] | Numbers, misfit_gradient: Float[ArrayLike, "5"] | Numbers
) -> Float[Array, "3 5"]:
    """Return three rows b of five numbers, (3, 5), for a fit of a body that is nearly flat. The
    Gauss–Newton method approximates the second derivative of the cost by products of first
    derivatives; the sum of the matrices b bᵀ is what this approximation leaves out near a flat
    body.

    Let A = 1 + V be the root of the second moment, where V is the matrix of `pack_shape`, a the
    least eigenvalue of A, and n its unit eigenvector. The least second moment is the square λ = a².
    The sum of b bᵀ is its second derivative, `d²λ = 2 |dA n|²`, multiplied by the derivative of the
    cost with respect to λ, which follows from the component along n nᵀ of the derivative with
    respect to A. The rows are zero for a body that is not flat, and for a cost that does not
    decrease as λ decreases.

    **Arguments:** `shape` (5,) as in `pack_shape`; `misfit_gradient` (5,) the derivative of
    the cost with respect to `shape`.

    >>> plate = pack_shape(jnp.diag(jnp.array([4.0, 4.0, 1e-12])))
    >>> curvature_rows_near_flat_body(plate, -1e-6 * jnp.ones(5)).shape
    (3, 5)
    """
    shape = _checks.array_of_shape(shape, (5,), "shape")
    misfit_gradient = _checks.array_of_shape(misfit_gradient, (5,), "misfit_gradient")
    root = _root(shape)
    # The eigenvector n is computed from the adjugate of A, the matrix `root`: for a flat body all
    # columns of the adjugate are along n. A fit needs n in every step, and the adjugate is cheaper
    # than eigenvectors.
    rows = root[0], root[1], root[2]
    adjugate = jnp.stack([cross(rows[k - 2], rows[k - 1]) for k in range(3)])
    longest = adjugate[jnp.argmax(jnp.abs(jnp.diagonal(adjugate)))]
    n = longest / jnp.sqrt(jnp.sum(longest * longest) + jnp.finfo(root.dtype).tiny)
    a = n @ apply(root, n)
    d1, d2, s12, s23, s13 = misfit_gradient
    # `misfit_gradient` does not contain the trace of `pull`, the derivative of the cost with
    # respect to A. The cost does not depend on the size of A: its derivative along A = 1 + V is
    # zero, which gives the trace.
    trace = -(shape @ misfit_gradient)
    d3 = (trace - d1 - d2) / 3.0
    pull = from_components(d1 + d3, d2 + d3, d3, 0.5 * s12, 0.5 * s13, 0.5 * s23)
    square = jnp.sum(root * root)
    gained = a * (n @ apply(pull, n)) / 2.0
    # `gained` is the least second moment λ times the derivative of the cost with respect to λ. If
    # `gained` is NaN, `gained > 0` would be false and the rows zero; `~(gained <= 0)` is true, so
    # that the rows are NaN and the caller sees it.
    flat = (a * a < FLAT * square) & ~(gained <= 0)
    size = jnp.where(flat, jnp.sqrt(2.0 * jnp.where(flat, gained, 1.0)), 0.0)
    size = size / jnp.where(flat, jnp.abs(a), 1.0)
    x, y, z = n
    nil = jnp.zeros((), n.dtype)
    rows = [x, nil, y, nil, z], [nil, y, x, z, nil], [-z, -z, nil, y, x]
    return size * jnp.stack([jnp.stack(row) for row in rows])


def _from_shape(shape: Float[Array, "5"]) -> Mat3:
    """Return the second moment (1 + V)²/Tr((1 + V)²), of trace 1, where the symmetric V without a
    trace has the five numbers of `pack_shape`.
    """
    root = _root(shape)
    # The root is scaled first: after a step of an optimiser that is much too long, squares of the
    # entries would overflow.
    root = root / jax.lax.stop_gradient(jnp.max(jnp.abs(root)))
    square = product(root, root)
    return square / (square[0, 0] + square[1, 1] + square[2, 2])


def _root(shape: Float[Array, "5"]) -> Mat3:
    """Return the root 1 + V of the second moment, scaled to trace 3."""
    d1, d2, s12, s23, s13 = shape
    return from_components(1.0 + d1, 1.0 + d2, 1.0 - d1 - d2, s12, s13, s23)


def _six_numbers(s: Mat3) -> Float[Array, "6"]:
    """Return the six numbers of `pack_second_moment`, in any unit."""
    total = _positive_trace(s[0, 0] + s[1, 1] + s[2, 2])
    root = _sqrt(_divide_by_large(require_second_moment(s), total))
    v = 3.0 * root / (root[0, 0] + root[1, 1] + root[2, 2]) - jnp.eye(3, dtype=s.dtype)
    size = _limit_exponent(0.5 * jnp.log(total / 3.0), jnp.expm1)
    return jnp.stack([size, v[0, 0], v[1, 1], v[0, 1], v[1, 2], v[0, 2]])


@jax.custom_jvp
def _sqrt(s: Mat3) -> Mat3:
    """Return the positive semi-definite square root of a second moment; its derivative is finite
    also if eigenvalues are equal.
    """
    values, axes = eigensystem(s)
    return product(axes * jnp.sqrt(jnp.maximum(values, 0.0))[None], axes.T)


@_sqrt.defjvp
def _sqrt_jvp(primals: tuple[Mat3], tangents: tuple[PyTree, ...]) -> tuple[Mat3, Mat3]:
    # The tangent dA of the root A of 𝔖 solves A dA + dA A = d𝔖, nine linear equations, right also
    # at equal moments, where the principal axes have no derivative.
    root, one = _sqrt(*primals), jnp.eye(3, dtype=primals[0].dtype)
    sums = jnp.kron(root, one) + jnp.kron(one, root)
    change = 0.5 * (tangents[0] + tangents[0].T)
    return root, jnp.linalg.solve(sums, change.reshape(9)).reshape(3, 3)


def _positive_trace(trace: Scalar) -> Scalar:
    """Return the trace of a second moment, or raise an error if it is not positive (that of a point
    is zero) or not finite.
    """
    words = (
        "pack: wanted a second moment with a positive trace, got zero (a point has no shape), a "
        "negative number, or one beyond the dtype"
    )
    return _checks.error_if(trace, ~((trace > 0) & (trace < jnp.inf)), words)


def _divide_by_large(numerator: Array, denominator: Scalar) -> Array:
    """Return the quotient, correct also for a large denominator.

    XLA multiplies by the reciprocal of the denominator. In float32 the reciprocal of the second
    moment of the Earth would be zero without the factor ¼.
    """
    return (0.25 * numerator) / (0.25 * denominator)


def _limit_exponent(exponent: Array, map_excess: Callable[[Array], Array] = jnp.log1p) -> Array:
    """Return an exponent x, changed only beyond a limit of |x|, so that `exp(2 * x)` does not
    overflow: there `map_excess`, log1p or its inverse expm1, maps what exceeds the limit.
    """
    limit = 31.0 if exponent.dtype == jnp.float32 else 330.0
    beyond = jnp.maximum(jnp.abs(exponent) - limit, 0.0)
    return jnp.where(beyond > 0, jnp.sign(exponent) * (limit + map_excess(beyond)), exponent)


__all__ = [
    "FLAT", "curvature_rows_near_flat_body", "pack", "pack_moments", "pack_second_moment",
    "pack_shape", "unpack", "unpack_moments", "unpack_second_moment", "unpack_shape",
]  # fmt: skip

define_dir_and_getattr(__name__)
