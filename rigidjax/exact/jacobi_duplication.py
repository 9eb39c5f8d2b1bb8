"""Compute the three elliptic functions of a free body by repeated doubling of the argument, and the
half period of these functions.

A free body needs only the solution of

    S' = C D,   C' = −p S D,   D' = −q S C,   S(0) = 0, C(0) = D(0) = 1,

with `C² = 1 − p S²` and `D² = 1 − q S²`. S, C and D are Jacobi's functions sn, cn, dn in a scaling
that needs neither `p > q` nor `p, q ≠ 0`. For p = q = 0 the body is a sphere, or at rest; p = q is
the separatrix; q = 0 is a symmetric top, or a spin about an axis. The computation starts from the
Taylor series at `u/2^N` and applies the duplication formula N times (DLMF 22.6(ii)). Three measures
keep the digits. The difference p − q is a separate number. While S is small, `1 − C` is doubled
instead of C, by `1 − C(2u) = 2pS²D²/(C² + pS²D²)`. All denominators are sums of positive terms.
"""

import functools
import math
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from rigidjax._types import Scalar


class Elliptic(NamedTuple):
    """Hold the elliptic functions S, C and D of a free body at some time (see the head of this
    module), and the phase `ξ = κ ∫₀ᵘ S²/(1 + μS²) du`, rad, as a direction (x, y) ∝ (cos ξ, sin ξ):
    a correction to the rotation of the body about its momentum.
    """

    S: Scalar
    C: Scalar
    D: Scalar
    x: Scalar
    y: Scalar


class Modulus(NamedTuple):
    """Hold the parameters p and q of the elliptic functions and `gap` = p − q, all in 1/s².

    The caller computes `gap` without subtracting q from p, which would lose digits.
    """

    p: Scalar
    q: Scalar
    gap: Scalar


class IterationLimits(NamedTuple):
    """Hold, for one dtype, how often the steps of the elliptic functions are repeated, and two
    limits beyond which a free motion is taken as a simpler one.
    """

    doublings: int  # the number of doublings from u/2^doublings to u
    agm: int  # steps of the arithmetic–geometric mean
    floor: float  # a motion with |p − q|/max(p, q) ≤ floor is taken as on the separatrix
    rest: float  # beyond this √max(p, q) |u|, a motion on the separatrix is taken as steady


def iteration_limits(dtype: jnp.dtype) -> IterationLimits:
    """Return the numbers of steps and the limits for float32 or float64.

    The doublings are enough for the longest quarter period, ln(4/√floor)/√max(p, q); with this
    `floor`, C⁴ does not underflow in them.
    """
    wide = dtype == jnp.float64
    return IterationLimits(9, 11, 1e-64, 75.0) if wide else IterationLimits(7, 9, 1e-33, 20.0)


def is_aperiodic(modulus: Modulus) -> Bool[Array, ""]:
    """Return whether a motion has no period: on the separatrix, for a sphere, and at rest."""
    return jnp.abs(modulus.gap) <= iteration_limits(modulus.p.dtype).floor * jnp.maximum(
        modulus.p, modulus.q
    )


def clip_time(reduced_time: Scalar, modulus: Modulus) -> Scalar:
    """Return the time `reduced_time`, from which whole half periods are subtracted already; clip it
    on the separatrix to the time after which the motion is taken as a steady spin about the middle
    axis.
    """
    big = jnp.maximum(modulus.p, modulus.q)
    rest = iteration_limits(reduced_time.dtype).rest / jnp.sqrt(jnp.where(big > 0, big, 1.0))
    return jnp.where(
        is_aperiodic(modulus) & (big > 0), jnp.clip(reduced_time, -rest, rest), reduced_time
    )


def doubled_functions(
    functions: Elliptic, modulus: Modulus, mu: Scalar, phase_factor: Scalar
) -> Elliptic:
    """Return the elliptic functions and the phase at the time 2u from those at the time u.

    The phase is ξ(2u) = 2ξ + arctan(B/A), with A = C² + pS²D² + μS²(C²D² + C² + D²) and B = 2κS³CD
    at the time u; it is computed as a product of complex numbers.
    """
    S, C, D, x, y = functions
    s, cc, dd = S * S, C * C, D * D
    ps, qs = modulus.p * s, modulus.q * s
    den = cc + ps * dd
    r = 1.0 / den
    gs = modulus.gap * s
    C2 = jnp.where(ps < 0.5, 1.0 - 2.0 * ps * dd * r, (cc * cc - ps * gs) * r)
    D2 = jnp.where(qs < 0.5, 1.0 - 2.0 * qs * cc * r, (dd * dd + qs * gs) * r)
    a = den + mu * s * (cc * dd + cc + dd)
    b = 2.0 * phase_factor * s * S * C * D
    xx, yy = x * x - y * y, 2.0 * x * y
    x2, y2 = xx * a - yy * b, xx * b + yy * a
    scale = 1.0 / (jnp.abs(x2) + jnp.abs(y2))
    return Elliptic(2.0 * S * C * D * r, C2, D2, x2 * scale, y2 * scale)


def elliptic_series(time: Scalar, modulus: Modulus, mu: Scalar, phase_factor: Scalar) -> Elliptic:
    """Compute the elliptic functions and the phase at a short time by Taylor series, exact to
    round-off for √max(p, q) |u| ≤ 0.15 in float64 and ≤ 0.31 in float32.
    """
    hh = time * time
    p, q = modulus.p * hh, modulus.q * hh
    e, f = p + q, p * q
    # The list begins with the smallest term of the Taylor series of S: the terms are added in the
    # order of the list, and the sum has the least round-off if the smallest comes first.
    terms = [
        -e * f * f * (e * e * (258821 / 3027024000) + f * (13511 / 36036000)),
        e * e * (e * e * f * (8303 / 518918400) + f * f * (9481 / 14414400))
        + f * f * f * (11 / 15600),
        -e * (e * e * (e * e / 39916800 + f * (461 / 1663200)) + f * f * (307 / 92400)),
        e * e * (e * e / 362880 + f * (17 / 5040)) + f * f / 120,
        -e * (e * e / 5040 + f * (11 / 420)),
        e * e / 120 + f / 10,
        -e / 6,
    ]
    S = time * (functools.reduce(operator.add, terms) + 1.0)
    s = S * S
    xi = phase_factor * third_kind_series(S, modulus, mu)
    z = xi * xi
    tangent = xi * (1.0 + z * (1 / 3 + z * (2 / 15 + z * (17 / 315))))
    one = jnp.ones_like(s)
    return Elliptic(S, jnp.sqrt(1.0 - modulus.p * s), jnp.sqrt(1.0 - modulus.q * s), one, tangent)


def third_kind_series(S: Scalar, modulus: Modulus, mu: Scalar) -> Scalar:
    """Return the integral ∫ S²/(1 + μS²) du from 0 to u, for a small value `S` at u.

    With S as the variable, it is ∫ S² dS/((1 + μS²) √(1 − pS²) √(1 − qS²)), a power series in S.
    The recurrence of Legendre's polynomials gives the terms of 1/(√(1 − pS²) √(1 − qS²)), and a
    second recurrence multiplies this series by 1/(1 + μS²).
    """
    s = S * S
    e, f, w = (modulus.p + modulus.q) * s, (modulus.p * modulus.q) * (s * s), mu * s
    older, root, term = jnp.zeros_like(s), jnp.ones_like(s), jnp.ones_like(s)
    total = term / 3
    for k in range(1, 9):
        older, root = root, (1 - 0.5 / k) * e * root - (1 - 1 / k) * f * older
        term = root - w * term
        total = total + term / (2 * k + 3)
    return S * s * total


def elliptic_functions(u: Scalar, modulus: Modulus, mu: Scalar, phase_factor: Scalar) -> Elliptic:
    """Return elliptic functions and phase at u, at most a quarter period, for 0 ≤ μ ≤ √(pq)."""
    n = iteration_limits(u.dtype).doublings
    f = elliptic_series(u * 2.0**-n, modulus, mu, phase_factor)
    # Double the time in a loop: it compiles eight times sooner than nine doublings written out.
    return jax.lax.fori_loop(0, n, lambda _, g: doubled_functions(g, modulus, mu, phase_factor), f)


class HalfPeriod(NamedTuple):
    """Hold the duration of half a period of S, the phase ξ at its end, and the mean of S²."""

    time: Scalar  # the least time T > 0 with S(T) = 0; infinite on the separatrix
    phase: Scalar  # the phase ξ at the end of the half period
    mean: Scalar  # the mean of S² over the half period


def half_period(modulus: Modulus, mu: Scalar, phase_factor: Scalar) -> HalfPeriod:
    """Return the half period of the elliptic function S.

    With λ² = max(p, q), a₀ = 1 and b₀ = √|p − q|/λ, the time is `T = π/(λ agm(a₀, b₀))` (DLMF
    19.8.5), where agm is the arithmetic–geometric mean. With `c₁ = (a₀ − b₀)/2` and `c_{n+1} =
    c_n²/(4 a_{n+1})`, the mean is `⟨S²⟩ = (½ + Σ 2^{n−1} c_n²/w)/λ²`, where w = min(p, q)/λ² (DLMF
    19.8.6 divided by w, so that w = 0 is an ordinary value). The phase is the complete integral of
    the third kind, DLMF 19.8.7–19.8.9, with μ instead of −α².
    """
    big, small = jnp.maximum(modulus.p, modulus.q), jnp.minimum(modulus.p, modulus.q)
    at_rest = big <= 0
    big = jnp.where(at_rest, 1.0, big)
    gap = jnp.abs(modulus.gap)
    endless = is_aperiodic(modulus)
    # Divide all quantities by powers of λ = √max(p, q): XLA may multiply the divisors below into
    # one product, which would underflow for a slow motion.
    w = small / big
    a, b = jnp.ones_like(big), jnp.sqrt(jnp.where(endless, 1.0, gap / big))
    # The loop begins at n = 1, with c_n in `c` and 2^{n−1} c_n²/w in `ratio`. The formula
    # c₁ = w/(2(a₀ + b₀)) equals (a₀ − b₀)/2, but has no difference that would lose digits.
    c = w / (2.0 * (a + b))
    ratio = w / (4.0 * (a + b) ** 2)
    point, half, one = jnp.sqrt(1.0 + mu / big), jnp.full_like(a, 0.5), jnp.ones_like(a)

    def step(_, state):
        # After n steps a and b are the two means, c is c_{n+1} = (a − b)/2, and `ratio` is
        # 2ⁿ c_{n+1}²/w, whose sum, with ½, is `total`. `point` and `part` are p_n and Q_n of DLMF
        # 19.8.7–19.8.9.
        a, b, c, ratio, total, point, part, sum_parts = state
        square, product = point * point, a * b
        part = 0.5 * part * (square - product) / (square + product)
        a, b = 0.5 * (a + b), jnp.sqrt(product)
        narrow = c / (2.0 * (a + b))
        ratios = c * narrow, 2.0 * ratio * narrow * narrow, total + ratio
        return a, b, *ratios, 0.5 * (square + product) / point, part, sum_parts + part

    # Use a loop: the eleven steps of the arithmetic–geometric mean, written out, would take as long
    # to compile as the rest of the free motion.
    start = (a, b, c, ratio, half, point, one, one)
    steps = iteration_limits(a.dtype).agm
    a, *_, total, _, _, sum_parts = jax.lax.fori_loop(0, steps, step, start)
    time = math.pi / (a * jnp.sqrt(big))
    # The phase ξ = κ ∫ S²/(1 + μS²) du over half a period T is ½ κ T Σ/(λ² + μ), where Σ is
    # `sum_parts`, κ is `phase_factor` and λ² = max(p, q) (DLMF 19.8.7 with α² = −μ/λ²).
    phase = phase_factor * time * 0.5 / (big + mu) * sum_parts
    return HalfPeriod(jnp.where(endless, jnp.inf, time), phase, total / big)
