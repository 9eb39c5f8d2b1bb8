"""Compute sn, cn and dn near m = 1 as sums over images, with one hyperbolic function for each half
period.

Let K and K' be the complete integrals of the first kind for m and for m1 = 1 − m, let p =
exp(−πK/K') ≈ m1/16 be the complementary nome, and let B = π/(2K'). Then (DLMF §22.12, after
Jacobi's imaginary transformation, §22.6(iv))

    dn u = B Σᵢ sech(B(u − 2iK))            cn u = (B/k) Σᵢ (−1)ⁱ sech(B(u − 2iK))
    sn u = (B/k) Σᵢ (−1)ⁱ tanh(B(u − 2iK)),     i = −∞ … ∞,     e^(−2BK) = p.

Each term of these sums is called an image; its centre is at u = 2iK. B, k = √m and p are analytic
in m1 at 0. Every derivative in m, at m = 1 and near it, is therefore the derivative of an explicit
sum. The sums give the second derivatives. If the second derivatives were computed from ∂F/∂m, where
F is Legendre's integral of the first kind, they would lose all digits as m1 → 0.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from rigidjax.elliptic.arguments import RealOrArray
from rigidjax.rotation.stumpff import power_of_minus_one

# The sums are used for m1 = 1 − m up to this number. The complementary nome p is then below 0.0066:
# a few terms of the sums, and a few terms of the series for p, are enough.
LARGEST_M1 = 0.1
# Each sum over images in the docstring of this module is cut to this many images on either side of
# the one whose centre is nearest to the argument u.
_IMAGES = {np.dtype("float64"): 8, np.dtype("float32"): 4}


def sncndn_near_one(
    u: RealOrArray, m: RealOrArray, m1: RealOrArray
) -> tuple[RealOrArray, RealOrArray, RealOrArray]:
    """Return sn, cn and dn for 0 ≤ m1 ≤ 0.1, with an absolute error of about the machine epsilon;
    the tangent of m must be minus that of m1.
    """
    root = jnp.sqrt(m)
    fourth = jnp.sqrt(root)
    # The complementary nome p is DLMF 19.5.5–6, with the difference 1 − m^(1/4) written as a
    # quotient, which loses no digit.
    x = 0.5 * m1 / ((1 + fourth) * (1 + fourth) * (1 + root))
    x4 = (x * x) * (x * x)
    nome = x * (1 + x4 * (2 + 15 * x4))
    # The complete integral K' for m1 is (π/2) θ₃², where θ₃ is Jacobi's theta function at 0 with
    # the nome p (DLMF 20.9.2).
    theta3 = 1 + 2 * nome * (1 + nome * nome * nome)
    rate = 1 / (theta3 * theta3)

    y = jnp.abs(u) * rate
    length = -jnp.log(jax.lax.stop_gradient(nome))
    turns = jnp.round(jax.lax.stop_gradient(y) / length)
    reach = _IMAGES[np.dtype(u.dtype)]
    offset = jnp.arange(-reach, reach + 1, dtype=u.dtype).reshape((1,) * u.ndim + (-1,))
    image = turns[..., None] + offset
    # With y = B|u|, the centre of image i is at y = 2iBK = −i ln p. Compute e^(−d), where d is the
    # distance of y from the centre, as a power of p times e^(±y), because p, unlike d, has
    # derivatives at m1 = 0.
    beyond = jax.lax.stop_gradient(y) >= jnp.where(turns == 0, 0, turns * length)
    side = jnp.where(
        jnp.where(offset == 0, beyond[..., None], jnp.broadcast_to(offset < 0, image.shape)), -1, 1
    ).astype(u.dtype)
    z = _power_times_exp(nome[..., None], side * y[..., None], side * image)
    hyperbolic = 2 * z / (1 + z * z)
    # For sn, sum for each image, except the nearest one, tanh minus its limit 1 or −1 far from the
    # image: the limits of the images on the two sides cancel in pairs.
    tangent = jnp.where(offset == 0, -side * (1 - z * z), side * 2 * z * z) / (1 + z * z)

    sine = rate / root * (power_of_minus_one(image) * tangent).sum(-1)
    cosine = rate / root * (power_of_minus_one(image) * hyperbolic).sum(-1)
    return jnp.where(u < 0, -sine, sine), cosine, rate * hyperbolic.sum(-1)


@jax.custom_jvp
def _power_times_exp(base: Array, exponent: Array, power: Array) -> Array:
    """Return p^n e^y for a whole number n, with exact derivatives by p and y.

    For n = 1 the second derivative with respect to p is exactly 0; if JAX differentiated e^(y + n
    ln p) instead, an error of round-off would be left.
    """
    return jnp.exp(exponent + jnp.where(power == 0, 0, power * jnp.log(base)))


@_power_times_exp.defjvp
def _power_times_exp_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[PyTree, ...]
) -> tuple[Array, Array]:
    """Return p^n e^y and its tangent, for the primals (p, y, n) with a constant n."""
    (p, y, n), (dp, dy, _) = primals, tangents
    value = _power_times_exp(p, y, n)
    slope = jnp.where(n == 0, 0, n * _power_times_exp(p, y, n - 1))
    return value, slope * dp + value * dy
