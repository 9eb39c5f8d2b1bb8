"""One body of a batch as numbers: where it starts, its step, and the way back to a state.

The steps carry the momentum Π = IΩ in the place of Ω. Runge–Kutta methods do not notice a constant
linear change of variables, so these are the steps that `diffrax` takes with the same solver, to
round-off; and each of their stages is a third cheaper.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.batch.validation import start_of
from rigidjax.body.inertia import Inertia, inverse
from rigidjax.exact.components3 import (
    Six,
    Triple,
    adjugate,
    cross,
    determinant,
    half_product,
    times,
)
from rigidjax.exact.principal_axes import into, out_of, principal_frame
from rigidjax.motion import Attitude, Rigid, Spin, on_the_group
from rigidjax.motion.torques import evaluate
from rigidjax.rotation import quaternion
from rigidjax.solve import equations_of_motion
from rigidjax.solve.components import join, split
from rigidjax.solve.explicit import AbstractExplicit, Atoms, RungeKutta4, advance
from rigidjax.solve.magnus import Magnus4, require_blind, sees_attitude, turned
from rigidjax.solve.scalarise import scalarise
from rigidjax.special.barrier import barrier

Torque = Callable[[Any, Atoms], Triple]


class Lane(NamedTuple):
    """A body: numbers to start from, `step(t, end, h, y)`, and `state(y)` of such numbers."""

    start: Atoms
    step: Callable[[Any, Any, Any, Atoms], Atoms]
    state: Callable[[Atoms], Any]


def lane_of(body: Any, state0: Any, torque: Any, t0: Array, solver: Any) -> Lane:
    """The body's lane under `solver`, or under the cheapest that is right.

    **Raises:** `TypeError` for a solver that there is no lean step of.
    """
    state0 = start_of(state0)
    if isinstance(state0, Rigid):
        return _rigid(RungeKutta4() if solver is None else solver, body, state0, torque, t0)
    wide = Attitude([1.0, 0.0, 0.0, 0.0], state0.omega) if isinstance(state0, Spin) else state0
    if solver is None:
        blind = torque is None or not sees_attitude(torque, t0, wide, body)
        solver = Magnus4() if blind and isinstance(state0, Attitude) else RungeKutta4()
    if isinstance(solver, Magnus4) and isinstance(state0, Attitude):
        require_blind(torque, t0, state0, body)
        if torque is None:
            return _free(body, state0)
        return _magnus(body, state0, torque, t0)
    if not isinstance(solver, AbstractExplicit):
        raise TypeError(
            f"rollout: no lean step of {type(solver).__name__} on {type(state0).__name__}; wanted "
            "RungeKutta4, Tsitouras5 or DormandPrince8 of rigidjax.solvers, or, for an Attitude, "
            "Magnus4 of rigidjax.solvers; for others use simulate with stepsize_controller="
            "diffrax.ConstantStepSize() under jax.vmap"
        )
    return _explicit(solver, body, state0, torque, t0)


def _free(body: Inertia, state0: Attitude) -> Lane:
    """Principal axes, held fixed in derivatives: the off-diagonal entries carry only tangents."""
    six, axes = principal_frame(body.tensor)
    # Relative to the trace first: the cube of 1e37 kg m² is no number.
    size = six[0] + six[1] + six[2]
    unit: Six = tuple(i / size for i in six)
    scale = determinant(unit)
    weights: Six = tuple(c / scale / size for c in adjugate(unit))
    a, b, c, *_ = lax.stop_gradient(weights)
    gaps = (c - b, a - c, b - a)
    momentum = times(six, into(axes, state0.omega))
    one, none = jnp.ones_like(a), jnp.zeros_like(a)

    def step(t: Any, end: Any, h: Any, y: Atoms) -> Atoms:
        q, p = turned(
            lambda _, p: _free_slope(weights, gaps, p),
            lambda p: _free_rate(weights, p),
            t, end, h, y[:4], y[4:],
        )  # fmt: skip
        return (*q, *p)

    def state(y: Atoms) -> Attitude:
        # The numbers are the turn since the start, seen from the axes: Aᵀ…A turns its vector.
        omega = jnp.stack(out_of(axes, _free_rate(weights, y[4:])))
        turn = jnp.stack([y[0], *out_of(axes, y[1:4])])
        return Attitude(quaternion.multiply(state0.q, turn), omega)

    return Lane((one, none, none, none, *momentum), step, state)


@jax.custom_jvp
def _free_rate(weights: Six, p: Triple) -> Triple:
    """Ω of Π in principal axes."""
    return weights[0] * p[0], weights[1] * p[1], weights[2] * p[2]


@_free_rate.defjvp
def _free_rate_jvp(primals, tangents):
    (weights, p), (dw, dp) = primals, tangents
    moved = zip(_free_rate(weights, dp), times(dw, p), strict=True)
    return _free_rate(weights, p), tuple(a + b for a, b in moved)


@jax.custom_jvp
def _free_slope(weights: Six, gaps: Triple, p: Triple) -> Triple:
    """Π × Ω in principal axes."""
    return gaps[0] * (p[1] * p[2]), gaps[1] * (p[2] * p[0]), gaps[2] * (p[0] * p[1])


@_free_slope.defjvp
def _free_slope_jvp(primals, tangents):
    (weights, gaps, p), (dw, _, dp) = primals, tangents
    rate, turning = _free_rate_jvp((weights, p), (dw, dp))
    moved = zip(cross(dp, rate), cross(p, turning), strict=True)
    return _free_slope(weights, gaps, p), tuple(a + b for a, b in moved)


def _entries(a: Array) -> Six:
    # Both halves, so that the derivative is symmetric as the matrix is.
    off = [0.5 * (a[i, j] + a[j, i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return a[0, 0], a[1, 1], a[2, 2], *off


def _magnus(body: Inertia, state0: Attitude, torque: Any, t0: Array) -> Lane:
    weights = _entries(inverse(body.tensor))
    law = _law(torque, body, state0, t0)
    start = split(state0)

    def rate(p: Triple) -> Triple:
        return times(weights, p)

    def step(t: Any, end: Any, h: Any, y: Atoms) -> Atoms:
        q = y[:4]

        def slope(t: Any, p: Triple) -> Triple:
            omega = barrier(rate(p))
            return _sum(cross(p, omega), law(t, (*q, *omega)))

        q, p = turned(slope, rate, t, end, h, q, y[4:])
        return (*q, *p)

    def state(y: Atoms) -> Attitude:
        return Attitude(jnp.stack(y[:4]), jnp.stack(rate(y[4:])))

    return Lane((*start[:4], *times(_entries(body.tensor), start[4:])), step, state)


def _explicit(solver: AbstractExplicit, body: Inertia, state0: Any, torque: Any, t0: Array) -> Lane:
    weights = _entries(inverse(body.tensor))
    law = None if torque is None else _law(torque, body, state0, t0)
    project = scalarise(on_the_group, state0)
    start = split(state0)
    many = len(start) - 3

    def field(t: Any, y: Atoms) -> Atoms:
        q, p = y[:many], y[many:]
        # Shared by attitude and momentum; fenced, lest each of seven results work it out again.
        omega = barrier(times(weights, p))
        slope = cross(p, omega)
        if law is not None:
            slope = _sum(slope, law(t, (*q, *omega)))
        return (*half_product(q, omega), *slope) if many else slope

    def step(t: Any, end: Any, h: Any, y: Atoms) -> Atoms:
        return project(*advance(solver.tableau, field, t, h, y, end)[0])

    def state(y: Atoms) -> Any:
        return join((*y[:many], *times(weights, y[many:])), state0)

    momentum = times(_entries(body.tensor), start[many:])
    return Lane((*start[:many], *momentum), step, state)


def _rigid(solver: Any, body: Any, state0: Rigid, torque: Any, t0: Array) -> Lane:
    if not isinstance(solver, AbstractExplicit):
        raise TypeError(
            f"rollout: no lean step of {type(solver).__name__} on Rigid; wanted RungeKutta4, "
            "Tsitouras5 or DormandPrince8 of rigidjax.solvers"
        )
    field = equations_of_motion(body, state0, torque)
    numbers = scalarise(lambda t, y: field(t, y, None), t0, state0)
    project = scalarise(on_the_group, state0)

    def step(t: Any, end: Any, h: Any, y: Atoms) -> Atoms:
        raw, _, _ = advance(solver.tableau, lambda t, y: numbers(t, *y), t, h, y, end)
        return project(*raw)

    return Lane(split(state0), step, lambda y: join(y, state0))


def _law(torque: Any, body: Inertia, state0: Any, t0: Array) -> Torque:
    """The torque (3 numbers) of the time and the state's numbers."""
    numbers = scalarise(lambda t, y: evaluate(torque, t, y, body), t0, state0)
    return lambda t, y: barrier(numbers(t, *y))


def _sum(a: Triple, b: Triple) -> Triple:
    return tuple(x + y for x, y in zip(a, b, strict=True))
