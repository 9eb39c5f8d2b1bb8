"""Compute the motion of a free body in principal axes, and the derivatives of this motion.

The motion is a function of the inertia tensor I, the body momentum Π(0) at time 0 and the time t.
Its results are the body momentum Π(t) and the turn, which is the rotation R of the body from time 0
to t, as a quaternion.

The derivative of the turn needs no elliptic integral of the third kind. Let `δR = R hat(θ)` be the
change of R for a small change of the inputs, where θ is a small rotation vector and hat(θ) the
matrix of the cross product with θ, and let h = |Π|. The momentum is constant in space, `R Π(t) =
Π(0)`, and this gives the component of θ normal to Π(t):

    Π(t) × (Rᵀ δΠ(0) − δΠ(t)) = h² θ − Π (Π·θ)

The component of θ along Π(t) follows from `d(Π·θ)/dt = Π·δΩ = ½ δE₂ + ½ Π·δK Π`, where K = I⁻¹ and
E₂ = Π·KΠ is constant:

    Π(t)·θ = ½ t δE₂ + ½ δK : ∫₀ᵗ Π Πᵀ dt + E₂ δt.

Here A : B is the sum of AᵢⱼBᵢⱼ over i and j. Both δΠ(t) − δΠ(0) and R − 1 are proportional to the
angle of the turn. The division of these formulas by h² therefore loses no digits, except near rest,
where the derivative comes from a Taylor series.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax._types import Mat3, Quat, Scalar, Vec3
from rigidjax.exact import sigma_form
from rigidjax.exact.closed_form import (
    ClosedFormConstants,
    closed_form_constants,
    momentum_and_rotation,
    momentum_and_rotation_from_elliptic_functions,
    reduce_time,
)
from rigidjax.exact.components3 import (
    HALF,
    QuaternionEntries,
    SymmetricEntries,
    Triple,
    add,
    adjugate,
    change_by_inverse_rotation,
    cross,
    determinant,
    half_product,
    matvec,
    symmetric_rows,
)  # fmt: skip
from rigidjax.exact.jacobian import elliptic_functions_and_integrals, momentum_jacobian_and_integral
from rigidjax.exact.principal_axes import (
    combine_columns,
    components_along,
    principal_tensor_and_axes,
    tensor_in_axes,
)
from rigidjax.exact.sigma_form import Differences
from rigidjax.rotation.barrier import compiled_as_one_kernel
from rigidjax.rotation.linalg3 import components

# If the body turns by less than this angle, rad, from time 0 to t, the derivative of its rotation
# comes from a series of third order in time, else from the closed form. Second derivatives from the
# series have an error of about the square of the angle, those from the closed form an error of
# about the round-off divided by the angle.
_STILL = {jnp.dtype("float32"): 5e-3, jnp.dtype("float64"): 5e-6}


# The states of a body at n instants are computed in a loop if n is at most this number, else as one
# batch (`jax.vmap`). The loop compiles sooner. It also runs as fast as the batch, except if only
# the values of one body are computed, without derivatives.
_LOOPED = 1000

# The body momentum Π(t), the quaternion of the rotation from time 0 to t, and the body rate Ω(t).
Motion = tuple[Triple, QuaternionEntries, Triple]
# The differences and off-diagonal entries of K = I⁻¹, the six entries of K, and twice the energy.
InverseInertiaAndEnergy = tuple[Differences, SymmetricEntries, Scalar]
# The derivatives of the three components of a vector with respect to ten variables.
VectorDerivatives = tuple[Float[Array, "10"], ...]


@jax.custom_jvp
def free_momentum_and_rotation(
    inertia: SymmetricEntries, momentum: Triple, t: Scalar
) -> tuple[Triple, QuaternionEntries]:
    """Return two things: the body momentum Π(t) of a free body; and the quaternion (w, x, y, z) of
    its rotation from time 0 to t. Both have components along the principal axes.

    - `inertia`: the entries (I11, I22, I33, I12, I13, I23) of the inertia tensor in principal axes,
      with I11 ≤ I22 ≤ I33. The last three entries are zero in value, but their derivatives are not.
    - `momentum`: the three components of Π(0).
    - `t`: the time, of either sign.
    """
    return momentum_and_rotation(closed_form_constants(inertia[:3], momentum), t)


@free_momentum_and_rotation.defjvp
def _free_momentum_and_rotation_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[tuple[Triple, QuaternionEntries], tuple[Triple, QuaternionEntries]]:
    """Return two pairs: the body momentum Π(t) of a free body and the quaternion of its rotation
    from time 0 to t, both along the principal axes, as `free_momentum_and_rotation` gives them; and
    the changes of these two for a change of the inputs. By this rule JAX differentiates
    `free_momentum_and_rotation`.

    - `primals`: the three inputs of `free_momentum_and_rotation`: the six entries (11, 22, 33, 12,
      13, 23) of the inertia tensor in principal axes, the three components of Π(0), and the time t.
    - `tangents`: the changes of these three inputs, in the same form.
    """
    motion, rows, _ = motion_and_derivatives(*primals)
    d_out, d_turn, _ = _change_of_motion(
        motion, rows, _derivative_variables_and_changes(primals, tangents)[3]
    )
    return motion[:2], (d_out, d_turn)


def _derivative_variables_and_changes(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[
    InverseInertiaAndEnergy, InverseInertiaAndEnergy, Float[Array, "10"], Float[Array, "10"]
]:
    """Return four things that the derivative rules of a free motion share: three values that follow
    from the inputs, (differences, K, E₂); the changes of these three values; the ten variables
    (10,) with respect to which all derivatives are taken; and the changes (10,) of the ten
    variables.

    - `primals`: the three inputs: the six entries (11, 22, 33, 12, 13, 23) of the inertia tensor in
      principal axes, the three components of the body momentum Π(0), and the time t.
    - `tangents`: the changes of these three inputs, in the same form.

    K is the inverse of the inertia tensor, given by its six entries kij; `differences` are the
    differences d12, d13, d23 of its diagonal entries (dij = kii − kjj) with its off-diagonal
    entries; and E₂ = Π·KΠ is twice the energy. The ten variables are d12, d23, k12, k13, k23, the
    three components of Π(0), k33 and t.
    """
    inverse_inertia, changes = jax.jvp(inverse_inertia_and_energy, primals[:2], tangents[:2])
    return (
        inverse_inertia,
        changes,
        derivative_variables(inverse_inertia, *primals[1:]),
        derivative_variables(changes, *tangents[1:]),
    )


def _change_of_motion(
    motion: Motion, derivative_rows: "MotionDerivatives", change_of_variables: Float[Array, "10"]
) -> Motion:
    """Return the changes of the body momentum Π(t) of a free body, of the quaternion of its
    rotation from time 0 to t, and of its body rate Ω(t), for a given change of the ten variables.

    - `motion`: the triple of Π(t), the quaternion and Ω(t).
    - `derivative_rows`: the derivatives of the three vectors Π(t), θ and Ω(t), where θ is the small
      rotation vector, in the body frame, by which the rotation changes; for each vector three
      arrays (10,), one for each component, with the derivative with respect to each of the ten
      variables.
    - `change_of_variables`: (10,) the change of the variables: of d12, d23, k12, k13, k23, of the
      three components of Π(0), of k33 and of t, where kij are the entries of the inverse K of the
      inertia tensor in principal axes, and dij = kii − kjj.
    """
    out, theta, rate = (
        tuple(jnp.sum(row * change_of_variables) for row in three) for three in derivative_rows
    )
    return out, half_product(motion[1], theta), rate


class FreeMotionConstants(NamedTuple):
    """Hold the constants of a free motion as plain values, through which no derivative is taken.

    - `axes`: (3, 3) the matrix whose columns are the principal axes, in the body frame.
    - `moments`: the three principal moments, ascending.
    - `momentum`: the three components of the body momentum at time 0 along the principal axes.
    - `closed_form`: the constants from which the closed form is evaluated.
    """

    axes: Mat3
    moments: Triple
    momentum: Triple
    closed_form: ClosedFormConstants


@compiled_as_one_kernel
def free_motion_constants(tensor: Mat3, omega: Vec3) -> FreeMotionConstants:
    """Return the principal axes of a body, and the constants of its free motion in these axes.

    - `tensor`: (3, 3) the inertia tensor, body frame.
    - `omega`: (3,) the body rate at time 0, body frame.
    """
    moments, axes = principal_tensor_and_axes(tensor)
    momentum = matvec(moments, components_along(axes, omega))
    return FreeMotionConstants(
        axes, moments[:3], momentum, closed_form_constants(moments[:3], momentum)
    )


@jax.custom_jvp
def body_rate_and_rotation(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants, t: Float[Array, "*n"]
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 4"]]:
    """Return two things, both in the body frame: the body rate Ω(t) of a free body; and the
    quaternion (w, x, y, z) of its rotation from time 0 to t.

    - `tensor`: (3, 3) the inertia tensor.
    - `omega`: (3,) the body rate Ω(0).
    - `constants`: the result of `free_motion_constants` for `tensor` and `omega`. The value is
      computed from `constants` and `t` alone; derivatives are taken with respect to `tensor`,
      `omega` and `t`.
    - `t`: one time, or an array (n,) of times; the results then are (n, 3) and (n, 4).
    """
    del tensor, omega
    return _evaluate_at_each_time(lambda time: _rate_and_rotation_at(constants, time), t)


@body_rate_and_rotation.defjvp
def _rate_and_rotation_jvp(
    primals: tuple[Mat3, Vec3, FreeMotionConstants, Float[Array, "*n"]],
    tangents: tuple[PyTree, ...],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return two pairs: the body rate Ω(t) of a free body and the quaternion of its rotation from
    time 0 to t, both in the body frame, as `body_rate_and_rotation` gives them; and the changes of
    these two for a change of the inputs. By this rule JAX differentiates `body_rate_and_rotation`.

    - `primals`: the four inputs of `body_rate_and_rotation`: the inertia tensor (3, 3), the body
      rate Ω(0) (3,), the constants of the motion, and the time t, one or (n,) times.
    - `tangents`: the changes of these four inputs, in the same form; the change of the constants is
      not used.
    """
    tensor, omega, constants, t = primals
    d_tensor, d_omega, _, d_t = tangents
    # The derivative of the motion with respect to the tensor and the initial rate is a product of
    # two matrices: the derivatives of the motion with respect to nine variables, which depend on
    # time; and `first`, the derivatives of these variables with respect to the tensor and the rate,
    # which is computed once for all times. The changes of the inputs are only multiplied by the two
    # matrices: in reverse mode JAX therefore has little to transpose.
    first = _variable_derivatives_by_body(jnp.concatenate([tensor.ravel(), omega]), constants)
    out, (rates, thetas) = _evaluate_at_each_time(
        lambda time: _rate_and_rotation_with_derivatives(tensor, omega, constants, time), t
    )
    # Multiply by the matrices as sums over their entries: on a GPU a product of matrices is rounded
    # to ten bits in float32.
    change = jnp.sum(first * jnp.concatenate([d_tensor.ravel(), d_omega])[None], axis=-1)
    change = jnp.broadcast_to(change, (*t.shape, 9))
    change = jnp.concatenate([change, d_t[..., None]], axis=-1)
    d_rate, theta = (
        jnp.stack([jnp.sum(row * change, axis=-1) for row in rows], axis=-1)
        for rows in (rates, thetas)
    )
    return out, (d_rate, _quaternion_change_by_small_rotation(out[1], theta))


@functools.partial(jnp.vectorize, signature="(n),(m)->(n)")
def _quaternion_change_by_small_rotation(q: Quat, rotation_vector: Vec3) -> Quat:
    """Return the change ½ q ⊗ (0, θ) (4,) of a unit quaternion q for a small change of its
    rotation.

    - `q`: (4,), (w, x, y, z).
    - `rotation_vector`: θ (3,), rad, body frame, the rotation vector of a small rotation of the
      body after the rotation q.

    Arrays (…, 4) and (…, 3) are combined pair by pair.
    """
    return jnp.stack(half_product(components(q), components(rotation_vector)))


def _evaluate_at_each_time(
    function: Callable[[Scalar], PyTree[Array]], t: Float[Array, "*n"]
) -> PyTree[Array]:
    """Return the values of a function of time at the time t, or at each of the times t.

    - `function`: takes one time and returns any tree of arrays.
    - `t`: one time, or an array (n,) of times; with (n,) every array of the result begins with an
      axis of length n.
    """
    if t.ndim == 0:
        return function(t)
    return jax.lax.map(function, t) if t.size <= _LOOPED else jax.vmap(function)(t)


@compiled_as_one_kernel
def _rate_and_rotation_at(constants: FreeMotionConstants, t: Scalar) -> tuple[Vec3, Quat]:
    """Return two things at the time t, both in the body frame: the body rate Ω(t) (3,) of a free
    body; and the quaternion (4,) of its rotation from time 0 to t.

    - `constants`: the constants of the motion: the principal axes and moments, the momentum at time
      0, and the numbers from which the closed form is evaluated.
    - `t`: the time.
    """
    momentum, (w, *axis) = momentum_and_rotation(constants.closed_form, t)
    rate = tuple(p / i for p, i in zip(momentum, constants.moments, strict=True))
    return jnp.stack(combine_columns(constants.axes, rate)), jnp.stack(
        [w, *combine_columns(constants.axes, tuple(axis))]
    )


def _tensor_and_momentum_in_axes(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants
) -> tuple[SymmetricEntries, Triple]:
    """Return two things in principal axes, as differentiable functions of the inertia tensor and
    the body rate: the six entries (11, 22, 33, 12, 13, 23) of the tensor; and the three components
    of the body momentum Π(0).

    - `tensor`: (3, 3) the inertia tensor, body frame.
    - `omega`: (3,) the body rate at time 0, body frame.
    - `constants`: the constants of the motion, from which the principal axes and moments are taken.
      The axes are held fixed in derivatives.
    """
    moments = tensor_in_axes(tensor, constants.axes, constants.moments)
    return moments, matvec(moments, components_along(constants.axes, omega))


@compiled_as_one_kernel
def _variable_derivatives_by_body(
    tensor_and_rate: Float[Array, "12"], constants: FreeMotionConstants
) -> Float[Array, "9 12"]:
    """Return the derivatives (9, 12) of nine variables of a free motion with respect to the inertia
    tensor and the body rate.

    The nine variables are d12, d23, k12, k13, k23, the three components of the body momentum Π(0),
    and k33. Here kij are the entries of the inverse of the inertia tensor, in principal axes, and
    dij = kii − kjj.

    - `tensor_and_rate`: (12,) the nine entries of the inertia tensor, then the three of the body
      rate Ω(0), all in the body frame.
    - `constants`: the constants of the motion, from which the principal axes and moments are taken.
    """
    tensor, omega, axes = tensor_and_rate[:9].reshape(3, 3), tensor_and_rate[9:], constants.axes
    moments, momentum = _tensor_and_momentum_in_axes(tensor, omega, constants)
    # A change δI of the inertia tensor, in the body frame, changes its inverse K, in principal
    # axes, by δK = −BᵀδI B with B = A K, where the columns of A are the principal axes. The
    # products are written as sums of products of entries, because on a GPU a product of matrices is
    # rounded to ten bits in float32.
    k = jnp.stack(symmetric_rows(inverse_inertia_and_energy(moments, momentum)[1]))
    b = jnp.sum(axes[:, :, None] * k[None], axis=1)
    d_k = lambda i, j: -(b[:, None, i] * b[None, :, j]).ravel()  # noqa: E731
    c1, c2, c3 = d_k(0, 0), d_k(1, 1), d_k(2, 2)
    d_momentum = ((axes[:, None, i] * omega[None]).ravel() for i in range(3))
    by_tensor = jnp.stack([c1 - c2, c2 - c3, d_k(0, 1), d_k(0, 2), d_k(1, 2), *d_momentum, c3])
    by_tensor = by_tensor.reshape(9, 3, 3)
    by_tensor = 0.5 * (by_tensor + jnp.swapaxes(by_tensor, 1, 2)).reshape(9, 9)
    by_omega = jnp.sum(jnp.stack(symmetric_rows(moments))[:, None] * axes[None], axis=2)
    return jnp.concatenate([by_tensor, jnp.pad(by_omega, ((5, 1), (0, 0)))], axis=1)


@compiled_as_one_kernel
def _rate_and_rotation_with_derivatives(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants, t: Scalar
) -> tuple[tuple[Vec3, Quat], tuple[VectorDerivatives, VectorDerivatives]]:
    """Return two pairs, both in the body frame: the body rate Ω(t) and the quaternion of the
    rotation from time 0 to t of a free body; and the derivatives of Ω(t) and of θ, where θ is the
    small rotation vector by which the rotation changes, each as three arrays (10,), one for each
    component.

    - `tensor`: (3, 3) the inertia tensor.
    - `omega`: (3,) the body rate Ω(0).
    - `constants`: the constants of the motion: the principal axes and moments, the momentum at time
      0, and the numbers from which the closed form is evaluated.
    - `t`: the time.

    The derivatives are with respect to ten variables: d12, d23, k12, k13, k23, the three components
    of the body momentum Π(0), k33 and t, where kij are the entries of the inverse of the inertia
    tensor, in principal axes, and dij = kii − kjj.
    """
    moments, momentum = _tensor_and_momentum_in_axes(tensor, omega, constants)
    (_, (w, *axis), rate), rows, _ = motion_and_derivatives(moments, momentum, t)
    rate = combine_columns(constants.axes, rate)
    turn = jnp.stack([w, *combine_columns(constants.axes, tuple(axis))])
    # Return the derivatives of the components as three separate rows, not as one matrix: if many
    # times are computed at once, stacking the rows takes five times as long as computing them.
    in_body = jax.vmap(lambda *v: combine_columns(constants.axes, v))
    return (jnp.stack(rate), turn), (in_body(*rows.rate), in_body(*rows.theta))


class MotionDerivatives(NamedTuple):
    """Hold the derivatives of three vectors of a free motion with respect to ten variables: of the
    body momentum Π(t), of θ and of the body rate Ω(t), each as three arrays (10,), one for each
    component.

    The ten variables are d12, d23, k12, k13, k23, the three components of Π(0), k33 and t, where
    kij are the entries of the inverse of the inertia tensor, in principal axes, and dij = kii − kjj
    (see `derivative_variables`). θ is the small rotation vector that changes the rotation R of the
    body from time 0 to t: δR = R hat(θ), where hat(θ) is the matrix of the cross product with θ.
    """

    momentum: VectorDerivatives
    theta: VectorDerivatives
    rate: VectorDerivatives


# The motion, its derivatives, and the pair from which these derivatives are computed: the
# derivatives of Π(t) − Π(0), and the six entries of the matrix ∫ Π Πᵀ dt from 0 to t.
MotionAndDerivatives = tuple[Motion, MotionDerivatives, tuple[VectorDerivatives, SymmetricEntries]]


@jax.custom_jvp
@compiled_as_one_kernel
def motion_and_derivatives(
    inertia: SymmetricEntries, momentum: Triple, t: Scalar
) -> MotionAndDerivatives:
    """Return three things: the motion of a free body, which is (Π(t), quaternion of the rotation
    from time 0 to t, body rate Ω(t)); the derivatives of the motion; and the pair (rows, G) from
    which the derivatives are computed.

    - `inertia`: the six entries (11, 22, 33, 12, 13, 23) of the inertia tensor in principal axes,
      in ascending order of the moments. The last three entries are zero in value, but their
      derivatives are not.
    - `momentum`: the three components of the body momentum Π(0).
    - `t`: the time.

    In the pair, `rows` are the derivatives of Π(t) − Π(0) with respect to ten variables, as three
    arrays (10,), and G = ∫ Π Πᵀ dt from 0 to t, as six entries. The ten variables are d12, d23,
    k12, k13, k23, the three components of Π(0), k33 and t, where kij are the entries of the inverse
    of the inertia tensor and dij = kii − kjj (see `derivative_variables`).
    """
    (out, turn), rows, g = _momentum_and_rotation_with_derivatives(
        closed_form_constants(inertia[:3], momentum), inertia, momentum, t
    )
    _, k, energy2 = inverse_inertia_and_energy(inertia, momentum)
    motion = out, turn, matvec(k, out)
    return motion, _motion_derivatives(k, energy2, momentum, t, motion, rows, g), (rows, g)


# The second derivatives come from `sigma_form`, where the motion is a function of the whole inertia
# tensor: this function is smooth to any order.
@motion_and_derivatives.defjvp
def _motion_and_derivatives_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[MotionAndDerivatives, MotionAndDerivatives]:
    """Return two things: the result of `motion_and_derivatives` (the motion of a free body, its
    first derivatives, and the pair from which these derivatives are computed); and the changes of
    all numbers in this result for a change of the inputs. By this rule JAX takes second derivatives
    of a free motion.

    - `primals`: the three inputs of `motion_and_derivatives`: the six entries
      (11, 22, 33, 12, 13, 23) of the inertia tensor in principal axes, the three components of the
      body momentum Π(0), and the time t.
    - `tangents`: the changes of these three inputs, in the same form.
    """
    motion, rows, parts = motion_and_derivatives(*primals)
    (body, *k), (_, *d_k), inputs, change = _derivative_variables_and_changes(primals, tangents)
    d_motion = _change_of_motion(motion, rows, change)
    d_parts = _changes_of_momentum_derivatives(body, inputs, change)
    # One column after the other makes a shorter program than all columns as one batch.
    of_parts = functools.partial(_motion_derivatives, map_columns=jax.lax.map)
    at, changes = (*k, *primals[1:], motion, *parts), (*d_k, *tangents[1:], d_motion, *d_parts)
    return (motion, rows, parts), (d_motion, jax.jvp(of_parts, at, changes)[1], d_parts)


def _map_as_batch(function: Callable[[Any], Any], rows: PyTree) -> PyTree:
    """Return the results of `function` for each row of the arrays in `rows`, all computed
    together.
    """
    return jax.vmap(function)(rows)


def _motion_derivatives(
    inverse_inertia: SymmetricEntries,
    energy2: Scalar,
    momentum: Triple,
    t: Scalar,
    motion: Motion,
    momentum_rows: VectorDerivatives,
    momentum_integral: SymmetricEntries,
    map_columns: Callable[[Callable[[Any], Any], Any], Any] = _map_as_batch,
) -> MotionDerivatives:
    """Return the derivatives of a free motion (of its body momentum Π(t), rotation and body rate
    Ω(t)) with respect to ten variables, from the derivatives of its body momentum.

    - `inverse_inertia`: the six entries (11, 22, 33, 12, 13, 23) of K = I⁻¹, the inverse of the
      inertia tensor, in principal axes.
    - `energy2`: E₂ = Π·KΠ, which is twice the energy.
    - `momentum`: the three components of the body momentum Π(0).
    - `t`: the time.
    - `motion`: the triple of Π(t), the quaternion of the rotation from time 0 to t, and Ω(t).
    - `momentum_rows`: the derivatives of Π(t) − Π(0) with respect to the ten variables, as three
      arrays (10,), one for each component.
    - `momentum_integral`: the six entries of G = ∫ Π Πᵀ dt from 0 to t.
    - `map_columns`: a function (f, trees of arrays with ten rows) that calls f with each row, all
      together or one after the other.

    The ten variables are d12, d23, k12, k13, k23, the three of Π(0), k33 and t, where kij are the
    entries of K and dij = kii − kjj.
    """
    out, turn, _ = motion
    p1, p2, p3 = momentum
    h2 = p1 * p1 + p2 * p2 + p3 * p3
    most = h2 * (
        inverse_inertia[0] * inverse_inertia[0]
        + inverse_inertia[1] * inverse_inertia[1]
        + inverse_inertia[2] * inverse_inertia[2]
    )
    still = jax.lax.stop_gradient(most * (t * t)) <= _STILL[t.dtype] ** 2
    r = 1.0 / jnp.where(still, 1.0, h2)
    rate = matvec(inverse_inertia, momentum)
    pull = cross(momentum, rate)
    gain = matvec(inverse_inertia, pull)
    pulled = add(cross(pull, rate), cross(momentum, gain))
    squares = (p1 * p1, p2 * p2, p3 * p3, p1 * p2, p1 * p3, p2 * p3)
    weights = [c * (t * a + b) for c, a, b in zip(HALF, squares, momentum_integral, strict=True)]

    def column(e, change):
        e12, e23, o12, o13, o23, e1, e2, e3, e33, et = e
        d_k, start = (e33 + e12 + e23, e33 + e23, e33, o12, o13, o23), (e1, e2, e3)
        d_out = tuple(a + b for a, b in zip(start, change, strict=True))
        back = change_by_inverse_rotation(turn, start)
        across = cross(out, tuple(a - b for a, b in zip(back, change, strict=True)))
        along = sum(a * b for a, b in zip(weights, d_k, strict=True))
        along = along + t * sum(a * b for a, b in zip(rate, start, strict=True)) + energy2 * et
        theta = tuple(r * (a + b * along) for a, b in zip(across, out, strict=True))
        # If the body turns by a tiny angle only, the change θ of its rotation is a power series in
        # the time t. It follows from θ' = δΩ − Ω × θ, with the body rate Ω = KΠ, its change δΩ, and
        # the momentum Π with Π' = Π × Ω.
        faster = add(matvec(d_k, momentum), matvec(inverse_inertia, start))
        d_pull = add(cross(start, rate), cross(momentum, faster))
        gained = add(matvec(d_k, pull), matvec(inverse_inertia, d_pull))
        bent = add(gained, cross(faster, rate))
        d_jerk = add(add(cross(d_pull, rate), cross(pull, faster)), cross(start, gain))
        jerk = add(d_jerk, cross(momentum, gained))
        third = add(matvec(d_k, pulled), matvec(inverse_inertia, jerk))
        third = add(add(third, cross(add(faster, faster), gain)), cross(bent, rate))
        near = zip(faster, bent, third, matvec(inverse_inertia, out), strict=True)
        near = tuple(t * (a + t * (b / 2 + t * c / 6)) + et * d for a, b, c, d in near)
        theta = tuple(jnp.where(still, a, b) for a, b in zip(near, theta, strict=True))
        return d_out, theta, add(matvec(inverse_inertia, d_out), matvec(d_k, out))

    unit_changes = jnp.eye(10, dtype=t.dtype)
    return MotionDerivatives(*map_columns(lambda one: column(*one), (unit_changes, momentum_rows)))


def derivative_variables(
    inverse_inertia: InverseInertiaAndEnergy, momentum: Triple, t: Scalar
) -> Float[Array, "10"]:
    """Return the ten variables (10,) with respect to which all derivatives of this module are
    taken: d12, d23, k12, k13, k23, the three components of Π(0), k33 and t.

    - `inverse_inertia`: the result of `inverse_inertia_and_energy`, or the change of this result.
    - `momentum`, `t`: the body momentum Π(0) and the time, or their changes if `inverse_inertia` is
      a change.

    Here kij are the entries of K = I⁻¹, and dij = kii − kjj. The variable k33 is the least diagonal
    entry. It is chosen for the sake of thin rods, where I₁ is small: the thickness of the rod then
    changes d12 alone. With k11 in the place of k33, the thickness would change both k11 and d12 by
    a term of 1/I₁², and the two terms would cancel.
    """
    differences, k, _ = inverse_inertia
    return jnp.stack(
        [
            differences.d12,
            differences.d23,
            differences.k12,
            differences.k13,
            differences.k23,
            *momentum,
            k[2],
            t,
        ]
    )


@compiled_as_one_kernel
def _momentum_and_rotation_with_derivatives(
    constants: ClosedFormConstants, inertia: SymmetricEntries, momentum: Triple, t: Scalar
) -> tuple[tuple[Triple, QuaternionEntries], VectorDerivatives, SymmetricEntries]:
    """Return three things: the pair of the body momentum Π(t) of a free body and the quaternion of
    its rotation from time 0 to t; the derivatives of Π(t) − Π(0) with respect to ten variables, as
    three arrays (10,), one for each component; and the six entries (11, 22, 33, 12, 13, 23) of the
    matrix G = ∫ Π Πᵀ dt from 0 to t. All are in principal axes.

    - `constants`: the numbers from which the closed form of the motion is evaluated.
    - `inertia`: the six entries of the inertia tensor.
    - `momentum`: the three components of Π(0).
    - `t`: the time.

    The ten variables are d12, d23, k12, k13, k23, the three of Π(0), k33 and t, where kij are the
    entries of the inverse of the inertia tensor and dij = kii − kjj.
    """
    half_time = reduce_time(0.5 * t, constants.half.time, constants.modulus)
    half_time_integrals = elliptic_functions_and_integrals(
        half_time.near, constants.modulus, constants.mu, constants.phase_factor
    )
    f = half_time_integrals.f._replace(
        C=jnp.where(constants.swapped, half_time_integrals.f.D, half_time_integrals.f.C),
        D=jnp.where(constants.swapped, half_time_integrals.f.C, half_time_integrals.f.D),
    )
    none = half_time.halves == 0
    whole = jnp.where(none, 0.0, 2.0 * half_time.halves) * jnp.where(none, 0.0, constants.half.time)
    body, _, _ = inverse_inertia_and_energy(inertia, momentum)
    half = half_time_integrals._replace(f=f)
    rows, g = momentum_jacobian_and_integral(
        body, momentum, t, half, half_time.halves, whole, constants.half.mean
    )
    return (
        momentum_and_rotation_from_elliptic_functions(
            constants, half_time_integrals.f, half_time, t
        ),
        rows,
        g,
    )


def _changes_of_momentum_derivatives(
    inverse_inertia: Differences,
    variables: Float[Array, "10"],
    change_of_variables: Float[Array, "10"],
) -> tuple[VectorDerivatives, SymmetricEntries]:
    """Return how two results of a free motion change if its ten variables change.

    The first result is the derivatives of the body momentum Π(t) with respect to the ten variables,
    three arrays (10,), one for each component of Π. The second is the six entries (11, 22, 33, 12,
    13, 23) of the matrix G = ∫ Π Πᵀ dt from 0 to t.

    - `inverse_inertia`: the differences and off-diagonal entries of K = I⁻¹, the inverse of the
      inertia tensor, in principal axes.
    - `variables`: (10,) the variables d12, d23, k12, k13, k23, the three of Π(0), k33 and t, where
      kij are the entries of K and dij = kii − kjj.
    - `change_of_variables`: (10,) the change of the variables.

    The motion is taken from the module `sigma_form`, where it is a smooth function of the whole
    inertia tensor.
    """

    def of_inputs(x):
        d12, d23, k12, k13, k23, p1, p2, p3, _, time = x
        d13 = inverse_inertia.d13 + ((d12 - inverse_inertia.d12) + (d23 - inverse_inertia.d23))
        return sigma_form.momentum_and_outer_product_integral(
            Differences(d12, d13, d23, k12, k13, k23), (p1, p2, p3), time
        )

    def columns(x):
        # Compute the derivatives with respect to the ten variables one after the other: as one
        # batch (`jax.vmap`) they take longer to compile.
        column = lambda e: jax.jvp(of_inputs, (x,), (e,))[1]  # noqa: E731
        return jax.lax.map(column, jnp.eye(10, dtype=x.dtype))

    (_, by_inputs), (d_rows, _) = jax.jvp(columns, (variables,), (change_of_variables,))
    return d_rows, tuple(jnp.sum(g * change_of_variables) for g in by_inputs)


def inverse_inertia_and_energy(
    inertia: SymmetricEntries, momentum: Triple
) -> InverseInertiaAndEnergy:
    """Return three things: the differences and off-diagonal entries of K = I⁻¹, the inverse of the
    inertia tensor, each with all its digits; the six entries of K; and E₂ = Π·KΠ, which is twice
    the energy.

    - `inertia`: the six entries (11, 22, 33, 12, 13, 23) of the inertia tensor in principal axes.
    - `momentum`: the three components of the body momentum Π.
    """
    i1, i2, i3, i12, i13, i23 = inertia
    r = 1.0 / determinant(inertia)
    k = tuple(c * r for c in adjugate(inertia))
    body = Differences(
        ((i2 - i1) * i3 + (i13 * i13 - i23 * i23)) * r,
        ((i3 - i1) * i2 + (i12 * i12 - i23 * i23)) * r,
        ((i3 - i2) * i1 + (i12 * i12 - i13 * i13)) * r,
        *k[3:],
    )
    p1, p2, p3 = momentum
    energy2 = (
        k[0] * p1 * p1
        + k[1] * p2 * p2
        + k[2] * p3 * p3
        + 2.0 * (k[3] * p1 * p2 + k[4] * p1 * p3 + k[5] * p2 * p3)
    )
    return body, k, energy2
