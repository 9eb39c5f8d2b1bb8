"""Control the lengths of steps by a tolerance, end a run at NaN, and end steps at stops."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, PyTree

from rigidjax._types import RealLike
from rigidjax.solve.engine.loop import (
    NONFINITE,
    accept_and_adapt,
    is_finite,
    previous_float,
    rows_at,
    starting_step,
)

# The default norm of an error. It has the same value for a state as for the vector of all its
# numbers.
NORM = dfx.PIDController(rtol=1.0, atol=1.0).norm
_SLIVER = 16  # units of round-off: no step is left that is so short


def _inner_attribute(attribute: str) -> Any:
    """Define a property that reads an attribute of the wrapped controller; 0 where it has none."""
    return property(lambda self: getattr(self.controller, attribute, 0.0))


class StandardController(dfx.AbstractAdaptiveStepSizeController):
    """Choose the length of each step by the error of the step before it.

    The rule is that of Hairer, Nørsett and Wanner (1993), II.4: after an accepted step, the next
    step may be shorter. `diffrax.PIDController` never shortens it: on Arenstorf's orbit at a
    tolerance of 1e-13 it rejects 85 of 477 steps, this one 29 of 420, with a third of the error
    after one period. `Watched` chooses the first step.
    """

    rtol: Any
    atol: Any
    dtmax: Any = None
    norm: Callable[[PyTree], Any] = NORM  # the root mean square, by which an error is measured

    def wrap(self, direction: PyTree) -> "StandardController":
        return self

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        dt0: RealLike | None,
        args: PyTree,
        func: Callable[..., PyTree],
        error_order: RealLike | None,
    ) -> tuple[Any, Any]:
        assert dt0 is not None
        return t0 + (dt0 if self.dtmax is None else jnp.minimum(dt0, self.dtmax)), ()

    def adapt_step_size(
        self,
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        y1_candidate: PyTree,
        args: PyTree,
        y_error: PyTree,
        error_order: RealLike | None,
        controller_state: PyTree,
    ) -> tuple[Any, Any, Any, Any, Any, dfx.RESULTS]:
        if y_error is None:
            raise ValueError(
                "simulate: wanted a solver that estimates the error of its steps, as steps under "
                "rtol and atol need, got one that does not; give dt0 and "
                "stepsize_controller=diffrax.ConstantStepSize(), or take another solver"
            )
        error, *states = lax.stop_gradient((y_error, y0, y1_candidate))
        largest = jax.tree.map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), *states)
        over = jax.tree.map(lambda e, most: e / (self.atol + self.rtol * most), error, largest)
        keep, length = accept_and_adapt(self.norm(over), error_order, t1 - t0)
        length = length if self.dtmax is None else jnp.minimum(length, self.dtmax)
        left = jnp.where(keep, t1, t0)
        return keep, left, left + length, False, controller_state, dfx.RESULTS.successful


class Watched(dfx.AbstractAdaptiveStepSizeController):
    """Wrap an adaptive step controller so that a run that cannot continue ends at once.

    It ends if the start or its time derivative is not finite, or if the step after a rejected one
    would be shorter than a few units of round-off of the time. (`diffrax.PIDController` goes on
    until `max_steps`.) The result is `nonfinite` after NaN or infinity, else `dt_min_reached`.
    """

    controller: Any

    def __init__(self, controller: dfx.AbstractStepSizeController):
        self.controller = controller

    rtol = _inner_attribute("rtol")
    atol = _inner_attribute("atol")
    norm = _inner_attribute("norm")

    def wrap(self, direction: PyTree) -> "Watched":
        return Watched(self.controller.wrap(direction))

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        dt0: RealLike | None,
        args: PyTree,
        func: Callable[..., PyTree],
        error_order: RealLike | None,
    ) -> tuple[Any, Any]:
        # The length of the first step has no derivative. Everything below is therefore computed
        # without tangents.
        arrays, rest = eqx.partition((terms, y0, dt0, args), eqx.is_array)
        terms, y0, dt0, args = eqx.combine(lax.stop_gradient(arrays), rest)
        begin, end = (lax.stop_gradient(jnp.asarray(t)) for t in (t0, t1))
        slope = func(terms, begin, y0, args)
        # If the solver has no error estimate, `error_order` is `None`, and the inner controller
        # raises an error.
        if dt0 is None and error_order is not None:
            # The first step is chosen here, because diffrax itself takes 0.01 s for each field that
            # `diffeqsolve` has wrapped for the direction of time, and it wraps every field.
            numbers, tree = ravel_pytree(y0)
            scale = self.atol + self.rtol * jnp.abs(numbers)
            # The default norm may be called with the vector of all numbers; any other norm is
            # called with the state.
            tree = (lambda numbers: numbers) if self.norm is NORM else tree
            both = (numbers, ravel_pytree(slope)[0])
            size, rate = (jnp.asarray(self.norm(tree(a / scale))) for a in both)
            h = starting_step(size, rate, error_order).astype(begin.dtype)
            # If the state or the slope is NaN or infinite, h > 0 is false; the inner controller
            # then gets the length 1.
            sound = h > 0
            dt0 = jnp.where(sound, h, jnp.ones_like(h))
        else:
            sound = is_finite((y0, dt0, slope))
        first, inner = self.controller.init(terms, begin, end, y0, dt0, args, func, error_order)
        # Near t = 0 the round-off of t vanishes. The size of t is therefore taken to be at least
        # `least`, the round-off of the length of the run.
        least = jnp.finfo(begin.dtype).eps * jnp.abs(end - begin)
        # The first step is at least the shortest that the time can resolve, because steps of length
        # 0 would be accepted without end. If the start is not finite, the step has the length NaN,
        # which ends the run.
        first = jnp.where(
            sound, jnp.maximum(first, begin + self._shortest_step(begin, least)), jnp.nan
        )
        return first.astype(begin.dtype), (inner, least)

    def _shortest_step(self, t: ArrayLike, time_scale: ArrayLike) -> Array:
        """Return the shortest step, s: 8 units of round-off of max(|t|, `time_scale`)."""
        return 8 * jnp.finfo(jnp.result_type(t)).eps * jnp.maximum(jnp.abs(t), time_scale)

    # As in diffrax, the arguments come by position; they are those of `StandardController`.
    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0: RealLike, t1: RealLike, *given: Any
    ) -> Any:
        *rest, (inner, least) = given
        adapted = self.controller.adapt_step_size(t0, t1, *rest, inner)
        keep, left, right, jumped, inner, result = adapted
        unit = self._shortest_step(left, least)
        stuck = ~keep & ~(right - left > unit)
        y_error = rest[3]
        # A run that is stuck after a step to NaN or infinity ends with `NONFINITE`. If this step
        # was already the shortest possible one, a still shorter step might be finite: the result
        # then is `dt_min_reached`, which says that no step is short enough.
        short = is_finite(y_error) | (t1 - t0 <= unit)
        why = dfx.RESULTS.where(short, dfx.RESULTS.dt_min_reached, NONFINITE)
        why = dfx.RESULTS.where(stuck & (result == dfx.RESULTS.successful), why, result)
        return keep, left, right, jumped, (inner, least), why


class Stopping(dfx.AbstractAdaptiveStepSizeController):
    """Wrap an adaptive step controller so that steps end at `stops` (J,), where the field jumps.

    Such a step ends at the last floating-point number before the stop; the next one begins at the
    stop, and is at least as long as the step before would have been.
    (`diffrax.ClipStepSizeController` goes on from the length that was cut short.) A step that would
    end just before a stop ends at the stop.
    """

    controller: Any
    stops: Any
    # For each stop, the index of the first stop after it.
    following: Any

    def __init__(self, controller: dfx.AbstractStepSizeController, stops: Array):
        self.controller = controller
        self.stops = stops
        still = lax.stop_gradient(stops)
        self.following = jnp.searchsorted(still, still, side="right").astype(jnp.int32)

    rtol = _inner_attribute("rtol")
    atol = _inner_attribute("atol")
    norm = _inner_attribute("norm")

    def wrap(self, direction: PyTree) -> "Stopping":
        way = jnp.asarray(direction).astype(self.stops.dtype)
        stops = jnp.where(way < 0, -self.stops[::-1], self.stops)
        return Stopping(self.controller.wrap(direction), stops)

    def init(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, *given: Any
    ) -> tuple[Any, Any]:
        first, inner = self.controller.init(terms, t0, *given)
        index = jnp.sum(self.stops <= t0, dtype=jnp.int32)
        return self._end_of_step(t0, first - t0, index), (inner, first - t0, index)

    def _end_of_step(self, t: RealLike, length: Any, stop_index: Array) -> Array:
        """Return the end of a step from t, s, which is the next stop if that is not far beyond."""
        end = self._stop_and_end(stop_index)[1]
        near = end - _SLIVER * jnp.finfo(end.dtype).eps * jnp.abs(lax.stop_gradient(end))
        return jnp.where(t + length > jnp.where(jnp.isinf(end), end, near), end, t + length)

    def _stop_and_end(self, stop_index: Array) -> tuple[Array, Array]:
        """Return the time of a stop, s, and the last floating-point time before it, or inf."""
        none = jnp.full_like(self.stops[:1], jnp.inf)
        stop = rows_at(jnp.concatenate([self.stops, none]), stop_index)
        still = lax.stop_gradient(stop)
        return stop, stop + jnp.where(jnp.isinf(still), 0, previous_float(still) - still)

    # As in diffrax, the arguments come by position; they are those of `StandardController`.
    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0: RealLike, t1: RealLike, *given: Any
    ) -> Any:
        *rest, (inner, kept, index) = given
        adapted = self.controller.adapt_step_size(t0, t1, *rest, inner)
        keep, left, right, jumped, inner, result = adapted
        stop, end = self._stop_and_end(index)
        reached = keep & (t1 >= end)
        length = lax.stop_gradient(right - left)
        length = jnp.where(reached, jnp.maximum(length, kept), length)
        left = jnp.where(reached, stop, left)
        index = jnp.where(reached, rows_at(self.following, index), index)
        right = self._end_of_step(left, length, index)
        return keep, left, right, jumped | reached, (inner, length, index), result
