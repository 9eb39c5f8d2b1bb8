"""Compute the first derivatives of the free momentum in closed form, in principal axes.

Let S, C and D be the elliptic functions of a free body, with C² = 1 − pS² and D² = 1 − qS²
(`jacobi_duplication`). Let E be D if p > q, else C: this function has no zero. Let f = S/E, and let
`Y₂ = ∫ S²` and `Y = ∫ f²` be integrals from time 0. The changes δS, δC, δD for changes of t, p and
q follow from the derivative `∂τ/∂p = ½ ∫ S²/C² …` of the time τ as a function of S, without any
division by p, q or p − q:

    θ = δt + ½ δ|p−q| Y + ½ δmax(p,q) Y₂
    δS = C D θ − ½ S³ δmax,   δC = −p S D θ − ½ S² C δmax (+ ½ S² δ|p−q|/C if q > p),   …

Y₂ and Y at 2u follow from the values at u, as in `Y(2u) = 2Y(u) + f(u)² f(2u)`, and in each whole
period Y₂ and Y grow by the period times the mean of S² or of f². Off-diagonal entries of K = I⁻¹
enter through the divided differences of T = diag(D, 1, C), which the last doubling gives without a
quotient. The derivatives are equal to the derivatives of the motion in `sigma_form`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar
from rigidjax.exact.components3 import SymmetricEntries, Triple
from rigidjax.exact.jacobi_duplication import (
    Elliptic,
    Modulus,
    doubled_functions,
    elliptic_series,
    iteration_limits,
    third_kind_series,
)
from rigidjax.exact.sigma_form import Differences, invariants


class Integrals(NamedTuple):
    """Hold the elliptic functions of a free body at some time u, and the integrals over the time
    from 0 to u that the head of this module names.
    """

    f: Elliptic
    y2: Scalar  # Y₂ = ∫ S² du
    y: Scalar  # Y = ∫ S²/E² du


class MomentumParts(NamedTuple):
    """Hold the derivatives of Π(t) − Π(0) with respect to the variables of `ten_variables`,
    one array for each component, and the matrix G = ∫ Π Πᵀ dt from 0 to t.

    All derivatives of a free motion follow from them.
    """

    rows: tuple[Float[Array, "10"], ...]
    integral: SymmetricEntries


def momentum_jacobian(
    inverse_inertia: Differences,
    momentum: Triple,
    t: Scalar,
    half_time_integrals: Integrals,
    halves: Scalar,
    duration_of_halves: Scalar,
    mean_of_s_squared: Scalar,
) -> MomentumParts:
    """Return the derivatives of the momentum and the matrix G; `inverse_inertia` is diagonal.

    The `half_time_integrals` are those at t/2 less `halves` half periods, with the p and q of
    `sigma_form.invariants` for the axes in the order of `inverse_inertia`; 2 × `halves` half
    periods last `duration_of_halves`; the mean of S² is that over a period.
    """
    d12, d13, d23 = inverse_inertia[:3]
    p1, p2, p3 = momentum
    _, A1, A2, A3, q, p, gap, *_ = invariants(inverse_inertia, momentum)
    m = Modulus(p, q, gap)
    three = gap > 0
    top = jnp.where(three, p, q)
    after = doubled_integrals(half_time_integrals, m, jnp.zeros_like(t), jnp.zeros_like(t))
    S, C, D, *_ = after.f
    grown2 = after.y2 + duration_of_halves * mean_of_s_squared
    grown = after.y + duration_of_halves * (1.0 - top * mean_of_s_squared) / jnp.where(
        halves == 0, 1.0, jnp.abs(gap)
    )

    # The diagonal matrix T = diag(D, 1, C), with the elliptic functions D and C at the time t, is a
    # function of the inverse inertia K. If the entry k12 of K changes, the entry 12 of T changes by
    # t12 times this change; t13 and t23 are the factors for the entries 13 and 23. Each factor is a
    # divided difference of two diagonal entries of T.
    f = half_time_integrals.f
    s, cc, dd = f.S * f.S, f.C * f.C, f.D * f.D
    g = 2.0 * s / (cc + p * s * dd)
    t12, t13, t23 = -g * cc * A3, g * A2, g * dd * A1

    u1, u2, u3 = -d23 * p2 * p3, d13 * p1 * p3, -d12 * p1 * p2
    y1, y2, y3 = p1 * C + S * D * u1, p2 * C * D + S * u2, p3 * D + S * C * u3
    z = jnp.where(three, d12 * d13 * p1 * p1, d13 * d23 * p3 * p3)
    ss, tt = S * S, jnp.where(three, D, C)
    rw = 1.0 / (tt * tt + ss * z)
    m1, m2, m3 = y1 * rw, y2 * rw, y3 * rw
    # The body momentum Π(t) is the vector (y1, y2, y3) divided by W = 1/rw. The derivatives of
    # Π(t) − Π(0) need C − W, CD − W and D − W. For short times compute these from C − 1, D − 1 and
    # W − 1, which are small and are found without a subtraction of nearly equal numbers.
    w1 = ss * (z - jnp.where(three, q, p))
    short = jnp.abs(w1) < 0.5
    c1 = jnp.where(C > 0, -p * ss / (1.0 + jnp.abs(C)), C - 1.0)
    d1 = jnp.where(D > 0, -q * ss / (1.0 + jnp.abs(D)), D - 1.0)
    one1 = jnp.where(short, c1 - w1, C)
    one2 = jnp.where(short, c1 * D + d1 - w1, C * D)
    one3 = jnp.where(short, d1 - w1, D)
    less = jnp.where(short, 0.0, 1.0)
    rc, rd = 0.5 * ss / jnp.where(three, 1.0, C), 0.5 * ss / jnp.where(three, D, 1.0)

    def tangent(e12, e23, o12, o13, o23, e1, e2, e3, _, et):
        e13 = e12 + e23
        mixed = 2.0 * (o12 * (p1 * p2) + o13 * (p1 * p3) + o23 * (p2 * p3))
        dA1 = e12 * (p2 * p2) + e13 * (p3 * p3) + 2.0 * (e2 * (d12 * p2) + e3 * (d13 * p3)) - mixed
        dA3 = e13 * (p1 * p1) + e23 * (p2 * p2) + 2.0 * (e1 * (d13 * p1) + e2 * (d23 * p2)) + mixed
        dA2 = e23 * (p3 * p3) - e12 * (p1 * p1) + 2.0 * (e3 * (d23 * p3) - e1 * (d12 * p1)) - mixed
        dp, dq = e23 * A1 + d23 * dA1, e12 * A3 + d12 * dA3
        dgap = e13 * A2 + d13 * dA2
        dgap, dtop = jnp.where(three, dgap, -dgap), jnp.where(three, dp, dq)
        theta = et + 0.5 * (dgap * grown + dtop * grown2)
        shrink = 0.5 * ss * dtop
        dS = C * D * theta - S * shrink
        dC = -p * S * D * theta - C * shrink + jnp.where(three, 0.0, rc * dgap)
        dD = -q * S * C * theta - D * shrink + jnp.where(three, rd * dgap, 0.0)
        x12, x13, x23 = o12 * t12, o13 * t13, o23 * t23
        du1 = -e23 * (p2 * p3) - d23 * (e2 * p3 + e3 * p2) - o12 * (p1 * p3)
        du1 = du1 + o13 * (p1 * p2) + o23 * (p2 * p2 - p3 * p3)
        du2 = e13 * (p1 * p3) + d13 * (e1 * p3 + e3 * p1) + o12 * (p2 * p3)
        du2 = du2 + o13 * (p3 * p3 - p1 * p1) - o23 * (p1 * p2)
        du3 = -e12 * (p1 * p2) - d12 * (e1 * p2 + e2 * p1) + o12 * (p1 * p1 - p2 * p2)
        du3 = du3 - o13 * (p2 * p3) + o23 * (p1 * p3)
        dy1 = e1 * one1 + p1 * dC - x12 * C * p2 - x13 * p3 + dS * D * u1
        dy1 = dy1 + S * (dD * u1 + D * du1 + x12 * u2 + x13 * u3)
        dy2 = e2 * one2 + p2 * (dC * D + C * dD) - x12 * C * p1 - x23 * D * p3
        dy2 = dy2 + dS * u2 + S * (du2 + x12 * u1 + x23 * u3)
        dy3 = e3 * one3 + p3 * dD - x13 * p1 - x23 * D * p2 + dS * C * u3
        dy3 = dy3 + S * (dC * u3 + C * du3 + x13 * u1 + x23 * u2)
        dz1 = 2.0 * p1 * (d12 * d13 * e1 + d13 * o12 * p2 + d12 * o13 * p3)
        dz3 = 2.0 * p3 * (d13 * d23 * e3 - d23 * o13 * p1 - d13 * o23 * p2)
        dz1 = (e12 * d13 + d12 * e13) * (p1 * p1) + dz1
        dz3 = (e13 * d23 + d13 * e23) * (p3 * p3) + dz3
        dz = jnp.where(three, dz1, dz3)
        dw = 2.0 * (tt * jnp.where(three, dD, dC) + S * dS * z) + ss * dz
        return (
            (dy1 - m1 * dw) * rw - e1 * less,
            (dy2 - m2 * dw) * rw - e2 * less,
            (dy3 - m3 * dw) * rw - e3 * less,
        )

    rows = jax.vmap(lambda e: tangent(*e))(jnp.eye(10, dtype=t.dtype))

    # The entry 22 of G = ∫ Π Πᵀ dt is computed first. The entries 11 and 33 follow from it, because
    # A₁ = d₁₂Π₂² + d₁₃Π₃² and A₃ = d₁₃Π₁² + d₂₃Π₂² are constants of the motion. The off-diagonal
    # entries are computed last.
    g22 = A1 * A3 * grown2 + (S * C * D * p2 * p2 + ss * p2 * u2) * rw
    still = d13 == 0
    rest = (g22 - p2 * p2 * t) / jnp.where(still, 1.0, d13)
    g11, g33 = p1 * p1 * t - d23 * rest, p3 * p3 * t - d12 * rest
    h = 0.5 * ss
    g12 = (p1 * p2 * S * C + h * (p1 * u2 + p2 * u1) + 0.5 * p3 * d12 * t12 * t12) * rw
    g13 = (p1 * p3 * S + h * (p1 * u3 + p3 * u1) - 0.5 * p2 * d13 * t13 * t13) * rw
    g23 = (p2 * p3 * S * D + h * (p2 * u3 + p3 * u2) + 0.5 * p1 * d23 * t23 * t23) * rw
    return MomentumParts(rows, (g11, g22, g33, g12, g13, g23))


def elliptic_integrals(u: Scalar, modulus: Modulus, mu: Scalar, phase_factor: Scalar) -> Integrals:
    """Return elliptic functions, phase and integrals at u, at most a quarter period."""
    n = iteration_limits(u.dtype).doublings
    f = elliptic_series(u * 2.0**-n, modulus, mu, phase_factor)
    # The integrand S²/D² is S²/(1 + μS²) with μ = −q, and S²/C² is the same with μ = −p: one series
    # serves for both.
    low = jnp.where(modulus.gap > 0, -modulus.q, -modulus.p)
    first = Integrals(
        f,
        third_kind_series(f.S, modulus, jnp.zeros_like(u)),
        third_kind_series(f.S, modulus, low),
    )
    return jax.lax.fori_loop(
        0,
        n,
        lambda _, g: doubled_integrals(g, modulus, mu, phase_factor),
        first,
    )


def doubled_integrals(
    start: Integrals, modulus: Modulus, mu: Scalar, phase_factor: Scalar
) -> Integrals:
    """Return the elliptic functions and integrals at the time 2u from those at the time u."""
    f, three = start.f, modulus.gap > 0
    after = doubled_functions(f, modulus, mu, phase_factor)
    a, b = f.S / jnp.where(three, f.D, f.C), after.S / jnp.where(three, after.D, after.C)
    return Integrals(after, 2.0 * start.y2 + f.S * f.S * after.S, 2.0 * start.y + a * a * b)
