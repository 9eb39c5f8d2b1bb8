"""Scaling by powers of two, which loses no digit.

Not `jnp.ldexp(x, n)`: before jax 0.12 its derivative by x is 1 instead of 2ⁿ at x = 0 (as in every
off-diagonal entry of a diagonal tensor), loses digits at large |n|, and is infinite at n = 1023.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def exponent_of(x: Float[Array, "..."]) -> Int[Array, ""]:
    """The integer n with 2ⁿ⁻¹ ≤ max |x| < 2ⁿ, held fixed in derivatives; 0 for x = 0."""
    return jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(x))))[1]


def times_power_of_two(x: Float[Array, "..."], n: Int[Array, ""]) -> Float[Array, "..."]:
    """`x 2ⁿ`, |n| ≤ 2044 (float32: 252), exact with its derivatives if it is a normal number."""
    half = n // 2
    # XLA would multiply the two together first where it knows n.
    both = _power_of_two(half, x.dtype), _power_of_two(n - half, x.dtype)
    first, second = jax.lax.optimization_barrier(both)
    return x * first * second


def _power_of_two(n: Int[Array, ""], dtype: jnp.dtype) -> Float[Array, ""]:
    """A normal 2ⁿ from its bits: `jnp.ldexp` is fifty operations to compile."""
    info = jnp.finfo(dtype)
    bits = (n.astype(f"int{info.bits}") + (info.maxexp - 1)) << info.nmant
    return jax.lax.bitcast_convert_type(bits, dtype)
