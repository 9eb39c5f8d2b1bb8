"""Find the times at which a function g of the motion is zero: an event, or section crossings.

The crossings are found without derivatives. To get the derivatives, the motion is computed again up
to the times of the crossings, which are now constants. At such a fixed time g is zero but for a
small error. From g and its time derivatives ġ and g̈ along the motion, one step of Chebyshev's
method gives the time and the state of the crossing. The first and second derivatives of the results
of this step are those of the crossing:

    τ = −(g/ġ)(1 + ½ g g̈/ġ²),   y = y* + f τ + ½ (df/dt) τ².

Here τ is the time from the fixed time to the crossing, y* the state at the fixed time, f = dy/dt
the vector field, and y the state at the crossing.

If g jumps over zero, the time of the jump is found by halving an interval. How this time depends on
the parameters is not known, so that its derivatives are NaN.

A zero that is caused by round-off alone is no crossing. Round-off causes zeros if the motion
conserves g, or if g is a component of the state that stays at zero. At a zero of this kind |ġ| is
at most a small multiple of ε (|∂g/∂t| + Σ |∂g/∂yᵢ| rᵢ) times the square root of the number of
steps. Here ε is the relative rounding error, and rᵢ is the size of the terms that are summed up in
ẏᵢ, the time derivative of the number yᵢ of the state. This size is estimated as the sum of two
norms, each taken over the array of the state (Ω, x, …) that contains yᵢ: the norm of ẏ, and the
norm of the change of ẏ if each number of y changes by up to the norm of its own array.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.exact.free_body import FreeMotion
from rigidjax.frames import Point
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.coupled import Coupled, with_own_states
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.torques.base import missing_part
from rigidjax.solve.answer import crossing_loop, validation
from rigidjax.solve.answer.crossing_loop import (
    Located,
    Measured,
    Motion,
    Path,
    Search,
    result_of_search,
    step_with_error,
)
from rigidjax.solve.answer.run import (
    AnyRun,
    ClosedFormRun,
    DiffraxRun,
    forward_time,
    has_closed_form,
    hoist,
    solve,
    time_direction,
)
from rigidjax.solve.engine.adaptive import NO_METER, REPLAY
from rigidjax.solve.engine.loop import Method, result_of_body, starting_step
from rigidjax.solve.engine.momentum import Integrated, integrated_form
from rigidjax.solve.programs.batching import Arrays, Layout, bodies_last, lift
from rigidjax.solve.programs.linear_map import nan_derivatives, with_derivatives
from rigidjax.solve.programs.traced import extract_constants
from rigidjax.solve.steps.explicit import AbstractExplicit, require_explicit
from rigidjax.solve.times.stops import program_with_stops

State = TypeVar("State", Spin, Attitude, Rigid, Turn, Point, Coupled)


class Event(eqx.Module):
    """Describe the event that ends a run of `simulate`: the first zero of a condition.

    **Arguments:**

    - `condition`: a function or Module `(t, state, body) → scalar` that is smooth along the motion;
      the fields of a Module may be traced. If the condition jumps over zero (`jnp.sign(…)`), the
      event is at the jump, and its time has NaN derivatives. If the torque has states of its own,
      such as the speed of a wheel, the state is a `Coupled` of two parts: read `state.motion.omega`
      for the body rate, and `state.own` for the states of the torque.
    - `direction`: 1 for a zero on the way up, −1 for a zero on the way down, 0 for both (as in
      SciPy). In a run backwards in time, the way up means that the condition increases from step to
      step, that is with decreasing t.
    - `max_step`: the longest step, s. A zero is found if the condition has different signs at the
      two ends of a step; two zeros are found if the condition has one extremum between them.

    If the condition is zero at the start of the run, this zero is no event. A condition that is
    zero but for round-off all along the motion has no event (see `crossings`).

    **Raises:** `TypeError` if `condition` is not a function; `ValueError` for another `direction`,
    or for a `max_step` that is not positive.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flip = Event(lambda t, state, body: state.omega[1])
    >>> float(rj.simulate(body, start, [0.0, 20.0], event=flip).event_time)  # doctest: +ELLIPSIS
    9.42551789684...
    """

    condition: Callable[..., Any]
    direction: int = eqx.field(static=True)
    max_step: Any

    def __init__(
        self, condition: Callable[..., Any], direction: int = 0, max_step: ScalarLike | None = None
    ):
        self.condition = _checks.require_function(
            condition, "condition", "(t, state, body) → scalar"
        )
        if isinstance(direction, bool) or direction not in (-1, 0, 1):
            words = "direction: wanted 1 (on the way up), -1 (on the way down) or 0 (both), got "
            raise ValueError(f"{words}{direction!r}")
        self.direction = int(direction)
        self.max_step = max_step
        if max_step is not None:
            step = _checks.array_of_shape(max_step, (), "max_step")
            words = "max_step: wanted a positive step, s"
            self.max_step = _checks.error_if(step, ~(step > 0), words)


class Crossings(eqx.Module, Generic[State]):
    """Hold the result of `crossings`: the times and states at which a condition is zero.

    **Fields:**

    - `times`: (K,) the times of the crossings, s, in the order of the run; NaN after the last one.
    - `states`: the states at these times, of the type of the initial state, with a leading axis
      (K,).
    - `count`: the number of crossings.
    - `result`: a `diffrax.RESULTS`: `successful` if the run reached its end `t1`, `event_occurred`
      if it ended at crossing number `max_crossings`, else the reason why it ended early. In the
      second case the property `full` is true.
    - `num_steps`: the number of steps of the method, parts of steps included.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flips = rj.crossings(body, start, 0.0, 40.0, lambda t, state, body: state.omega[1])
    >>> int(flips.count), bool(flips.full)
    (2, False)
    """

    times: Float[Array, " crossings"]
    states: State
    count: Int[Array, ""]
    result: dfx.RESULTS
    num_steps: Int[Array, ""]

    @property
    def full(self) -> Array:
        """Return whether the run ended at crossing number `max_crossings`.

        If it did, more crossings may follow before `t1`.
        """
        return self.result == dfx.RESULTS.event_occurred


@suggest_arguments
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
    """Return the crossings of a section: all zeros of a condition between two times.

    **Arguments:**

    - `body`, `state0`, `torque`: as for `simulate`; `state0` is the state at `t0`.
    - `t0`, `t1`: the start and the end of the run, s; `t1 < t0` goes back in time.
    - `condition`, `direction`: as for `Event`. The condition may depend on the time (a stroboscopic
      section with the angular frequency ω is `sin(½(t − t₀)ω)`).
    - `max_crossings`: K, the length of the results; the run ends at crossing number K.
    - `max_step`: the longest step, s. Give it for a condition that changes much faster than the
      motion. Several zeros in one step are found if the cubic polynomial with the values and slopes
      of the condition at both ends of the step shows them.
    - `solver`: an explicit method of `rigidjax.solvers`; `None` is the closed form for a free body,
      and `rigidjax.solvers.DormandPrince8` for any other.
    - `rtol`, `atol`: as for `simulate`. A crossing is as accurate as a step; in closed form it is
      accurate to round-off.
    - `max_steps`: the largest number of steps, parts of steps included.

    A start on the section is no crossing, and a tangential contact with the section may be missed.
    A zero is a crossing only if round-off cannot have caused it: the rate of the condition at the
    zero has to be at least 16 times the rate that round-off could give it; under a solver, 16√n
    times after n steps. The energy minus its initial value, for example, has no crossing. For many
    bodies use `jax.vmap`.

    **Returns** a `Crossings`. Its times and states have first and second derivatives with respect
    to all numbers of `body`, `torque`, `condition` and `state0`, in forward and reverse mode. Near
    a tangential contact these derivatives grow without bound, as those of the exact crossing do.

    Source: Hénon 1982, doi:10.1016/0167-2789(82)90034-3, with Newton's method on the length of the
    step from the last accepted state instead of Hénon's change of variable.

    **Raises:** `TypeError` and `ValueError` as `simulate` does, for equal times, and for a
    condition that is not a number, is NaN at the start, or reads a part that the state lacks.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> flips = crossings(body, start, 0.0, 40.0, lambda t, state, body: state.omega[1])
    >>> int(flips.count), bool(flips.full)
    (2, False)
    """
    many = _checks.integer(max_crossings, "max_crossings", 1)
    max_steps = _checks.integer(max_steps, "max_steps", 1)
    event = Event(condition, direction, max_step)
    begin, end = _checks.checked_time(t0, "t0"), _checks.checked_time(t1, "t1")
    if _checks.is_known((begin, end)) and float(begin) == float(end):
        raise ValueError(f"t1: wanted another time than t0, got {float(end):g} for both")
    ts = jnp.stack([begin, end])
    body, state0, times = validation.checked_run(body, state0, ts, torque, throw=False)
    torque = hoist(torque, times[0], state0, body)
    state0 = checked_state(event, body, state0, torque, times[0])
    condition = hoist(condition, times[0], state0, body)
    event = Event(condition, direction, max_step)
    way = time_direction(times)
    if solver is None and has_closed_form(body, torque):
        setup = ClosedFormRun(body, way, False, torque)
        return _crossings(setup, event, many, max_steps, state0, times)
    solver = require_explicit(solver)
    rtol, atol = validation.checked_tolerances(rtol, atol, times.dtype)
    setup = DiffraxRun(
        body, torque, solver, rtol, atol, None, None, None, REPLAY, NO_METER, way, max_steps, False
    )
    return _crossings(setup, event, many, max_steps, state0, times)


def checked_state(
    event: Event, body: Inertia | MassProperties | None, state0: PyTree, torque: Any, t: Array
) -> PyTree:
    """Check an event's condition at the start; return the state, with the torque's own states.

    Raise `TypeError` or `ValueError` if the condition is not one real number, reads a part that the
    state lacks, or is NaN.
    """
    state0 = with_own_states(body, state0, torque, t)
    try:
        eqx.filter_eval_shape(condition_value, event, body, t, state0)
    except AttributeError as wrong:
        told = missing_part("condition", wrong)
        if told is None:
            raise
        raise TypeError(told) from wrong
    if _checks.is_known((event, body, t, state0)) and bool(
        jnp.isnan(_compiled_value(event, body, t, state0))
    ):
        words = "condition: wanted a number wherever the motion goes, got NaN at the start, t = "
        raise ValueError(f"{words}{float(t):g}")
    return state0


def condition_value(event: Event, body: Any, t: Any, y: PyTree) -> Array:
    """Return the value of a condition; raise `TypeError` or `ValueError` unless it is real."""
    with _checks.explain_tracing("condition", event.condition):
        found = event.condition(t, y, body)
    if jnp.issubdtype(getattr(found, "dtype", type(found)), jnp.bool_):
        raise TypeError(
            "condition: wanted one real number, zero at the event, got a truth value; give the "
            "difference, not its sign"
        )
    return _checks.array_of_shape(found, (), "condition", hint="one real number, zero at the event")


_compiled_value = eqx.filter_jit(condition_value)


class EventRun(NamedTuple):
    """Hold a run that ends at its first event."""

    ys: PyTree  # the states at the saved times, NaN after the event
    stats: dict[str, Any]  # as in `Solution.stats`
    result: dfx.RESULTS
    time: Array  # the time of the event, s, NaN if there is none
    state: PyTree  # the state at the event, NaN if there is none


@eqx.filter_jit
def solve_until_event(setup: AnyRun, event: Event, state0: PyTree, ts: Array) -> EventRun:
    """Return the run that ends at the first event."""
    state0 = project_to_group(state0)
    crossed, numbers = section_of_run(setup, event, state0, ts)
    found = locate(crossed, Search(event.direction, 1, setup.max_steps or 1_000_000), numbers)
    met, last = found.number > 0, lax.stop_gradient(ts[-1])
    end = jnp.where(met, crossed.signed(found.times[0]), last)
    before = ~(crossed.signed(ts) > crossed.signed(end))
    short = jnp.concatenate([jnp.where(before, ts, end), jnp.where(met, end, ts[-1])[None]])
    ys, stats, result = solve(setup, state0, short)
    y = crossed.vector(end, jax.tree.map(lambda leaf: leaf[-1], ys))
    jumps = found.jumps[0]
    s, y = chebyshev_step(crossed, numbers.constants, crossed.signed(end), y, met & ~jumps)
    met = met & (result == dfx.RESULTS.successful)

    there = lambda leaf: before.reshape(-1, *[1] * (leaf.ndim - 1))  # noqa: E731
    ys = jax.tree.map(lambda leaf: jnp.where(there(leaf), leaf[:-1], jnp.nan), ys)
    time, y = (jnp.where(met, leaf, jnp.nan) for leaf in (crossed.signed(s), y))
    inputs = (event.condition, setup.body, setup.torque, state0, ts)
    ys = nan_derivatives(ys, inputs)
    time, state = _unknown_to_nan((time, crossed.state(time, y)), jumps, inputs)
    result = dfx.RESULTS.where(met, dfx.RESULTS.event_occurred, result)
    return EventRun(ys, stats, result, time, state)


def _unknown_to_nan(crossing: PyTree, jumps: Array, inputs: PyTree) -> PyTree:
    """Return the arrays of `crossing`, with NaN for the derivatives that are not known.

    These are those of NaN itself, and of a crossing at which g jumps over zero: how such a crossing
    depends on the inputs is not known. The axes of `jumps` are the first axes of each array.
    """
    over = lambda leaf: jumps.reshape(*jumps.shape, *[1] * (leaf.ndim - jumps.ndim))  # noqa: E731
    moved = jax.tree.map(lambda leaf: jnp.where(over(leaf), jnp.nan, leaf), crossing)
    moved = nan_derivatives(moved, inputs)
    return with_derivatives(lax.stop_gradient(crossing), moved)


@eqx.filter_jit
def _crossings(
    setup: AnyRun, event: Event, max_crossings: int, max_steps: int, state0: Any, ts: Array
) -> Crossings:
    """Return the crossings of `event`, whose times and states JAX can differentiate."""
    state0 = project_to_group(state0)
    crossed, numbers = section_of_run(setup, event, state0, ts)
    found = locate(crossed, Search(event.direction, max_crossings, max_steps), numbers)
    times, states = _differentiable_crossings(
        found.times, found.states, found.jumps, setup, event, state0, ts
    )
    inputs = (event.condition, setup.body, setup.torque, state0, ts)
    times = crossed.signed(times)
    out = times, jax.vmap(crossed.state)(times, states)
    times, states = _unknown_to_nan(out, found.jumps, inputs)
    full = found.number >= max_crossings
    result = result_of_search(found.h, found.t, crossed.signed(ts[-1]), full)
    result = result_of_body(result, setup.body)
    return Crossings(times, states, found.number, result, found.steps)


@eqx.filter_custom_jvp
def _differentiable_crossings(
    times: Array, states: Array, jumps: Array, *inputs: Any
) -> tuple[Array, Array]:
    """Return the crossings (K,), (K, n) as they are; their derivatives come from a second run.

    The second run is made only if derivatives are taken. `inputs` are set-up, event, start and
    times.
    """
    return times, states


@_differentiable_crossings.def_jvp
def _jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the crossings, and the tangents of a `chebyshev_step` from their fixed times."""
    found, jumps = primals[:2], primals[2]
    there = jnp.isfinite(found[0])

    def again(setup: Any, event: Event, state0: Any, ts: Array) -> tuple[Array, Array]:
        crossed, (constants, _) = section_of_run(setup, event, state0, ts)
        start = lax.stop_gradient(crossed.signed(ts[0]))
        s = jnp.where(there, found[0], jnp.max(jnp.where(there, found[0], start)))
        t = crossed.signed(s)
        ys, *_ = solve(setup, state0, jnp.concatenate([ts[:1], t]))
        ys = jax.vmap(crossed.vector)(t, jax.tree.map(lambda leaf: leaf[1:], ys))
        times, states = jax.vmap(partial(chebyshev_step, crossed, constants))(s, ys, there & ~jumps)
        return jnp.where(there, times, jnp.nan), jnp.where(there[:, None], states, jnp.nan)

    moved, along = eqx.filter_jvp(again, primals[3:], tangents[3:])
    return with_derivatives(found, moved), along


# The condition of a free body is sampled this many times in one turn of the body at its largest
# rate.
_SAMPLES = 16
# A zero counts as a crossing if the rate of the condition is at least this many times the rate that
# round-off could cause.
_CLEAR = 16


class Section(NamedTuple):
    """Hold a condition g and a motion y as functions of the time s = σt, which grows along the run.

    σ is 1 if the run goes forwards in time t, and −1 if it goes backwards. The section is the set
    of states with g = 0. The first argument of each function is the list of the arrays that it
    reads.
    """

    solver: AbstractExplicit | None  # `None` is the closed form
    # motion(constants, s, y) returns dy/ds, the slope of the state y along the time s; in closed
    # form it returns the state at the time s instead.
    motion: Callable[[Arrays, Array, Array], Array]
    # rates(constants, s, y) returns the condition g, its slope dg/ds along the motion, and dy/ds.
    rates: Callable[[Arrays, Array, Array], tuple[Array, Array, Array]]
    tree: Callable[[Array], Any]  # the state from the vector of its numbers
    sizes: list[int]  # how many numbers each array of the state has
    sign: Array  # σ
    form: Integrated  # what is integrated

    def vector(self, t: Array, state: PyTree) -> Array:
        """Return the vector (n,) of the numbers that are integrated, made from the state at `t`."""
        return ravel_pytree(self.form.from_state(t, state))[0]

    def state(self, t: Array, y: Array) -> PyTree:
        """Return the state at `t` of a vector of integrated numbers, the inverse of `vector`."""
        return self.form.to_state(t, self.tree(y))

    def project(self, y: Array) -> Array:
        """Return the vector of a state with its quaternion, if any, scaled to length 1."""
        return ravel_pytree(project_to_group(self.tree(y)))[0]

    def signed(self, s: Array) -> Array:
        """Return σs: convert the time s to the time t, or t to s."""
        return self.sign.astype(s.dtype) * s

    def measure(self, constants: Arrays, s: Array, y: Array) -> Measured:
        """Return g and its rate at a state, the slope of the state, and the round-off of g."""
        of_g = lambda s, y: self.rates(constants, s, y)[0]  # noqa: E731
        noise = jax.jvp(of_g, (s, y), (s, _probe(self.sizes, y)))[1]
        blur = _CLEAR * jnp.finfo(y.dtype).eps * jnp.abs(noise)
        g, rate, slope = self.rates(constants, s, y)
        return Measured(jnp.asarray(g), jnp.asarray(rate), slope, blur)

    def clarity(self, constants: Arrays, s: Array, y: Array) -> Array:
        """Return |dg/ds| at a zero over the rate that round-off could cause: about 1 if it did."""
        rates = partial(self.rates, constants, s)
        _, rate, slope = rates(y)
        shift = jax.jvp(lambda y: rates(y)[2], (y,), (_probe(self.sizes, y),))[1]
        by_s, by_y = jax.jacfwd(lambda s, y: self.rates(constants, s, y)[0], (0, 1))(s, y)
        lengths = _norms(self.sizes, slope) + _norms(self.sizes, shift)
        terms = jnp.abs(by_s) + jnp.sum(jnp.abs(by_y) * lengths)
        return jnp.abs(rate) / (jnp.finfo(y.dtype).eps * terms)


class Numbers(NamedTuple):
    """Hold the arrays with which a `Section` is searched."""

    constants: Arrays  # those of the functions of the section
    run: Path


def section_of_run(setup: AnyRun, event: Event, state0: Any, ts: Array) -> tuple[Section, Numbers]:
    """Return the `Section` of an event along a run, and the arrays with which it is searched."""
    form = integrated_form(setup.body, state0, setup.torque)

    def condition(t: Array, y: Any) -> Array:
        return condition_value(event, setup.body, t, form.to_state(t, y))

    (y0, tree), dtype = ravel_pytree(form.from_state(ts[0], state0)), ts.dtype
    sign = jnp.sign(ts[-1] - ts[0]).astype(jnp.int32)
    ends = ts[jnp.array([0, -1])]
    field, asked, along, jumps = forward_time(setup.sign, form.field, condition, ends)
    whole: Any = lambda s, y, *sides: ravel_pytree(field(s, tree(y), sides or None))[0]  # noqa: E731
    program = program_with_stops(whole, jumps, along[0], along[1], y0)
    longest = length = lax.stop_gradient(along[1] - along[0])
    if event.max_step is not None:
        longest = lax.stop_gradient(jnp.asarray(event.max_step, dtype))
    if setup.max_step is not None:
        longest = jnp.minimum(longest, setup.max_step)

    slope = partial(program.field, program.constants)

    def rates(s: Array, y: Array) -> tuple[Array, Array, Array]:
        there = slope(s, y)
        of_y = lambda s, y: asked(s, tree(y))  # noqa: E731
        return *jax.jvp(of_y, (s, y), (jnp.ones_like(s), there)), there

    if isinstance(setup, DiffraxRun):
        solver, motion = setup.solver, slope
        rtol, atol = (jnp.asarray(a, y0.dtype) for a in (setup.rtol, setup.atol))
        h0 = jnp.asarray(jnp.nan if setup.dt0 is None else setup.dt0, dtype)
    else:
        solver, free = None, setup.moving(state0)
        motion = lambda s, _: ravel_pytree(free(sign.astype(s.dtype) * s - ts[0]))[0]  # noqa: E731
        longest = jnp.minimum(longest, _sampling_interval(free, setup.body, length))
        rtol, atol, h0 = jnp.zeros((), y0.dtype), jnp.zeros((), y0.dtype), longest
    (of_motion, of_rates), constants = extract_constants([motion, rates], along[0], y0)
    stops = jnp.concatenate([program.stops, along[1:]])
    sizes = [leaf.size for leaf in jax.tree.leaves(state0)]
    crossed = Section(solver, of_motion, of_rates, tree, sizes, sign, form)
    return crossed, Numbers(constants, Path(along[0], stops, y0, rtol, atol, h0, longest))


def _sampling_interval(motion: Any, body: Any, length: Array) -> Array:
    """Return the interval between two samples, s, of a condition along a motion in closed form.

    It is a sixteenth of a turn at the largest rate that energy and momentum allow, or of the run if
    the body turns by less than a radian in it.
    """
    if isinstance(motion, FreeMotion):
        tensor, omega = lax.stop_gradient((tensor_of(body), motion.state0.omega))
        momentum = jnp.sum(tensor * omega[None], axis=1)
        least = jnp.linalg.eigvalsh(tensor)[0]
        by_energy = jnp.sqrt(jnp.sum(momentum * omega) / least)
        rate = jnp.minimum(by_energy, jnp.sqrt(jnp.sum(momentum**2)) / least)
    else:
        rate = lax.stop_gradient(motion.pace)
    return jnp.where(rate * length > 1, 2 * np.pi / (_SAMPLES * rate), length / _SAMPLES)


def locate(section: Section, search: Search, numbers: Numbers) -> Located:
    """Return the first crossings of a run, without derivatives."""
    constants, run = lax.stop_gradient(numbers)
    return Located(*bodies_last(partial(_locate, section, search), constants, [*run]))


def _locate(
    section: Section, search: Search, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    """Return the fields of `Located` in a list: the crossings of one body, or of many at once.

    `each` are the fields of `Path`.
    """
    run, solver, motion = Path(*each), section.solver, layout.vmap(section.motion)
    project = jax.vmap(section.project, -1, -1) if layout.bodies else section.project
    seen, clear = (partial(layout.vmap(f), constants) for f in (section.measure, section.clarity))

    def counts(s: Array, y: Array, steps: Array) -> Array:
        # The round-off of n steps adds up as a random walk does, to about √n times that of one
        # step. In closed form, without a solver, there are no steps.
        many = 1 if solver is None else jnp.sqrt(1 + steps.astype(y.dtype))
        return ~(clear(s, y) < _CLEAR * many)

    order, still = 1, jnp.zeros_like(run.rtol)
    attempt: Any = lambda step: (motion(constants, step.end, step.y), still)  # noqa: E731
    if solver is not None:
        # `locate_zeros` has its own control of steps.
        method = Method(
            solver.tableau, motion, project, None, None, section.sizes, search.max_steps
        )
        scale = lift(run.atol, run.y0) + lift(run.rtol, run.y0) * jnp.abs(run.y0)
        both = run.y0, motion(constants, run.t0, run.y0)
        size, rate = (jnp.sqrt(jnp.mean((a / scale) ** 2, 0)) for a in both)
        h0 = starting_step(size, rate, solver.tableau.order).astype(run.t0.dtype)
        h0 = jnp.minimum(jnp.where(jnp.isnan(run.h0), h0, run.h0), run.longest)
        run = run._replace(h0=h0)
        attempt, order = partial(step_with_error, method, constants, run), solver.tableau.order
    moving = Motion(attempt, order, seen, counts, project)
    return list(crossing_loop.locate_zeros(moving, search, run))


def _norms(sizes: list[int], vector: Array) -> Array:
    """Return for each number of a vector (n,), made of arrays of `sizes`, the norm of its array."""
    which = np.repeat(np.arange(len(sizes)), sizes)
    same = jnp.asarray(which[:, None] == which[None], vector.dtype)
    return jnp.sqrt(jnp.sum(same * (vector * vector)[None], 1))


def _probe(sizes: list[int], y: Array) -> Array:
    """Return a change (n,) of the state, by which the effect of round-off is measured.

    Each number changes by at most the norm of its array. The factors, cosines of 1, 2, …, differ,
    so that the change has components along all axes of the body.
    """
    return jnp.asarray(np.cos(1 + np.arange(y.size)), y.dtype) * _norms(sizes, y)


def chebyshev_step(
    section: Section, constants: Arrays, s: Array, y: Array, is_crossing: Array
) -> tuple[Array, Array]:
    """Return the time s and the state (n,) of a crossing, by one step from the fixed time nearby.

    First and second derivatives are then those of the crossing; the module has the formula. If
    there is no crossing, the step has the length 0.
    """
    rates = partial(section.rates, constants)
    g, rate, slope = rates(s, y)
    # The second time derivatives of g and of y are multiplied by g². At the crossing g² is zero,
    # and so is the first derivative of g². The first and second derivatives of the results
    # therefore do not contain the derivatives of these second time derivatives, which are not
    # taken.
    here = lax.stop_gradient((s, y))
    _, moved = jax.jvp(rates, here, (jnp.ones_like(s), lax.stop_gradient(slope)))
    _, second, turn = lax.stop_gradient(moved)
    rate = jnp.where(is_crossing, rate, jnp.ones_like(rate))
    newton = -g / rate
    move = jnp.where(
        is_crossing, newton * (1 - 0.5 * newton * second / rate), jnp.zeros_like(newton)
    )
    return s + move.astype(s.dtype), section.project(y + slope * move + 0.5 * turn * move * move)
