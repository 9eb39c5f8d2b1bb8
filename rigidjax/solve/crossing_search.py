"""The crossings of one body, with derivatives: found without them, then corrected with them.

A crossing at t* of g(t, y(t)) = 0 moves with every number of the scene. The motion is run again to
the times found, which stay as they are, and what is left of g there, its rates ġ and g̈ along the
motion give the time and the state by one step of Chebyshev's method,

    τ = −(g/ġ)(1 + ½ g g̈/ġ²),   y = y* + f τ + ½ (df/dt) τ².

τ is zero but for the error of dense output, and its first and second derivatives are those of the
crossing (the error is of third order in what moves). At a touch, ġ = 0, there is none. The values
are those that were found, whether there are derivatives or not.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.motion import on_the_group
from rigidjax.solve import crossing_loop, runge_kutta
from rigidjax.solve.adaptive import adaptive, taken_out
from rigidjax.solve.batching import Arrays, Layout, in_lanes
from rigidjax.solve.components import flat, leaf_sizes, unflat
from rigidjax.solve.crossing_loop import Located, Motion, Search
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.record import Method, Run
from rigidjax.solve.runge_kutta import Step
from rigidjax.solve.step_control import NONFINITE, error_norm, first_step

_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0


class Scene(NamedTuple):
    """What moves, as functions of numbers and closures.

    **Fields:** `solver` a method of ours, or `None` where `flow` answers; `field` f(t, y, args);
    `flow(t)` the state at a time in closed form, or `None`; `condition(t, y)` g; `like` a state.
    """

    solver: AbstractExplicit | None
    field: Callable[..., Any]
    flow: Callable[..., Any] | None
    condition: Callable[..., Any]
    like: Any


class Numbers(NamedTuple):
    """`t0`, `stops` (J,) where the field jumps and the end, `y0` (n,), tolerances, first step (NaN
    to choose one), longest step.
    """

    t0: Array
    stops: Array
    y0: Array
    rtol: Array
    atol: Array
    h0: Array
    longest: Array


class Found(NamedTuple):
    """Times (K,), NaN beyond the last; states with a leading axis; how many; how the search ended;
    passes.
    """

    times: Array
    states: Any
    number: Array
    result: dfx.RESULTS
    steps: Array


def only_found(scene: Scene, what: Search, numbers: Numbers) -> Found:
    """The first crossings on the way through `numbers.stops`, without derivatives."""
    rules, constants = _rules(scene, numbers.t0)
    located = Located(*_find(scene, rules, what, len(constants), *constants, *numbers))
    return _found(scene, what, numbers, located)


def search(scene: Scene, what: Search, numbers: Numbers) -> Found:
    """As `only_found`, differentiable in all numbers."""
    rules, constants = _rules(scene, numbers.t0)
    count = len(constants)
    find = partial(_find, scene, rules, what, count)
    answer = jax.custom_jvp(find)

    @answer.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        found = Located(*find(*primals))

        def again(*args: Array) -> Any:
            given = Numbers(*args[count:])
            return _corrected(scene, rules, what, list(args[:count]), given, found)

        value, moved = jax.jvp(again, tuple(primals), tuple(tangents))
        rest = [_no_tangent(a) for a in found[2:]]
        return [*value, *found[2:]], [*moved, *rest]

    return _found(scene, what, numbers, Located(*answer(*constants, *numbers)))


def _find(scene: Scene, rules: "_Rules", what: Search, count: int, *args: Array) -> Arrays:
    still = [lax.stop_gradient(a) for a in args]
    program = partial(_located, scene, rules, what)
    return in_lanes(program, still[:count], still[count:])


def _found(scene: Scene, what: Search, numbers: Numbers, out: Located) -> Found:
    result = dfx.RESULTS.dt_min_reached
    for there, word in (
        (jnp.isnan(out.h), NONFINITE),
        (out.h > 0, dfx.RESULTS.max_steps_reached),
        (out.t >= numbers.stops[-1], dfx.RESULTS.successful),
        (out.number >= what.many, dfx.RESULTS.event_occurred),
    ):
        result = dfx.RESULTS.where(there, word, result)
    states = jax.vmap(partial(unflat, like=scene.like))(out.states)
    return Found(out.times, states, out.number, result, out.steps)


def _no_tangent(a: Array) -> Any:
    if jnp.issubdtype(a.dtype, jnp.inexact):
        return jnp.zeros_like(a)
    return np.zeros(a.shape, jax.dtypes.float0)


class _Rules(NamedTuple):
    """Functions of one body, of all constants, of t, and of y (n,)."""

    field: Callable[[Arrays, Array, Array], Array]
    flow: Callable[[Arrays, Array, Array], Array]
    condition: Callable[[Arrays, Array, Array], Array]


def _rules(scene: Scene, t0: Array) -> tuple[_Rules, Arrays]:
    y0 = flat(scene.like)
    flow = (lambda t, y: y) if scene.flow is None else lambda t, y: flat(scene.flow(t))  # pyright: ignore
    parts = (
        lambda t, y: flat(scene.field(t, unflat(y, scene.like), None)),
        flow,
        lambda t, y: scene.condition(t, unflat(y, scene.like)),
    )
    functions: list[Any] = []
    constants: Arrays = []
    for part in parts:
        function, own = taken_out(part, t0, y0)
        begin, end = len(constants), len(constants) + len(own)
        functions.append(partial(_of_own, function, begin, end))
        constants.extend(own)
    return _Rules(*functions), constants


def _of_own(function: Any, begin: int, end: int, constants: Arrays, t: Array, y: Array) -> Any:
    return function(constants[begin:end], t, y)


def _rates(rules: _Rules, constants: Arrays, t: Array, y: Array) -> tuple[Array, Array, Array]:
    """g, dg/dt along the motion, and dy/dt."""
    slope = rules.field(constants, t, y)
    condition = partial(rules.condition, constants)
    g, rate = jax.jvp(condition, (t, y), (jnp.ones_like(t), slope))
    return g, rate, slope


def _located(
    scene: Scene,
    rules: _Rules,
    what: Search,
    layout: Layout,
    constants: Arrays,
    each: Arrays,
) -> Arrays:
    numbers = Numbers(*each)

    def project(y: Array) -> Array:
        return flat(on_the_group(unflat(y, scene.like)))

    over = lambda f: f  # noqa: E731
    if layout.bodies:
        shared = [None if s else -1 for s in layout.shared]
        over = lambda f: jax.vmap(f, (shared, -1, -1), -1)  # noqa: E731
        project = jax.vmap(project, -1, -1)
    field, flow = over(rules.field), partial(over(rules.flow), constants)
    condition = partial(over(partial(_rates, rules)), constants)
    longest = numbers.longest

    def at_any_time(t: Array, h: Array, end: Array, y: Array) -> tuple[Array, Array, Array]:
        del t, h
        return flow(end, y), jnp.zeros_like(numbers.rtol), longest

    def a_step(t: Array, h: Array, end: Array, y: Array) -> tuple[Array, Array, Array]:
        there = runge_kutta.stages(tableau, field, constants, Step(t, h, end, y))
        after = project(there.end)
        error = runge_kutta.error_estimate(tableau, sizes, h, there.slopes)
        size = error_norm(error, y, after, numbers.rtol, numbers.atol)
        size = jnp.where(jnp.isnan(size), jnp.inf, size)
        factor = jnp.clip(_SAFETY * size ** (-1 / tableau.order), _SMALLEST, _LARGEST)
        return after, size, jnp.minimum(h * factor.astype(h.dtype), longest)

    attempt, begin = at_any_time, longest
    if scene.solver is not None:
        tableau, sizes = scene.solver.tableau, leaf_sizes(scene.like)
        attempt = a_step
        run = Run(
            numbers.t0, numbers.stops, numbers.stops[:0], numbers.y0, numbers.rtol, numbers.atol,
            numbers.h0,
        )  # fmt: skip
        begin, _ = first_step(Method(tableau, field, project, None, sizes, 0), constants, run)
        begin = jnp.where(jnp.isnan(numbers.h0), begin, numbers.h0)
        begin = jnp.minimum(begin, longest)
    jumps = numbers.stops[:-1]
    earlier = jnp.nextafter(jumps, jnp.full_like(jumps, -jnp.inf))
    before = jnp.concatenate([earlier, numbers.stops[-1:]])
    motion = Motion(attempt, condition, project)
    out = crossing_loop.locate(motion, what, numbers.t0, numbers.stops, before, numbers.y0, begin)
    return list(out)


def _corrected(
    scene: Scene,
    rules: _Rules,
    what: Search,
    constants: Arrays,
    numbers: Numbers,
    found: Located,
) -> tuple[Array, Array]:
    """The times and states found as functions of all numbers."""
    there = jnp.arange(what.many, dtype=jnp.int32) < found.number
    last = jnp.max(jnp.where(there, found.times, lax.stop_gradient(numbers.t0)))
    ts = lax.stop_gradient(jnp.where(there, found.times, last))
    if scene.solver is None:
        ys = jax.vmap(lambda t: rules.flow(constants, t, numbers.y0))(ts)
    else:
        ys = _run_again(scene, rules, what, constants, numbers, ts)
    shift = partial(correction, partial(_rates, rules, constants))
    times, states = jax.vmap(shift)(ts, ys, there)
    states = jax.vmap(lambda y: flat(on_the_group(unflat(y, scene.like))))(states)
    times, states = (
        value + (a - lax.stop_gradient(a))
        for value, a in ((ts, times), (lax.stop_gradient(found.states), states))
    )
    return jnp.where(there, times, jnp.nan), jnp.where(there[:, None], states, jnp.nan)


def _run_again(
    scene: Scene, rules: _Rules, what: Search, constants: Arrays, numbers: Numbers, ts: Array
) -> Array:
    def field(t: Array, y: Any, args: Any) -> Any:
        return unflat(rules.field(constants, t, flat(y)), scene.like)

    solver: Any = scene.solver
    run = adaptive(
        solver,
        field,
        jnp.concatenate([numbers.t0[None], ts]),
        unflat(numbers.y0, scene.like),
        rtol=lax.stop_gradient(numbers.rtol),
        atol=lax.stop_gradient(numbers.atol),
        dt0=lax.stop_gradient(numbers.h0),
        max_steps=what.max_steps,
        jumps=numbers.stops[:-1],
    )
    return jax.vmap(flat)(run.ys)[1:]


def correction(rates: Callable[..., Any], t: Array, y: Array, there: Array) -> tuple[Array, Array]:
    """Time and state (n,) of the crossing near `t`, by Chebyshev's method; as they are if not
    `there`.

    **Arguments:** `rates(t, y) → (g, dg/dt, dy/dt)`.
    """
    g, rate, slope = rates(t, y)
    # These two meet only the square of what is zero: their derivatives are not wanted.
    here = lax.stop_gradient((t, y))
    _, moved = jax.jvp(rates, here, (jnp.ones_like(t), lax.stop_gradient(slope)))
    _, second, turn = lax.stop_gradient(moved)
    rate = jnp.where(there, rate, jnp.ones_like(rate))
    newton = -g / rate
    move = jnp.where(there, newton * (1 - 0.5 * newton * second / rate), jnp.zeros_like(newton))
    state = y + slope * move + 0.5 * turn * move * move
    return t + move.astype(t.dtype), state
