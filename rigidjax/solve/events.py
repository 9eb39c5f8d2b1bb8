"""An event that ends a run: the first time at which a condition is zero."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia
from rigidjax.exact import FreeBody
from rigidjax.motion import Attitude, Rigid, on_the_group
from rigidjax.motion.torques.base import jumps_of, lacking
from rigidjax.solve.components import flat, unflat
from rigidjax.solve.crossing_loop import Search
from rigidjax.solve.crossing_search import Found, Numbers, Scene, correction, only_found
from rigidjax.solve.direction import Directed, DirectedCondition, DirectedJumps
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.run import Free, Loop, solve
from rigidjax.solve.vector_field import equations_of_motion

# Samples of a free body's condition in one turn at its largest rate.
_SAMPLES = 16


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

    A start at a zero does not count, nor a condition that is zero all along.

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


class Asked(eqx.Module):
    """A condition on (t, y), of this body."""

    condition: Callable[..., Any]
    body: Any

    def __call__(self, t: Any, y: Any) -> Array:
        value = self.condition(t, y, self.body)
        if jnp.issubdtype(getattr(value, "dtype", type(value)), jnp.bool_):
            raise TypeError(
                "condition: wanted one real number, zero at the event, got whether it is so; give "
                "the difference, not whether it is positive"
            )
        return _checks.floating(value, (), "condition", hint="one real number, zero at the event")


def require_condition(asked: Asked, t: Array, state0: Any) -> None:
    """Raise in words unless a condition gives one real number, which is not NaN at the start."""
    try:
        eqx.filter_eval_shape(asked, t, state0)
    except AttributeError as wrong:
        told = lacking("condition", wrong)
        if told is None:
            raise
        raise TypeError(told) from wrong
    if _checks.known((asked, t, state0)) and bool(jnp.isnan(_value(asked, t, state0))):
        raise ValueError(
            f"condition: wanted a number wherever the motion goes, got NaN at the start, t = "
            f"{float(t):g}"
        )


_value = eqx.filter_jit(lambda asked, t, state0: asked(t, state0))


def found_by(
    how: Callable[[Scene, Search, Numbers], Found],
    setup: Free | Loop,
    asked: Asked,
    max_step: Any,
    what: Search,
    state0: Any,
    ts: Array,
) -> Found:
    """The crossings between `ts[0]` and `ts[-1]`, in the order in which the run meets them.

    **Arguments:** `how` to search, `search` or `only_found`.
    """
    sign: Any = jnp.sign(ts[-1] - ts[0]).astype(jnp.int32)
    if isinstance(setup, Loop):
        sign = setup.sign
    field: Any = equations_of_motion(setup.body, state0, getattr(setup, "torque", None))
    condition: Any = asked
    jumps = jumps_of(setup.torque) if isinstance(setup, Loop) else jnp.zeros(0)
    flow = _Flow(setup.body, state0, ts[0], sign) if isinstance(setup, Free) else None
    along, jumps = ts[jnp.array([0, -1])], jnp.sort(jumps.astype(ts.dtype))
    if sign is not None:
        field = DirectedJumps(field, sign) if jumps.size else Directed(field, sign)
        condition = DirectedCondition(condition, sign)
        way = sign.astype(ts.dtype)
        along, jumps = way * along, jnp.sort(way * jumps)
    stops = jnp.concatenate([jnp.clip(jumps, along[0], along[1]), along[1:]])
    whole = lax.stop_gradient(along[1] - along[0])
    longest = whole if max_step is None else jnp.asarray(max_step, ts.dtype)
    dtype = ts.dtype
    if isinstance(setup, Free):
        longest = jnp.minimum(longest, _spacing(setup.body, state0, whole))
        rtol = atol = jnp.zeros((), dtype)
        h0, solver = longest, None
    else:
        controller: Any = setup.controller
        rtol, atol = (jnp.asarray(a, dtype) for a in (controller.rtol, controller.atol))
        h0, solver = jnp.asarray(jnp.nan if setup.dt0 is None else setup.dt0, dtype), setup.solver
    scene = Scene(solver, field, flow, condition, state0)
    numbers = Numbers(along[0], stops, flat(state0), rtol, atol, h0, longest)
    found = how(scene, what, numbers)
    if sign is None:
        return found
    return found._replace(times=sign.astype(ts.dtype) * found.times)


class _Flow(eqx.Module):
    """A free body at s = σt."""

    turning: FreeBody
    moving: Any
    t0: Array
    sign: Array

    def __init__(self, body: Any, state0: Any, t0: Array, sign: Array):
        inertia = body if isinstance(body, Inertia) else body.inertia
        rigid = isinstance(state0, Rigid)
        self.turning = FreeBody(inertia, Attitude(state0.q, state0.omega) if rigid else state0)
        self.moving = (state0.x, state0.v) if rigid else None
        self.t0, self.sign = t0, sign

    def __call__(self, s: Array) -> Any:
        since = self.sign.astype(s.dtype) * s - self.t0
        state: Any = self.turning(since)
        if self.moving is None:
            return state
        x, v = self.moving
        return Rigid(x + since * v, v, state.q, state.omega)


def _spacing(body: Any, state0: Any, whole: Array) -> Array:
    """A part of the time of one turn at the largest rate that energy and momentum allow."""
    inertia = body if isinstance(body, Inertia) else body.inertia
    tensor, omega = lax.stop_gradient((inertia.tensor, state0.omega))
    momentum = jnp.sum(tensor * omega[None], axis=1)
    least = jnp.linalg.eigvalsh(tensor)[0]
    rate = jnp.minimum(
        jnp.sqrt(jnp.sum(momentum * omega) / least), jnp.sqrt(jnp.sum(momentum**2)) / least
    )
    return jnp.where(rate * whole > 1, 2 * np.pi / (_SAMPLES * rate), whole / _SAMPLES)


@eqx.filter_jit
def solve_until(
    setup: Free | Loop, event: Event, state0: Any, ts: Array
) -> tuple[Any, dict[str, Any], dfx.RESULTS, Array, Any]:
    """As `solve`, as far as the event; and the event's time and state, NaN where there is none.

    The run is done twice: to find the event, and up to it, with derivatives.
    """
    state0 = on_the_group(state0)
    asked = Asked(event.condition, setup.body)
    steps = setup.max_steps if isinstance(setup, Loop) else 1_000_000
    what = Search(event.direction, 1, steps)
    found = found_by(only_found, setup, asked, event.max_step, what, state0, ts)
    met = found.number > 0
    end = jnp.where(met, found.times[0], lax.stop_gradient(ts[-1]))
    way = jnp.sign(ts[-1] - ts[0])
    before = ~(way * ts > way * end)
    short = jnp.concatenate([jnp.where(before, ts, end), jnp.where(met, end, ts[-1])[None]])
    ys, stats, result = solve(setup, state0, short)
    last = jax.tree.map(lambda leaf: leaf[-1], ys)
    ys = jax.tree.map(lambda leaf: leaf[:-1], ys)

    def mark(leaf: Array) -> Array:
        there = before.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(there, leaf, jnp.full_like(leaf, jnp.nan))

    ys = jax.tree.map(mark, ys)
    field: Any = equations_of_motion(setup.body, state0, getattr(setup, "torque", None))

    def rates(t: Array, y: Array) -> tuple[Array, Array, Array]:
        slope = flat(field(t, unflat(y, state0), None))
        g, rate = jax.jvp(
            lambda t, y: asked(t, unflat(y, state0)), (t, y), (jnp.ones_like(t), slope)
        )
        return g, rate, slope

    time, state = correction(rates, end, flat(last), met)
    state = on_the_group(unflat(state, state0))
    successful = result == dfx.RESULTS.successful
    met = met & successful
    time, state = jax.tree.map(lambda leaf: jnp.where(met, leaf, jnp.nan), (time, state))
    inputs = (asked, getattr(setup, "torque", None), state0, ts)
    ys, time, state = nan_derivatives((ys, time, state), inputs)
    result = dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, result)
    return ys, stats, result, time, state
