"""A run that cannot go on ends, and says so, instead of being ground out to the last step."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

# diffrax inherits it from optimistix, where type checkers do not follow.
NONFINITE: Any = dfx.RESULTS.nonfinite


class Watched(dfx.AbstractAdaptiveStepSizeController):
    """Wraps an adaptive step controller so that a run without a way on ends at once.

    Where the vector field is NaN, `diffrax.PIDController` tries smaller and smaller steps until
    `max_steps`, and in a batch all the others wait for it. Here a start without a slope, and a
    rejected step whose successor would be below a few units of round-off of the time, end the run:
    with `RESULTS.nonfinite` where there was NaN or infinity, else with `RESULTS.dt_min_reached`.
    The steps of a healthy run are not touched.

    **Arguments:** `controller` any adaptive controller of diffrax.

    >>> Watched(dfx.PIDController(rtol=1e-6, atol=1e-9)).rtol
    1e-06
    """

    controller: Any

    def __init__(self, controller: Any):
        self.controller = controller

    @property
    def rtol(self) -> Any:
        return self.controller.rtol

    @property
    def atol(self) -> Any:
        return self.controller.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm

    def wrap(self, direction: Any) -> "Watched":
        return Watched(self.controller.wrap(direction))

    def init(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        dt0: Any,
        args: Any,
        func: Any,
        error_order: Any,
    ) -> tuple[Any, Any]:
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        # Where t is nought its own round-off is, too: then that of the run's length counts.
        least = jnp.finfo(t0.dtype).eps * jnp.abs(t1 - t0)
        # Where there is no slope to begin with, no step is short enough.
        return first, (inner, least, ~finite((y0, func(terms, t0, y0, args))))

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> tuple[Any, Any, Any, Any, Any, dfx.RESULTS]:
        inner, least, lost = controller_state
        keep, left, right, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        unit = 8 * jnp.finfo(left.dtype).eps * jnp.maximum(jnp.abs(left), least)
        stuck = lost | (~keep & ~(right - left > unit))
        stuck = stuck & (result == dfx.RESULTS.successful)
        ill = lost | ~finite((right, y1_candidate, y_error))
        why = dfx.RESULTS.where(ill, NONFINITE, dfx.RESULTS.dt_min_reached)
        return (
            keep,
            left,
            right,
            jumped,
            (inner, least, lost),
            dfx.RESULTS.where(stuck, why, result),
        )


def finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number in `tree` is finite.

    >>> bool(finite((jnp.ones(2), jnp.array(jnp.nan))))
    False
    """
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good = good & jnp.all(jnp.isfinite(leaf))
    return good
