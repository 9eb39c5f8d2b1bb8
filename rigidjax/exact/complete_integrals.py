"""Half a period of a free body's rates, by the arithmetic–geometric mean."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from rigidjax._types import Scalar
from rigidjax.exact.jacobi_duplication import Modulus, is_endless, limits


class HalfPeriod(NamedTuple):
    """Over half a period: the time, the phase ξ, and the mean of S².

    On the separatrix the time is infinite.
    """

    time: Scalar
    phase: Scalar
    mean: Scalar


def half_period(m: Modulus, mu: Scalar, turn: Scalar) -> HalfPeriod:
    """The least T > 0 with S(T) = 0, and what S gathers on the way.

    With λ² = max(p, q), a₀ = 1, b₀ = √|p − q|/λ: `T = π/(λ agm(a₀, b₀))` (DLMF 19.8.5), and with
    `c₁ = (a₀ − b₀)/2, c_{n+1} = c_n²/(4 a_{n+1})` the mean `⟨S²⟩ = (½ + Σ 2^{n−1} c_n²/w)/λ²`,
    w = min(p, q)/λ² (19.8.6 divided through by w, so that w = 0 is an ordinary value). The phase is
    the complete integral of the third kind, 19.8.7–19.8.9, with μ in the place of −α².
    """
    big, small = jnp.maximum(m.p, m.q), jnp.minimum(m.p, m.q)
    at_rest = big <= 0
    big = jnp.where(at_rest, 1.0, big)
    gap = jnp.abs(m.gap)
    endless = is_endless(m)
    # In units of λ: XLA may gather the divisors below into one product, which must not underflow.
    w = small / big
    a, b = jnp.ones_like(big), jnp.sqrt(jnp.where(endless, 1.0, gap / big))
    # c₁ = w/(2(a₀ + b₀)) exactly; `ratio` is c_n²/w and `c` is c_n.
    c = w / (2.0 * (a + b))
    ratio = w / (4.0 * (a + b) ** 2)
    # A loop: written out, eleven steps take as long to compile as the rest of the motion.
    point, half, one = jnp.sqrt(1.0 + mu / big), jnp.full_like(a, 0.5), jnp.ones_like(a)
    start = (a, b, c, ratio, half, point, one, one)
    a, *_, total, _, _, sum_parts = jax.lax.fori_loop(0, limits(a.dtype).agm, _mean, start)
    time = math.pi / (a * jnp.sqrt(big))
    # turn = κμ h; over a quarter ξ = κ h (π/2a) ½ μ/(λ² + μ) Σ.
    phase = turn * time * 0.5 / (big + mu) * sum_parts
    return HalfPeriod(jnp.where(endless, jnp.inf, time), phase, total / big)


def _mean(_: Array, state: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """A step of the arithmetic–geometric mean, and of what is summed along it.

    `ratio` carries 2^{n−1}.
    """
    a, b, c, ratio, total, point, part, sum_parts = state
    square, product = point * point, a * b
    part = 0.5 * part * (square - product) / (square + product)
    a, b = 0.5 * (a + b), jnp.sqrt(product)
    narrow = c / (2.0 * (a + b))
    return (
        a,
        b,
        c * narrow,
        2.0 * ratio * narrow * narrow,
        total + ratio,
        0.5 * (square + product) / point,
        part,
        sum_parts + part,
    )
