"""Make the fixed step of a method for a body and a torque, in a form that a loop can call.

The loop carries each number of a state as a scalar (see the module `components`); torques are
called with arrays. For a body that turns, the loop carries the momentum Π = IΩ instead of the body
rate Ω, which makes each stage a third cheaper. This does not change the results: a Runge–Kutta
method gives the same steps after a constant linear change of variables.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax._types import HasAttitude
from rigidjax.body.inertia import Inertia
from rigidjax.exact.components3 import SymmetricEntries, Triple, add, cross, half_product, matvec
from rigidjax.exact.principal_axes import combine_columns
from rigidjax.motion import Attitude, Spin
from rigidjax.motion.coupled import motion_of
from rigidjax.motion.equations import AttitudeEquations, EulerEquations
from rigidjax.motion.torques.base import evaluate_torque, may_read_attitude
from rigidjax.motion.torques.inputs import bind, delays_of
from rigidjax.rotation import quaternion
from rigidjax.rotation.barrier import barrier
from rigidjax.rotation.kernels import quaternion_product, squared_norm
from rigidjax.rotation.linalg3 import components
from rigidjax.solve.steps import splitting
from rigidjax.solve.steps.components import Atoms, join_scalars, split_scalars
from rigidjax.solve.steps.equal_steps import StepWithLoopedStages, change_in_step
from rigidjax.solve.steps.explicit import AbstractExplicit, RungeKutta4
from rigidjax.solve.steps.magnus import Magnus4, change_and_turn, refuse_attitude
from rigidjax.solve.steps.splitting import AbstractSplitting

# Runs of at least this many steps use `Carrying`, with which a run without derivatives takes a
# tenth to a third longer. In shorter runs the rounding errors are too small to justify this.
_MANY = 10_000


class Stepper(NamedTuple):
    """Hold the functions that take fixed steps of one body, from `t` to `end`, of length `h`, s.

    They work on numbers y, which stand for the state but may differ from it: they may hold the
    momentum in the place of the body rate. `inputs` are the values of the torque's inputs during
    the step, or `None`.
    """

    start: Any  # the numbers y at the start, which stand for the state there
    # change(t, end, h, y, inputs): the change of the numbers y in a step from t to end, of length
    # h.
    change: Callable[[Any, Any, Any, Any, Any], Any]
    state: Callable[[Any], Any]  # the state that the numbers y stand for
    delays: tuple[tuple[str, Array], ...] = ()  # name and delay, s, of each delayed input

    def step(self, t: Any, end: Any, h: Any, y: Any, inputs: Any) -> Any:
        return jax.tree.map(jnp.add, y, self.change(t, end, h, y, inputs))


class Carrying(NamedTuple):
    """Take the fixed steps of the stepper `of`, and carry the rounding errors of the sums along.

    Each step adds the rounding error of the sum before it to its own change, so that the round-off
    of n steps grows as √n, not as n. The error has no derivative; it is exact if |change| ≤ |y|.
    Source: Kahan 1965, doi:10.1145/363707.363723; Dekker 1971, doi:10.1007/BF01397083.
    """

    of: Stepper

    @property
    def start(self) -> tuple[Any, Any]:
        """Return the numbers at the start, and their rounding errors, which are 0."""
        return self.of.start, jax.tree.map(jnp.zeros_like, self.of.start)

    @property
    def delays(self) -> tuple[tuple[str, Array], ...]:
        return self.of.delays

    def step(self, t: Any, end: Any, h: Any, y: Any, inputs: Any) -> Any:
        y, lost = y
        change = jax.tree.map(jnp.add, self.of.change(t, end, h, y, inputs), lost)
        after = jax.tree.map(jnp.add, y, change)
        lost = jax.tree.map(lambda d, a, b: d - (b - a), change, y, after)
        return after, lax.stop_gradient(lost)

    def state(self, numbers_and_errors: tuple[Any, Any]) -> Any:
        """Return the state that the numbers stand for; their rounding errors are left out."""
        return self.of.state(numbers_and_errors[0])


AnyStepper = Stepper | Carrying


def stepper_of(solver: Any, field: Callable[..., Any], y0: Any, count: Any = 1) -> AnyStepper:
    """Return the object that takes fixed steps of a vector field `f(t, y, args)` by a method.

    `None` stands for the cheapest method. At 10 000 steps and more, and if `count` is traced, the
    result is a `Carrying`.
    """
    stepper = _stepper(solver, field, y0)._replace(delays=tuple(delays_of(field)))
    return Carrying(stepper) if not isinstance(count, int) or count >= _MANY else stepper


def cheapest_method(field: Callable[..., Any]) -> Magnus4 | RungeKutta4:
    """Return the method of order 4 that takes the least work for a vector field.

    It is `Magnus4` for an attitude whose torque does not read the attitude, else `RungeKutta4`.
    """
    blind = isinstance(field, AttitudeEquations) and not may_read_attitude(field.euler.torque)
    return Magnus4() if blind else RungeKutta4()


def _stepper(solver: Any, field: Any, y0: Any) -> Stepper:
    """Return a `Stepper` without delays; raise `TypeError` if the method cannot take such steps."""
    # A body that also moves in space, or whose torque has states of its own, is not `turning`.
    euler, turning = field.euler if isinstance(field, AttitudeEquations) else field, None
    if isinstance(euler, EulerEquations) and isinstance(y0, Spin | Attitude):
        dtype = y0.omega.dtype
        inertia = jax.tree.map(lambda a: a.astype(dtype), euler.inertia)
        turning = _Turning(inertia, _entries(euler.inverse.astype(dtype)), euler.torque)
    solver = cheapest_method(field) if solver is None else solver
    if isinstance(solver, Magnus4) and isinstance(y0, Attitude) and turning is not None:
        refuse_attitude(turning.torque)
        return (
            _free_stepper(turning.inertia, y0)
            if turning.torque is None
            else _magnus_stepper(turning, y0)
        )
    if isinstance(solver, AbstractSplitting):
        return _splitting_stepper(solver, field, y0)
    if not isinstance(solver, AbstractExplicit | StepWithLoopedStages):
        raise TypeError(
            f"no fixed steps of {type(solver).__name__} on {type(y0).__name__}; wanted "
            "RungeKutta4, Tsitouras5 or DormandPrince8 of rigidjax.solvers, or, for an Attitude, "
            "Magnus4 or a Splitting of rigidjax.solvers; for others use simulate with "
            "stepsize_controller=diffrax.ConstantStepSize() under jax.vmap"
        )
    if turning is not None:
        return _explicit_stepper(solver, turning, y0)

    def slope_under(inputs: Any) -> Callable[[Any, Atoms], Atoms]:
        return lambda t, y: split_scalars(bind(field, inputs)(t, join_scalars(y, y0), None))

    start = split_scalars(y0)
    return _stepper_of_slope(solver, slope_under, start, lambda y: join_scalars(y, y0), y0)


class _Turning(NamedTuple):
    """Hold inertia and torque of a body that only turns, in the dtype of the body rate."""

    inertia: Inertia
    weights: SymmetricEntries  # the six different entries of the inverse of the inertia, 1/(kg m²)
    torque: Any  # the torque law, or `None` for a free body


def _free_stepper(body: Inertia, state0: Attitude) -> Stepper:
    """Return the steps of a free body by Magnus' method of order 4.

    The numbers are the quaternion of the turn since the start, and the momentum Π, both along the
    principal axes. Derivatives hold these axes fixed: the off-diagonal entries of the inertia along
    them are zero, but have tangents.
    """
    frame = splitting.principal_frame(body.tensor)
    weights, axes = frame.weights, frame.axes
    a, b, c, *_ = lax.stop_gradient(weights)
    gaps = (c - b, a - c, b - a)
    momentum = splitting.momentum_along(frame, state0.omega)
    one, none = jnp.ones_like(a), jnp.zeros_like(a)

    def change(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        slope = lambda _, p: _free_slope(weights, gaps, p)  # noqa: E731
        dp, turn = change_and_turn(slope, partial(splitting.rate_along, weights), t, end, h, y[4:])
        return (*quaternion_product(y[:4], turn), *dp)

    def state(y: Atoms) -> Attitude:
        # y[:4] is the quaternion of the turn since the start, with its vector along the principal
        # axes; `combine_columns` gives the vector in body axes.
        turn = jnp.stack([y[0], *combine_columns(axes, y[1:4])])
        q = quaternion.normalise(quaternion.multiply(state0.q, turn))
        return Attitude(q, splitting.rate_in_body(frame, y[4:]))

    return Stepper((one, none, none, none, *momentum), change, state)


@jax.custom_jvp
def _free_slope(inverse: SymmetricEntries, inverse_differences: Triple, momentum: Triple) -> Triple:
    """Return the time derivative of the momentum of a free body along its principal axes, Π × Ω.

    `inverse_differences` (c − b, a − c, b − a) are those of the diagonal a, b, c of I⁻¹.
    """
    d, p = inverse_differences, momentum
    return d[0] * (p[1] * p[2]), d[1] * (p[2] * p[0]), d[2] * (p[0] * p[1])


@_free_slope.defjvp
def _free_slope_jvp(primals, tangents):
    (weights, gaps, p), (dw, _, dp) = primals, tangents
    rate, turning = splitting.rate_along_jvp((weights, p), (dw, dp))
    return _free_slope(weights, gaps, p), add(cross(dp, rate), cross(p, turning))


def _entries(a: Array) -> SymmetricEntries:
    """Return the entries 11, 22, 33, 12, 13, 23 of a symmetric matrix (3, 3)."""
    # Both halves of the matrix are used, so that the derivative is symmetric as the matrix is.
    off = [0.5 * (a[i, j] + a[j, i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return a[0, 0], a[1, 1], a[2, 2], *off


def _magnus_stepper(turning: _Turning, state0: Attitude) -> Stepper:
    """Return steps by Magnus' method under a torque that reads the time and the body rate.

    The numbers are the quaternion and the angular momentum in body axes.
    """
    body, weights, torque = turning
    start, rate = split_scalars(state0), partial(matvec, weights)

    def change(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        law = bind(torque, inputs)

        def slope(t: Any, p: Triple) -> Triple:
            omega = barrier(rate(p))
            # The torque does not read the attitude. It therefore gets a `Spin`, a state without an
            # attitude.
            value = evaluate_torque(law, t, Spin(jnp.stack(omega)), body)
            return add(cross(p, omega), split_scalars(value))

        dp, turn = change_and_turn(slope, rate, t, end, h, y[4:])
        return (*quaternion_product(y[:4], turn), *dp)

    def state(y: Atoms) -> Attitude:
        return Attitude(quaternion.normalise(jnp.stack(y[:4])), jnp.stack(rate(y[4:])))

    return Stepper((*start[:4], *matvec(_entries(body.tensor), start[4:])), change, state)


def _explicit_stepper(
    solver: AbstractExplicit | StepWithLoopedStages, turning: _Turning, state0: Any
) -> Stepper:
    """Return steps of an explicit method for a body that only turns, a `Spin` or an `Attitude`.

    The numbers are the quaternion, if any, and the angular momentum in body axes.
    """
    body, weights, torque = turning
    start = split_scalars(state0)
    many = len(start) - 3

    def slope_for_inputs(inputs: Any) -> Callable[[Any, Atoms], Atoms]:
        law = bind(torque, inputs)

        def slope(t: Any, y: Atoms) -> Atoms:
            q, p = y[:many], y[many:]
            # The derivatives of attitude and momentum both use the body rate `omega`. Without the
            # barrier XLA would compute it again for each of the seven results.
            omega = barrier(matvec(weights, p))
            pushed = cross(p, omega)
            if law is not None:
                value = evaluate_torque(law, t, join_scalars((*q, *omega), state0), body)
                pushed = add(pushed, split_scalars(value))
            return (*half_product(q, omega), *pushed) if many else pushed

        return slope

    def state(y: Atoms) -> Any:
        return join_scalars((*y[:many], *matvec(weights, y[many:])), state0)

    momentum = matvec(_entries(body.tensor), start[many:])
    return _stepper_of_slope(solver, slope_for_inputs, (*start[:many], *momentum), state, state0)


def _stepper_of_slope(
    solver: AbstractExplicit | StepWithLoopedStages,
    slope_for_inputs: Callable[[Any], Callable[[Any, Atoms], Atoms]],
    start: Atoms,
    state: Callable[[Atoms], Any],
    example_state: Any,
) -> Stepper:
    """Return the `Stepper` of an explicit method for a slope `slope_for_inputs(inputs)(t, y)`.

    `example_state` has as many numbers as y, in the same order, and shows which are a quaternion.
    """

    def change(t: Any, end: Any, h: Any, y: Atoms, inputs: Any) -> Atoms:
        change = change_in_step(solver, slope_for_inputs(inputs), t, h, y, end)
        if not isinstance(motion_of(example_state), HasAttitude):
            return change
        # Without the barrier XLA would compute the whole change again for each part of the
        # quaternion.
        change = barrier(change)
        after, moved = (
            components(motion_of(join_scalars(part, example_state)).q)
            for part in (jax.tree.map(jnp.add, y, change), change)
        )
        # q is the quaternion after the step. The difference |q|² − 1, the excess, has few correct
        # digits. Its rounding error is harmless, because it only changes the length of q and does
        # not turn the body.
        excess = jnp.minimum(squared_norm(after) - 1.0, 1.0)
        # 1 − 1/√(1 + e), with the excess e, is computed by a series, because on a GPU a root and a
        # quotient take a third of the time of a step. The error e⁴/4 of the series is below
        # round-off for steps that turn the body by less than half a radian; after a longer step the
        # following steps bring the length back to 1.
        less = barrier(excess * (0.5 - excess * (0.375 - 0.3125 * excess)))
        q = jnp.stack([d - less * a for d, a in zip(moved, after, strict=True)])
        return split_scalars(
            eqx.tree_at(lambda s: motion_of(s).q, join_scalars(change, example_state), q)
        )

    return Stepper(start, change, state)


def _splitting_stepper(solver: AbstractSplitting, field: Any, state0: Any) -> Stepper:
    """Return steps of a splitting: free motions and kicks in turn.

    The numbers are the quaternion, and the angular momentum along the principal axes.
    """
    # The momentum Π is carried from step to step, along the principal axes. No step converts Π to Ω
    # = I⁻¹Π and back, so that |Π| drifts only by the round-off of the free motion.
    frame = splitting.frame_of_field(field, state0)

    def change(t: Any, end: Any, h: Any, y: Any, inputs: Any) -> Any:
        return splitting.splitting_change(solver.composition, bind(field, inputs), frame, t, h, y)

    def state(y: Any) -> Attitude:
        return Attitude(quaternion.normalise(y[0]), splitting.rate_in_body(frame, y[1]))

    return Stepper((state0.q, splitting.momentum_along(frame, state0.omega)), change, state)
