"""All crossings of a section: Poincaré sections in one call."""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import Point
from rigidjax.motion import Attitude, Rigid, Spin, on_the_group
from rigidjax.motion.coupled import Coupled
from rigidjax.solve import validation
from rigidjax.solve.components import unflat
from rigidjax.solve.crossing_loop import Search
from rigidjax.solve.crossing_search import crossings_of, section
from rigidjax.solve.direction import direction as direction_of
from rigidjax.solve.events import Event, ready, value
from rigidjax.solve.explicit import AbstractExplicit, DormandPrince8
from rigidjax.solve.linear_map import nan_derivatives
from rigidjax.solve.run import Free, Loop
from rigidjax.solve.step_control import Watched, of_body, outcome

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

    A start on the section does not count, and a tangential contact may be missed. A condition that
    is zero all along has no crossing, nor has one that is so but for round-off, such as an energy
    minus its value: a zero counts where the condition goes through it 16 times as fast as round-off
    could make it (in closed form; else times the root of the number of steps). Many bodies:
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
    event = Event(condition, direction, max_step)
    begin, end = _checks.time(t0, "t0"), _checks.time(t1, "t1")
    if _checks.known((begin, end)) and float(begin) == float(end):
        raise ValueError(f"t1: wanted another time than t0, got {float(end):g} for both")
    body, state0, times = validation.scene(
        body, state0, jnp.stack([begin, end]), torque, throw=False
    )
    state0 = ready(event, body, state0, torque, times[0])
    setup: Free | Loop
    if torque is None and solver is None and body is not None:
        setup = Free(body, False)
    else:
        solver = DormandPrince8() if solver is None else solver
        _checks.instance(
            solver, AbstractExplicit, "solver", wanted="an explicit method of rigidjax.solvers"
        )
        rtol, atol = validation.tolerances(rtol, atol, times.dtype)
        control = Watched(dfx.PIDController(rtol=rtol, atol=atol))  # pyright: ignore
        way = direction_of(times)
        setup = Loop(body, torque, solver, control, None, way, max_steps, False)
    return _solved(setup, event, many, max_steps, state0, times)


@eqx.filter_jit
def _solved(
    setup: Free | Loop, event: Event, many: int, max_steps: int, state0: Any, ts: Array
) -> Crossings:
    state0 = on_the_group(state0)
    condition = lambda t, y: value(event, setup.body, t, y)  # noqa: E731
    crossed, numbers = section(setup, condition, event.max_step, state0, ts)
    found = crossings_of(crossed, Search(event.direction, many, max_steps), numbers)
    states = jax.vmap(partial(unflat, like=state0))(found.states)
    inputs = (event.condition, setup.body, getattr(setup, "torque", None), state0, ts)
    times, states = nan_derivatives((crossed.time(found.times), states), inputs)
    result = outcome(found.h, found.t, crossed.time(ts[-1]), found.number >= many)
    result = of_body(result, setup.body)
    return Crossings(times, states, found.number, result, found.steps)
