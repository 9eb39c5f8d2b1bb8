"""Compute smooth kernels of θ², correct with all their derivatives from θ = 0 upwards.

Rotations need sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³, … as functions of t = θ². These are the
Stumpff functions c_k(t) = Σ (−t)ⁿ/(k + 2n)!  (Stumpff 1959; Battin 1999, sec. 4.5). Their
derivatives are Stumpff functions too, c_k' = ½ (k c_{k+2} − c_{k+1}), so that no derivative needs a
cancelling quotient. Sine and cosine are computed by polynomials on a reduced range: on CPU the
functions of libm take one number at a time, and a polynomial takes a whole vector.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

# The largest argument of `arctan_ratio`, tan²(π/8).
_REACH = math.tan(math.pi / 8) ** 2
# π as the sum of three numbers. The first two have only 28 (float64) or 10 (float32) bits, so that
# their products with a number of half turns are exact.
_PI_PARTS = {
    np.dtype("float64"): (3.141592651605606, 1.9841871479187034e-09, 1.1442377452219664e-17),
    np.dtype("float32"): (3.140625, 0.0009670257568359375, 6.278329465203569e-07),
}


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def stumpff(k: int, t: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the Stumpff function c_k(t) = Σ (−t)ⁿ/(k + 2n)! for t = θ² ≥ 0 (Battin 1999, eq 4.80).

    c_0 is cos θ, c_1 sin θ/θ, c_2 (1 − cos θ)/θ², c_3 (θ − sin θ)/θ³. Values and derivatives of
    every order are right to a few units of round-off of 1/k!.
    """
    if k < 2:
        return _cos_or_sinc(k, t)
    # For t > π² the recurrence c_{j+2} = (1/j! − c_j)/t is used, which loses no digit that matters
    # there; for a smaller t it would, and the series of c_k is summed.
    limit = math.pi**2
    far = t > limit
    divisor = jnp.where(far, t, 1)
    value = _cos_or_sinc(k % 2, t)
    for j in range(k % 2, k - 2, 2):
        value = (1 / math.factorial(j) - value) / divisor
    near = _series(k, jnp.where(far, 0, t), limit)
    return jnp.where(far, 1 / math.factorial(k - 2) - value, near) / divisor


@stumpff.defjvp
def _stumpff_jvp(
    k: int, primals: tuple[Float[Array, "..."]], tangents: tuple[PyTree, ...]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return c_k and its tangent, by c_k' = ½ (k c_{k+2} − c_{k+1})."""
    (t,), (dt,) = primals, tangents
    slope = k * stumpff(k + 2, t) - stumpff(k + 1, t) if k else -stumpff(1, t)
    return stumpff(k, t), 0.5 * slope * dt


def inverse_coefficient(t: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return g = (1 − (θ/2) cot(θ/2))/θ² of t = θ² < (2π)², the coefficient of (hat v)² in the
    inverse Jacobian of a rotation vector v; it is 1/12 at 0.
    """
    return (stumpff(3, t) - 2 * stumpff(4, t)) / stumpff(1, 0.25 * t) ** 2


def arctan_ratio(x_squared: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return arctan(x)/x from x² ≤ tan²(π/8), by Taylor series (Abramowitz & Stegun 4.4.42)."""
    tiny = jnp.finfo(x_squared.dtype).eps / 4
    terms = next(n for n in range(1, 40) if _REACH**n / (2 * n + 1) < tiny)
    return _polynomial([(-1) ** n / (2 * n + 1) for n in range(terms)], x_squared)


def _cos_or_sinc(k: int, t: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return cos θ (k = 0) or sin θ/θ (k = 1) from t = θ² ≥ 0, by a polynomial, after half turns
    are subtracted from an angle above π/2.
    """
    limit = (math.pi / 2) ** 2
    far = t > limit
    theta = jnp.sqrt(jnp.where(far, t, 1))
    turns, remainder = split_half_turns(theta)
    # An angle θ beyond 1/ε, where ε is the unit of round-off, has no correct digit; its remainder
    # must still stay in the range of the polynomials.
    remainder = jnp.clip(remainder, -2.0, 2.0)
    value = _series(k, jnp.where(far, remainder * remainder, t), limit)
    value = value * jnp.where(far, remainder, 1) if k else value
    # The value is divided by the sign, not multiplied: XLA on CPU computes a quotient once, but
    # repeats a polynomial for each use.
    sign = power_of_minus_one(turns)
    return value / jnp.where(far, sign * theta if k else sign, 1)


def split_half_turns(angle: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return n and r of angle = nπ + r with |r| ≤ π/2 and an integer n without derivative."""
    turns = jax.lax.stop_gradient(jnp.round(angle * (1 / math.pi)))
    # π is the sum of three parts. The number n of half turns (`turns`) times `head`, and times
    # `middle`, is exact, so that the remainder r keeps the digits of the angle (Cody & Waite 1980).
    head, middle, tail = _PI_PARTS[np.dtype(angle.dtype)]
    return turns, ((angle - turns * head) - turns * middle) - turns * tail


def power_of_minus_one(n: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return (−1)ⁿ for integers n, given as floating-point numbers."""
    return 1 - 2 * (n - 2 * jnp.floor(0.5 * n))


def _series(k: int, t: Float[Array, "..."], limit: float) -> Float[Array, "..."]:
    """Return c_k(t) for 0 ≤ t ≤ `limit` by as many terms as the limit needs."""
    tiny = jnp.finfo(t.dtype).eps / 8
    size = 1 / math.factorial(k)
    terms = next(n for n in range(1, 40) if limit**n / math.factorial(k + 2 * n) < tiny * size)
    return _polynomial([(-1) ** n / math.factorial(k + 2 * n) for n in range(terms)], t)


def _polynomial(coefficients: list[float], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return c₀ + c₁ x + c₂ x² + … by Horner's scheme."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
