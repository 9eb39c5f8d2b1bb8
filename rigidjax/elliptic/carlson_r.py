"""Compute Carlson's multivariate R without its factor, which gives elliptic integrals and all their
derivatives.

    H(b; a) = ∫₀^∞ ∏ (t + aᵢ)^(−bᵢ) dt = R_{1−Σb}(b; a) / (Σb − 1)        (DLMF 19.16.9)

R_F, R_D and R_J have this form (DLMF 19.16.1, 19.16.2, 19.16.5), and so have their derivatives:
∂H/∂aᵢ = −bᵢ H(b + eᵢ; a), where eᵢ is the i-th unit vector. The integrand is positive, so that
nothing cancels at any order. As a function of s = ln t it is analytic for |Im s| < π and decays
exponentially. The trapezoidal rule with the step h in s therefore converges like exp(−2π²/h)
(Trefethen & Weideman 2014, doi 10.1137/130932132), and a fixed number of nodes reaches round-off,
also for arguments of very different sizes.
"""

import functools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from rigidjax.elliptic.arguments import RealOrArray, Tangent

# The numbers of nodes of the trapezoidal rule. With them the step h in s = ln t is below 0.5
# (float64) or 0.9 (float32) for arguments whose ratios are up to 1e35.
_NODES = {np.dtype("float64"): 512, np.dtype("float32"): 160}
# The largest argument is scaled to this number. In float32 the number is large, because the tail of
# the integrand at t → 0 needs values of t far below all arguments, and these values must not
# underflow.
_UNIT = {np.dtype("float64"): 1.0, np.dtype("float32"): 2.0**24}


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def r_integral(powers: tuple[float, ...], arguments: tuple[RealOrArray, ...]) -> RealOrArray:
    """Return ∫₀^∞ ∏ (t + aᵢ)^(−bᵢ) dt, with the `arguments` aᵢ ≥ 0, of one shape and dtype, and the
    `powers` bᵢ, multiples of ½ with a sum above 1.

    The result is infinite if the integral diverges at t = 0, and NaN for a negative argument. It is
    accurate to round-off if the ratios of the aᵢ are up to 1e35; for ratios of 1e60 it is accurate
    to 1e-13.
    """
    scale = largest_or_one(arguments)
    dtype = np.dtype(arguments[0].dtype)
    unit = _UNIT[dtype]
    scaled = [a / scale * unit for a in arguments]

    smallest, at_zero = jnp.full_like(scale, unit), jnp.ones_like(scale)
    for a, power in zip(scaled, powers, strict=True):
        smallest = jnp.where(a > 0, jnp.minimum(smallest, a), smallest)
        at_zero = jnp.where(a == 0, at_zero - power, at_zero)
    digits = -math.log(float(jnp.finfo(dtype).eps) / 8)
    low = jnp.log(smallest) - digits / jnp.maximum(at_zero, 0.5)
    low = jnp.maximum(low, 0.99 * math.log(float(jnp.finfo(dtype).tiny)))
    high = math.log(unit) + digits / (sum(powers) - 1)
    nodes = _NODES[dtype]
    step = (high - low) / nodes
    count = (jnp.arange(nodes, dtype=dtype) + 0.5).reshape((nodes,) + (1,) * scale.ndim)
    t = jnp.exp(low[None] + step[None] * count)

    # Begin the product with t, and divide by one power of t + a after the other: begun with 1, the
    # product of the quotients alone could overflow or underflow for very small or large t.
    product = t
    for a, power in zip(scaled, powers, strict=True):
        product = _divide_by_power(product, t + a[None], power)
    excess = sum(powers) - 1
    value = product.sum(0) * step * unit**excess
    value = _divide_by_power(value, scale, excess)
    value = jnp.where(at_zero > 0, value, jnp.inf)
    return nan_where_negative(value, arguments)


@partial(r_integral.defjvp, symbolic_zeros=True)
def _r_integral_jvp(
    powers: tuple[float, ...],
    primals: tuple[tuple[Array, ...]],
    tangents: tuple[tuple[Tangent, ...]],
) -> tuple[Array, Array]:
    """Return the integral H and its tangent, by ∂H/∂aᵢ = −bᵢ H(b + eᵢ; a)."""
    (arguments,), (directions,) = primals, tangents
    return r_integral(powers, arguments), r_tangent(powers, arguments, directions)


def r_tangent(
    powers: tuple[float, ...],
    arguments: tuple[Array, ...],
    directions: tuple[Tangent, ...],
) -> Array:
    """Return the tangent of `r_integral` for the tangents `directions` of its arguments."""
    tangent = jnp.zeros_like(arguments[0])
    for i, direction in enumerate(directions):
        if powers[i] and not isinstance(direction, SymbolicZero):
            raised = (*powers[:i], powers[i] + 1, *powers[i + 1 :])
            tangent = tangent - powers[i] * r_integral(raised, arguments) * direction
    return tangent


def nan_where_negative(value: Array, arguments: tuple[Array, ...]) -> Array:
    """Return `value`, but NaN where an argument is negative or NaN."""
    good = functools.reduce(jnp.logical_and, (a >= 0 for a in arguments))
    return jnp.where(good, value, jnp.nan)


def largest_or_one(arguments: tuple[Array, ...]) -> Array:
    """Return the largest of the arguments, or 1 where all are 0.

    The integrals of Carlson are homogeneous: if the arguments are divided by this number, no square
    overflows.
    """
    largest = functools.reduce(jnp.maximum, arguments)
    return jnp.where(largest > 0, largest, 1)


def _divide_by_power(value: Array, base: Array, power: float) -> Array:
    """Return `value` / `base`^`power` for a multiple of ½, by repeated factors."""
    whole = math.floor(power)
    if power > whole:
        factor = jax.lax.rsqrt(base)
        for _ in range(abs(round(2 * power))):
            value = value * (factor if power > 0 else factor * base)
        return value
    factor = 1 / base if power > 0 else base
    for _ in range(abs(whole)):
        value = value * factor
    return value
