"""How long a step is: the norm of an error, the first step, and runs that stop on NaN."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from rigidjax.solve.components import lift
from rigidjax.solve.record import Method, Run

# diffrax inherits it from optimistix, where type checkers do not follow.
NONFINITE: Any = dfx.RESULTS.nonfinite
_IMPOSSIBLE: Any = dfx.RESULTS.nonfinite_input

# The defaults of diffrax.PIDController: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0


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
        # At t = 0 the round-off of t vanishes: that of the length of the run is taken.
        least = jnp.finfo(t0.dtype).eps * jnp.abs(t1 - t0)
        # Where the first derivative is not finite the run ends at once.
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


def watched(rtol: Any, atol: Any) -> Watched:
    """The controller of `simulate`, from its tolerances."""
    return Watched(dfx.PIDController(rtol=rtol, atol=atol))


def finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number in `tree` is finite.

    >>> bool(finite((jnp.ones(2), jnp.array(jnp.nan))))
    False
    """
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good = good & jnp.all(jnp.isfinite(leaf))
    return good


def of_body(result: dfx.RESULTS, body: Any) -> dfx.RESULTS:
    """The result of a run; `nonfinite_input` where no body has these numbers.

    **Arguments:** `body` as `validation.real_or_nan` gives it, NaN where it cannot be.

    >>> of_body(dfx.RESULTS.nonfinite, jnp.nan) == dfx.RESULTS.nonfinite_input
    Array(True, dtype=bool)
    """
    return dfx.RESULTS.where(finite(body), result, _IMPOSSIBLE)


def error_norm(error: Array, left: Array, right: Array, rtol: Array, atol: Array) -> Array:
    """Root mean square of error over tolerance, as `diffrax.PIDController` does; inf for NaN."""
    scale = lift(atol, left) + lift(rtol, left) * jnp.maximum(jnp.abs(left), jnp.abs(right))
    tiny = float(jnp.finfo(error.dtype).tiny)
    norm = jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + tiny)
    # NaN in a step too long says as little as infinity: try a shorter one.
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


def controlled(
    norm: Array, order: int, t: Array, h: Array, kept: Array, last: Array, length: Array
) -> tuple[Array, Array]:
    """Whether a step is accepted, and the next one: 0 where none is left to try, NaN after a NaN.

    **Arguments:** `norm` of the error over the tolerance, as of `error_norm`; `t` and `h` of the
    step, `last` whether it was cut short at a stop, `kept` what the controller had wanted there;
    `length` of the run, whose round-off counts where that of `t` vanishes.
    """
    norm, h, kept = lax.stop_gradient((norm, h, kept))
    good = norm < 1
    factor = jnp.clip(_SAFETY * norm ** (-1 / order), _SMALLEST, _LARGEST)
    following = h * factor.astype(h.dtype)
    eps = jnp.finfo(h.dtype).eps
    unit = 8 * eps * jnp.maximum(jnp.abs(t), eps * length)
    why = jnp.where(jnp.isfinite(norm), 0.0, jnp.nan).astype(h.dtype)
    shorter = jnp.where(following > unit, following, why)
    longer = jnp.where(last, jnp.maximum(following, kept), following)
    return good, jnp.where(good, longer, shorter)


def outcome(h: Array, t: Array, end: Array, met: Array) -> dfx.RESULTS:
    """How a run ended: its next step and time, the last time, whether it met what ends it."""
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(h), NONFINITE),
        (h > 0, dfx.RESULTS.max_steps_reached),
        (t >= end, dfx.RESULTS.successful),
        (met, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    return result


def first_step(method: Method, constants: list[Array], run: Run) -> tuple[Array, Array]:
    """The starting step of Hairer, Nørsett and Wanner (1993), II.4; the slope at the start."""
    y0, t0 = run.y0, run.t0
    scale = lift(run.atol, y0) + lift(run.rtol, y0) * jnp.abs(y0)

    def norm(a: Array) -> Array:
        return jnp.sqrt(jnp.mean((a / scale) ** 2, 0))

    d0 = norm(y0)

    def slope(_: Array, state: Any) -> Any:
        # At the start, then after a short step of Euler's: one field to compile.
        h, first, _ = state
        now = method.field(constants, t0 + h.astype(t0.dtype), y0 + lift(h, y0) * first)
        d1 = norm(now)
        small = (d0 < 1e-5) | (d1 < 1e-5)
        short = jnp.where(small, 1e-6, 0.01 * d0 / jnp.where(small, 1.0, d1)).astype(d0.dtype)
        begun = h != 0
        return jnp.where(begun, h, short), jnp.where(lift(begun, y0), first, now), now

    h = jnp.zeros_like(d0)
    state = (h, jnp.zeros_like(y0), jnp.zeros_like(y0))
    h, first, last = lax.fori_loop(np.int32(0), np.int32(2), slope, state)
    d2 = norm(last - first) / h
    largest = jnp.maximum(norm(first), d2)
    flat = largest <= 1e-15
    guess = (0.01 / jnp.where(flat, 1.0, largest)) ** (1 / method.tableau.order)
    h = jnp.minimum(100 * h, jnp.where(flat, jnp.maximum(1e-6, 1e-3 * h), guess))
    return h.astype(t0.dtype), first
