"""Compute the free motion as a smooth function of the whole inertia tensor, for its derivatives.

Principal axes are not a smooth function of a tensor, but the motion is. With `K = I⁻¹`, Π the body
momentum, `E₂ = Π·KΠ` and `h = |Π|`, let

    E = E₂ K + h² adj(K)      (symmetric; commutes with K)

Let σ(u) be a scalar and T(u) a matrix that commutes with K, both fixed up to a common factor, with

    T² = w 1 − σ² E,   T(2u) = T⁴ − σ⁴ χ'(E),   σ(2u) = 2 σ det T

Here w is a number, 1 the unit matrix, and χ' the derivative of the characteristic polynomial χ of
E. The number σ and the eigenvalues σ₁, σ₂, σ₃ of T are Weierstrass's four sigma functions. Their
addition theorem then reads

    Π(t) ∝ adj(T) Π + σ T (Π × KΠ),   T and σ at t,   |Π(t)| = h

Let now k = Π(t/2), let T and σ be taken at u = t/2, let W be the number by which the right side of
the last formula must be divided to give Π(t) (see `DivisorTerms`), and let `Y = ∫₀ᵘ σ² T⁻² du`,
with `Y(2u) = 2Y + (σT⁻¹)²(u) (σT⁻¹)(2u)`. Then

    G = ∫₀ᵗ Π Πᵀ dt = 2σ/(W det T) (adj(T)k)(adj(T)k)ᵀ − 2 adj(E₂ 1 − h² K) Y.

Proof of the formula for Π(t): in principal axes of K, with the diagonal entries a₁, a₂, a₃, it is
Jacobi's solution with T = diag(D, 1, C), σ = S, by `E₃₃ − E₂₂ = (a₂ − a₃)(a₁h² − E₂) = p`, `E₁₁ −
E₂₂ = q`; and both sides of the formula turn with the axes. All terms but the length |Π(t)| are
polynomial in K: a sphere or a symmetric top is an ordinary point. Proof of the formula for G:
differentiate it in principal axes, where T = diag(τ₁, τ₂, τ₃) and g = σ/τᵢ has the derivative g' =
τⱼτₗ/τᵢ², with the three indices i, j and l; the choice of k, the momentum at the mid point, removes
the even terms.

The functions are evaluated in principal axes of K. The off-diagonal entries of K are therefore zero
in value, and only their tangents are not. The differences of the
diagonal entries are arguments, and so they are accurate. If an entry of a matrix can be written in
several equal forms, the form without cancellation is used.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import Scalar
from rigidjax.exact.components3 import (
    SymmetricEntries,
    Triple,
    adjugate,
    commuting_product,
    determinant,
    matvec,
)
from rigidjax.exact.jacobi_duplication import (
    Modulus,
    clip_time,
    is_aperiodic,
    iteration_limits,
)
from rigidjax.rotation.barrier import barrier


class Differences(NamedTuple):
    """Hold K = I⁻¹, the inverse of an inertia tensor in principal axes, 1/(kg m²), up to a multiple
    of the unit matrix: the differences dij = kii − kjj and the off-diagonal entries.
    """

    d12: Scalar
    d13: Scalar
    d23: Scalar
    k12: Scalar
    k13: Scalar
    k23: Scalar


class Invariants(NamedTuple):
    """Hold the constants of a free motion from which its sigma functions are computed: the entries
    of the matrix E − E₂₂ 1, and the numbers from which these follow.
    """

    h2: Scalar  # h² = |Π|²
    a1: Scalar  # k₁₁h² − E₂
    a2: Scalar  # k₂₂h² − E₂
    a3: Scalar  # E₂ − k₃₃h²
    q: Scalar  # the entry 11 of E − E₂₂ 1
    p: Scalar  # the entry 33
    gap: Scalar  # p − q, computed without a subtraction of q from p
    e12: Scalar
    e13: Scalar
    e23: Scalar


class Sigma(NamedTuple):
    """Hold Weierstrass's four sigma functions of a free motion at some time u, the number σ and the
    eigenvalues of the matrix T, each matrix as its entries (11, 22, 33, 12, 13, 23).
    """

    s: Scalar  # σ; the factor common to σ and T is chosen so that T₂₂ = 1
    t: SymmetricEntries  # T
    adjugate: SymmetricEntries  # of T
    det: Scalar  # of T
    y: SymmetricEntries  # Y = ∫₀ᵘ σ² T⁻² du


class MomentumAndIntegral(NamedTuple):
    """Hold the body momentum Π after some time, and G = ∫ Π Πᵀ dt over it (or a term of G)."""

    momentum: Triple
    integral: SymmetricEntries


def invariants(inverse_inertia: Differences, momentum: Triple) -> Invariants:
    """Return the constants of a free motion from K and the initial momentum."""
    d12, d13, d23, k12, k13, k23 = inverse_inertia
    p1, p2, p3 = momentum
    x1, x2, x3 = p1 * p1, p2 * p2, p3 * p3
    h2 = x1 + x2 + x3
    mixed = 2.0 * (k12 * (p1 * p2) + k13 * (p1 * p3) + k23 * (p2 * p3))
    h2, mixed = barrier((h2, mixed))
    a1 = d12 * x2 + d13 * x3 - mixed
    a2 = d23 * x3 - d12 * x1 - mixed
    a3 = d13 * x1 + d23 * x2 + mixed
    a1, a2, a3 = barrier((a1, a2, a3))
    s12, s13, s23 = k12 * k12, k13 * k13, k23 * k23
    return Invariants(
        h2,
        a1,
        a2,
        a3,
        d12 * a3 + h2 * (s13 - s23),
        d23 * a1 + h2 * (s13 - s12),
        d13 * a2 + h2 * (s23 - s12),
        k12 * a3 + h2 * (k13 * k23),
        h2 * (k12 * k23) - k13 * a2,
        h2 * (k12 * k13) - k23 * a1,
    )


# The time is halved, and later doubled, this many times more often than `iteration_limits` says: at
# so short a time two terms of the series in `sigma_series` are enough.
_MORE = 10


def sigma_series(u: Scalar, constants: Invariants) -> Sigma:
    """Return the sigma functions at a time u so short that two Taylor terms are exact.

    The matrix T = √(1 − X) is taken to second order in the matrix X = σ² (E − E₂₂ 1).
    """
    uu, zero = u * u, jnp.zeros_like(u)
    c1 = (constants.p + constants.q) * uu
    s = barrier(u * (1.0 - c1 / 6))
    x = barrier(
        _scaled_matrix(
            (constants.q, zero, constants.p, constants.e12, constants.e13, constants.e23), s * s
        )
    )
    t = tuple(-0.5 * (a + 0.25 * b) for a, b in zip(x, commuting_product(x, x), strict=True))
    # The integral Y of σ² T⁻² from 0 to u is ⅓u³ (1 − c₁/5 + 3X/5) to the fifth power of u, where
    # `c1` is c₁ = (p + q) u², and `x` is the matrix X of the docstring.
    y = _scaled_matrix(_shifted_matrix(_scaled_matrix(x, 0.6), 1.0 - 0.2 * c1), u * uu / 3)
    return _normalised_sigma(s, _shifted_matrix(t, 1.0), y)


def doubled_sigma(sigma: Sigma, constants: Invariants) -> Sigma:
    """Return the sigma functions at 2u by T(2u) = T⁴ − σ⁴ χ'(E) and σ(2u) = 2 σ det T."""
    t1, t2, t3, t12, t13, t23 = sigma.t
    s = sigma.s
    ss = s * s
    *_, q, p, gap, e12, e13, e23 = constants
    s12, s13, s23 = t12 * t12, t13 * t13, t23 * t23
    # By T² = w 1 − σ²E, the off-diagonal entries of M = T² are exactly those of −σ²E.
    m11, m22, m33 = t1 * t1 + s12 + s13, t2 * t2 + s12 + s23, t3 * t3 + s13 + s23
    m12, m13, m23 = -ss * e12, -ss * e13, -ss * e23
    m11, m22, m33, m12, m13, m23 = barrier((m11, m22, m33, m12, m13, m23))
    x12, x13, x23 = barrier((m12 * m12, m13 * m13, m23 * m23))
    n22 = 0.5 * (
        m22 * (m11 + m33)
        - (x12 + x23)
        + ss * (p * m11 + q * m33 - 2.0 * e13 * m13 + e12 * m12 + e23 * m23)
    )
    n22 = barrier(n22)
    n11 = jnp.where(
        ss * jax.lax.stop_gradient(q) < 0.5,
        n22 - 2.0 * (m33 * (ss * q) + (x13 - x23)),
        m11 * m11 + x12 + x13 - ss * ss * (2.0 * (e12 * e12 + e13 * e13) - e23 * e23 - q * gap),
    )
    n33 = jnp.where(
        ss * jax.lax.stop_gradient(p) < 0.5,
        n22 - 2.0 * (m11 * (ss * p) + (x13 - x12)),
        m33 * m33 + x13 + x23 - ss * ss * (2.0 * (e13 * e13 + e23 * e23) - e12 * e12 + p * gap),
    )
    n12 = 2.0 * (m12 * m33 - m13 * m23)
    n13 = 2.0 * (m13 * m22 - m12 * m23)
    n23 = 2.0 * (m23 * m11 - m12 * m13)
    after = _normalised_sigma(2.0 * s * sigma.det, (n11, n22, n33, n12, n13, n23), sigma.y)
    # The integral Y = ∫₀ᵘ σ² T⁻² du at the double time is Y(2u) = 2Y + (σT⁻¹)²(u) (σT⁻¹)(2u).
    before = barrier(_scaled_matrix(sigma.adjugate, s / sigma.det))
    more = commuting_product(
        barrier(commuting_product(before, before)),
        _scaled_matrix(after.adjugate, after.s / after.det),
    )
    return after._replace(y=barrier(tuple(2.0 * a + b for a, b in zip(sigma.y, more, strict=True))))


class DivisorTerms(NamedTuple):
    """Hold the terms and factors that do not depend on Π of the divisor W in the addition theorem
    Π(t) = (adj(T) Π + σ T (Π × KΠ))/W.

    It is `W = (T²)ᵢᵢ + σ² (Eᵢᵢ − Tr K E₂ + |KΠ|²)`, where i is 1 if `first` is true, else 3: with
    this choice W is a sum of positive terms. The number `square` is (T²)ᵢᵢ. The factor of σ² is `d
    Πᵢ² + 2 d13 k Πᵢ Π₂ + 2 slant k13 Π₁ Π₃ + |KΠ|² − less`, where K in KΠ is taken without its
    diagonal.
    """

    first: Array
    square: Scalar
    d: Scalar
    slant: Scalar
    k: Scalar
    less: Scalar


def divisor_of_step(
    inverse_inertia: Differences, constants: Invariants, sigma_of_step: Sigma
) -> DivisorTerms:
    """Return the terms of W for a step whose sigma functions are given."""
    one, three = (
        (inverse_inertia.d12, inverse_inertia.d12, inverse_inertia.k12),
        (inverse_inertia.d23, -inverse_inertia.d23, -inverse_inertia.k23),
    )
    first, (t1, _, t3, t12, t13, t23) = constants.gap > 0, sigma_of_step.t
    d, slant, k = (jnp.where(first, a, b) for a, b in zip(one, three, strict=True))
    t, off = jnp.where(first, t1, t3), jnp.where(first, t12, t23)
    less = jnp.where(first, inverse_inertia.k23, inverse_inertia.k12)
    square = t * t + off * off + t13 * t13
    return DivisorTerms(
        first, square, inverse_inertia.d13 * d, slant, k, constants.h2 * (less * less)
    )


def step_and_integral_term(
    inverse_inertia: Differences,
    divisor_terms: DivisorTerms,
    sigma_of_step: Sigma,
    momentum: Triple,
) -> MomentumAndIntegral:
    """Return the momentum after a step of time u, and the first term of the integral G over an
    interval of length 2u, 2σ/(W det T) (adj(T)Π)(adj(T)Π)ᵀ with Π = `momentum`.

    The interval has its mid point at the beginning of the step. The head of this module gives the
    other term.
    """
    p1, p2, p3 = momentum
    d12, d13, d23, k12, k13, k23 = inverse_inertia
    # The numbers r1, r2 and r3 are the components of KΠ, with K taken without its diagonal.
    r1, r2, r3 = barrier((k12 * p2 + k13 * p3, k12 * p1 + k23 * p3, k13 * p1 + k23 * p2))
    u1 = -d23 * p2 * p3 + p2 * r3 - p3 * r2
    u2 = d13 * p1 * p3 + p3 * r1 - p1 * r3
    u3 = -d12 * p1 * p2 + p1 * r2 - p2 * r1
    adj, turned = barrier(
        (matvec(sigma_of_step.adjugate, momentum), matvec(sigma_of_step.t, barrier((u1, u2, u3))))
    )
    end = jnp.where(divisor_terms.first, p1, p3)
    z = divisor_terms.d * (end * end) + 2.0 * (
        d13 * (divisor_terms.k * (end * p2)) + divisor_terms.slant * (k13 * (p1 * p3))
    )
    z = z + (r1 * r1 + r2 * r2 + r3 * r3 - divisor_terms.less)
    r = barrier(1.0 / (divisor_terms.square + sigma_of_step.s * sigma_of_step.s * z))
    a1, a2, a3 = adj
    c = barrier(2.0 * sigma_of_step.s * r / sigma_of_step.det)
    part = tuple(c * x for x in (a1 * a1, a2 * a2, a3 * a3, a1 * a2, a1 * a3, a2 * a3))
    after = tuple((a + sigma_of_step.s * b) * r for a, b in zip(adj, turned, strict=True))
    return barrier(MomentumAndIntegral(after, part))


def integral_in_four_parts(
    inverse_inertia: Differences, momentum: Triple, constants: Invariants, duration: Scalar
) -> MomentumAndIntegral:
    """Return the momentum after a time of either sign, and G over this time, in four equal parts.

    The sigma functions are thus needed at short times only: the integral needs the inverse of T,
    and T has none at a quarter period.
    """
    u, hh = 0.125 * duration, constants.h2
    n = iteration_limits(u.dtype).doublings + _MORE
    sigma = sigma_series(u * 2.0**-n, constants)
    sigma = jax.lax.fori_loop(0, n, lambda _, g: doubled_sigma(g, constants), sigma)
    terms = barrier(divisor_of_step(inverse_inertia, constants, sigma))
    k12, k13, k23 = (hh * c for c in inverse_inertia[3:])
    b = (
        -constants.a2 * constants.a3 - k23 * k23,
        -constants.a1 * constants.a3 - k13 * k13,
        constants.a1 * constants.a2 - k12 * k12,
        hh * constants.e12,
        hh * constants.e13,
        hh * constants.e23,
    )

    def take_eighth(i, state):
        # The time is taken in eight steps, two for each of its four parts. After the first step of
        # a part Π is the momentum at the middle of the part: the second step, with an odd i, gives
        # the term of the integral that belongs to this part.
        point, total = state
        point, part = step_and_integral_term(inverse_inertia, terms, sigma, point)
        odd = i % 2 == 1
        total = tuple(a + jnp.where(odd, c, 0.0) for a, c in zip(total, part, strict=True))
        return MomentumAndIntegral(point, total)

    first = MomentumAndIntegral(momentum, _scaled_matrix(commuting_product(b, sigma.y), -8.0))
    return jax.lax.fori_loop(0, 8, take_eighth, first)


def momentum_period(constants: Invariants) -> Scalar:
    """Return the time after which the body momentum of a free motion repeats.

    The period is `2π/agm(√(z − x), √(z − y))`, where agm is the arithmetic–geometric mean, x, y and
    z are the eigenvalues of E, and z is the largest.

    In value z is the largest diagonal entry of E. One step of Newton's method from this entry gives
    the derivatives of z up to third order. The other two eigenvalues, x and y, enter only through
    symmetric functions: the first step of the arithmetic–geometric mean can be written in this way.
    """
    three = constants.gap > 0
    top = jnp.where(three, constants.p, constants.q)
    *_, e12, e13, e23 = constants
    off = (e12 * e12, e13 * e13, e23 * e23)

    def differences(z):
        # Return the differences of z and the three diagonal entries of E. If z is the largest of
        # these entries, E₁₁ or E₃₃, this needs no subtraction of nearly equal numbers.
        extra = z - top
        return (
            jnp.where(three, constants.gap, 0.0) + extra,
            z,
            jnp.where(three, 0.0, -constants.gap) + extra,
        )

    def slope(x1, x2, x3):
        return x1 * x2 + x1 * x3 + x2 * x3 - (off[0] + off[1] + off[2])

    x1, x2, x3 = differences(top)
    f = x1 * x2 * x3 - x1 * off[2] - x2 * off[1] - x3 * off[0] - 2.0 * e12 * e13 * e23
    x1, x2, x3 = barrier(differences(barrier(top - f / slope(x1, x2, x3))))
    root = barrier(jnp.sqrt(slope(x1, x2, x3)))
    a, b = 0.5 * jnp.sqrt(x1 + x2 + x3 + 2.0 * root), jnp.sqrt(root)
    mean = lambda _, x: (0.5 * (x[0] + x[1]), jnp.sqrt(x[0] * x[1]))  # noqa: E731
    a, b = jax.lax.fori_loop(0, iteration_limits(a.dtype).agm, mean, (a, b))
    return 2.0 * jnp.pi / a


def momentum_and_integral(
    inverse_inertia: Differences, momentum: Triple, t: Scalar
) -> MomentumAndIntegral:
    """Return Π(t) and G for any t, both smooth functions of the whole inertia tensor."""
    v = barrier(invariants(inverse_inertia, momentum))
    m = jax.lax.stop_gradient(Modulus(v.p, v.q, v.gap))
    endless = is_aperiodic(m)
    # If the motion has no period, compute the period of another motion (`tame`), whose result is
    # not used: JAX differentiates it, too, and its derivatives must not be NaN.
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    tame = Invariants(one, one, one, one, zero, one, one, zero, zero, zero)
    usual = jax.tree.map(lambda a, b: jnp.where(endless, b, a), v, tame)
    count = jnp.round(
        t / jnp.where(endless, jnp.inf, momentum_period(jax.lax.stop_gradient(usual)))
    )
    several = count != 0
    usual = barrier(jax.tree.map(lambda a, b: jnp.where(several, a, b), v, tame))
    whole = barrier(momentum_period(usual))
    r = 2.0 * clip_time(0.5 * (t - jnp.where(several, count * whole, 0.0)), m)

    # The time t is `count` whole periods and the rest r. Compute the motion over r and over one
    # whole period by the same program, in one loop, so that this program is compiled once.
    both = jax.tree.map(lambda *a: jnp.stack(a), (v, r), (usual, whole))
    out, g = jax.lax.map(lambda a: integral_in_four_parts(inverse_inertia, momentum, *a), both)
    g = tuple(c[0] + jnp.where(several, count * c[1], 0.0) for c in g)
    return MomentumAndIntegral(tuple(p[0] for p in out), g)


def _normalised_sigma(
    sigma: Scalar, t_matrix: SymmetricEntries, integral: SymmetricEntries
) -> Sigma:
    """Return the sigma functions with σ and T divided by T₂₂, so that T₂₂ = 1 in value.

    The divisor is a constant in derivatives: a factor common to σ and T changes no result.
    """
    factor = barrier(1.0 / jax.lax.stop_gradient(t_matrix[1]))
    sigma, t_matrix = barrier((sigma * factor, _scaled_matrix(t_matrix, factor)))
    return Sigma(sigma, t_matrix, *barrier((adjugate(t_matrix), determinant(t_matrix))), integral)


def _scaled_matrix(matrix: SymmetricEntries, factor: Scalar | float) -> SymmetricEntries:
    """Return the matrix times a number."""
    return tuple(c * factor for c in matrix)


def _shifted_matrix(matrix: SymmetricEntries, summand: Scalar | float) -> SymmetricEntries:
    """Return the matrix plus `summand` times the unit matrix."""
    return (matrix[0] + summand, matrix[1] + summand, matrix[2] + summand, *matrix[3:])
