"""The free motion as a smooth function of the whole inertia tensor, for its derivatives.

Principal axes are not a smooth function of a tensor; the motion is. With `K = I⁻¹`, Π the body
momentum, `E₂ = Π·KΠ` and `h = |Π|`, let

    E = E₂ K + h² adj(K)      (symmetric; commutes with K)

and let σ(u) be a scalar, T(u) a matrix that commutes with K, both fixed up to a common factor, with

    T² = w 1 − σ² E,   T(2u) = T⁴ − σ⁴ χ'(E),   σ(2u) = 2 σ det T,   χ the characteristic polynomial

(Weierstrass's sigma functions: T has eigenvalues σ₁, σ₂, σ₃). Then the addition theorem reads

    Π(t) ∝ adj(T) Π + σ T (Π × KΠ),   T and σ at t,   |Π(t)| = h

and, with k = Π(t/2), T and σ at u = t/2, W the factor left out for k, and `Y = ∫₀ᵘ σ² T⁻² du`,
which doubles as `Y(2u) = 2Y + (σT⁻¹)²(u) (σT⁻¹)(2u)`,

    G = ∫₀ᵗ Π Πᵀ dt = 2σ/(W det T) (adj(T)k)(adj(T)k)ᵀ − 2 adj(E₂ 1 − h² K) Y.

Proof of the first: in principal axes of K it is Jacobi's solution with T = diag(D, 1, C), σ = S, by
`E₃₃ − E₂₂ = (a₂ − a₃)(a₁h² − E₂) = p`, `E₁₁ − E₂₂ = q`, and both sides turn with the axes. All
terms but `|…|` are polynomial in K: a sphere or a symmetric top is an ordinary point. (The second:
differentiate in principal axes: with g = σ/τᵢ, g' = τⱼτₖ/τᵢ²; the mid point removes even terms.)

The axes are principal at the point of evaluation: off-diagonal entries are zeros that carry
tangents, diagonal differences are given as accurate numbers, and each entry uses the one of its
equal forms that does not cancel.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rigidjax._types import Scalar
from rigidjax.exact.components3 import Six, Triple, adjugate, determinant, product, times
from rigidjax.exact.jacobi_duplication import Modulus, is_endless, limits, until_rest


class Differences(NamedTuple):
    """Hold K = I⁻¹ without its trace: differences of its diagonal, and off-diagonal entries."""

    d12: Scalar
    d13: Scalar
    d23: Scalar
    k12: Scalar
    k13: Scalar
    k23: Scalar


class Invariants(NamedTuple):
    """Hold the parts of E − E₂₂ 1; `a1, a2, a3` are a₁h² − E₂, a₂h² − E₂, E₂ − a₃h²."""

    h2: Scalar
    a1: Scalar
    a2: Scalar
    a3: Scalar
    q: Scalar
    p: Scalar
    gap: Scalar
    e12: Scalar
    e13: Scalar
    e23: Scalar


class Sigma(NamedTuple):
    """Hold σ, T, Y at some time; T is scaled so that T₂₂ = 1."""

    s: Scalar
    t: Six
    y: Six


def invariants(body: Differences, momentum: Triple) -> Invariants:
    """Return the invariants of a motion from K and Π(0)."""
    d12, d13, d23, k12, k13, k23 = body
    p1, p2, p3 = momentum
    x1, x2, x3 = p1 * p1, p2 * p2, p3 * p3
    h2 = x1 + x2 + x3
    mixed = 2.0 * (k12 * (p1 * p2) + k13 * (p1 * p3) + k23 * (p2 * p3))
    a1 = d12 * x2 + d13 * x3 - mixed
    a2 = d23 * x3 - d12 * x1 - mixed
    a3 = d13 * x1 + d23 * x2 + mixed
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


def start(u: Scalar, v: Invariants) -> Sigma:
    """Return σ, T, Y at a small u from their Taylor series."""
    q, p, e12, e13, e23 = v.q, v.p, v.e12, v.e13, v.e23
    uu = u * u
    c1 = (p + q) * uu
    c2 = (p * q - e12 * e12 - e13 * e13 - e23 * e23) * (uu * uu)
    c3 = (2.0 * e12 * e13 * e23 - q * e23 * e23 - p * e12 * e12) * (uu * uu * uu)
    s = u * (
        1.0
        + (-c1 / 6)
        + (c1 * c1 / 120 + c2 / 10)
        - (c1 * c1 * c1 / 5040 + c1 * c2 * (11 / 420) + c3 / 14)
        + (c1 * c1 * (c1 * c1 / 362880 + c2 * (17 / 5040)) + c1 * c3 / 28 + c2 * c2 / 120)
    )
    # T = √(1 − x), x = σ²E.
    ss = s * s
    zero = jnp.zeros_like(u)
    x = (ss * q, zero, ss * p, ss * e12, ss * e13, ss * e23)
    inner = _add_scalar(_scale(x, 7 / 128), 5 / 64)
    for c in (1 / 8, 1 / 4, 1.0):
        inner = _add_scalar(product(x, inner), c)
    t = _add_scalar(_scale(product(x, inner), -0.5), 1.0)
    # Y = ⅓u³ (1 − c₁/5 + (2c₁² + 9c₂)/105 + (3/5 − 2c₁/7) x + 3x²/7), x = u²E.
    r = u * uu / 3
    x = (q * uu, zero, p * uu, e12 * uu, e13 * uu, e23 * uu)
    inner = _add_scalar(_scale(x, 3 / 7), 0.6 - (2 / 7) * c1)
    more = 1.0 + (-c1 / 5 + (2.0 * c1 * c1 + 9.0 * c2) / 105)
    y = _scale(_add_scalar(product(x, inner), more), r)
    return _rescale(Sigma(s, t, y))


def double(f: Sigma, v: Invariants) -> Sigma:
    """Return σ, T, Y at 2u from `f`, their values at u."""
    t1, t2, t3, t12, t13, t23 = f.t
    s = f.s
    ss = s * s
    q, p, gap, e12, e13, e23 = v.q, v.p, v.gap, v.e12, v.e13, v.e23
    s12, s13, s23 = t12 * t12, t13 * t13, t23 * t23
    # M = T²: its off-diagonal entries are −σ²E exactly.
    m11, m22, m33 = t1 * t1 + s12 + s13, t2 * t2 + s12 + s23, t3 * t3 + s13 + s23
    m12, m13, m23 = -ss * e12, -ss * e13, -ss * e23
    x12, x13, x23 = m12 * m12, m13 * m13, m23 * m23
    n22 = 0.5 * (
        m22 * (m11 + m33)
        - (x12 + x23)
        + ss * (p * m11 + q * m33 - 2.0 * e13 * m13 + e12 * m12 + e23 * m23)
    )
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
    det = determinant(f.t)
    t = (n11, n22, n33, n12, n13, n23)
    s2 = 2.0 * s * det
    before = _scale(adjugate(f.t), s / det)
    after = _scale(adjugate(t), s2 / determinant(t))
    square = product(before, before)
    y = tuple(2.0 * a + b for a, b in zip(f.y, product(square, after), strict=True))
    return _rescale(Sigma(s2, t, y))


def momentum_at(
    body: Differences, v: Invariants, f: Sigma, momentum: Triple
) -> tuple[Triple, Scalar]:
    """Return Π after the time of `f`, `momentum` before it, and the factor W divided out."""
    p1, p2, p3 = momentum
    d12, d13, d23, k12, k13, k23 = body
    u1 = -d23 * p2 * p3 + p2 * (k13 * p1 + k23 * p2) - p3 * (k12 * p1 + k23 * p3)
    u2 = d13 * p1 * p3 + p3 * (k12 * p2 + k13 * p3) - p1 * (k13 * p1 + k23 * p2)
    u3 = -d12 * p1 * p2 + p1 * (k12 * p1 + k23 * p3) - p2 * (k12 * p2 + k13 * p3)
    adj, turned = times(adjugate(f.t), momentum), times(f.t, (u1, u2, u3))
    t1, _, t3, t12, t13, t23 = f.t
    ss = f.s * f.s
    # W = (T²)ᵢᵢ + σ² (Eᵢᵢ − Tr K E₂ + |KΠ|²) for each i; 1 and 3 are sums of positive terms.
    v12, v13, v23 = k12 * (p1 * p2), k13 * (p1 * p3), k23 * (p2 * p3)
    r1, r2, r3 = k12 * p2 + k13 * p3, k12 * p1 + k23 * p3, k13 * p1 + k23 * p2
    more = r1 * r1 + r2 * r2 + r3 * r3
    h2 = p1 * p1 + p2 * p2 + p3 * p3
    z1 = d12 * d13 * (p1 * p1) + 2.0 * (d13 * v12 + d12 * v13) + (more - h2 * (k23 * k23))
    z3 = d13 * d23 * (p3 * p3) - 2.0 * (d23 * v13 + d13 * v23) + (more - h2 * (k12 * k12))
    w = jnp.where(
        v.gap > 0,
        t1 * t1 + t12 * t12 + t13 * t13 + ss * z1,
        t3 * t3 + t13 * t13 + t23 * t23 + ss * z3,
    )
    r = 1.0 / w
    return tuple((a + f.s * b) * r for a, b in zip(adj, turned, strict=True)), w


def integral_about(body: Differences, v: Invariants, f: Sigma, k: Triple) -> Six:
    """Return ∫ Π Πᵀ dt from −u to u about the moment when Π = k; `f` is at u."""
    _, w = momentum_at(body, v, f, k)
    alpha = times(adjugate(f.t), k)
    r = 2.0 * f.s / (w * determinant(f.t))
    a1, a2, a3 = alpha
    hh = v.h2
    k12, k13, k23 = (hh * c for c in body[3:])
    b = (
        -v.a2 * v.a3 - k23 * k23,
        -v.a1 * v.a3 - k13 * k13,
        v.a1 * v.a2 - k12 * k12,
        hh * v.e12,
        hh * v.e13,
        hh * v.e23,
    )
    n = product(b, f.y)
    return tuple(
        r * c - 2.0 * d
        for c, d in zip((a1 * a1, a2 * a2, a3 * a3, a1 * a2, a1 * a3, a2 * a3), n, strict=True)
    )


def sigma_at(u: Scalar, v: Invariants) -> Sigma:
    """Return σ, T, Y at u: the Taylor series of a small part of u, then doublings."""
    n = limits(u.dtype).doublings + 3
    f = start(u * 2.0**-n, v)
    return jax.lax.fori_loop(0, n, lambda _, g: double(g, v), f)


def period(v: Invariants) -> Scalar:
    """Return the period of Π: `2π/agm(√(z − x), √(z − y))`, x, y, z the eigenvalues of E.

    z is the largest.

    One step of Newton's from the diagonal entry has the derivatives of z to third order; the other
    two enter through symmetric functions, the first step of the mean.
    """
    three = v.gap > 0
    top = jnp.where(three, v.p, v.q)
    off = v.e12 * v.e12, v.e13 * v.e13, v.e23 * v.e23

    def differences(z):
        # z − E₁₁ and z − E₃₃ without subtraction where z is one of them.
        extra = z - top
        return jnp.where(three, v.gap, 0.0) + extra, z, jnp.where(three, 0.0, -v.gap) + extra

    def slope(x1, x2, x3):
        return x1 * x2 + x1 * x3 + x2 * x3 - (off[0] + off[1] + off[2])

    x1, x2, x3 = differences(top)
    f = x1 * x2 * x3 - x1 * off[2] - x2 * off[1] - x3 * off[0] - 2.0 * v.e12 * v.e13 * v.e23
    x1, x2, x3 = differences(top - f / slope(x1, x2, x3))
    root = jnp.sqrt(slope(x1, x2, x3))
    a, b = 0.5 * jnp.sqrt(x1 + x2 + x3 + 2.0 * root), jnp.sqrt(root)
    for _ in range(limits(a.dtype).agm):
        a, b = 0.5 * (a + b), jnp.sqrt(a * b)
    return 2.0 * jnp.pi / a


def momentum_and_integral(body: Differences, momentum: Triple, t: Scalar) -> tuple[Triple, Six]:
    """Return Π(t) and G = ∫₀ᵗ Π Πᵀ dt."""
    v = invariants(body, momentum)
    m = jax.lax.stop_gradient(Modulus(v.p, v.q, v.gap))
    endless = is_endless(m)
    # Dummy invariants keep NaN out of the derivatives if there is no period.
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    tame = Invariants(one, one, one, one, zero, one, one, zero, zero, zero)
    usual = jax.tree.map(lambda a, b: jnp.where(endless, b, a), v, tame)
    count = jnp.round(t / jnp.where(endless, jnp.inf, jax.lax.stop_gradient(period(usual))))
    several = count != 0
    usual = jax.tree.map(lambda a, b: jnp.where(several, a, b), usual, tame)
    whole = period(usual)
    r = 2.0 * until_rest(0.5 * (t - jnp.where(several, count * whole, 0.0)), m)

    # About two points of the orbit: T has no inverse a quarter period away.
    f = sigma_at(0.25 * r, v)
    half = double(f, v)
    first, _ = momentum_at(body, v, f, momentum)
    second, _ = momentum_at(body, v, half, first)
    out, _ = momentum_at(body, v, double(half, v), momentum)
    parts = (integral_about(body, v, f, k) for k in (first, second))
    g = tuple(a + b for a, b in zip(*parts, strict=True))

    # A whole period: four quarters about four points of the orbit.
    eighth = sigma_at(0.125 * whole, usual)
    quarter = double(eighth, usual)
    point, total = momentum, tuple(zero for _ in range(6))
    for _ in range(4):
        part = integral_about(body, v, eighth, point)
        total = tuple(a + b for a, b in zip(total, part, strict=True))
        point, _ = momentum_at(body, usual, quarter, point)
    g = tuple(a + jnp.where(several, count * b, 0.0) for a, b in zip(g, total, strict=True))
    return out, g


def _rescale(f: Sigma) -> Sigma:
    """Scale σ and T by one factor so that T₂₂ = 1 in value."""
    r = 1.0 / jax.lax.stop_gradient(f.t[1])
    return Sigma(f.s * r, _scale(f.t, r), f.y)


def _scale(m: Six, r) -> Six:
    """Multiply a symmetric matrix by a number."""
    return tuple(c * r for c in m)


def _add_scalar(m: Six, r) -> Six:
    """Add a number to the diagonal of a symmetric matrix."""
    return (m[0] + r, m[1] + r, m[2] + r, *m[3:])
