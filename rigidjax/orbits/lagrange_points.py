"""The five equilibrium points of the restricted three-body problem."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax._types import Scalar


def points(mu: Scalar) -> Float[Array, "5 3"]:
    """L1 … L5 (5, 3) of 0 < μ ≤ ½ by Euler's quintics (Szebehely 1967, sec. 4.4), rotating axes."""
    between, beyond, opposite = distances(mu)
    zero = jnp.zeros_like(mu)
    height = jnp.full_like(mu, 0.75**0.5)
    rows = [
        [1 - mu - between, zero, zero],
        [1 - mu + beyond, zero, zero],
        [-mu - opposite, zero, zero],
        [0.5 - mu, height, zero],
        [0.5 - mu, -height, zero],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def distances(mu: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """The distances of L1 and L2 from the second primary, and of L3 from the first."""
    one = jnp.ones_like(mu)
    hill = jnp.cbrt(mu / (3 * (1 - mu)))
    between = _root([one, mu - 3, 3 - 2 * mu, -mu, 2 * mu, -mu], hill * (1 - hill / 3))
    beyond = _root([one, 3 - mu, 3 - 2 * mu, -mu, -2 * mu, -mu], hill * (1 + hill / 3))
    rest = mu - 1
    opposite = _root([one, 2 + mu, 1 + 2 * mu, rest, 2 * rest, rest], 1 - 7 * mu / 12)
    return between, beyond, opposite


def _root(coefficients: list[Scalar], start: Scalar) -> Scalar:
    """Newton's root of a polynomial, highest power first; `start` is near it for every μ."""

    def step(_: object, x: Scalar) -> Scalar:
        value, slope = coefficients[0], jnp.zeros_like(x)
        for c in coefficients[1:]:
            value, slope = value * x + c, slope * x + value
        return x - value / slope

    return lax.fori_loop(0, 7, step, start)
