"""Compute Jacobi's elliptic functions sn, cn, dn and the amplitude, for every real parameter.

For the values, the argument is reduced by the half period 2K. Bulirsch's descending transformation
(1965, doi 10.1007/BF01397975) then works with 1 − m, and no digit is lost as m → 1.

For the derivatives, let φ = am(u|m) be the amplitude, so that u = F(φ|m) with Legendre's integral F
of the first kind. The derivative at fixed u is ∂φ/∂m = dn X with

    X = −∂F/∂m = −½ ∫₀^u sd²(v) dv.

Here sd = sn/dn. The integrand is positive: X has all its digits at m = 0 and as m → 1, where the
textbook formulas (Byrd & Friedman 1971, 710.51–53) divide a small difference by m (1 − m). The
second derivative with respect to m also comes from X for m ≤ 0.9 or |u| ≤ 1, and otherwise from a
sum of hyperbolic functions, one for each half period (`jacobi_near_one.py`).
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from rigidjax.elliptic.arguments import (
    Real,
    RealOrArray,
    Tangent,
    by_complement,
    common_arrays,
    with_complement,
)
from rigidjax.elliptic.jacobi_near_one import LARGEST_M1, sncndn_near_one
from rigidjax.elliptic.legendre import agm_iterates, complete_integral, incomplete_integral
from rigidjax.rotation.stumpff import power_of_minus_one, split_half_turns

SnCnDn = tuple[Array, Array, Array]

# If cn and dn are below this number, the integral of sd² = (sn/dn)², from which the derivatives
# with respect to m follow, is 1/dn² times a function of the ratio of cn and dn. The relative error
# of this rule is about the square of this number.
_FLOOR = {np.dtype("float64"): 1e-40, np.dtype("float32"): 1e-8}


def sncndn(
    u: Real, m: Real, m1: Real | None = None
) -> tuple[RealOrArray, RealOrArray, RealOrArray]:
    """Return Jacobi's elliptic functions sn(u|m), cn(u|m) and dn(u|m).

    **Arguments:**

    - `u`: real; the error grows as |u| eps.
    - `m`: the parameter k² (not the modulus k), any real number.
    - `m1`: 1 − m. Give it if m is so near 1 that 1 − m loses digits: values and derivatives are
      then computed from m1, and m is used only where it is small.

    **Returns** three arrays (DLMF 22.2.4–6). m = 0 gives sin, cos, 1; m = 1 gives tanh, sech, sech
    (DLMF 22.5.3–4); m < 0 and m > 1 follow from DLMF 22.17. Derivatives of every order with respect
    to u (DLMF 22.13(i)), m and m1 are exact.

    >>> [round(float(x), 12) for x in sncndn(1.0, 0.5)]
    [0.803001824896, 0.595976567672, 0.823161001632]
    """
    u, m, m1 = common_arrays(u=u, **with_complement("m", m, m1))
    s, c, d, _ = functions(u, by_complement(m, m1), m1)
    return s, c, d


def am(u: Real, m: Real, m1: Real | None = None) -> RealOrArray:
    """Return Jacobi's amplitude φ = ∫₀^u dn(v|m) dv, rad, which is the inverse of F(φ|m) for m ≤ 1.

    **Arguments:** `u` real; `m` the parameter k², any real number; `m1` = 1 − m, as for `sncndn`.
    **Returns:** φ (DLMF 22.16.1–3). For m ≤ 1 the amplitude grows by π in each half period 2K,
    without jumps; for m > 1 it oscillates within |φ| ≤ arcsin(1/√m).

    >>> round(float(am(1.0, 0.5)), 12)
    0.932315079884
    """
    u, m, m1 = common_arrays(u=u, **with_complement("m", m, m1))
    s, c, _, turns = functions(u, by_complement(m, m1), m1)
    sign = power_of_minus_one(turns)
    return jnp.arctan2(sign * s, sign * c) + math.pi * turns


class Functions(NamedTuple):
    """Hold Jacobi's functions for any real parameter, and the whole number n of half turns in the
    amplitude φ, so that φ − nπ lies between −π/2 and π/2; n is 0 for m > 1.
    """

    sn: Array
    cn: Array
    dn: Array
    half_turns: Array


def functions(u: Array, m: Array, m1: Array) -> Functions:
    """Return Jacobi's functions for any real parameter."""
    # By DLMF 22.17.2–4, a parameter m > 1 is replaced by 1/m and u by u√m; cn and dn change places.
    above = m1 < 0
    divisor = jnp.where(above, m, 1)
    root = jnp.sqrt(divisor)
    v = u * root
    inner_m = jnp.where(above, 1, m) / divisor
    inner_m1 = jnp.where(above, -m1, m1) / divisor

    s, c, d = _sncndn(v, inner_m, inner_m1)
    turns = _reduced_argument(jax.lax.stop_gradient(v), jax.lax.stop_gradient(inner_m1))[0]
    c, d = jnp.where(above, d, c), jnp.where(above, c, d)
    return Functions(s / root, c, d, jnp.where(above, 0, turns))


@jax.custom_jvp
def _sncndn(u: Array, m: Array, m1: Array) -> SnCnDn:
    """Return sn, cn and dn for m = 1 − m1 ≤ 1, with derivatives by u and m1 alone."""
    turns, angle, rows = _reduced_argument(u, m1)
    sign = power_of_minus_one(turns)
    theta = jnp.abs(angle)
    # Bulirsch's recursion squares the cotangent of the angle, which must not overflow if u is near
    # 0 or near a multiple of the half period. The angle is therefore kept above a tiny number, and
    # for tiny u a Taylor series is used.
    tiny = jnp.abs(u) * jnp.maximum(1, jnp.sqrt(m1)) < float(jnp.finfo(u.dtype).eps) ** (1 / 3)
    safe = jnp.maximum(theta, float(jnp.finfo(u.dtype).tiny) ** 0.4)
    a = jnp.cos(safe) / jnp.sin(safe)
    c, d = rows[-1][0] * a, jnp.ones_like(u)
    for low, high in rows[-2::-1]:
        a, c = a * c, c * d
        d = (high + a) / (low + a)
        a = c / low
    hypotenuse = jnp.sqrt(1 + c * c)
    s = jnp.where(angle < 0, -sign, sign) / hypotenuse
    c = sign * c / hypotenuse

    square = u * u
    s = jnp.where(tiny, u * (1 - square * (1 + m) / 6), s)
    c = jnp.where(tiny, 1 - square / 2, c)
    d = jnp.where(tiny, 1 - m * square / 2, d)

    # For m = 1 the three functions are tanh, sech and sech. Clip |u| to `largest` in sech: for a
    # larger |u| sech would underflow, and quotients such as sn/dn would be wrong or infinite.
    largest = 0.97 * math.log(float(jnp.finfo(u.dtype).max))
    e = jnp.exp(-jnp.minimum(jnp.abs(u), largest))
    sech = 2 * e / (1 + e * e)
    hyperbolic = m1 == 0
    s, c, d = (jnp.where(hyperbolic, a, b) for a, b in ((jnp.tanh(u), s), (sech, c), (sech, d)))
    return s, c, d


@partial(_sncndn.defjvp, symbolic_zeros=True)
def _sncndn_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Tangent, Tangent, Tangent]
) -> tuple[SnCnDn, SnCnDn]:
    """Return sn, cn and dn and their tangents for tangents of u and m1."""
    (u, m, m1), (du, _, dm1) = primals, tangents
    s, c, d = _sncndn(u, m, m1)
    ds, dc, dd = jnp.zeros_like(u), jnp.zeros_like(u), jnp.zeros_like(u)
    if not isinstance(du, SymbolicZero):
        # The derivatives with respect to u are DLMF 22.13.1–3.
        ds, dc, dd = c * d * du, -s * d * du, -m * s * c * du
    if not isinstance(dm1, SymbolicZero):
        sm, cm, dm = _by_m(u, m, m1)
        ds, dc, dd = ds - sm * dm1, dc - cm * dm1, dd - dm * dm1
    return (s, c, d), (ds, dc, dd)


@jax.custom_jvp
def _by_m(u: Array, m: Array, m1: Array) -> SnCnDn:
    """Return the derivatives of sn, cn and dn by the parameter m at a fixed u."""
    return _by_m_integral(u, m, m1)


@partial(_by_m.defjvp, symbolic_zeros=True)
def _by_m_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Tangent, Tangent, Tangent]
) -> tuple[SnCnDn, SnCnDn]:
    """Return the derivatives by m and their tangents, by which JAX takes second derivatives."""
    (u, m, m1), (du, _, dm1) = primals, tangents
    sm, cm, dm = slopes = _by_m(u, m, m1)
    ds, dc, dd = jnp.zeros_like(u), jnp.zeros_like(u), jnp.zeros_like(u)
    if not isinstance(du, SymbolicZero):
        s, c, d = _sncndn(u, m, m1)
        ds, dc = (cm * d + c * dm) * du, -(sm * d + s * dm) * du
        dd = -(s * c + m * (sm * c + s * cm)) * du
    if not isinstance(dm1, SymbolicZero):
        # Near m = 1 the second derivatives come from a sum of hyperbolic functions, one for each
        # half period (`sncndn_near_one`), but only for |u| > 1. For small u they are of the order
        # u⁴ or higher: the terms of the sum then cancel, while the integral has no large terms.
        near = (m1 < LARGEST_M1) & (jnp.abs(u) > 1)
        middle, one = jnp.full_like(m1, 0.5), jnp.ones_like(m1)
        far_m, far_m1 = jnp.where(near, middle, m), jnp.where(near, middle, m1)
        _, far = jax.jvp(partial(_by_m_integral, u), (far_m, far_m1), (one, -one))
        near_m = jnp.where(near, m, 1 - LARGEST_M1)
        near_m1 = jnp.where(near, m1, LARGEST_M1)

        first = lambda a, b: jax.jvp(partial(sncndn_near_one, u), (a, b), (one, -one))[1]  # noqa: E731
        _, close = jax.jvp(first, (near_m, near_m1), (one, -one))
        ss, cc, d2 = (jnp.where(near, a, b) for a, b in zip(close, far, strict=True))
        ds, dc, dd = ds - ss * dm1, dc - cc * dm1, dd - d2 * dm1
    return slopes, (ds, dc, dd)


def _by_m_integral(u: Array, m: Array, m1: Array) -> SnCnDn:
    """Return the derivatives by m from ∂φ/∂m = X dn, with X of the head of this module from
    Carlson's R_D, after whole half periods are subtracted from u.
    """
    s, c, d = _sncndn(u, m, m1)
    turns = _reduced_argument(jax.lax.stop_gradient(u), jax.lax.stop_gradient(m1))[0]
    sign = power_of_minus_one(turns)
    # The integral X grows as 1/dn² and must not overflow. If cn and dn are tiny, X is 1/dn² times a
    # function of their ratio alone, with a relative error of the square of `_FLOOR`. Therefore
    # multiply cn and dn by the same large number `up`, and correct the result by powers of `up`.
    up = jnp.maximum(1, _FLOOR[np.dtype(u.dtype)] / jax.lax.stop_gradient(d))
    c, d, raised = c * up, d * up, m1 * up * up
    near = turns == 0
    whole = complete_integral((1, 1, 0), jnp.where(near, 1, raised))
    x = incomplete_integral((1, 1, 0), sign * s, sign * c, raised, jnp.ones_like(m1))
    x = -0.5 * (x + jnp.where(near, 0, 2 * turns * whole))
    return c * d * x, -s * d * x * up, -(0.5 * s * s / d + m * s * c * x) * up


class HalfPeriods(NamedTuple):
    """Hold an argument u = 2Kn + r with |r| ≤ K, where 2K is the half period; for m1 = 0 this is
    infinite, n is 0, and the other fields mean nothing.
    """

    whole: Array  # n
    angle: Array  # πr/(2K), rad
    means: list[tuple[Array, Array]]  # the arithmetic and geometric means from (1, √m1) to π/(2K)


def _reduced_argument(u: Array, m1: Array) -> HalfPeriods:
    """Return the argument less whole half periods."""
    rows = agm_iterates(jnp.where(m1 == 0, 1, m1))
    turns, angle = split_half_turns(u * rows[-1][0])
    return HalfPeriods(jnp.where(m1 == 0, 0, turns), angle, rows)
