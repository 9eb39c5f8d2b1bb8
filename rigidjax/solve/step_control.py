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
from rigidjax.solve.adaptive_loop import (
    NONFINITE,
    finite,
    next_step,
    previous_number,
    starting_step,
    take,
)

# The default norm of an error, which is the same for a state and for its numbers in a row.
NORM = dfx.PIDController(rtol=1.0, atol=1.0).norm


def _of(name: str) -> Any:
    return property(lambda self: getattr(self.controller, name))


class StandardController(dfx.AbstractAdaptiveStepSizeController):
    """Choose the length of each step by the error of the step before it.

    It is used inside `Watched`, which chooses the first step. The rule is that of Hairer, Nørsett
    and Wanner (1993), II.4: the step after an accepted one may be shorter. `diffrax.PIDController`
    never shortens the step after an accepted one: on Arenstorf's orbit at a tolerance of 1e-13 it
    rejects 85 of 477 steps. This controller rejects 29 of 420 steps there, and the orbit closes
    with a third of the error.

    **Arguments:** `rtol` and `atol` are the tolerances; `dtmax` is the longest step, or `None`.

    >>> StandardController(1e-6, 1e-9).rtol
    1e-06
    """

    rtol: Any
    atol: Any
    dtmax: Any = None

    @property
    def norm(self) -> Callable[[PyTree], Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the norm of an error: the root mean square of its numbers."""
        return NORM

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
        return t0 + self._limited(dt0), ()

    def _limited(self, length: Any) -> Any:
        """Return the length of a step, or `dtmax` if that is shorter."""
        return length if self.dtmax is None else jnp.minimum(length, self.dtmax)

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
        def over_tolerance(error: Array, left: Array, right: Array) -> Array:
            return error / (self.atol + self.rtol * jnp.maximum(jnp.abs(left), jnp.abs(right)))

        still = lax.stop_gradient((y_error, y0, y1_candidate))
        keep, length = next_step(
            self.norm(jax.tree.map(over_tolerance, *still)), error_order, t1 - t0
        )
        left = jnp.where(keep, t1, t0)
        right = left + self._limited(length)
        return keep, left, right, False, controller_state, dfx.RESULTS.successful


class Watched(dfx.AbstractAdaptiveStepSizeController):
    """Wrap an adaptive step controller so that a run that cannot continue ends at once.

    A run ends if its start has no finite derivative, or if the step after a rejected one would be
    shorter than a few units of round-off of the time. The result is `RESULTS.nonfinite` after NaN
    or infinity, else `RESULTS.dt_min_reached`. (`diffrax.PIDController` goes on until `max_steps`.)

    **Arguments:** `controller` is any adaptive controller of diffrax.

    >>> Watched(dfx.PIDController(rtol=1e-6, atol=1e-9)).rtol
    1e-06
    """

    controller: Any

    def __init__(self, controller: dfx.AbstractStepSizeController):
        self.controller = controller

    rtol = _of("rtol")
    atol = _of("atol")
    norm = _of("norm")

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
        # The first step has no derivative, and neither has the test whether there is one: all that
        # follows is computed without tangents.
        arrays, rest = eqx.partition((terms, y0, dt0, args), eqx.is_array)
        terms, y0, dt0, args = eqx.combine(lax.stop_gradient(arrays), rest)
        begin, end = (lax.stop_gradient(jnp.asarray(t)) for t in (t0, t1))
        slope = func(terms, begin, y0, args)
        # A solver without an order of its error is refused by the inner controller.
        if dt0 is None and error_order is not None:
            # diffrax itself takes 0.01 for any field that it wraps with a direction of time, as
            # `diffeqsolve` does with every field.
            h = self._first_step(y0, slope, error_order).astype(begin.dtype)
            # After NaN or infinity h is not positive; the inner controller then gets 1 in the place
            # of h.
            sound = h > 0
            dt0 = jnp.where(sound, h, jnp.ones_like(h))
        else:
            sound = finite((y0, dt0, slope))
        first, inner = self.controller.init(terms, begin, end, y0, dt0, args, func, error_order)
        # At t = 0 the round-off of t vanishes: there |t| is replaced by the round-off of the length
        # of the run.
        least = jnp.finfo(begin.dtype).eps * jnp.abs(end - begin)
        # A step of length 0 would be accepted for ever, but a step of length NaN ends the run.
        shortest = begin + self._unit(begin, least)
        first = jnp.where(sound, jnp.maximum(first, shortest), jnp.nan)
        return first.astype(begin.dtype), (inner, least)

    def _first_step(self, y: PyTree, slope: PyTree, order: RealLike) -> Array:
        """Return the first step from the state `y` and its derivative `slope`.

        It is 0 or NaN if one of the two is not finite; `order` is that of the error of a step.
        """
        y, tree = ravel_pytree(y)
        scale = self.atol + self.rtol * jnp.abs(y)
        # The default norm takes the numbers of a state in a row; any other takes the state itself.
        of_state = (lambda numbers: numbers) if self.norm is NORM else tree
        both = (y, ravel_pytree(slope)[0])
        size, rate = (jnp.asarray(self.norm(of_state(a / scale))) for a in both)
        return starting_step(size, rate, order)

    def _unit(self, t: ArrayLike, least: ArrayLike) -> Array:
        """Return the shortest step at the time `t`: some units of round-off of |t| or `least`."""
        return 8 * jnp.finfo(jnp.result_type(t)).eps * jnp.maximum(jnp.abs(t), least)

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
        inner, least = controller_state
        keep, left, right, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        unit = self._unit(left, least)
        stuck = ~keep & ~(right - left > unit)
        # If NaN is in the shortest step that the times can tell apart, a shorter step might have
        # none: the cause is then the length of the step.
        short = finite(y_error) | (t1 - t0 <= unit)
        why = dfx.RESULTS.where(short, dfx.RESULTS.dt_min_reached, NONFINITE)
        why = dfx.RESULTS.where(stuck & (result == dfx.RESULTS.successful), why, result)
        return keep, left, right, jumped, (inner, least), why


class Stopping(dfx.AbstractAdaptiveStepSizeController):
    """Wrap an adaptive step controller so that steps end at the `stops`, where the field jumps.

    A step ends at the last moment before a stop. The next step begins at the stop, and is at least
    as long as the controller wanted the step before to be. (`diffrax.ClipStepSizeController` goes
    on from the length of the step that was cut short: a stop then costs several short steps.)

    **Arguments:** `controller` is any adaptive controller of diffrax; `stops` (J,) are times in
    order.

    >>> Stopping(dfx.PIDController(rtol=1e-6, atol=1e-9), jnp.array([0.5])).rtol
    1e-06
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

    rtol = _of("rtol")
    atol = _of("atol")
    norm = _of("norm")

    def wrap(self, direction: PyTree) -> "Stopping":
        way = jnp.asarray(direction).astype(self.stops.dtype)
        stops = jnp.where(way < 0, -self.stops[::-1], self.stops)
        return Stopping(self.controller.wrap(direction), stops)

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
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index = jnp.sum(self.stops <= t0, dtype=jnp.int32)
        return jnp.minimum(first, self._stop_and_moment_before(index)[1]), (
            inner,
            first - t0,
            index,
        )

    def _stop_and_moment_before(self, index: Any) -> tuple[Any, Any]:
        """Return the stop of this `index`, and the last moment before it.

        Both are infinite for an index after the last stop.
        """
        none = jnp.full_like(self.stops[:1], jnp.inf)
        stop = take(jnp.concatenate([self.stops, none]), index)
        still = lax.stop_gradient(stop)
        gap = jnp.where(jnp.isinf(still), 0, previous_number(still) - still)
        return stop, stop + gap

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
        inner, kept, index = controller_state
        keep, left, right, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        stop, end = self._stop_and_moment_before(index)
        reached = keep & (t1 >= end)
        length = lax.stop_gradient(right - left)
        length = jnp.where(reached, jnp.maximum(length, kept), length)
        left = jnp.where(reached, stop, left)
        index = jnp.where(reached, take(self.following, index), index)
        right = jnp.minimum(left + length, self._stop_and_moment_before(index)[1])
        return keep, left, right, jumped | reached, (inner, length, index), result
