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

from rigidjax._types import Mat3, Scalar, Vec3
from rigidjax.exact import sigma_form
from rigidjax.exact.closed_form import (
    ClosedFormConstants,
    MomentumAndTurn,
    closed_form_constants,
    from_elliptic,
    momentum_and_turn,
    reduce_time,
)
from rigidjax.exact.components3 import (
    HALF,
    QuaternionEntries,
    SymmetricEntries,
    Triple,
    add,
    adjugate,
    change_unrotated,
    cross,
    determinant,
    half_product,
    matvec,
    symmetric_rows,
)  # fmt: skip
from rigidjax.exact.jacobian import MomentumParts, elliptic_integrals, momentum_jacobian
from rigidjax.exact.principal_axes import (
    combine_columns,
    components_along,
    principal_axes,
    tensor_in_axes,
)
from rigidjax.exact.sigma_form import Differences
from rigidjax.rotation.barrier import one_kernel
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

# The derivatives of the three components of a vector with respect to the ten variables of
# `ten_variables`.
VectorDerivatives = tuple[Float[Array, "10"], ...]


class Inverse(NamedTuple):
    """Hold the inverse K = I⁻¹ of an inertia tensor in principal axes, and twice the energy."""

    differences: Differences  # each with all its digits
    k: SymmetricEntries  # K
    energy2: Scalar  # E₂ = Π·KΠ


class Motion(NamedTuple):
    """Hold Π(t), the turn from time 0 to t, and Ω(t) of a free body, in principal axes."""

    momentum: Triple
    turn: QuaternionEntries
    rate: Triple


class RateAndTurn(NamedTuple):
    """Hold Ω(t) and the turn from time 0 to t of a free body, both in the body frame."""

    rate: Float[Array, "*n 3"]
    turn: Float[Array, "*n 4"]


@jax.custom_jvp
def free_motion(inertia: SymmetricEntries, momentum: Triple, t: Scalar) -> MomentumAndTurn:
    """Return the motion of a free body at a time of either sign.

    The inertia is in principal axes, with the moments ascending. Its off-diagonal entries are zero
    in value, but their derivatives are not.
    """
    return momentum_and_turn(closed_form_constants(inertia[:3], momentum), t)


@free_motion.defjvp
def _free_motion_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[MomentumAndTurn, MomentumAndTurn]:
    """Return the motion of a free body and its tangent."""
    motion, rows, _ = motion_and_derivatives(*primals)
    change = _motion_tangent(motion, rows, _inputs(primals, tangents).d_variables)
    return MomentumAndTurn(*motion[:2]), MomentumAndTurn(*change[:2])


class Inputs(NamedTuple):
    """Hold the inverse inertia and the ten variables of a free motion, and the tangents of both."""

    inverse: Inverse
    d_inverse: Inverse
    variables: Float[Array, "10"]
    d_variables: Float[Array, "10"]


def _inputs(
    primals: tuple[SymmetricEntries, Triple, Scalar], tangents: tuple[PyTree, ...]
) -> Inputs:
    """Return the `Inputs` for the inertia, Π(0) and t, and their tangents."""
    inverse, change = jax.jvp(inverse_and_energy, primals[:2], tangents[:2])
    variables = ten_variables(inverse, *primals[1:])
    return Inputs(inverse, change, variables, ten_variables(change, *tangents[1:]))


def _motion_tangent(
    motion: Motion, derivative_rows: "MotionDerivatives", change_of_variables: Float[Array, "10"]
) -> Motion:
    """Return the tangent of the motion for a change of the ten variables."""
    out, theta, rate = (
        tuple(jnp.sum(row * change_of_variables) for row in three) for three in derivative_rows
    )
    return Motion(out, half_product(motion.turn, theta), rate)


class FreeMotionConstants(NamedTuple):
    """Hold the constants of a free motion as plain values, through which no derivative is taken."""

    axes: Mat3  # the columns are the principal axes, in the body frame
    moments: Triple  # ascending
    momentum: Triple  # Π(0) along the principal axes
    closed_form: ClosedFormConstants


@one_kernel
def motion_constants(tensor: Mat3, omega: Vec3) -> FreeMotionConstants:
    """Return the principal axes of a body, and the constants of its free motion in these axes, from
    the tensor and the initial rate in the body frame.
    """
    moments, axes = principal_axes(tensor)
    momentum = matvec(moments, components_along(axes, omega))
    return FreeMotionConstants(
        axes, moments[:3], momentum, closed_form_constants(moments[:3], momentum)
    )


@jax.custom_jvp
def rate_and_turn(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants, t: Float[Array, "*n"]
) -> RateAndTurn:
    """Return the rate and the turn of a free body at one time, or at n times.

    The value is computed from `constants`, the result of `motion_constants` for `tensor` and
    `omega`, and from `t`; derivatives are taken with respect to `tensor`, `omega` and `t`.
    """
    del tensor, omega
    return _at_each(lambda time: _rate_and_turn_at(constants, time), t)


@rate_and_turn.defjvp
def _rate_and_turn_jvp(
    primals: tuple[Mat3, Vec3, FreeMotionConstants, Float[Array, "*n"]],
    tangents: tuple[PyTree, ...],
) -> tuple[RateAndTurn, RateAndTurn]:
    """Return the rate and the turn of a free body and their tangents."""
    tensor, omega, constants, t = primals
    d_tensor, d_omega, _, d_t = tangents
    # The derivative of the motion with respect to the tensor and the initial rate is a product of
    # two matrices: the derivatives of the motion with respect to nine variables, which depend on
    # time; and `first`, the derivatives of these variables with respect to the tensor and the rate,
    # which is computed once for all times. The changes of the inputs are only multiplied by the two
    # matrices: in reverse mode JAX therefore has little to transpose.
    first = _rows_by_body(jnp.concatenate([tensor.ravel(), omega]), constants)
    out, rates, thetas = _at_each(lambda time: _rate_rows(tensor, omega, constants, time), t)
    # Multiply by the matrices as sums over their entries: on a GPU a product of matrices is rounded
    # to ten bits in float32.
    change = jnp.sum(first * jnp.concatenate([d_tensor.ravel(), d_omega])[None], axis=-1)
    change = jnp.broadcast_to(change, (*t.shape, 9))
    change = jnp.concatenate([change, d_t[..., None]], axis=-1)
    d_rate, theta = (
        jnp.stack([jnp.sum(row * change, axis=-1) for row in rows], axis=-1)
        for rows in (rates, thetas)
    )
    d_turn = jnp.vectorize(
        lambda q, v: jnp.stack(half_product(components(q), components(v))),
        signature="(n),(m)->(n)",
    )(out.turn, theta)
    return out, RateAndTurn(d_rate, d_turn)


def _at_each(function: Callable[[Scalar], PyTree[Array]], t: Float[Array, "*n"]) -> PyTree[Array]:
    """Return the values of a function of time at the time t, or at each of the times t."""
    if t.ndim == 0:
        return function(t)
    return jax.lax.map(function, t) if t.size <= _LOOPED else jax.vmap(function)(t)


@one_kernel
def _rate_and_turn_at(constants: FreeMotionConstants, t: Scalar) -> RateAndTurn:
    """Return the rate and the turn of a free body at one time."""
    momentum, (w, *axis) = momentum_and_turn(constants.closed_form, t)
    rate = tuple(p / i for p, i in zip(momentum, constants.moments, strict=True))
    rate = jnp.stack(combine_columns(constants.axes, rate))
    return RateAndTurn(rate, jnp.stack([w, *combine_columns(constants.axes, tuple(axis))]))


def _in_axes(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants
) -> tuple[SymmetricEntries, Triple]:
    """Return the inertia and the momentum in principal axes, which derivatives hold fixed, as
    differentiable functions of the tensor and the rate.
    """
    moments = tensor_in_axes(tensor, constants.axes, constants.moments)
    return moments, matvec(moments, components_along(constants.axes, omega))


@one_kernel
def _rows_by_body(
    tensor_and_rate: Float[Array, "12"], constants: FreeMotionConstants
) -> Float[Array, "9 12"]:
    """Return the derivatives of the first nine variables of `ten_variables` with respect to
    the nine entries of the inertia tensor and the three of the body rate, in the body frame.
    """
    tensor, omega, axes = tensor_and_rate[:9].reshape(3, 3), tensor_and_rate[9:], constants.axes
    moments, momentum = _in_axes(tensor, omega, constants)
    # A change δI of the inertia tensor, in the body frame, changes its inverse K, in principal
    # axes, by δK = −BᵀδI B with B = A K, where the columns of A are the principal axes. The
    # products are written as sums of products of entries, because on a GPU a product of matrices is
    # rounded to ten bits in float32.
    k = jnp.stack(symmetric_rows(inverse_and_energy(moments, momentum)[1]))
    b = jnp.sum(axes[:, :, None] * k[None], axis=1)
    d_k = lambda i, j: -(b[:, None, i] * b[None, :, j]).ravel()  # noqa: E731
    c1, c2, c3 = d_k(0, 0), d_k(1, 1), d_k(2, 2)
    d_momentum = ((axes[:, None, i] * omega[None]).ravel() for i in range(3))
    by_tensor = jnp.stack([c1 - c2, c2 - c3, d_k(0, 1), d_k(0, 2), d_k(1, 2), *d_momentum, c3])
    by_tensor = by_tensor.reshape(9, 3, 3)
    by_tensor = 0.5 * (by_tensor + jnp.swapaxes(by_tensor, 1, 2)).reshape(9, 9)
    by_omega = jnp.sum(jnp.stack(symmetric_rows(moments))[:, None] * axes[None], axis=2)
    return jnp.concatenate([by_tensor, jnp.pad(by_omega, ((5, 1), (0, 0)))], axis=1)


class RateDerivatives(NamedTuple):
    """Hold the rate and the turn of a free body, and the derivatives of Ω(t) and of θ (see
    `MotionDerivatives`), in the body frame.
    """

    value: RateAndTurn
    rate: VectorDerivatives
    theta: VectorDerivatives


@one_kernel
def _rate_rows(
    tensor: Mat3, omega: Vec3, constants: FreeMotionConstants, t: Scalar
) -> RateDerivatives:
    """Return the rate and the turn of a free body at one time, and their derivatives."""
    moments, momentum = _in_axes(tensor, omega, constants)
    (_, (w, *axis), rate), rows, _ = motion_and_derivatives(moments, momentum, t)
    rate = combine_columns(constants.axes, rate)
    turn = jnp.stack([w, *combine_columns(constants.axes, tuple(axis))])
    # Return the derivatives of the components as three separate rows, not as one matrix: if many
    # times are computed at once, stacking the rows takes five times as long as computing them.
    in_body = jax.vmap(lambda *v: combine_columns(constants.axes, v))
    value = RateAndTurn(jnp.stack(rate), turn)
    return RateDerivatives(value, in_body(*rows.rate), in_body(*rows.theta))


class MotionDerivatives(NamedTuple):
    """Hold the derivatives of Π(t), θ and Ω(t) by the variables of `ten_variables`.

    θ is the small rotation vector that changes the turn R: δR = R hat(θ), where hat(θ) is the
    matrix of the cross product with θ.
    """

    momentum: VectorDerivatives
    theta: VectorDerivatives
    rate: VectorDerivatives


class MotionAndDerivatives(NamedTuple):
    """Hold a free motion, its derivatives, and the parts from which these derivatives follow."""

    motion: Motion
    rows: MotionDerivatives
    parts: MomentumParts


@jax.custom_jvp
@one_kernel
def motion_and_derivatives(
    inertia: SymmetricEntries, momentum: Triple, t: Scalar
) -> MotionAndDerivatives:
    """Return the motion of a free body and its derivatives, for the inputs of `free_motion`."""
    (out, turn), parts = _turn_and_parts(
        closed_form_constants(inertia[:3], momentum), inertia, momentum, t
    )
    _, k, energy2 = inverse_and_energy(inertia, momentum)
    motion = Motion(out, turn, matvec(k, out))
    rows = _motion_rows(k, energy2, momentum, t, motion, *parts)
    return MotionAndDerivatives(motion, rows, parts)


# The second derivatives come from `sigma_form`, where the motion is a function of the whole inertia
# tensor: this function is smooth to any order.
@motion_and_derivatives.defjvp
def _motion_and_derivatives_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[MotionAndDerivatives, MotionAndDerivatives]:
    """Return motion and derivatives, and their tangents, which second derivatives need."""
    motion, rows, parts = motion_and_derivatives(*primals)
    (body, *k), (_, *d_k), variables, change = _inputs(primals, tangents)
    d_motion = _motion_tangent(motion, rows, change)
    d_parts = _parts_tangent(body, variables, change)
    # One column after the other makes a shorter program than all columns as one batch.
    of_parts = functools.partial(_motion_rows, map_columns=jax.lax.map)
    at, changes = (*k, *primals[1:], motion, *parts), (*d_k, *tangents[1:], d_motion, *d_parts)
    d_rows = jax.jvp(of_parts, at, changes)[1]
    return (
        MotionAndDerivatives(motion, rows, parts),
        MotionAndDerivatives(d_motion, d_rows, d_parts),
    )


def _motion_rows(
    inverse_inertia: SymmetricEntries,
    energy2: Scalar,
    momentum: Triple,
    t: Scalar,
    motion: Motion,
    momentum_rows: VectorDerivatives,
    momentum_integral: SymmetricEntries,
    map_columns: Callable[[Callable[[Any], Any], Any], Any] = lambda f, rows: jax.vmap(f)(rows),
) -> MotionDerivatives:
    """Return the derivatives of a free motion from those of its momentum; `map_columns` maps a
    function over ten rows, all together or one after the other.
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
        back = change_unrotated(turn, start)
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


def ten_variables(inverse: Inverse, momentum: Triple, t: Scalar) -> Float[Array, "10"]:
    """Return the ten variables with respect to which all derivatives of this module are taken: d12,
    d23, k12, k13, k23, the three components of Π(0), k33 and t; or their tangents, if the arguments
    are tangents.

    Here kij are the entries of K = I⁻¹ in principal axes, and dij = kii − kjj. The variable k33 is
    the least diagonal entry. It is chosen for the sake of thin rods, where I₁ is small: the
    thickness of the rod then changes d12 alone. With k11 in the place of k33, the thickness would
    change both k11 and d12 by a term of 1/I₁², and the two terms would cancel.
    """
    d12, _, d23, k12, k13, k23 = inverse.differences
    return jnp.stack([d12, d23, k12, k13, k23, *momentum, inverse.k[2], t])


@one_kernel
def _turn_and_parts(
    constants: ClosedFormConstants, inertia: SymmetricEntries, momentum: Triple, t: Scalar
) -> tuple[MomentumAndTurn, MomentumParts]:
    """Return the motion at the time t, and the parts from which its derivatives are computed."""
    half_time = reduce_time(0.5 * t, constants.half.time, constants.modulus)
    half = elliptic_integrals(
        half_time.near, constants.modulus, constants.mu, constants.phase_factor
    )
    f, swapped = half.f, constants.swapped
    half = half._replace(
        f=f._replace(C=jnp.where(swapped, f.D, f.C), D=jnp.where(swapped, f.C, f.D))
    )
    none = half_time.halves == 0
    whole = jnp.where(none, 0.0, 2.0 * half_time.halves) * jnp.where(none, 0.0, constants.half.time)
    body, _, _ = inverse_and_energy(inertia, momentum)
    parts = momentum_jacobian(body, momentum, t, half, half_time.halves, whole, constants.half.mean)
    return from_elliptic(constants, f, half_time, t), parts


def _parts_tangent(
    inverse_inertia: Differences,
    variables: Float[Array, "10"],
    change_of_variables: Float[Array, "10"],
) -> MomentumParts:
    """Return the tangent of `MomentumParts` for a change of the ten variables.

    The motion is taken from the module `sigma_form`, where it is a smooth function of the whole
    inertia tensor.
    """

    def of_inputs(x):
        d12, d23, k12, k13, k23, p1, p2, p3, _, time = x
        d13 = inverse_inertia.d13 + ((d12 - inverse_inertia.d12) + (d23 - inverse_inertia.d23))
        return sigma_form.momentum_and_integral(
            Differences(d12, d13, d23, k12, k13, k23), (p1, p2, p3), time
        )

    def columns(x):
        # Compute the derivatives with respect to the ten variables one after the other: as one
        # batch (`jax.vmap`) they take longer to compile.
        column = lambda e: jax.jvp(of_inputs, (x,), (e,))[1]  # noqa: E731
        return jax.lax.map(column, jnp.eye(10, dtype=x.dtype))

    (_, by_inputs), (d_rows, _) = jax.jvp(columns, (variables,), (change_of_variables,))
    return MomentumParts(d_rows, tuple(jnp.sum(g * change_of_variables) for g in by_inputs))


def inverse_and_energy(inertia: SymmetricEntries, momentum: Triple) -> Inverse:
    """Return the inverse of an inertia tensor in principal axes, and twice the energy."""
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
    return Inverse(body, k, energy2)
