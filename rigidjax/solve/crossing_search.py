"""The crossings of one body: found without derivatives, then corrected with them.

A crossing at t* of g(t, y(t)) = 0 moves with every number of the scene. The motion is run again to
the times found, which are held fixed. The rest of g there and its rates ġ and g̈ along the motion
give the time and the state by one step of Chebyshev's method,

    τ = −(g/ġ)(1 + ½ g g̈/ġ²),   y = y* + f τ + ½ (df/dt) τ².

τ is zero but for the error of dense output, and its first and second derivatives are those of the
crossing (the error is of third order in what moves). At a touch, ġ = 0, there is none.

A zero of round-off, of what the motion conserves or of a component that stays at zero, is none. Its
ġ is not more than round-off makes of it, which is some ε (|∂g/∂t| + Σ |∂g/∂yᵢ| rᵢ), times the root
of the number of steps. The size rᵢ of the terms of ẏᵢ is the length of the array of the state that
i belongs to, taken of ẏ and of the change of ẏ where each y changes by the length of its array.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.body.inertia import Inertia
from rigidjax.exact.free_body import FreeMotion
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.torques.base import jumps_of
from rigidjax.solve import crossing_loop
from rigidjax.solve.adaptive import adaptive, taken_out
from rigidjax.solve.adaptive_loop import Method, Run, first_step, tried
from rigidjax.solve.batching import Arrays, Layout, in_lanes
from rigidjax.solve.components import flat, leaf_sizes, unflat
from rigidjax.solve.crossing_loop import Located, Motion, Search
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.linear_map import no_tangent
from rigidjax.solve.run import Free, Loop, ahead, equations_of_motion

# Samples of a free body's condition in one turn at its largest rate.
_SAMPLES = 16
# How many times its round-off the slope of a crossing is at least.
_CLEAR = 16


class Section(NamedTuple):
    """The section and the motion, in s = σt, which increases.

    **Fields:** `solver` `None` for the closed form; `motion(constants, s, y)` dy/ds, or the state
    itself in closed form; `rates(constants, s, y)` g, dg/ds and dy/ds; `like` a state; `sign` σ.
    """

    solver: AbstractExplicit | None
    motion: Callable[[Arrays, Array, Array], Array]
    rates: Callable[[Arrays, Array, Array], tuple[Array, Array, Array]]
    like: Any
    sign: Array

    def project(self, y: Array) -> Array:
        return flat(on_the_group(unflat(y, self.like)))

    def time(self, s: Array) -> Array:
        """Time t at s, and the other way."""
        return self.sign.astype(s.dtype) * s


# The constants of a section's functions, the run, its longest step.
Numbers = tuple[Arrays, Run, Array]


def section(
    setup: Free | Loop, condition: Callable[..., Any], max_step: Any, state0: Any, ts: Array
) -> tuple[Section, Numbers]:
    """The section `condition(t, y)` = 0 between `ts[0]` and `ts[-1]`, and what it is made of."""
    y0, dtype = flat(state0), ts.dtype
    sign = jnp.sign(ts[-1] - ts[0]).astype(jnp.int32)
    way = setup.sign if isinstance(setup, Loop) else sign
    jumps = jumps_of(setup.torque).astype(dtype)
    field: Any = equations_of_motion(setup.body, state0, setup.torque)
    field, condition, along, jumps = ahead(way, field, condition, ts[jnp.array([0, -1])], jumps)
    longest = whole = lax.stop_gradient(along[1] - along[0])
    if max_step is not None:
        longest = lax.stop_gradient(jnp.asarray(max_step, dtype))

    def slope(s: Array, y: Array) -> Array:
        return flat(field(s, unflat(y, state0), None))

    def rates(s: Array, y: Array) -> tuple[Array, Array, Array]:
        there = slope(s, y)
        of_y = lambda s, y: condition(s, unflat(y, state0))  # noqa: E731
        return *jax.jvp(of_y, (s, y), (jnp.ones_like(s), there)), there

    if isinstance(setup, Loop):
        solver, motion = setup.solver, slope
        rtol, atol = (jnp.asarray(a, y0.dtype) for a in (setup.rtol, setup.atol))
        h0 = jnp.asarray(jnp.nan if setup.dt0 is None else setup.dt0, dtype)
    else:
        solver, free = None, FreeMotion(setup.body, state0)
        motion = lambda s, _: flat(free(sign.astype(s.dtype) * s - ts[0]))  # noqa: E731
        longest = jnp.minimum(longest, _spacing(setup.body, state0, whole))
        rtol, atol, h0 = jnp.zeros((), y0.dtype), jnp.zeros((), y0.dtype), longest
    (of_motion, of_rates), constants, _ = taken_out([motion, rates], along[0], y0)
    stops = jnp.concatenate([jnp.clip(jnp.sort(jumps), along[0], along[1]), along[1:]])
    crossed = Section(solver, of_motion, of_rates, state0, sign)
    run = Run(along[0], stops, stops[:0], y0, rtol, atol, h0)
    return crossed, (constants, run, longest)


def _spacing(body: Any, state0: Any, whole: Array) -> Array:
    """A part of the time of one turn at the largest rate that energy and momentum allow."""
    inertia = body if isinstance(body, Inertia) else body.inertia
    tensor, omega = lax.stop_gradient((inertia.tensor, state0.omega))
    momentum = jnp.sum(tensor * omega[None], axis=1)
    least = jnp.linalg.eigvalsh(tensor)[0]
    by_energy = jnp.sqrt(jnp.sum(momentum * omega) / least)
    rate = jnp.minimum(by_energy, jnp.sqrt(jnp.sum(momentum**2)) / least)
    return jnp.where(rate * whole > 1, 2 * np.pi / (_SAMPLES * rate), whole / _SAMPLES)


def located(section: Section, what: Search, numbers: Numbers) -> Located:
    """The first crossings on the way through `run.stops`, without derivatives."""
    constants, run, longest = lax.stop_gradient(numbers)
    program = partial(_located, section, what)
    return Located(*in_lanes(program, constants, [*run, longest]))


def _located(
    section: Section, what: Search, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    run, longest = Run(*each[:-1]), each[-1]
    solver, project, over = section.solver, section.project, lambda f: f
    if layout.bodies:
        shared = [None if s else -1 for s in layout.shared]
        over = lambda f: jax.vmap(f, (shared, -1, -1), -1)  # noqa: E731
        project = jax.vmap(project, -1, -1)
    motion = over(section.motion)
    seen, clear = (partial(over(partial(f, section)), constants) for f in (_seen, _clear))

    def counts(s: Array, y: Array, steps: Array) -> Array:
        # The round-off of steps adds up as a random walk does.
        many = 1 if solver is None else jnp.sqrt(1 + steps.astype(y.dtype))
        return ~(clear(s, y) < _CLEAR * many)

    order, still = 1, jnp.zeros_like(run.rtol)
    attempt: Any = lambda step: (motion(constants, step.end, step.y), still)  # noqa: E731
    if solver is not None:
        method = Method(solver.tableau, motion, project, None, leaf_sizes(section.like), 0)
        h0, _ = first_step(method, constants, run)
        h0 = jnp.minimum(jnp.where(jnp.isnan(run.h0), h0, run.h0), longest)
        run = run._replace(h0=h0)
        attempt, order = partial(tried, method, constants, run), solver.tableau.order
    moving = Motion(attempt, order, longest, seen, counts, project)
    return list(crossing_loop.locate(moving, what, run))


def _lengths(like: Any, a: Array) -> Array:
    """The length of the array of a state that each number belongs to."""
    which = np.repeat(np.arange(len(leaf_sizes(like))), leaf_sizes(like))
    same = jnp.asarray(which[:, None] == which[None], a.dtype)
    return jnp.sqrt(jnp.sum(same * (a * a)[None], 1))


def _push(like: Any, y: Array) -> Array:
    """A change of each number by the length of its array, in a direction along no body's axis."""
    return jnp.asarray(np.cos(1 + np.arange(y.size)), y.dtype) * _lengths(like, y)


def _seen(section: Section, constants: Arrays, s: Array, y: Array) -> tuple[Array, ...]:
    """g, dg/ds, dy/ds, and what g may be by round-off."""
    of_g = lambda s, y: section.rates(constants, s, y)[0]  # noqa: E731
    noise = jax.jvp(of_g, (s, y), (s, _push(section.like, y)))[1]
    blur = _CLEAR * jnp.finfo(y.dtype).eps * jnp.abs(noise)
    g, rate, slope = section.rates(constants, s, y)
    return jnp.asarray(g), jnp.asarray(rate), slope, blur


def _clear(section: Section, constants: Arrays, s: Array, y: Array) -> Array:
    """The ratio of the rate of g through zero to its round-off."""
    rates, like = partial(section.rates, constants, s), section.like
    _, rate, slope = rates(y)
    shift = jax.jvp(lambda y: rates(y)[2], (y,), (_push(like, y),))[1]
    by_s, by_y = jax.jacfwd(lambda s, y: section.rates(constants, s, y)[0], (0, 1))(s, y)
    sizes = _lengths(like, slope) + _lengths(like, shift)
    terms = jnp.abs(by_s) + jnp.sum(jnp.abs(by_y) * sizes)
    return jnp.abs(rate) / (jnp.finfo(y.dtype).eps * terms)


def crossings_of(section: Section, what: Search, numbers: Numbers) -> Located:
    """As `located`; times and states are differentiable in all numbers."""
    answer: Any = jax.custom_jvp(partial(located, section, what))

    @answer.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        found = located(section, what, *primals)
        value, moved = jax.jvp(partial(_corrected, section, what, found), primals, tangents)
        rest = [no_tangent(a) for a in found[2:]]
        return Located(*value, *found[2:]), Located(*moved, *rest)  # pyright: ignore

    return answer(numbers)


def _corrected(
    section: Section, what: Search, found: Located, numbers: Numbers
) -> tuple[Array, Array]:
    """The times and states found as functions of all numbers."""
    constants, run, _ = numbers
    there = jnp.arange(what.many, dtype=jnp.int32) < found.number
    last = jnp.max(jnp.where(there, found.times, lax.stop_gradient(run.t0)))
    ts = lax.stop_gradient(jnp.where(there, found.times, last))
    if section.solver is None:
        ys = jax.vmap(lambda s: section.motion(constants, s, run.y0))(ts)
    else:
        field = lambda s, y, args: unflat(  # noqa: E731
            section.motion(constants, s, flat(y)), section.like
        )
        rtol, atol, h0 = lax.stop_gradient((run.rtol, run.atol, run.h0))
        out = adaptive(
            section.solver, field, jnp.concatenate([run.t0[None], ts]),
            unflat(run.y0, section.like), rtol=rtol, atol=atol, dt0=h0, max_steps=what.max_steps,
            jumps=run.stops[:-1],
        )  # fmt: skip
        ys = jax.vmap(flat)(out.ys)[1:]
    moved = jax.vmap(partial(correction, section, constants))(ts, ys, there)
    known = ts, lax.stop_gradient(found.states)
    times, states = (a + (b - lax.stop_gradient(b)) for a, b in zip(known, moved, strict=True))
    return jnp.where(there, times, jnp.nan), jnp.where(there[:, None], states, jnp.nan)


def correction(
    section: Section, constants: Arrays, s: Array, y: Array, there: Array
) -> tuple[Array, Array]:
    """The crossing near `s`, and the state, by Chebyshev's method; as they are if not `there`."""
    rates = partial(section.rates, constants)
    g, rate, slope = rates(s, y)
    # These two meet only the square of what is zero: their derivatives are not wanted.
    here = lax.stop_gradient((s, y))
    _, moved = jax.jvp(rates, here, (jnp.ones_like(s), lax.stop_gradient(slope)))
    _, second, turn = lax.stop_gradient(moved)
    rate = jnp.where(there, rate, jnp.ones_like(rate))
    newton = -g / rate
    move = jnp.where(there, newton * (1 - 0.5 * newton * second / rate), jnp.zeros_like(newton))
    state = y + slope * move + 0.5 * turn * move * move
    return s + move.astype(s.dtype), section.project(state)
