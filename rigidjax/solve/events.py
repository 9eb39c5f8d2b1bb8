"""An event that ends a run: the first time at which a condition is zero."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.motion import on_the_group
from rigidjax.motion.coupled import started
from rigidjax.motion.torques.base import lacking
from rigidjax.solve.components import flat, unflat
from rigidjax.solve.crossing_loop import Search
from rigidjax.solve.crossing_search import correction, located, section
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.run import Free, Loop, solve


class Event(eqx.Module):
    """What ends a run of `simulate`: the first zero of a condition.

    **Arguments:**

    - `condition`: a Module or function `(t, state, body) → scalar`, smooth along the motion; it
      may hold traced numbers. Under a law with states of its own the state is a
      `rigidjax.motion.Coupled`: `state.motion.omega`, `state.own`.
    - `direction`: 1 for a zero on the way up, −1 on the way down, 0 for both (as in SciPy), in the
      order in which the run meets them.
    - `max_step`: the longest step, s. Zeros are found where the condition has changed its sign at
      the end of a step, or has one extremum within it; a condition that is much faster than the
      motion needs shorter steps.

    A start at a zero does not count, nor a condition that is zero all along, also if that is so but
    for round-off (see `crossings`).

    **Raises:** `TypeError`, `ValueError` for what is no function, another direction, a step that is
    not positive.

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
        _checks.function(condition, "condition", "(t, state, body) → scalar")
        self.condition = condition
        self.direction = require_direction(direction)
        self.max_step = None if max_step is None else require_step(max_step)


def require_direction(direction: Any) -> int:
    """Return `direction` if it is −1, 0 or 1."""
    if isinstance(direction, bool) or direction not in (-1, 0, 1):
        raise ValueError(
            "direction: wanted 1 (on the way up), -1 (on the way down) or 0 (both), got "
            f"{direction!r}"
        )
    return int(direction)


def require_step(value: Any) -> Array:
    """Return `max_step` as a scalar, positive where it is known."""
    step = _checks.floating(value, (), "max_step")
    return _checks.refuse(step, ~(step > 0), "max_step: wanted a positive step, s")


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
            "condition: wanted one real number, zero at the event, got whether it is so; give "
            "the difference, not whether it is positive"
        )
    return _checks.floating(found, (), "condition", hint="one real number, zero at the event")


_value = eqx.filter_jit(value)


@eqx.filter_jit
def solve_until(
    setup: Free | Loop, event: Event, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS, Array, Any]:
    """As `solve`, as far as the event; and the event's time and state, NaN where there is none.

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
    inputs = (event.condition, setup.body, getattr(setup, "torque", None), state0, ts)
    out = (jax.tree.map(rows, ys), time, unflat(y, state0))
    ys, time, state = nan_derivatives(out, inputs)
    return ys, stats, dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, result), time, state
