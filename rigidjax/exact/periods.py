"""Compute the two periods of a free body: of its body rates, and of its precession."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rigidjax import _checks
from rigidjax._types import Mat3, Scalar, Vec3, Vec3Like
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia
from rigidjax.body.scaling import binary_exponent, times_power_of_two
from rigidjax.exact import sigma_form
from rigidjax.exact.components3 import HALF, SymmetricEntries, Triple, matvec
from rigidjax.exact.derivatives import inverse_and_energy, motion_and_derivatives
from rigidjax.exact.jacobi_duplication import Modulus, half_period, is_aperiodic
from rigidjax.exact.principal_axes import components_along, principal_axes


def body_period(inertia: Inertia, omega0: Vec3Like) -> Scalar:
    """Return the time after which the body rates repeat, while the momentum circles an axis of the
    body once.

    In this time the angular momentum goes once round the axis of the smallest or largest moment in
    the body frame (5.41 days about the long axis for 4179 Toutatis). For a spin about a stable axis
    the result is the period of small wobbles. The result is infinite on the separatrix, for a
    sphere and at rest.

    **Arguments:**

    - `inertia`: of the body about its centre of mass, kg m².
    - `omega0`: (3,) Ω at any moment, rad/s, body frame.

    **Returns** the period, a scalar, s.

    `T = 2π/agm(√(e₁ − e₂), √(e₁ − e₃))`, where agm is the arithmetic–geometric mean, and e₁, e₂, e₃
    are the eigenvalues of the matrix E in `rigidjax.exact.sigma_form`; e₁ is the largest (DLMF
    19.8.5; Landau and Lifshitz, Mechanics, eq 37.11).

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype, or for a principal moment that
    is zero and not traced by JAX.

    >>> top = rj.Inertia.from_principal(1.0, 2.0, 2.0)
    >>> bool(abs(body_period(top, jnp.array([1.0, 0.5, 0.0])) - 4 * jnp.pi) < 1e-14)
    True
    """
    return _checked_periods(inertia, omega0)[0]


def precession_period(inertia: Inertia, omega0: Vec3Like) -> Scalar:
    """Return the mean time in which the axis that the momentum circles turns once about the angular
    momentum.

    This axis of the body turns about the angular momentum, which is fixed in space; the result is
    2π over the mean rate of this turn (7.35 days for the long axis of 4179 Toutatis). If the
    momentum circles no axis (separatrix, sphere) the result is the limit, `2π I₂/|L|`. It is
    infinite at rest.

    **Arguments:** `inertia` of the body about its centre of mass, kg m²; `omega0` (3,) the body
    rate at any moment, rad/s, body frame. **Returns** a scalar, s.

    In one body period this axis turns by the angle χ + 2π if it has the largest moment, and by χ −
    2π if it has the smallest. Here χ is the angle by which the body turns about its momentum, a
    complete integral of the third kind (DLMF 19.8.7).

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype, or for a principal moment that
    is zero and not traced by JAX.

    >>> top = rj.Inertia.from_principal(1.0, 2.0, 2.0)
    >>> precession_period(top, jnp.array([1.0, 0.5, 0.0]))  # 2π I₂/|L|
    Array(8.88576588, dtype=float64)
    """
    return _checked_periods(inertia, omega0)[1]


def _checked_periods(inertia: Inertia, omega0: Vec3Like) -> tuple[Scalar, Scalar]:
    """Return the body period and the precession period after checks of the arguments."""
    _checks.require_unbatched_instance(
        inertia, Inertia, "inertia", hint="of MassProperties pass .inertia"
    )
    tensor = validation.require_physical_body(inertia, throw=False).tensor
    rate = _checks.array_of_shape(omega0, (3,), "omega0").astype(tensor.dtype)
    return _periods(tensor, rate)


@jax.jit
def _periods(tensor: Mat3, omega: Vec3) -> tuple[Scalar, Scalar]:
    """Return the body period and the precession period, s, from one program."""
    exponent = binary_exponent(omega)
    moments, axes = principal_axes(times_power_of_two(tensor, -binary_exponent(tensor)))
    momentum = matvec(moments, components_along(axes, times_power_of_two(omega, -exponent)))
    body, _, _ = inverse_and_energy(moments, momentum)
    v = sigma_form.invariants(body, momentum)
    h = jnp.sqrt(sum(p * p for p in momentum))
    endless = is_aperiodic(jax.lax.stop_gradient(Modulus(v.p, v.q, v.gap)))
    # If the motion has no period, compute the period of another motion, whose result is discarded
    # below: JAX differentiates both branches of `where`, and the derivative of the discarded one
    # must not be NaN.
    one, zero = jnp.ones_like(h), jnp.zeros_like(h)
    other = (one, 2 * one, 3 * one, zero, zero, zero), (one, zero, zero)
    safe_moments, safe_momentum = jax.tree.map(
        lambda a, b: jnp.where(endless, a, b), other, (moments, momentum)
    )
    body, _, _ = inverse_and_energy(safe_moments, safe_momentum)
    period = sigma_form.momentum_period(sigma_form.invariants(body, safe_momentum))
    angle = _precession_angle(safe_moments, safe_momentum, period)
    still = h == 0
    middle = 2.0 * math.pi * moments[1] / jnp.where(still, 1.0, h)
    precession = jnp.where(endless, middle, 2.0 * math.pi * period / angle)
    period, precession = jnp.where(endless, jnp.inf, period), jnp.where(still, jnp.inf, precession)
    return times_power_of_two(period, -exponent), times_power_of_two(precession, -exponent)


@jax.custom_jvp
def _precession_angle(inertia: SymmetricEntries, momentum: Triple, period: Scalar) -> Scalar:
    """Return the angle, rad, by which the axis that the momentum circles turns about the momentum
    in one `period` of the body rate.
    """
    body, k, _ = inverse_and_energy(inertia, momentum)
    v = sigma_form.invariants(body, momentum)
    about_three, h = v.a2 > 0, jnp.sqrt(v.h2)
    mu = jnp.where(about_three, body.d23 * v.a3, body.d12 * v.a1)
    rate = jnp.where(about_three, -body.d13, body.d13) * h * mu
    half = half_period(Modulus(v.p, v.q, v.gap), mu, rate)
    turn = jnp.where(about_three, k[2], k[0]) * h * period - 2.0 * half.phase
    return turn + jnp.where(about_three, 2.0 * math.pi, -2.0 * math.pi)


@_precession_angle.defjvp
def _precession_angle_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[Scalar, Scalar]:
    """Return the angle and its tangent, by the formula for Π·θ in the head of `derivatives`."""
    moments, momentum, period = primals
    (_, _, energy2), (_, d_k, d_energy2) = jax.jvp(
        inverse_and_energy, (moments, momentum), tangents[:2]
    )
    g = _period_integral(moments, momentum, period)
    along = 0.5 * period * d_energy2 + energy2 * tangents[2]
    along = along + sum(w * a * b for w, a, b in zip(HALF, g, d_k, strict=True))
    h = jnp.sqrt(sum(p * p for p in momentum))
    return _precession_angle(*primals), along / h


@jax.custom_jvp
def _period_integral(
    inertia: SymmetricEntries, momentum: Triple, period: Scalar
) -> SymmetricEntries:
    """Return G = ∫ Π Πᵀ dt over one `period` of the body rate, in principal axes.

    The integral of the product of two different components is zero. The squares of the components
    have the means `A₃(1 − p⟨S²⟩)/d₁₃`, `A₁A₃⟨S²⟩` and `A₁(1 − q⟨S²⟩)/d₁₃`, with the numbers of
    `sigma_form.invariants`, and ⟨S²⟩ of `half_period`.
    """
    body, _, _ = inverse_and_energy(inertia, momentum)
    v = sigma_form.invariants(body, momentum)
    mean = half_period(Modulus(v.p, v.q, v.gap), jnp.zeros_like(period), period).mean
    zero = jnp.zeros_like(period)
    g11 = period * v.a3 * (1.0 - v.p * mean) / body.d13
    g33 = period * v.a1 * (1.0 - v.q * mean) / body.d13
    return g11, period * v.a1 * v.a3 * mean, g33, zero, zero, zero


@_period_integral.defjvp
def _period_integral_jvp(
    primals: tuple[SymmetricEntries, Triple, Scalar],
    tangents: tuple[PyTree, ...],
) -> tuple[SymmetricEntries, SymmetricEntries]:
    """Return G over one period and its tangent.

    The closed form holds for a diagonal tensor alone. The tangent is therefore that of the integral
    from 0 to a time t, which is known for the whole tensor. Its program takes seconds to compile,
    and first derivatives do not need it.
    """
    of_time = lambda *at: motion_and_derivatives(*at).parts.integral  # noqa: E731
    change = jax.jvp(of_time, primals, tangents)[1]
    return _period_integral(*primals), change
