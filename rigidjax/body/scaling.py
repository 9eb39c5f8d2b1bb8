"""Scale by powers of two, which loses no digit.

`jnp.ldexp(x, n)` is not used: before jax 0.12 its derivative with respect to x is 1 instead of 2ⁿ
at x = 0 (as in every off-diagonal entry of a diagonal tensor), loses digits at large |n|, and is
infinite at n = 1023.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def binary_exponent(x: Float[Array, "..."]) -> Int[Array, ""]:
    """Return the integer n, constant in derivatives, of 2ⁿ⁻¹ ≤ max |x| < 2ⁿ; 0 if x is zero."""
    return jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(x))))[1]


def times_power_of_two(x: Float[Array, "..."], n: Int[Array, ""]) -> Float[Array, "..."]:
    """Return x 2ⁿ, |n| ≤ 2044 (float32: 252), exact if the product is a normal number."""
    half = n // 2
    # 2ⁿ itself may overflow: `x` is multiplied by two smaller powers, one after the other. Without
    # the barrier XLA, where it knows n, would first multiply the two powers. The powers are made
    # from their bits, because `jnp.ldexp` would give XLA fifty operations to compile.
    info = jnp.finfo(x.dtype)
    both = tuple(
        jax.lax.bitcast_convert_type(
            (k.astype(f"int{info.bits}") + (info.maxexp - 1)) << info.nmant, x.dtype
        )
        for k in (half, n - half)
    )
    first, second = jax.lax.optimization_barrier(both)
    return x * first * second
