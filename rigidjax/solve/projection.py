"""Wrappers for diffrax: a solver kept on the group, a controller that ends at NaN or at jumps."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, PyTree

from rigidjax import _checks
from rigidjax._types import RealLike
from rigidjax.motion.equations import on_the_group
from rigidjax.solve.adaptive_loop import NONFINITE, before, finite, starting_step, take

# The norm of an error by default: that of the numbers of a state in a row.
NORM = dfx.PIDController(rtol=1.0, atol=1.0).norm


class GroupInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output of another interpolation, its quaternion scaled to length 1."""

    t0: Any
    t1: Any
    inner: dfx.AbstractLocalInterpolation

    def evaluate(self, t0: RealLike, t1: RealLike | None = None, left: bool = True) -> Any:
        if t1 is None:
            return on_the_group(self.inner.evaluate(t0, left=left))
        end, start = self.evaluate(t1, left=left), self.evaluate(t0, left=left)
        return jtu.tree_map(lambda a, b: a - b, end, start)


class _Build(eqx.Module):
    """Makes a `GroupInterpolation` of a solver's dense information."""

    inner_cls: Any = eqx.field(static=True)

    def __call__(self, *, t0: RealLike, t1: RealLike, **dense_info: Any) -> GroupInterpolation:
        return GroupInterpolation(t0, t1, self.inner_cls(t0=t0, t1=t1, **dense_info))


def _of(part: str, name: str) -> Any:
    return property(lambda self: getattr(getattr(self, part), name))


class Projected(dfx.AbstractWrappedSolver):
    """Wraps a diffrax solver so that attitudes stay unit quaternions.

    Each accepted step ends with q ← q/|q|, and so does every value of the dense output. The stages
    are unchanged, because a change there alters the order (jaxsim#192). A state without a
    quaternion passes through. A step that gives NaN or infinity ends the run with
    `RESULTS.nonfinite`.

    **Arguments:** `solver` any `diffrax.AbstractSolver` on `Spin`, `Attitude` or `Rigid` states.

    >>> import diffrax
    >>> Projected(diffrax.Tsit5()).order(None)
    5
    """

    solver: dfx.AbstractSolver

    def __check_init__(self) -> None:
        _checks.instance(self.solver, dfx.AbstractSolver, "solver")

    term_structure = _of("solver", "term_structure")
    term_compatible_contr_kwargs = _of("solver", "term_compatible_contr_kwargs")
    # Adjoints set the one, controllers the others, on whatever is a Runge–Kutta or implicit method.
    scan_kind = _of("solver", "scan_kind")
    root_finder = _of("solver", "root_finder")
    root_find_max_steps = _of("solver", "root_find_max_steps")

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Build(self.solver.interpolation_cls)

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> Any:
        return self.solver.strong_order(terms)

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> Any:
        return self.solver.error_order(terms)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
    ) -> Any:
        return self.solver.init(terms, t0, t1, y0, args)

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Bool[ArrayLike, ""],
    ) -> Any:
        # A slope kept from the last step is the one before the projection; and diffrax computes it
        # anew for all of a batch as soon as one body needs it. True: always anew, for each alone.
        del made_jump
        y1, error, dense, state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, True
        )
        ill = (result == dfx.RESULTS.successful) & ~finite(y1)
        result = dfx.RESULTS.where(ill, NONFINITE, result)
        return on_the_group(y1), error, dense, state, result

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return self.solver.func(terms, t0, y0, args)


class Watched(dfx.AbstractAdaptiveStepSizeController):
    """Wraps an adaptive step controller so that a run that cannot continue ends at once.

    A start without a finite derivative, or a rejected step whose successor would be below a few
    units of round-off of the time, ends the run: with `RESULTS.nonfinite` after NaN or infinity,
    else with `RESULTS.dt_min_reached`. (`diffrax.PIDController` goes on until `max_steps`.)

    **Arguments:** `controller` any adaptive controller of diffrax.

    >>> Watched(dfx.PIDController(rtol=1e-6, atol=1e-9)).rtol
    1e-06
    """

    controller: Any

    def __init__(self, controller: dfx.AbstractStepSizeController):
        self.controller = controller

    rtol = _of("controller", "rtol")
    atol = _of("controller", "atol")
    norm = _of("controller", "norm")

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
        t0 = jnp.asarray(t0)
        # Neither the first step nor whether there is one has a derivative: none is traced.
        arrays, rest = eqx.partition((terms, t0, t1, y0, dt0, args), eqx.is_array)
        terms, t0, t1, y0, dt0, args = eqx.combine(lax.stop_gradient(arrays), rest)
        slope = func(terms, t0, y0, args)
        # A solver without an order of its error is refused by the inner controller.
        if dt0 is None and error_order is not None:
            # diffrax takes 0.01 for any field that runs in a direction of time, as in `diffeqsolve`
            # all do.
            h = self._first_step(y0, slope, error_order).astype(t0.dtype)
            # After NaN or infinity it is not positive; the inner controller gets any other.
            sound = h > 0
            dt0 = jnp.where(sound, h, jnp.ones_like(h))
        else:
            sound = finite((y0, dt0, slope))
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        # At t = 0 the round-off of t vanishes: that of the length of the run is taken.
        least = jnp.finfo(t0.dtype).eps * jnp.abs(t1 - t0)
        # A step of length 0 would be accepted for ever; one of length NaN ends the run.
        first = jnp.where(sound, jnp.maximum(first, t0 + self._unit(t0, least)), jnp.nan)
        return first.astype(t0.dtype), (inner, least)

    def _first_step(self, y: PyTree, slope: PyTree, order: RealLike) -> Array:
        """Return the first step from the state y and its derivative; 0 or NaN if either is lost."""
        y, tree = ravel_pytree(y)
        scale = self.atol + self.rtol * jnp.abs(y)
        # The norm of a state, or the same of its numbers in a row.
        of_state = (lambda numbers: numbers) if self.norm is NORM else tree
        size, rate = (self.norm(of_state(a / scale)) for a in (y, ravel_pytree(slope)[0]))
        return starting_step(size, rate, order)

    def _unit(self, t: ArrayLike, least: ArrayLike) -> Array:
        """Return the shortest step at the time t, some units of round-off."""
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
        # NaN in the shortest step that the times can tell apart may be absent in a shorter one.
        short = finite(y_error) | (t1 - t0 <= unit)
        why = dfx.RESULTS.where(short, dfx.RESULTS.dt_min_reached, NONFINITE)
        why = dfx.RESULTS.where(stuck & (result == dfx.RESULTS.successful), why, result)
        return keep, left, right, jumped, (inner, least), why


class Stopping(dfx.AbstractAdaptiveStepSizeController):
    """Wraps an adaptive step controller so that a step ends at each of the `stops`, where f jumps.

    A step ends at the last moment before a stop, and the next one begins at the stop with the
    length that the controller wanted there. (`diffrax.ClipStepSizeController` goes on from the
    length of the step that was cut: a stop then costs several short steps.)

    **Arguments:** `controller` any adaptive controller of diffrax; `stops` (J,) times in order.

    >>> Stopping(dfx.PIDController(rtol=1e-6, atol=1e-9), jnp.array([0.5])).rtol
    1e-06
    """

    controller: Any
    stops: Any
    # The index of the first stop after each.
    following: Any

    def __init__(self, controller: dfx.AbstractStepSizeController, stops: Array):
        self.controller = controller
        self.stops = stops
        still = lax.stop_gradient(stops)
        self.following = jnp.searchsorted(still, still, side="right").astype(jnp.int32)

    rtol = _of("controller", "rtol")
    atol = _of("controller", "atol")
    norm = _of("controller", "norm")

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
        return jnp.minimum(first, self._next(index)[1]), (inner, first - t0, index)

    def _next(self, index: Any) -> tuple[Any, Any]:
        """Return the stop of this index and the last moment before it; infinite after the last."""
        none = jnp.full_like(self.stops[:1], jnp.inf)
        stop = take(jnp.concatenate([self.stops, none]), index)
        still = lax.stop_gradient(stop)
        gap = jnp.where(jnp.isinf(still), 0, before(still) - still)
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
        stop, end = self._next(index)
        reached = keep & (t1 >= end)
        length = lax.stop_gradient(right - left)
        length = jnp.where(reached, jnp.maximum(length, kept), length)
        left = jnp.where(reached, stop, left)
        index = jnp.where(reached, take(self.following, index), index)
        right = jnp.minimum(left + length, self._next(index)[1])
        return keep, left, right, jumped | reached, (inner, length, index), result
