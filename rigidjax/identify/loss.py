"""How much an outlier counts."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import Scalar, Vec3


class SoftL1(eqx.Module):
    """Quadratic for ordinary errors, linear for large ones: `ρ(s) = 2c²(√(1 + s/c²) − 1)`.

    `s` is the squared length of a sensor's error in units of its noise, so one reading counts as a
    whole and the loss does not depend on the frame. Convex, unlike Cauchy's, which has minima of
    its own making.

    **Arguments:** `scale` c, where quadratic turns to linear, in standard deviations.

    Source: Charbonnier et al. 1997, doi:10.1109/83.551699 (as `soft_l1` in SciPy).

    >>> import jax.numpy as jnp
    >>> bool(jnp.linalg.norm(SoftL1(3.0).shrink(jnp.array([300.0, 0, 0]))) < 45)
    True
    """

    scale: float = 3.0

    def shrink(self, error: Vec3) -> Vec3:
        """The error scaled so that its square is ρ(s): what least squares then minimises."""
        s = jnp.sum(error**2) / self.scale**2
        return error * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + s)))

    def weight(self, error: Vec3) -> Scalar:
        """dρ/ds, the weight of the reading in the normal equations: 1 for a small error."""
        return 1.0 / jnp.sqrt(1.0 + jnp.sum(error**2) / self.scale**2)


def shrink(loss: SoftL1 | None, error: Float[Array, "3"]) -> Vec3:
    """The error as least squares is to see it."""
    return error if loss is None else loss.shrink(error)


def weight(loss: SoftL1 | None, error: Float[Array, "3"]) -> Any:
    """The weight of the reading in the normal equations."""
    return jnp.ones((), error.dtype) if loss is None else loss.weight(error)
