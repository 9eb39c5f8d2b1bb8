"""Losses: the weight of an outlier."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar


class AbstractLoss(eqx.Module):
    """`ρ(s)` of the squared length s of a sensor's error in units of its noise.

    A reading counts as a whole, so that the loss does not depend on the frame.

    >>> import jax.numpy as jnp
    >>> class Squares(AbstractLoss):  # no outliers: ρ(s) = s
    ...     def shrink(self, error):
    ...         return error
    ...     def weight(self, error):
    ...         return jnp.ones(())
    >>> float(Squares().weight(jnp.array([6.0, 0.0, 0.0])))
    1.0
    """

    @abc.abstractmethod
    def shrink(self, error: Float[Array, " k"]) -> Float[Array, " k"]:
        """The error scaled so that its square is ρ(s), for least squares."""

    @abc.abstractmethod
    def weight(self, error: Float[Array, " k"]) -> Scalar:
        """dρ/ds, the weight of the reading in the normal equations: 1 for a small error."""


def _scale(value: Any) -> float:
    return _checks.positive(value, "scale")


class SoftL1(AbstractLoss):
    """Quadratic for ordinary errors, linear for large ones: `ρ(s) = 2c²(√(1 + s/c²) − 1)`.

    Convex, unlike Cauchy's, which can add local minima.

    **Arguments:** `scale` c, where quadratic turns to linear, in standard deviations. **Raises:**
    `ValueError` where it is not positive.

    Source: Charbonnier et al. 1997, doi:10.1109/83.551699 (as `soft_l1` in SciPy).

    >>> import jax.numpy as jnp
    >>> bool(jnp.linalg.norm(SoftL1(3.0).shrink(jnp.array([300.0, 0, 0]))) < 45)
    True
    """

    scale: float = eqx.field(default=3.0, converter=_scale)

    def shrink(self, error: Float[Array, " k"]) -> Float[Array, " k"]:
        s = jnp.sum(error**2) / self.scale**2
        return error * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + s)))

    def weight(self, error: Float[Array, " k"]) -> Scalar:
        return 1.0 / jnp.sqrt(1.0 + jnp.sum(error**2) / self.scale**2)


class Huber(AbstractLoss):
    """Quadratic up to c, linear beyond: `ρ(s) = s` for s ≤ c², else `2c√s − c²`.

    **Arguments:** `scale` c, in standard deviations. **Raises:** `ValueError` where it is not
    positive.

    Source: Huber 1964, doi:10.1214/aoms/1177703732.

    >>> import jax.numpy as jnp
    >>> Huber(3.0).weight(jnp.array([6.0, 0.0, 0.0]))
    Array(0.5, dtype=float64)
    """

    scale: float = eqx.field(default=3.0, converter=_scale)

    def shrink(self, error: Float[Array, " k"]) -> Float[Array, " k"]:
        s = jnp.sum(error**2) / self.scale**2
        large = s > 1.0
        length = jnp.sqrt(jnp.where(large, s, 1.0))
        return error * jnp.where(large, jnp.sqrt(2.0 * length - 1.0) / length, 1.0)

    def weight(self, error: Float[Array, " k"]) -> Scalar:
        s = jnp.sum(error**2) / self.scale**2
        return 1.0 / jnp.sqrt(jnp.maximum(s, 1.0))
