"""Describe a function of time by Chebyshev polynomials on equal intervals, as ephemerides are
published.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, _show
from rigidjax._types import Scalar, ScalarLike
from rigidjax.rotation.barrier import barrier


class Chebyshev(eqx.Module):
    """Evaluate a function of time, t → (k,): a Chebyshev series on each of many equal intervals.

    **Arguments:** `start` s, the beginning of the first interval; `step` s, the length of each
    interval; `coefficients` (intervals, k, terms), in the layout of JPL's ephemerides: the value is
    `Σ_n c_n T_n(x)` with the coefficients c_n of the interval, the Chebyshev polynomials T_n, and x
    from −1 to 1 along the interval. All arguments may be traced.

    `GravityGradient` and `Tide` take such a function as the `position` of a point mass; the
    position then has the full precision of the table. The value is NaN outside of the intervals.
    **Raises:** `ValueError` for a step that is not positive. The sum is computed by Clenshaw's
    recurrence (1955, Mathematical Tables 9:118).

    >>> Chebyshev(0.0, 2.0, [[[1.0, 0.0, 1.0]]])(2.0)  # 1 + T₂(1)
    Array([2.], dtype=float64)
    """

    start: Scalar
    step: Scalar
    coefficients: Float[Array, "intervals k terms"]

    __repr__ = _show.fields_as_text

    def __init__(
        self,
        start: ScalarLike,
        step: ScalarLike,
        coefficients: Float[ArrayLike, "n k terms"] | Sequence[Any],
    ):
        rows = _checks.numeric_array(coefficients, "coefficients")
        if rows.ndim != 3 or 0 in rows.shape:
            raise ValueError(f"coefficients: wanted (intervals, k, terms), got {rows.shape}")
        dtype = jnp.result_type(float)
        self.coefficients = _checks.require_finite(rows, "coefficients").astype(dtype)
        self.start, step = (
            _checks.finite_array(start, (), "start"),
            _checks.finite_array(step, (), "step"),
        )
        self.start = self.start.astype(dtype)
        self.step = _checks.require_positive(step, "step", "a positive length, s").astype(dtype)

    def __call__(self, t: ScalarLike) -> Any:
        """Return the value (k,) of the Chebyshev series at the time `t`, s; NaN if t is outside of
        all intervals.
        """
        count, _, terms = self.coefficients.shape
        place = (jnp.asarray(t, self.start.dtype) - self.start) / self.step
        i = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, count - 1)
        x = 2 * (place - i.astype(place.dtype)) - 1
        # Without this optimisation barrier, XLA on CPU reads the table again for every number that
        # is computed from the row.
        x, row = barrier((x, self.coefficients[i]))
        value, before = jnp.zeros_like(row[:, 0]), jnp.zeros_like(row[:, 0])
        for n in range(terms - 1, 0, -1):
            value, before = row[:, n] + 2 * x * value - before, value
        value = row[:, 0] + x * value - before
        inside = (place >= 0) & (place <= count)
        return jnp.where(inside, value, jnp.nan)
