"""Times at which a motion meets a condition: the event that ends a run, and section crossings."""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import Point
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, started
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.torques.base import lacking
from rigidjax.solve import validation
from rigidjax.solve.adaptive_loop import of_body, outcome
from rigidjax.solve.components import flat, unflat
from rigidjax.solve.crossing_loop import Search
from rigidjax.solve.crossing_search import correction, crossings_of, located, section
from rigidjax.solve.explicit import AbstractExplicit, explicit
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.run import Free, Loop, direction as direction_of, solve

State = TypeVar("State", Spin, Attitude, Rigid, Point, Coupled)


class Event(eqx.Module):
    """The event that ends a run of `simulate`: the first zero of a condition.

    **Arguments:**

    - `condition`: a Module or function `(t, state, body) → scalar`, smooth along the motion; it
      may hold traced numbers. Under a law with states of its own the state is a
      `Coupled`: `state.motion.omega`, `state.own`.
    - `direction`: 1 for a zero on the way up, −1 on the way down, 0 for both (as in SciPy), in the
      order in which the run meets them.
    - `max_step`: the longest step, s. A zero is found if the condition has changed its sign at the
      end of a step, or has one extremum within it; a condition that is much faster than the motion
      needs shorter steps.

    A start at a zero does not count, nor does a condition that is always zero to round-off (see
    `crossings`).

    **Raises:** `TypeError`, `ValueError` for anything but a function, another direction, a step
    that is not positive.

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flip = Event(lambda t, state, body: state.omega[1])
    >>> float(rj.simulate(body, start, [0.0, 20.0], event=flip).event_time)  # doctest: +ELLIPSIS
    9.42551789684...
    """

    condition: Callable[..., Any]
    direction: int = eqx.field(static=True)
    max_step: Any

    def __init__(
        self,
        condition: Callable[..., Any],
        direction: int = 0,
        max_step: ScalarLike | None = None,
    ):
        self.condition = _checks.function(condition, "condition", "(t, state, body) → scalar")
        if isinstance(direction, bool) or direction not in (-1, 0, 1):
            words = "direction: wanted 1 (on the way up), -1 (on the way down) or 0 (both), got "
            raise ValueError(f"{words}{direction!r}")
        self.direction = int(direction)
        self.max_step = max_step
        if max_step is not None:
            step = _checks.floating(max_step, (), "max_step")
            words = "max_step: wanted a positive step, s"
            self.max_step = _checks.refuse(step, ~(step > 0), words)


class Crossings(eqx.Module, Generic[State]):
    """The result of `crossings`.

    **Fields:** `times` (K,) s, in the order of the run, NaN beyond the last; `states` there, of the
    type of `state0`, with a leading axis; `count` their number; `result` a `diffrax.RESULTS`:
    `successful` if the run reached `t1`, `event_occurred` if it ended with `max_crossings` of them,
    or why it ended early; `num_steps` of the method, partial ones included.

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flips = rj.crossings(body, start, 0.0, 40.0, lambda t, state, body: state.omega[1])
    >>> [round(float(t), 3) for t in flips.times[: flips.count]]
    [9.426, 28.277]
    """

    times: Float[Array, " crossings"]
    states: State
    count: Int[Array, ""]
    result: dfx.RESULTS
    num_steps: Int[Array, ""]

    @property
    def full(self) -> Array:
        """Whether there are `max_crossings`: there may be more of them."""
        return self.result == dfx.RESULTS.event_occurred


def crossings(
    body: Inertia | MassProperties | None,
    state0: State,
    t0: ScalarLike,
    t1: ScalarLike,
    condition: Callable[..., Any],
    torque: Any = None,
    *,
    direction: int = 0,
    max_crossings: int = 100,
    max_step: ScalarLike | None = None,
    solver: AbstractExplicit | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    max_steps: int = 1_000_000,
) -> Crossings[State]:
    """The crossings of a section: all zeros of a condition between two times.

    **Arguments:**

    - `body`, `state0`, `torque`: as for `simulate`; `state0` at `t0`.
    - `t0`, `t1`: s; `t1 < t0` goes back in time.
    - `condition`: a Module or function `(t, state, body) → scalar`, smooth along the motion. It may
      hold traced numbers, and depend on the time (a stroboscopic section is `sin(½(t − t₀)ω)`).
      The state is a `Coupled`, as in the result, if a torque has states of its own.
    - `direction`: 1 for zeros on the way up, −1 on the way down, 0 for both, in the order of the
      run.
    - `max_crossings`: K, the length of the results; the run ends with the last of them.
    - `max_step`: the longest step, s, for a condition that is much faster than the motion: several
      zeros in one step are found if the cubic through its ends, with their slopes, shows them.
    - `solver`: `None` is the closed form for a free body, else `rigidjax.solvers.DormandPrince8`;
      or an explicit method of `rigidjax.solvers`. `rtol`, `atol` as for `simulate`; a crossing is
      as accurate as a step, that of a free body to round-off.
    - `max_steps`: parts of steps included.

    A start on the section does not count, and a tangential contact may be missed. A condition that
    is always zero to round-off, such as an energy minus its value, has no crossing: a zero counts
    if the condition goes through it 16 times as fast as round-off could make it (under a solver,
    times the root of the number of steps). For many bodies use `jax.vmap`.

    **Returns** `times`, `states`, their `count`, `result` and `num_steps` (`Crossings`). Times and
    states have first and second derivatives with respect to all numbers of the scene, of
    `condition` and of `state0`, forward and reverse; near a tangential contact they grow without
    bound, as the true ones do.

    Source: Newton's method on the step from the last accepted state, instead of Hénon's change of
    variable (Hénon 1982, doi:10.1016/0167-2789(82)90034-3): two to three parts of a step.

    **Raises:** `TypeError`, `ValueError` as `simulate`, for equal times, and for a condition that
    is no number, is NaN at the start, or reads a part that the state does not have.

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flips = crossings(body, start, 0.0, 40.0, lambda t, state, body: state.omega[1])
    >>> int(flips.count), bool(flips.full)
    (2, False)
    """
    many = _checks.whole(max_crossings, "max_crossings", 1)
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    event = Event(condition, direction, max_step)
    begin, end = _checks.time(t0, "t0"), _checks.time(t1, "t1")
    if _checks.known((begin, end)) and float(begin) == float(end):
        raise ValueError(f"t1: wanted another time than t0, got {float(end):g} for both")
    ts = jnp.stack([begin, end])
    body, state0, times = validation.scene(body, state0, ts, torque, throw=False)
    state0 = ready(event, body, state0, torque, times[0])
    if torque is None and solver is None and body is not None:
        return _solved(Free(body, False), event, many, max_steps, state0, times)
    solver = explicit(solver)
    rtol, atol = validation.tolerances(rtol, atol, times.dtype)
    way = direction_of(times)
    setup = Loop(body, torque, solver, rtol, atol, None, way, max_steps, False)
    return _solved(setup, event, many, max_steps, state0, times)


def ready(event: Event, body: Any, state0: Any, torque: Any, t: Array) -> Any:
    """`state0` with the states of the torque, unless the condition is no number there: an error."""
    state0 = started(body, state0, torque, t)
    try:
        eqx.filter_eval_shape(value, event, body, t, state0)
    except AttributeError as wrong:
        told = lacking("condition", wrong)
        if told is None:
            raise
        raise TypeError(told) from wrong
    if _checks.known((event, body, t, state0)) and bool(jnp.isnan(_value(event, body, t, state0))):
        raise ValueError(
            f"condition: wanted a number wherever the motion goes, got NaN at the start, t = "
            f"{float(t):g}"
        )
    return state0


def value(event: Event, body: Any, t: Any, y: Any) -> Array:
    """The condition of an event."""
    found = event.condition(t, y, body)
    if jnp.issubdtype(getattr(found, "dtype", type(found)), jnp.bool_):
        raise TypeError(
            "condition: wanted one real number, zero at the event, got a truth value; give the "
            "difference, not its sign"
        )
    return _checks.floating(found, (), "condition", hint="one real number, zero at the event")


_value = eqx.filter_jit(value)


@eqx.filter_jit
def solve_until(
    setup: Free | Loop, event: Event, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS, Array, Any]:
    """As `solve`, up to the event; and the event's time and state, NaN if there is none.

    The run is done twice: to find the event, and up to it, with derivatives.
    """
    state0 = on_the_group(state0)
    condition = lambda t, y: value(event, setup.body, t, y)  # noqa: E731
    crossed, numbers = section(setup, condition, event.max_step, state0, ts)
    steps = setup.max_steps if isinstance(setup, Loop) else 1_000_000
    found = located(crossed, Search(event.direction, 1, steps), numbers)
    met, last = found.number > 0, lax.stop_gradient(ts[-1])
    end = jnp.where(met, crossed.time(found.times[0]), last)
    before = ~(crossed.time(ts) > crossed.time(end))
    short = jnp.concatenate([jnp.where(before, ts, end), jnp.where(met, end, ts[-1])[None]])
    ys, stats, result = solve(setup, state0, short)
    y = flat(jax.tree.map(lambda leaf: leaf[-1], ys))
    s, y = correction(crossed, numbers[0], crossed.time(end), y, met)
    met = met & (result == dfx.RESULTS.successful)

    def rows(leaf: Array) -> Array:
        there = before.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(there, leaf[:-1], jnp.full_like(leaf[:-1], jnp.nan))

    time, y = (jnp.where(met, leaf, jnp.nan) for leaf in (crossed.time(s), y))
    inputs = (event.condition, setup.body, setup.torque, state0, ts)
    out = (jax.tree.map(rows, ys), time, unflat(y, state0))
    ys, time, state = nan_derivatives(out, inputs)
    return ys, stats, dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, result), time, state


@eqx.filter_jit
def _solved(
    setup: Free | Loop, event: Event, many: int, max_steps: int, state0: Any, ts: Array
) -> Crossings:
    state0 = on_the_group(state0)
    condition = lambda t, y: value(event, setup.body, t, y)  # noqa: E731
    crossed, numbers = section(setup, condition, event.max_step, state0, ts)
    found = crossings_of(crossed, Search(event.direction, many, max_steps), numbers)
    states = jax.vmap(partial(unflat, like=state0))(found.states)
    inputs = (event.condition, setup.body, setup.torque, state0, ts)
    times, states = nan_derivatives((crossed.time(found.times), states), inputs)
    result = outcome(found.h, found.t, crossed.time(ts[-1]), found.number >= many)
    result = of_body(result, setup.body)
    return Crossings(times, states, found.number, result, found.steps)
