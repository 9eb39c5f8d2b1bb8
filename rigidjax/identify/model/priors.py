"""Compute robust losses, which give outliers less weight, a prior of the body, and measurements
that belong to no recording.
"""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import NumbersLike, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties


class AbstractLoss(eqx.Module):
    """Define a robust loss ρ(s), which gives outliers less weight.

    Here s is the squared length of the error vector of a reading, in units of its noise. Since the
    loss is a function of this length alone, it does not depend on the frame of the vector. To make
    a loss of your own, write a subclass with two methods of the error: `shrink` returns the error
    shortened to the squared length ρ(s), and `weight` the derivative dρ/ds.

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
        """Return the `error` (k,) of a reading, multiplied by a factor so that its squared length
        becomes the loss ρ(s).

        Here s is the squared length of the given `error`, which is in units of its noise.
        """

    @abc.abstractmethod
    def weight(self, error: Float[Array, " k"]) -> Scalar:
        """Return the weight dρ/ds of a reading in the normal equations, where ρ is the loss and s
        the squared length of the `error` (k,) of the reading in units of its noise.

        The weight is 1 for a small error.
        """


_scale = partial(_checks.positive_float, name="scale")


class SoftL1(AbstractLoss):
    """Define a loss that is quadratic for ordinary errors and linear for large ones.

    It is `ρ(s) = 2c²(√(1 + s/c²) − 1)`, where s is the squared length of the error in standard
    deviations. SciPy calls this loss `soft_l1` (Charbonnier et al. 1997, doi:10.1109/83.551699).

    **Arguments:** `scale` c, the error at which the loss turns from quadratic to linear, in
    standard deviations. **Raises:** `ValueError` for a scale that is not positive.

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
    """Define a loss that is quadratic up to an error c and linear beyond it.

    It is `ρ(s) = s` for s ≤ c², else `2c√s − c²`, where s is the squared length of the error in
    standard deviations (Huber 1964, doi:10.1214/aoms/1177703732).

    **Arguments:** `scale` c, the error at which the loss turns from quadratic to linear, in
    standard deviations. **Raises:** `ValueError` for a scale that is not positive.

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


class Entropic(eqx.Module):
    """Define the entropic prior `w D(body, guess)`, where D is the log-determinant divergence of
    two bodies.

    For a `Mass` chart D is `rigidjax.body.divergence`, the divergence of the pseudo-inertias J (of
    the body) and J₀ (of the guess). For other charts the matrices of second moments 𝔖 = ∫ r rᵀ dm
    of both bodies take the place of J and J₀; for a chart without a scale each 𝔖 is divided by its
    trace. D is a sum of squares, `D = Σ_{i>j} c_ij² + Σ_i (c_ii² − 1 − 2 log c_ii)`. Here c_ij are
    the elements of the Cholesky factor C of `L₀⁻¹ J L₀⁻ᵀ = C Cᵀ`, and L₀ is the Cholesky factor of
    `J₀ = L₀ L₀ᵀ`. The weight w has the effect of w/2 readings drawn from the guess.

    **Arguments:** `guess` an `Inertia`, or `MassProperties` for a `Mass` chart; `weight` w > 0.
    Source: Lee, Wensing and Park 2020, doi:10.1109/TRO.2019.2926491 (the divergence).

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> bool(jnp.abs(Entropic(body, 1.0).residuals(body)).max() < 1e-7)
    True
    """

    guess: Inertia | MassProperties
    weight: Scalar = eqx.field(
        converter=lambda w: jnp.asarray(_checks.positive_float(w, "weight"), jnp.result_type(float))
    )

    def __check_init__(self) -> None:
        validation.require_single_body(self.guess, (Inertia, MassProperties), "guess")

    def residuals(
        self, body: Inertia | MassProperties, to_scale: bool = True
    ) -> Float[Array, " n"]:
        """Return residuals whose squares add up to `2 w D`, where D is the divergence of `body`
        from the guess and w the weight.

        If `to_scale` is false, each matrix of second moments is divided by its trace first, so that
        D compares only the shapes of the two bodies.
        """
        if isinstance(body, MassProperties) and isinstance(self.guess, MassProperties):
            here, there = pseudo_inertia(body), pseudo_inertia(self.guess)
        else:
            here, there = body.second_moment, self.guess.second_moment
        if not to_scale:
            here, there = here / jnp.trace(here), there / jnp.trace(there)
        root = jnp.linalg.cholesky(there)
        half = jnp.linalg.solve(root, here)
        factor = jnp.linalg.cholesky(jnp.linalg.solve(root, half.T))
        n = factor.shape[0]
        rows, columns = jnp.tril_indices(n, -1)
        # The divergence of each variance c² from the variance 1 has a root that is smooth at c = 1
        # if it has the sign of c − 1. Near c = 1 the formula would lose its digits; the series is
        # that in (1 + x)² − 1 − 2 log(1 + x) = 2 x² (1 − x/3 + x²/4 − x³/5 + …).
        c = jnp.diagonal(factor)
        x = c - 1.0
        near = jnp.abs(x) < 1e-2
        series = 1.0 - x * (1 / 3 - x * (1 / 4 - x * (1 / 5 - x * (1 / 6 - x * (1 / 7 - x / 8)))))
        far = jnp.where(near, 2.0, c)
        exact = jnp.sign(far - 1.0) * jnp.sqrt(far * far - 1.0 - 2.0 * jnp.log(far))
        signed = jnp.where(near, x * jnp.sqrt(2.0 * series), exact)
        parts = jnp.concatenate([factor[rows, columns], signed])
        return jnp.sqrt(2.0 * self.weight) * parts


class Measured(eqx.Module):
    """Define a measured number of the body or of the `Free`s, such as a weight, a period or a
    length in a drawing, or k such numbers: a reading that belongs to no recording.

    A fit adds the residual `(value − of(point)) / sigma`. The sign is that of other readings.

    **Arguments:**

    - `of`: a differentiable function of an `Unpacked` (body, initial states, values of the `Free`s)
      that returns the number, such as `lambda point: point.body.mass`, or k numbers (k,). Another
      function is compiled anew.
    - `value`: the measured number, in its unit, or (k,) numbers.
    - `sigma`: its standard deviation, in the same unit, one or (k,).
    - `name`: its name in reports.

    **Raises:** `TypeError` for anything but a function and a name; `ValueError` for a value that is
    not finite, or a standard deviation that is not positive.

    >>> Measured(lambda point: point.body.mass, 0.482, 0.001, "weight").name
    'weight'
    """

    of: Callable[[Any], Any] = eqx.field(static=True)
    value: Float[Array, "*k"]
    sigma: Float[Array, "*k"]
    name: str = eqx.field(static=True)

    def __init__(self, of: Callable[[Any], Any], value: NumbersLike, sigma: NumbersLike, name: str):
        self.of = _checks.require_function(of, "of", "of an `Unpacked` to a number")
        self.name = _checks.require_instance(name, str, "name")
        here, kind = f"Measured {name!r}", jnp.result_type(float)
        number = _checks.numeric_array(value, f"{here}: value").astype(kind)
        if number.ndim > 1:
            raise ValueError(f"{here}: value: wanted a number or (k,) numbers, got {number.shape}")
        self.value = _checks.require_finite(number, f"{here}: value")
        wide = _checks.numeric_array(sigma, f"{here}: sigma").astype(kind)
        if wide.shape not in ((), number.shape):
            raise ValueError(f"{here}: sigma: wanted one or {number.shape}, got {wide.shape}")
        wide = jnp.broadcast_to(wide, number.shape)
        self.sigma = _checks.require_positive(wide, f"{here}: sigma", "a positive number")

    def residual(self, point: Any) -> Float[Array, "*k"]:
        """Return the measured minus the computed number, in standard deviations."""
        number = _checks.differentiable_array(self.of(point), f"Measured {self.name!r}")
        if number.shape != self.value.shape:
            words = f"wanted {self.value.shape or 'one number'} of `of`, got {number.shape}"
            raise ValueError(f"Measured {self.name!r}: {words}")
        return (self.value - number) / self.sigma


def pseudo_inertia(body: MassProperties) -> Float[Array, "4 4"]:
    """Return the pseudo-inertia `J = ∫ r̃ r̃ᵀ dm` of a `body`, with the four-vectors r̃ = (r, 1)."""
    m, c = body.mass, body.com
    upper = body.second_moment + m * c[:, None] * c[None, :]
    side = (m * c)[:, None]
    return jnp.block([[upper, side], [side.T, m]])
