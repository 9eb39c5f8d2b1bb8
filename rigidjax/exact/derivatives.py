"""Compute the motion of a free body in principal axes, and the derivatives of this motion.

The motion is a function of the inertia tensor I, the body momentum Π(0) at time 0 and the time t.
Its results are the body momentum Π(t) and the turn, which is the rotation R of the body from time 0
to t, as a quaternion.

The derivative of the turn needs no elliptic integral of the third kind. Let `δR = R hat(θ)` be the
change of R for a small change of the inputs, where θ is a small rotation vector, and let h = |Π|.
The momentum is constant in space, `R Π(t) = Π(0)`, and this gives the component of θ normal to
Π(t):

    Π(t) × (Rᵀ δΠ(0) − δΠ(t)) = h² θ − Π (Π·θ)

The component of θ along Π(t) follows from `d(Π·θ)/dt = Π·δΩ = ½ δE₂ + ½ Π·δK Π`, where K = I⁻¹ and
E₂ = Π·KΠ is constant:

    Π(t)·θ = ½ t δE₂ + ½ δK : ∫₀ᵗ Π Πᵀ dt + E₂ δt.

Both δΠ(t) − δΠ(0) and R − 1 are proportional to the angle of the turn. The division of these
formulas by h² therefore loses no digits, except near rest, where the derivative comes from a Taylor
series.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Mat3, Quat, Scalar, Vec3
from rigidjax.exact import sigma_form
from rigidjax.exact.closed_form import (
    Orbit,
    momentum_and_turn,
    motion_from_functions,
    orbit,
    reduce_time,
)
from rigidjax.exact.components3 import (
    HALF,
    Four,
    Six,
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
from rigidjax.exact.jacobian import integrals, jacobian_and_integral
from rigidjax.exact.principal_axes import (
    combine_columns,
    components_along,
    principal_frame,
    tensor_in_axes,
)
from rigidjax.exact.sigma_form import Differences
from rigidjax.rotation.barrier import compiled_as_one_kernel
from rigidjax.rotation.linalg3 import components

# Below this angle of the turn, rad, the derivative of the turn comes from a series of third order
# in time. The second derivatives of the series have an error of about the square of the angle; the
# second derivatives of the closed form have an error of about the round-off divided by the angle.
_STILL = {jnp.dtype("float32"): 5e-3, jnp.dtype("float64"): 5e-6}


# Up to this number of times, a loop over the times is used: it compiles sooner than one batch of
# all times. The loop is as fast as the batch, except if only the values of one body are computed,
# without derivatives.
_LOOPED = 1000


@jax.custom_jvp
def flow(moments: Six, momentum: Triple, t: Scalar) -> tuple[Triple, Four]:
    """Return two things: the body momentum Π(t), and the quaternion of the turn from time 0 to t.

    `moments` are the entries (I11, I22, I33, I12, I13, I23) of the inertia tensor in principal
    axes, with I11 ≤ I22 ≤ I33. The last three entries are zero in value, but their derivatives are
    not. `momentum` is Π(0).
    """
    return momentum_and_turn(orbit(moments[:3], momentum), t)


@flow.defjvp
def _flow_jvp(primals, tangents):
    motion, rows, _ = motion_and_derivatives(*primals)
    d_out, d_turn, _ = _change_of_motion(motion, rows, _variables(primals, tangents)[3])
    return motion[:2], (d_out, d_turn)


def _variables(primals, tangents):
    """Return four things: the result of `reciprocal`; the change of this result; the result of
    `derivative_variables`; and the change of this result.

    `primals` are (moments, momentum, t), as for `flow`, and `tangents` are the changes of these
    three.
    """
    parts, changes = jax.jvp(reciprocal, primals[:2], tangents[:2])
    return (
        parts,
        changes,
        derivative_variables(parts, *primals[1:]),
        derivative_variables(changes, *tangents[1:]),
    )


def _change_of_motion(motion, derivative_rows, change):
    """Return three things: the change of Π(t), the change of the quaternion of the turn, and the
    change of Ω(t), if the result of `derivative_variables` changes by `change`.

    `motion` holds Π(t), the quaternion and Ω(t). `rows` holds the derivatives of Π(t), θ and Ω(t),
    where θ is the small rotation vector that changes the turn.
    """
    out, theta, rate = (tuple(jnp.sum(row * change) for row in three) for three in derivative_rows)
    return out, half_product(motion[1], theta), rate


class MotionConstants(NamedTuple):
    """Hold the constants of a free motion as plain values, through which no derivative is taken."""

    axes: Mat3
    moments: Triple
    momentum: Triple
    orbit: Orbit


@compiled_as_one_kernel
def set_up(tensor: Mat3, omega: Vec3) -> MotionConstants:
    """Return the principal axes of the inertia `tensor`, and the constants, in these axes, of the
    motion that begins with the body rate `omega`.
    """
    moments, axes = principal_frame(tensor)
    momentum = matvec(moments, components_along(axes, omega))
    return MotionConstants(axes, moments[:3], momentum, orbit(moments[:3], momentum))


@jax.custom_jvp
def body_motion(
    tensor: Mat3, omega: Vec3, setting: MotionConstants, t: Float[Array, "*n"]
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 4"]]:
    """Return two things: the body rate Ω(t), and the quaternion of the turn from time 0 to t, both
    in body axes.

    `t` is one time, or an array (n,) of times. `setting` is the result of `set_up` for the inertia
    `tensor` and the initial body rate `omega`.
    """
    del tensor, omega
    return _at_each_time(lambda time: _body_motion_at(setting, time), t)


@body_motion.defjvp
def _body_motion_jvp(primals, tangents):
    tensor, omega, setting, t = primals
    d_tensor, d_omega, _, d_t = tangents
    # The derivative is a product of two matrices, of which only the left one depends on time. The
    # part that is transposed for reverse mode is therefore short, and the right matrix is compiled
    # once.
    first = _input_derivatives(jnp.concatenate([tensor.ravel(), omega]), setting)
    out, (rates, thetas) = _at_each_time(
        lambda time: _body_motion_and_derivatives(tensor, omega, setting, time), t
    )
    # Sum products of entries: on a GPU a product of matrices is rounded to ten bits in float32.
    change = jnp.sum(first * jnp.concatenate([d_tensor.ravel(), d_omega])[None], axis=-1)
    change = jnp.broadcast_to(change, (*t.shape, 9))
    change = jnp.concatenate([change, d_t[..., None]], axis=-1)
    d_rate, theta = (
        jnp.stack([jnp.sum(row * change, axis=-1) for row in rows], axis=-1)
        for rows in (rates, thetas)
    )
    return out, (d_rate, _quaternion_change(out[1], theta))


@functools.partial(jnp.vectorize, signature="(n),(m)->(n)")
def _quaternion_change(turn: Quat, theta: Vec3) -> Quat:
    """Return the change ½ q ⊗ (0, θ) of the quaternion q = `turn` for a small rotation θ."""
    return jnp.stack(half_product(components(turn), components(theta)))


def _at_each_time(function, t):
    """Return the values of `function` at the time t, or at each of the times t."""
    if t.ndim == 0:
        return function(t)
    return jax.lax.map(function, t) if t.size <= _LOOPED else jax.vmap(function)(t)


@compiled_as_one_kernel
def _body_motion_at(s: MotionConstants, t: Scalar) -> tuple[Vec3, Quat]:
    """Return the body rate Ω(t) and the quaternion of the turn from time 0 to t, both in body axes,
    of the motion with the constants `s`.
    """
    momentum, (w, *axis) = momentum_and_turn(s.orbit, t)
    rate = tuple(p / i for p, i in zip(momentum, s.moments, strict=True))
    return jnp.stack(combine_columns(s.axes, rate)), jnp.stack(
        [w, *combine_columns(s.axes, tuple(axis))]
    )


def _moments_and_momentum(tensor: Mat3, omega: Vec3, s: MotionConstants) -> tuple[Six, Triple]:
    """Return the entries of the inertia tensor, as for `flow`, and the momentum Π(0), both in the
    principal axes of `s`.

    The two results are differentiable functions of the inertia `tensor` and the body rate `omega`
    at time 0. The principal axes are held fixed.
    """
    moments = tensor_in_axes(tensor, s.axes, s.moments)
    return moments, matvec(moments, components_along(s.axes, omega))


@compiled_as_one_kernel
def _input_derivatives(body: Float[Array, "12"], s: MotionConstants) -> Float[Array, "9 12"]:
    """Return the derivatives (9, 12) of the first nine `derivative_variables`, all except t, with
    respect to `body`.

    `body` (12,) holds the nine entries of the inertia tensor, then the three of Ω(0).
    """
    tensor, omega, axes = body[:9].reshape(3, 3), body[9:], s.axes
    moments, momentum = _moments_and_momentum(tensor, omega, s)
    # In principal axes, δK = −K δI K is −BᵀδI B with B = A K, where the columns of A are the axes.
    # The products are written as sums of products of entries, for the reason given in
    # `_body_motion_jvp`.
    k = jnp.stack(symmetric_rows(reciprocal(moments, momentum)[1]))
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
def _body_motion_and_derivatives(tensor: Mat3, omega: Vec3, s: MotionConstants, t: Scalar):
    """Return two pairs, both in body axes: Ω(t) and the quaternion of the turn; and the derivatives
    of Ω(t) and of θ with respect to `derivative_variables`.

    θ is the small rotation vector that changes the turn.
    """
    moments, momentum = _moments_and_momentum(tensor, omega, s)
    (_, (w, *axis), rate), rows, _ = motion_and_derivatives(moments, momentum, t)
    rate = combine_columns(s.axes, rate)
    turn = jnp.stack([w, *combine_columns(s.axes, tuple(axis))])
    # Return the derivatives as rows, not as matrices: in a batch, stacking the rows takes five
    # times as long as computing them.
    in_body = jax.vmap(lambda *v: combine_columns(s.axes, v))
    return (jnp.stack(rate), turn), (in_body(*rows.rate), in_body(*rows.theta))


class MotionDerivatives(NamedTuple):
    """Hold the derivatives of Π(t), θ and Ω(t) with respect to `derivative_variables`: for each of
    these vectors three rows of ten numbers.

    θ is the small rotation vector that changes the turn.
    """

    momentum: Triple
    theta: Triple
    rate: Triple


@jax.custom_jvp
@compiled_as_one_kernel
def motion_and_derivatives(moments: Six, momentum: Triple, t: Scalar):
    """Return three things: the motion, which is (Π(t), quaternion of the turn, Ω(t)); the
    derivatives of the motion, as `MotionDerivatives`; and the pair (rows, G) from which these are
    computed.

    `_first_order` returns the pair: `rows` are the derivatives of Π(t) − Π(0), and G = ∫ Π Πᵀ dt
    from 0 to t.
    """
    (out, turn), rows, g = _first_order(orbit(moments[:3], momentum), moments, momentum, t)
    _, k, energy2 = reciprocal(moments, momentum)
    motion = out, turn, matvec(k, out)
    return motion, _derivative_columns(k, energy2, momentum, t, motion, rows, g), (rows, g)


# The second derivatives come from `sigma_form`, where the motion is a function of the whole inertia
# tensor: this function is smooth to any order.
@motion_and_derivatives.defjvp
def _motion_and_derivatives_jvp(primals, tangents):
    motion, rows, parts = motion_and_derivatives(*primals)
    (body, *k), (_, *d_k), inputs, change = _variables(primals, tangents)
    d_motion = _change_of_motion(motion, rows, change)
    d_parts = _second_order(body, inputs, change)
    at, changes = (*k, *primals[1:], motion, *parts), (*d_k, *tangents[1:], d_motion, *d_parts)
    return (motion, rows, parts), (d_motion, jax.jvp(_derivative_columns, at, changes)[1], d_parts)


def _derivative_columns(
    k: Six, energy2: Scalar, momentum: Triple, t: Scalar, motion, rows, g: Six
) -> MotionDerivatives:
    """Return the derivatives of `motion`, the first result of `motion_and_derivatives`.

    `k` (the matrix K) and `energy2` (E₂) come from `reciprocal`; `rows` (the derivatives of Π(t) −
    Π(0)) and `g` (the matrix G) come from `_first_order`; `momentum` is Π(0).
    """
    out, turn, _ = motion
    p1, p2, p3 = momentum
    h2 = p1 * p1 + p2 * p2 + p3 * p3
    most = h2 * (k[0] * k[0] + k[1] * k[1] + k[2] * k[2])
    still = jax.lax.stop_gradient(most * (t * t)) <= _STILL[t.dtype] ** 2
    r = 1.0 / jnp.where(still, 1.0, h2)
    rate = matvec(k, momentum)
    pull = cross(momentum, rate)
    gain = matvec(k, pull)
    pulled = add(cross(pull, rate), cross(momentum, gain))
    squares = (p1 * p1, p2 * p2, p3 * p3, p1 * p2, p1 * p3, p2 * p3)
    weights = [c * (t * a + b) for c, a, b in zip(HALF, squares, g, strict=True)]

    def column(e, change):
        e12, e23, o12, o13, o23, e1, e2, e3, e33, et = e
        d_k, start = (e33 + e12 + e23, e33 + e23, e33, o12, o13, o23), (e1, e2, e3)
        d_out = tuple(a + b for a, b in zip(start, change, strict=True))
        back = change_by_inverse_rotation(turn, start)
        across = cross(out, tuple(a - b for a, b in zip(back, change, strict=True)))
        along = sum(a * b for a, b in zip(weights, d_k, strict=True))
        along = along + t * sum(a * b for a, b in zip(rate, start, strict=True)) + energy2 * et
        theta = tuple(r * (a + b * along) for a, b in zip(across, out, strict=True))
        # Near rest the derivative is a series in t, from θ' = δΩ − Ω × θ with Ω = KΠ and Π' = Π ×
        # Ω.
        faster = add(matvec(d_k, momentum), matvec(k, start))
        d_pull = add(cross(start, rate), cross(momentum, faster))
        gained = add(matvec(d_k, pull), matvec(k, d_pull))
        bent = add(gained, cross(faster, rate))
        d_jerk = add(add(cross(d_pull, rate), cross(pull, faster)), cross(start, gain))
        jerk = add(d_jerk, cross(momentum, gained))
        third = add(matvec(d_k, pulled), matvec(k, jerk))
        third = add(add(third, cross(add(faster, faster), gain)), cross(bent, rate))
        near = zip(faster, bent, third, matvec(k, out), strict=True)
        near = tuple(t * (a + t * (b / 2 + t * c / 6)) + et * d for a, b, c, d in near)
        theta = tuple(jnp.where(still, a, b) for a, b in zip(near, theta, strict=True))
        return d_out, theta, add(matvec(k, d_out), matvec(d_k, out))

    return MotionDerivatives(*jax.vmap(column)(jnp.eye(10, dtype=t.dtype), rows))


def derivative_variables(parts, momentum: Triple, t: Scalar) -> Float[Array, "10"]:
    """Return d12, d23, k12, k13, k23, Π(0), k33 and t: all derivatives of this module are taken
    with respect to these ten variables.

    `parts` is the result of `reciprocal`, or the change of this result; `momentum` and t are then
    changes, too. Here kij are the entries of K = I⁻¹, and dij = kii − kjj. The variable k33 is the
    least diagonal entry. With k33, the thickness of a rod changes d12 alone; with k11 instead, the
    thickness would change both k11 and d12 by a term of 1/I₁², and the two terms would cancel.
    """
    body, k, _ = parts
    return jnp.stack([body.d12, body.d23, body.k12, body.k13, body.k23, *momentum, k[2], t])


@compiled_as_one_kernel
def _first_order(o: Orbit, moments: Six, momentum: Triple, t: Scalar):
    """Return three things: the result of `flow`; the derivatives of Π(t) − Π(0) with respect to
    `derivative_variables`, as three rows; and the matrix G = ∫ Π Πᵀ dt from 0 to t.

    `o` holds the constants of the motion; `moments`, `momentum` and t are as for `flow`.
    """
    u = reduce_time(0.5 * t, o.half.time, o.modulus)
    at = integrals(u.near, o.modulus, o.mu, o.turn)
    f = at.f._replace(
        C=jnp.where(o.swapped, at.f.D, at.f.C), D=jnp.where(o.swapped, at.f.C, at.f.D)
    )
    none = u.halves == 0
    whole = jnp.where(none, 0.0, 2.0 * u.halves) * jnp.where(none, 0.0, o.half.time)
    body, _, _ = reciprocal(moments, momentum)
    half = at._replace(f=f)
    rows, g = jacobian_and_integral(body, momentum, t, half, u.halves, whole, o.half.mean)
    return motion_from_functions(o, at.f, u, t), rows, g


def _second_order(body: Differences, inputs, change):
    """Return two changes to first order: of the derivatives that `_first_order` returns, and of G.

    G = ∫ Π Πᵀ dt is that of `sigma_form`. The motion is taken as a function of the whole inertia
    tensor. `body` holds the matrix K, `inputs` is the result of `derivative_variables`, and
    `change` is the change of these variables.
    """

    def of_inputs(x):
        d12, d23, k12, k13, k23, p1, p2, p3, _, time = x
        d13 = body.d13 + ((d12 - body.d12) + (d23 - body.d23))
        return sigma_form.momentum_and_integral(
            Differences(d12, d13, d23, k12, k13, k23), (p1, p2, p3), time
        )

    def columns(x):
        # Compute one column after the other: a batch of columns takes longer to compile.
        column = lambda e: jax.jvp(of_inputs, (x,), (e,))[1]  # noqa: E731
        return jax.lax.map(column, jnp.eye(10, dtype=x.dtype))

    (_, by_inputs), (d_rows, _) = jax.jvp(columns, (inputs,), (change,))
    return d_rows, tuple(jnp.sum(g * change) for g in by_inputs)


def reciprocal(moments: Six, momentum: Triple):
    """Return three things: the `Differences` of K = I⁻¹; the six entries of K; and E₂ = Π·KΠ, which
    is twice the energy.
    """
    i1, i2, i3, i12, i13, i23 = moments
    r = 1.0 / determinant(moments)
    k = tuple(c * r for c in adjugate(moments))
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
