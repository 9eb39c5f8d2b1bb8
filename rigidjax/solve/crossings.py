"""All crossings of a section: Poincaré sections in one call."""

from collections.abc import Callable
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
from rigidjax.motion import Attitude, Rigid, Spin, on_the_group
from rigidjax.motion.coupled import Coupled, started
from rigidjax.solve import validation
from rigidjax.solve.crossing_loop import Search
from rigidjax.solve.crossing_search import search
from rigidjax.solve.direction import direction as direction_of
from rigidjax.solve.events import (
    Asked,
    found_by,
    require_condition,
    require_direction,
    require_step,
)
from rigidjax.solve.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.run import Free, Loop
from rigidjax.solve.step_control import Watched

State = TypeVar("State", Spin, Attitude, Rigid, Point, Coupled)


class Crossings(eqx.Module, Generic[State]):
    """What `crossings` returns.

    **Fields:** `times` (K,) s, in the order of the run, NaN beyond the last; `states` there, of the
    type of `state0`, with a leading axis; `count` how many; `result` a `diffrax.RESULTS`:
    `successful` where the run came to `t1`, `event_occurred` where it ended with `max_crossings` of
    them, or why it ended early; `num_steps` of the method, partial ones included.

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
    """Where the motion crosses a section: all zeros of a condition between two times.

    **Arguments:**

    - `body`, `state0`, `torque`: as for `simulate`; `state0` at `t0`.
    - `t0`, `t1`: s; `t1 < t0` goes back in time.
    - `condition`: a Module or function `(t, state, body) → scalar`, smooth along the motion. It may
      hold traced numbers, and depend on the time (a stroboscopic section is `sin(½(t − t₀)ω)`).
      Under a law with states of its own the state is a `Coupled`, as in what is returned.
    - `direction`: 1 for zeros on the way up, −1 on the way down, 0 for both, in the order of the
      run.
    - `max_crossings`: K, the length of what is returned; the run ends with the last of them.
    - `max_step`: the longest step, s, for a condition that is much faster than the motion: several
      zeros in one step are found where the cubic through its ends, with their slopes, shows them.
    - `solver`: `None` is the closed form for a free body, else `rigidjax.solvers.DormandPrince8`;
      or an explicit method of `rigidjax.solvers`. `rtol`, `atol` as for `simulate`; a crossing is
      as accurate as a step, that of a free body to round-off.
    - `max_steps`: parts of steps included.

    A start on the section does not count, a condition that is zero all along has no crossing, and a
    tangential contact may be missed. Many bodies:
    `jax.vmap(lambda start: rj.crossings(body, start, …))`.

    **Returns** `Crossings`. Times and states have first and second derivatives with respect to all
    numbers of the scene, of `condition` and of `state0`, forward and reverse; near a tangential
    contact they grow without bound, as the true ones do.

    Source: Newton's method on the step from the last accepted state, in the place of Hénon's change
    of variable (Hénon 1982, doi:10.1016/0167-2789(82)90034-3): two to three parts of a step.

    **Raises:** `TypeError`, `ValueError` as `simulate`, for times that are equal, and for a
    condition that is no number, is NaN at the start, or looks at what the state has not.

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flips = crossings(body, start, 0.0, 40.0, lambda t, state, body: state.omega[1])
    >>> int(flips.count), bool(flips.full)
    (2, False)
    """
    many = _checks.whole(max_crossings, "max_crossings", 1)
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    _checks.function(condition, "condition", "(t, state, body) → scalar")
    begin, end = _checks.time(t0, "t0"), _checks.time(t1, "t1")
    if _checks.known((begin, end)) and float(begin) == float(end):
        raise ValueError(f"t1: wanted another time than t0, got {float(end):g} for both")
    times = validation.times(jnp.stack([begin, end]), False)
    state0 = validation.start(state0, False)
    dtype = times.dtype
    for leaf in jax.tree.leaves(state0):
        dtype = jnp.promote_types(dtype, leaf.dtype)
    times, state0 = jax.tree.map(lambda leaf: leaf.astype(dtype), (times, state0))
    validation.require_fit(body, state0, torque)
    if body is not None:
        body = validation.real_or_nan(body)
    asked = Asked(condition, body)
    state0 = started(body, state0, torque, times[0])
    require_condition(asked, times[0], state0)
    step = None if max_step is None else require_step(max_step)
    setup: Free | Loop
    if torque is None and solver is None and body is not None:
        setup = Free(body, False)
    else:
        solver = DormandPrince8() if solver is None else solver
        _checks.instance(
            solver, AbstractExplicit, "solver", wanted="an explicit method of rigidjax.solvers"
        )
        rtol, atol = validation.tolerances(rtol, atol, dtype)
        control = Watched(dfx.PIDController(rtol=rtol, atol=atol))  # pyright: ignore
        way = direction_of(times)
        setup = Loop(body, torque, solver, control, None, way, max_steps, False)
    what = Search(require_direction(direction), many, max_steps)
    return _solved(setup, asked, step, what, state0, times)


@eqx.filter_jit
def _solved(
    setup: Free | Loop, asked: Asked, step: Any, what: Search, state0: Any, ts: Array
) -> Crossings:
    state0 = on_the_group(state0)
    step = None if step is None else lax.stop_gradient(step)
    found = found_by(search, setup, asked, step, what, state0, ts)
    inputs = (asked, getattr(setup, "torque", None), state0, ts)
    times, states = nan_derivatives((found.times, found.states), inputs)
    return Crossings(times, states, found.number, found.result, found.steps)
