"""Compute Legendre's elliptic integrals, complete and incomplete, with the parameter m = k².

All of these integrals, and all their derivatives, belong to one family that is closed under
differentiation:

    I_jkl(φ, m, n) = ∫₀^φ sin^{2j}θ Δ^{−(2k+1)} (1 − n sin²θ)^{−l} dθ,      Δ = √(1 − m sin²θ)
    dI_jkl = [integrand at φ] dφ + (k + ½) I_{j+1,k+1,l} dm + l I_{j+1,k,l+1} dn

F is I_000, E is I_{0,−1,0}, Π is I_001. Every integrand is positive, so no derivative is a
difference of large numbers. The textbook formulas (DLMF 19.4) divide such differences by m (1 − m).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from rigidjax.elliptic.arguments import (
    Real,
    RealOrArray,
    Tangent,
    common_arrays,
    with_complement,
)
from rigidjax.elliptic.carlson import rd, rf
from rigidjax.elliptic.carlson_r import r_integral
from rigidjax.rotation.stumpff import split_half_turns

# After this number of steps the arithmetic mean a and the geometric mean b agree to √eps, for a
# first ratio b/a down to the square root of the least number of the dtype.
_MEAN_STEPS = {np.dtype("float64"): 11, np.dtype("float32"): 8}


def ellipk(m: Real, m1: Real | None = None) -> RealOrArray:
    """Return the complete elliptic integral of the first kind, K(m) = ∫₀^{π/2} dθ/√(1 − m sin²θ).

    **Arguments:**

    - `m`: the parameter k² (not the modulus k), below 1 and possibly negative; m = 1 gives
      infinity, m > 1 gives NaN.
    - `m1`: 1 − m. Give it if m is so near 1 that 1 − m loses digits: value and derivative then
      depend on m1 alone.

    **Returns** π/(2 agm(1, √m1)), with agm the arithmetic–geometric mean (DLMF 19.8.5).

    >>> round(float(ellipk(1.0, 1e-30)), 12)
    35.925070756031
    """
    _, m1 = common_arrays(**with_complement("m", m, m1))
    return _complete_first_kind(m1)


def ellipe(m: Real, m1: Real | None = None) -> RealOrArray:
    """Return the complete elliptic integral of the second kind, E(m) = ∫₀^{π/2} √(1 − m sin²θ) dθ.

    **Arguments:** `m` ≤ 1 the parameter k² (m > 1 gives NaN); `m1` = 1 − m, as for `ellipk`.

    **Returns** E(m), computed by DLMF 19.25.1 from Carlson's integrals as a sum of positive terms.

    >>> float(ellipe(1.0))
    1.0
    """
    _, m1 = common_arrays(**with_complement("m", m, m1))
    return complete_integral((0, -1, 0), m1)


def ellippi(n: Real, m: Real, m1: Real | None = None, n1: Real | None = None) -> RealOrArray:
    """Return the complete integral of the third kind, ∫₀^{π/2} dθ/((1 − n sin²θ) √(1 − m sin²θ)).

    **Arguments**, in the order of Wolfram and mpmath:

    - `n`: the characteristic (DLMF's α²), below 1; n = 1 gives infinity, n > 1 gives NaN (not the
      principal value).
    - `m`: the parameter k², below 1.
    - `m1`, `n1`: 1 − m and 1 − n, as for `ellipk`.

    **Returns** the integral Π(n, m) of DLMF 19.2.8, computed as one integral with a positive
    integrand, accurate to round-off for any n < 1.

    >>> round(float(ellippi(0.5, 0.5)), 12)
    2.701287762095
    """
    _, n1, _, m1 = common_arrays(**with_complement("n", n, n1), **with_complement("m", m, m1))
    return complete_integral((0, 0, 1), m1, n1)


def ellipf(phi: Real, m: Real, m1: Real | None = None) -> RealOrArray:
    """Return the incomplete elliptic integral of the first kind, F(φ|m) = ∫₀^φ dθ/√(1 − m sin²θ).

    **Arguments:** `phi` the amplitude, rad, of any size; `m` the parameter k² with m sin²φ < 1
    (else NaN); `m1` = 1 − m, as for `ellipk`.

    **Returns** F(φ|m), computed by DLMF 19.25.5 from Carlson's integral R_F, after reduction to |φ|
    ≤ π/2 (DLMF 19.2.10).

    >>> round(float(ellipf(1.0, 0.5)), 12)
    1.083216772845
    """
    phi, _, m1 = common_arrays(phi=phi, **with_complement("m", m, m1))
    return _at_amplitude((0, 0, 0), phi, m1)


def ellipeinc(phi: Real, m: Real, m1: Real | None = None) -> RealOrArray:
    """Return the incomplete elliptic integral of the second kind, E(φ|m) = ∫₀^φ √(1 − m sin²θ) dθ.

    **Arguments:** `phi` the amplitude, rad, of any size; `m` ≤ 1 the parameter k² (m > 1 gives
    NaN); `m1` = 1 − m, as for `ellipk`.

    **Returns** E(φ|m), computed from Carlson's integrals by DLMF 19.25.9 or 19.25.10, whichever has
    positive terms, after reduction to |φ| ≤ π/2 (DLMF 19.2.10).

    >>> round(float(ellipeinc(1.0, 0.5)), 12)
    0.927329883624
    """
    phi, _, m1 = common_arrays(phi=phi, **with_complement("m", m, m1))
    return _at_amplitude((0, -1, 0), phi, m1)


def ellippiinc(
    n: Real, phi: Real, m: Real, m1: Real | None = None, n1: Real | None = None
) -> RealOrArray:
    """Return the incomplete integral of the third kind, ∫₀^φ dθ/((1 − n sin²θ) √(1 − m sin²θ)).

    **Arguments**, in the order of Wolfram and mpmath:

    - `n`: the characteristic, with n sin²φ < 1 (else NaN).
    - `phi`: the amplitude, rad, of any size.
    - `m`: the parameter k², with m sin²φ < 1 (else NaN).
    - `m1`, `n1`: 1 − m and 1 − n, as for `ellipk`.

    **Returns** the integral Π(n, φ|m) of DLMF 19.2.7, computed as one integral, after reduction to
    |φ| ≤ π/2 (DLMF 19.2.10).

    >>> round(float(ellippiinc(0.5, 1.0, 0.5)), 12)
    1.288978174245
    """
    _, n1, phi, _, m1 = common_arrays(
        **with_complement("n", n, n1), phi=phi, **with_complement("m", m, m1)
    )
    return _at_amplitude((0, 0, 1), phi, m1, n1)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def incomplete_integral(
    orders: tuple[int, int, int], sine: Array, cosine: Array, m1: Array, n1: Array
) -> Array:
    """Return I_jkl, |φ| ≤ π/2, from sin φ and cos φ, which lose no digit near φ = π/2."""
    j, k, last = orders
    s, c2 = sine, cosine * cosine
    one, delta2 = jnp.ones_like(s), c2 + m1 * s * s
    if orders == (0, 0, 0):
        return s * rf(c2, delta2, one)
    if orders == (1, 1, 0):
        return s**3 / 3 * rd(c2, one, delta2)
    if orders == (1, 0, 0):
        return s**3 / 3 * rd(c2, delta2, one)
    if orders == (0, -1, 0):
        return _second_kind(s, c2, delta2, m1)
    powers, values = [j - k - last + 0.5, 0.5, k + 0.5], [one, c2, delta2]
    if last:
        powers, values = [*powers, float(last)], [*values, c2 + n1 * s * s]
    return 0.5 * s ** (2 * j + 1) * r_integral(tuple(powers), tuple(values))


@partial(incomplete_integral.defjvp, symbolic_zeros=True)
def _incomplete_integral_jvp(
    orders: tuple[int, int, int],
    primals: tuple[Array, Array, Array, Array],
    tangents: tuple[Tangent, Tangent, Tangent, Tangent],
) -> tuple[Array, Array]:
    """Return I_jkl and its tangent, by the formula in the head of this module."""
    j, k, last = orders
    s, c, m1, n1 = primals
    ds, dc, dm1, dn1 = tangents
    value = incomplete_integral(orders, *primals)
    tangent = jnp.zeros_like(value)
    if not (isinstance(ds, SymbolicZero) and isinstance(dc, SymbolicZero)):
        ds = jnp.zeros_like(s) if isinstance(ds, SymbolicZero) else ds
        dc = jnp.zeros_like(c) if isinstance(dc, SymbolicZero) else dc
        delta2 = c * c + m1 * s * s
        rate = s ** (2 * j) * jax.lax.integer_pow(delta2, -k) * jax.lax.rsqrt(delta2)
        if last:
            rate = rate / (c * c + n1 * s * s) ** last
        tangent = tangent + rate * (c * ds - s * dc)
    if not isinstance(dm1, SymbolicZero):
        tangent = tangent - (k + 0.5) * incomplete_integral((j + 1, k + 1, last), *primals) * dm1
    if last and not isinstance(dn1, SymbolicZero):
        tangent = tangent - last * incomplete_integral((j + 1, k, last + 1), *primals) * dn1
    return value, tangent


def complete_integral(orders: tuple[int, int, int], m1: Array, n1: Array | None = None) -> Array:
    """Return I_jkl for φ = π/2, with n = 0 if `n1` is None."""
    one = jnp.ones_like(m1)
    return incomplete_integral(orders, one, jnp.zeros_like(m1), m1, one if n1 is None else n1)


def agm_iterates(m1: Array) -> list[tuple[Array, Array]]:
    """Return the pairs of arithmetic and geometric means from (1, √m1) to their common value."""
    rows = [(jnp.ones_like(m1), jnp.sqrt(m1))]
    for _ in range(_MEAN_STEPS[np.dtype(m1.dtype)]):
        a, b = rows[-1]
        rows.append((0.5 * (a + b), jnp.sqrt(a * b)))
    return rows


@jax.custom_jvp
def _complete_first_kind(m1: Array) -> Array:
    """Return K(m) = π/(2 agm(1, √m1)), infinite for m1 = 0."""
    a, b = agm_iterates(m1)[-1]
    return jnp.where(m1 == 0, jnp.inf, math.pi / (a + b))


@_complete_first_kind.defjvp
def _complete_first_kind_jvp(
    primals: tuple[Array], tangents: tuple[PyTree, ...]
) -> tuple[Array, Array]:
    """Return K and its tangent."""
    (m1,), (dm1,) = primals, tangents
    return _complete_first_kind(m1), -0.5 * complete_integral((1, 1, 0), m1) * dm1


def _second_kind(sine: Array, cosine_squared: Array, delta_squared: Array, m1: Array) -> Array:
    """Return E(φ|m) for |φ| ≤ π/2, by DLMF 19.25.10 for 0 ≤ m ≤ 1 and 19.25.9 for m < 0: with this
    choice every term is positive.
    """
    m, one = 1 - m1, jnp.ones_like(sine)
    # For m = 1 and |φ| = π/2 Carlson's integrals below are not finite; E(φ|1) is sin φ.
    end = delta_squared == 0
    cosine_squared, delta_squared = (
        jnp.where(end, one, x) for x in (cosine_squared, delta_squared)
    )
    above = m >= 0
    first = jnp.where(above, m1, one) * sine * rf(cosine_squared, delta_squared, one)
    third = rd(
        cosine_squared, jnp.where(above, one, delta_squared), jnp.where(above, delta_squared, one)
    )
    second = jnp.where(above, m1 * m, -m) * sine**3 / 3 * third
    rest = jnp.where(above, m * sine * jnp.sqrt(cosine_squared / delta_squared), 0)
    value = jnp.where(end, sine, first + second + rest)
    return jnp.where(m1 < 0, jnp.nan, value)


def _at_amplitude(
    orders: tuple[int, int, int], phi: Array, m1: Array, n1: Array | None = None
) -> Array:
    """Return I_jkl for an amplitude of any size, with n = 0 if `n1` is None.

    With φ = Nπ + r, for a whole number N and |r| ≤ π/2, it is 2N times the complete integral plus
    the integral from 0 to r.
    """
    turns, remainder = split_half_turns(phi)
    n1 = jnp.ones_like(m1) if n1 is None else n1
    part = incomplete_integral(orders, jnp.sin(remainder), jnp.cos(remainder), m1, n1)
    # For |φ| ≤ π/2 the complete integral is not needed, and it may be infinite: replace it by the
    # one for m = n = 0.
    near = turns == 0
    one = jnp.ones_like(m1)
    safe_m1, safe_n1 = jnp.where(near, one, m1), jnp.where(near, one, n1)
    first = orders == (0, 0, 0)
    whole = _complete_first_kind(safe_m1) if first else complete_integral(orders, safe_m1, safe_n1)
    return part + jnp.where(near, 0, 2 * turns * whole)
