"""A fixed step of a method, a body and a torque: their interface to a loop.

The numbers are carried one by one (see `components`); torques are called on arrays all the same:
XLA sees through the stacks and slices between.

A body that turns carries the momentum Π = IΩ instead of Ω, which makes each stage a third cheaper.
Runge–Kutta methods do not notice a constant linear change of variables, so these are the steps that
`diffrax` takes with the same solver, to round-off.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.body.inertia import Inertia
from rigidjax.exact.components3 import Six, Triple, cross, half_product, plus, times
from rigidjax.exact.principal_axes import out_of
from rigidjax.motion import Attitude, Spin
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, on_the_group
from rigidjax.motion.torques.base import evaluate, sees_attitude
from rigidjax.motion.torques.inputs import bind, delays_of
from rigidjax.rotation import quaternion
from rigidjax.rotation.barrier import barrier
from rigidjax.solve import splitting
from rigidjax.solve.components import Atoms, join, split
from rigidjax.solve.equal_steps import Rolled, end_of_step
from rigidjax.solve.explicit import AbstractExplicit, RungeKutta4
from rigidjax.solve.magnus import Magnus4, require_blind, turned
from rigidjax.solve.splitting import AbstractSplitting


class Stepper(NamedTuple):
    """A step of one body."""

    start: Any  # numbers y
    step: Callable[[Any, Any, Any, Any, Any], Any]  # (t, end, h, y, inputs of the law or None)
    state: Callable[[Any], Any]  # of y
    delays: tuple[tuple[str, Array], ...] = ()  # name and delay, s, of each delayed input


def stepper_of(solver: Any, field: Callable[..., Any], y0: Any) -> Stepper:
    """The stepper of a vector field under `solver`, or, for `None`, the cheapest that is right."""
    return _stepper_of(solver, field, y0)._replace(delays=tuple(delays_of(field)))


def cheapest(field: Callable[..., Any]) -> Magnus4 | RungeKutta4:
    """The method of order 4 that takes the least work."""
    attitude = isinstance(field, AttitudeEquations)
    blind = attitude and not sees_attitude(field.euler.torque)
    return Magnus4() if blind else RungeKutta4()


def _stepper_of(solver: Any, field: Callable[..., Any], y0: Any) -> Stepper:
    turning = _turning(field, y0)
    solver = cheapest(field) if solver is None else solver
    if isinstance(solver, Magnus4) and isinstance(y0, Attitude) and turning is not None:
        require_blind(turning.torque)
        return _free(turning.inertia, y0) if turning.torque is None else _magnus(turning, y0)
    if isinstance(solver, AbstractSplitting):
        return _split(solver, field, y0)
    if not isinstance(solver, AbstractExplicit | Rolled):
        raise TypeError(
            f"no fixed steps of {type(solver).__name__} on {type(y0).__name__}; wanted "
            "RungeKutta4, Tsitouras5 or DormandPrince8 of rigidjax.solvers, or, for an Attitude, "
            "Magnus4 or a Splitting of rigidjax.solvers; for others use simulate with "
            "stepsize_controller=diffrax.ConstantStepSize() under jax.vmap"
        )
    return _general(solver, field, y0) if turning is None else _explicit(solver, turning, y0)


class _Turning(NamedTuple):
    """Inertia, its inverse (six numbers each) and the torque, in the precision of the state."""

    inertia: Inertia
    weights: Six
    torque: Any


def _turning(field: Any, y0: Any) -> _Turning | None:
    euler = field.euler if isinstance(field, AttitudeEquations) else field
    if not isinstance(euler, EulerEquations) or not isinstance(y0, Spin | Attitude):
        return None
    dtype = y0.omega.dtype
    inertia = jax.tree.map(lambda a: a.astype(dtype), euler.inertia)
    return _Turning(inertia, _entries(euler.inverse.astype(dtype)), euler.torque)


def _free(body: Inertia, state0: Attitude) -> Stepper:
    """Principal axes, held fixed in derivatives: the off-diagonal entries carry only tangents."""
    frame = splitting.principal(body.tensor)
    weights, axes = frame.weights, frame.axes
    a, b, c, *_ = lax.stop_gradient(weights)
    gaps = (c - b, a - c, b - a)
    momentum = splitting.enter(frame, state0.omega)
    one, none = jnp.ones_like(a), jnp.zeros_like(a)

    def step(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        slope = lambda _, p: _free_slope(weights, gaps, p)  # noqa: E731
        q, p = turned(slope, partial(splitting.rate_of, weights), t, end, h, y[:4], y[4:])
        return (*q, *p)

    def state(y: Atoms) -> Attitude:
        # The numbers are the turn since the start, seen from the axes: Aᵀ…A turns its vector.
        turn = jnp.stack([y[0], *out_of(axes, y[1:4])])
        return Attitude(quaternion.multiply(state0.q, turn), splitting.leave(frame, y[4:]))

    return Stepper((one, none, none, none, *momentum), step, state)


@jax.custom_jvp
def _free_slope(weights: Six, gaps: Triple, p: Triple) -> Triple:
    """Π × Ω in principal axes."""
    return gaps[0] * (p[1] * p[2]), gaps[1] * (p[2] * p[0]), gaps[2] * (p[0] * p[1])


@_free_slope.defjvp
def _free_slope_jvp(primals, tangents):
    (weights, gaps, p), (dw, _, dp) = primals, tangents
    rate, turning = splitting.rate_of_jvp((weights, p), (dw, dp))
    return _free_slope(weights, gaps, p), plus(cross(dp, rate), cross(p, turning))


def _entries(a: Array) -> Six:
    # Both halves, so that the derivative is symmetric as the matrix is.
    off = [0.5 * (a[i, j] + a[j, i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return a[0, 0], a[1, 1], a[2, 2], *off


def _magnus(turning: _Turning, state0: Attitude) -> Stepper:
    body, weights, torque = turning
    start, rate = split(state0), partial(times, weights)

    def step(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        law = bind(torque, inputs)

        def slope(t: Any, p: Triple) -> Triple:
            omega = barrier(rate(p))
            # It gets no attitude that it could look at.
            value = evaluate(law, t, Spin(jnp.stack(omega)), body)
            return plus(cross(p, omega), split(value))

        q, p = turned(slope, rate, t, end, h, y[:4], y[4:])
        return (*q, *p)

    def state(y: Atoms) -> Attitude:
        return Attitude(jnp.stack(y[:4]), jnp.stack(rate(y[4:])))

    return Stepper((*start[:4], *times(_entries(body.tensor), start[4:])), step, state)


def _explicit(solver: AbstractExplicit | Rolled, turning: _Turning, state0: Any) -> Stepper:
    body, weights, torque = turning
    start = split(state0)
    many = len(start) - 3

    def slope_under(inputs: Any) -> Callable[[Any, Atoms], Atoms]:
        law = bind(torque, inputs)

        def slope(t: Any, y: Atoms) -> Atoms:
            q, p = y[:many], y[many:]
            # Shared by attitude and momentum; fenced: else each of seven results computes it again.
            omega = barrier(times(weights, p))
            pushed = cross(p, omega)
            if law is not None:
                value = evaluate(law, t, join((*q, *omega), state0), body)
                pushed = plus(pushed, split(value))
            return (*half_product(q, omega), *pushed) if many else pushed

        return slope

    def state(y: Atoms) -> Any:
        return join((*y[:many], *times(weights, y[many:])), state0)

    momentum = times(_entries(body.tensor), start[many:])
    return _of_slope(solver, slope_under, (*start[:many], *momentum), state, state0)


def _general(solver: AbstractExplicit | Rolled, field: Callable[..., Any], state0: Any) -> Stepper:
    def slope_under(inputs: Any) -> Callable[[Any, Atoms], Atoms]:
        here = bind(field, inputs)
        return lambda t, y: split(here(t, join(y, state0), None))

    return _of_slope(solver, slope_under, split(state0), lambda y: join(y, state0), state0)


def _of_slope(solver: Any, slope_under: Any, start: Atoms, state: Any, like: Any) -> Stepper:
    def step(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        after = end_of_step(solver, slope_under(inputs), t, h, y, end)
        return split(on_the_group(join(after, like)))

    return Stepper(start, step, state)


def _split(solver: AbstractSplitting, field: Any, state0: Any) -> Stepper:
    # No step goes through Ω = I⁻¹Π and back, so that |Π| drifts by round-off of the flow alone.
    frame = splitting.frame_of(field, state0)

    def step(t: Any, end: Any, h: Any, y: Any, inputs: Any) -> Any:
        return splitting.compose(solver.composition, bind(field, inputs), frame, t, h, y)

    def state(y: Any) -> Attitude:
        return Attitude(y[0], splitting.leave(frame, y[1]))

    return Stepper((state0.q, splitting.enter(frame, state0.omega)), step, state)
