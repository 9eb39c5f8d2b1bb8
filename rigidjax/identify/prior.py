"""A prior around a roughly known body, the same in every frame and unit."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.body.inertia import Inertia, MassProperties


def _weight(value: float) -> Scalar:
    return jnp.asarray(_checks.positive(value, "weight"), jnp.result_type(float))


class Entropic(eqx.Module):
    """The entropic prior `w D(body, guess)`, D the log-determinant divergence of two bodies.

    D is `rigidjax.body.divergence` for a `Mass` chart, the same of 𝔖 alone for an inertia, and of
    the shapes for a chart without a scale. A weight w has the effect of w/2 readings drawn from the
    guess. It is a sum of squares, for least squares: with `L₀⁻¹ J L₀⁻ᵀ = C Cᵀ`,
    `D = Σ_{i>j} c_ij² + Σ_i (c_ii² − 1 − 2 log c_ii)`.

    **Arguments:** `guess` an `Inertia`, or `MassProperties` for a `Mass` chart; `weight` w > 0.

    Source: Lee, Wensing and Park 2020, doi:10.1109/TRO.2019.2926491 (the divergence).

    **Raises:** `TypeError`, `ValueError` for arguments of another type or shape.

    >>> import rigidjax as rj
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> bool(jnp.abs(Entropic(body, 1.0).residuals(body)).max() < 1e-7)
    True
    """

    guess: Inertia | MassProperties
    weight: Scalar = eqx.field(converter=_weight)

    def __check_init__(self) -> None:
        _checks.single(self.guess, (Inertia, MassProperties), "guess")

    def residuals(self, body: Inertia | MassProperties, scaled: bool = True) -> Float[Array, " n"]:
        """Numbers whose squares add up to `2 w D`; `scaled` false compares shapes alone."""
        if isinstance(body, MassProperties) and isinstance(self.guess, MassProperties):
            here, there = _pseudo_inertia(body), _pseudo_inertia(self.guess)
        else:
            here, there = body.second_moment, self.guess.second_moment
        if not scaled:
            here, there = here / jnp.trace(here), there / jnp.trace(there)
        root = jnp.linalg.cholesky(there)
        half = jnp.linalg.solve(root, here)
        factor = jnp.linalg.cholesky(jnp.linalg.solve(root, half.T))
        n = factor.shape[0]
        rows, columns = jnp.tril_indices(n, -1)
        parts = jnp.concatenate([factor[rows, columns], _root(jnp.diagonal(factor))])
        return jnp.sqrt(2.0 * self.weight) * parts


def _root(c: Float[Array, " n"]) -> Float[Array, " n"]:
    """`√(c² − 1 − 2 log c)` with the sign of c − 1: smooth through c = 1."""
    x = c - 1.0
    near = jnp.abs(x) < 1e-2
    # (x + 1)² − 1 − 2 log(1 + x) = 2 x² (1 − x/3 + x²/4 − x³/5 + …)
    series = 1.0 - x * (1 / 3 - x * (1 / 4 - x * (1 / 5 - x * (1 / 6 - x * (1 / 7 - x / 8)))))
    far = jnp.where(near, 2.0, c)
    exact = jnp.sign(far - 1.0) * jnp.sqrt(far * far - 1.0 - 2.0 * jnp.log(far))
    return jnp.where(near, x * jnp.sqrt(2.0 * series), exact)


def _pseudo_inertia(body: MassProperties) -> Float[Array, "4 4"]:
    m, c = body.mass, body.com
    upper = body.second_moment + m * c[:, None] * c[None, :]
    side = (m * c)[:, None]
    return jnp.block([[upper, side], [side.T, m]])
