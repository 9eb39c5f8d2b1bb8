"""Solve the rotation of a body by splitting: exact free motion, and kicks of the momentum.

A step is the sequence `B(b1) A(a1) B(b2) … A(a1) B(b1)`, which is the same from left to right as
from right to left. `A(a)` is the motion of the free body in closed form (`rigidjax.exact`) during
the time a h, where h is the length of the step. `B(b)` is a kick: it adds b h τ(t, q) to the
momentum Π, where τ is the torque at the time t and the attitude q, while q stays fixed. Both A and
B are exact flows of a Hamiltonian.
"""

from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, PyTree

from rigidjax._types import RealLike
from rigidjax.exact.components3 import (
    SymmetricEntries,
    Triple,
    add,
    adjugate,
    change_unrotated,
    determinant,
    matvec,
)
from rigidjax.exact.derivatives import free_motion
from rigidjax.exact.diffrax_solver import field_and_direction
from rigidjax.exact.principal_axes import (
    combine_columns,
    components_along,
    principal_axes,
)
from rigidjax.motion import Attitude
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques.base import evaluate_torque, may_read_rate
from rigidjax.rotation import quaternion
from rigidjax.solve.steps.explicit import (
    NestedInterpolation,
    cubic_coefficients,
    direction_and_length,
)
from rigidjax.solve.steps.magnus import attitude_equations
from rigidjax.solve.steps.tableaus import parse_numbers


class Composition(NamedTuple):
    """Hold a splitting method by its order and its weights, `flows` a1, a2, … and `kicks` b1, …."""

    order: int
    flows: tuple[float, ...]
    kicks: tuple[float, ...]


def _symmetric_composition(
    order: int, flows: tuple[float, ...], kicks: tuple[float, ...]
) -> Composition:
    """Return a symmetric splitting from the first of its weights.

    The middle weights follow because the weights of each kind sum up to 1.
    """
    if len(flows) < len(kicks):
        middle = 1 - 2 * sum(kicks)
        flows = (*flows, 0.5 - sum(flows))
        return Composition(order, (*flows, *flows[::-1]), (*kicks, middle, *kicks[::-1]))
    middle = 1 - 2 * sum(flows)
    kicks = (*kicks, 0.5 - sum(kicks))
    return Composition(order, (*flows, middle, *flows[::-1]), (*kicks, *kicks[::-1]))


# Half a kick, a free motion and half a kick: Strang 1968, doi:10.1137/0705041.
STRANG = Composition(2, (1.0,), (0.5, 0.5))
# Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, methods SRKN6b and SRKN11b. These methods
# are for kicks B that commute with [B, [B, A]], where [·, ·] is the commutator. This holds here,
# because B and [B, [B, A]] both change only the momentum, by a function of the attitude.
SRKN6 = _symmetric_composition(
    4,
    parse_numbers("0.245298957184271 0.604872665711080"),
    parse_numbers("0.0829844064174052 0.396309801498368 -0.0390563049223486"),
)
SRKN11 = _symmetric_composition(
    6,
    parse_numbers("""
    0.123229775946271 0.290553797799558 -0.127049212625417 -0.246331761062075 0.357208872795928
    """),
    parse_numbers("""
    0.0414649985182624 0.198128671918067 -0.0400061921041533 0.0752539843015807 -0.0115113874206879
    """),
)


class PrincipalFrame(NamedTuple):
    """Hold the principal axes of a body, and the inertia and its inverse along these axes.

    The off-diagonal entries are zero, but have tangents: derivatives hold the axes fixed.
    """

    moments: SymmetricEntries  # the inertia, kg m²
    weights: SymmetricEntries  # the inverse of the inertia, 1/(kg m²)
    axes: Array  # (3, 3), the axes as columns


def principal_frame(tensor: Array) -> PrincipalFrame:
    """Return the principal axes of an inertia (3, 3), kg m²."""
    six, axes = principal_axes(tensor)
    # The tensor is divided by its trace before it is inverted, because the determinant of an
    # inertia of 1e37 kg m² would overflow.
    size = six[0] + six[1] + six[2]
    unit: SymmetricEntries = tuple(i / size for i in six)
    scale = determinant(unit)
    return PrincipalFrame(six, tuple(c / scale / size for c in adjugate(unit)), axes)


@jax.custom_jvp
def rate_along(inverse: SymmetricEntries, momentum: Triple) -> Triple:
    """Return the body rate Ω = I⁻¹Π along the principal axes.

    The value does not use the off-diagonal entries of I⁻¹, which are zero; the derivative does.
    """
    return inverse[0] * momentum[0], inverse[1] * momentum[1], inverse[2] * momentum[2]


@rate_along.defjvp
def rate_along_jvp(primals, tangents):
    (weights, p), (dw, dp) = primals, tangents
    return rate_along(weights, p), add(rate_along(weights, dp), matvec(dw, p))


class AbstractSplitting(dfx.AbstractSolver):
    """Solve the rotation of a body by a sequence of kicks and exact free motions."""

    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = NestedInterpolation
    composition: eqx.AbstractClassVar[Composition]

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        return self.composition.order

    def init(
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, t1: RealLike, y0: PyTree, args: PyTree
    ) -> PrincipalFrame:
        return frame_of_field(field_and_direction(terms)[0], y0)

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: PrincipalFrame,
        made_jump: Bool[ArrayLike, ""],
    ) -> Any:
        field, way = field_and_direction(terms)
        state, h = (y0.q, momentum_along(solver_state, y0.omega)), jnp.asarray(t1 - t0) * way
        dq, dp = splitting_change(
            self.composition, field, solver_state, jnp.asarray(t0) * way, h, state
        )
        # Only the change of the momentum is converted to a change of the body rate Ω. To convert
        # the momentum itself would give I⁻¹(IΩ), which differs from Ω by a rounding error that is
        # the same in each step and would add up.
        omega = y0.omega + rate_in_body(solver_state, dp)
        y1 = Attitude(quaternion.normalise(y0.q + dq), omega)
        dense = dict(y0=y0, coefficients=_quintic(terms, t0, t1, args, y0, y1))
        return y1, None, dense, solver_state, dfx.RESULTS.successful

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)


class Splitting2(AbstractSplitting):
    """Solve the rotation to order 2 by half a kick, the exact free motion, and half a kick.

    This solver is for long runs with fixed steps, under torques that are small against the free
    motion and depend on time and attitude, not on the body rate. With fixed steps the error of the
    energy stays bounded; with an adaptive controller it does not. There is no error estimate.
    Within a step (dense output) the attitudes are unit quaternions, and are accurate to the order
    of the method.

    Source: Strang's splitting (1968), doi:10.1137/0705041, with the free flow of
    `rigidjax.exact.free_body`.

    >>> import diffrax
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> term = diffrax.ODETerm(field)
    >>> diffrax.diffeqsolve(term, Splitting2(), 0.0, 1.0, 0.5, start).ys.q[0, 3]
    Array(0.47942554, dtype=float64)
    """

    composition: ClassVar[Composition] = STRANG


class Splitting4(AbstractSplitting):
    """Solve the rotation to order 4 by seven kicks and six exact free motions in each step.

    A kick is a sudden change of the momentum by the torque. This solver is for long runs with fixed
    steps, under torques that are small against the free motion and depend on time and attitude, not
    on the body rate.

    Source: Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, method SRKN6b.

    >>> Splitting4().order(None)
    4
    """

    composition: ClassVar[Composition] = SRKN6


class Splitting6(AbstractSplitting):
    """Solve the rotation to order 6 by twelve kicks and eleven exact free motions in each step.

    A kick is a sudden change of the momentum by the torque. This solver is for long runs with fixed
    steps, under torques that are small against the free motion and depend on time and attitude, not
    on the body rate.

    Source: Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, method SRKN11b.

    >>> Splitting6().order(None)
    6
    """

    composition: ClassVar[Composition] = SRKN11


def frame_of_field(field: Any, y0: Any) -> PrincipalFrame:
    """Return the principal axes of the body of a vector field, in the dtype of `y0`.

    Raise `TypeError` unless it is an `AttitudeEquations` of a torque that reads no body rate.
    """
    # A torque that reads the body rate is refused, because a kick would then be no exact flow, and
    # the order of the method would fall to 1.
    torque = attitude_equations("Splitting", field, y0, "DormandPrince8").euler.torque
    if may_read_rate(torque):
        raise TypeError(
            f"Splitting: the torque {type(torque).__name__} depends on the body rate (damping, a "
            "flywheel), or does not say that it does not; only time and attitude may enter a kick: "
            "a law of your own says so by rate_free = True; for others use DormandPrince8"
        )
    return principal_frame(field.euler.inertia.tensor.astype(y0.omega.dtype))


def momentum_along(frame: PrincipalFrame, omega: Array) -> Triple:
    """Return the momentum Π = IΩ along the principal axes, N m s, from Ω in body axes, rad/s."""
    return matvec(frame.moments, components_along(frame.axes, omega))


def rate_in_body(frame: PrincipalFrame, momentum: Triple) -> Array:
    """Return the body rate Ω = I⁻¹Π in body axes (3,), rad/s."""
    return jnp.stack(combine_columns(frame.axes, rate_along(frame.weights, momentum)))


def splitting_change(
    composition: Composition,
    field: AttitudeEquations,
    frame: PrincipalFrame,
    t: Any,
    h: Any,
    state: Any,
) -> tuple[Array, Triple]:
    """Return the change of q, not scaled to length 1, and of Π in one step from `state` (q, Π).

    Π has components along the principal axes.
    """
    dtype = state[0].dtype

    def kicked(t: Any, weight: Any, q: Array, change: Triple) -> Triple:
        if field.euler.torque is None:
            return change
        # The torque has declared that it does not read the body rate. It gets NaN as the body rate,
        # so that the result is NaN if the torque reads it nevertheless.
        at = Attitude(q, jnp.full(3, jnp.nan, dtype))
        torque = components_along(
            frame.axes, evaluate_torque(field.euler.torque, t, at, field.euler.inertia)
        )
        return add(change, tuple(weight * a for a in torque))

    # A stage is a free motion and the kick after it. The stages are computed in a loop, because up
    # to eleven copies of the free motion would take long to compile.
    def stage(carry: Any, weights: tuple[Array, Array]) -> tuple[Any, None]:
        t, dq, change = carry
        drift, kick = weights
        length = drift.astype(dtype)
        momentum = add(state[1], change)
        _, (w, x, y, z) = free_motion(frame.moments, momentum, length)
        # The components of the momentum along the body axes change, because the axes turn. Only the
        # change is computed and added, so that the rounding error of |Π| is that of the change,
        # which is small.
        change = add(change, change_unrotated((w, x, y, z), momentum))
        turn = jnp.stack(
            [-(x * x + y * y + z * z) / (1 + w), *combine_columns(frame.axes, (x, y, z))]
        )
        dq = dq + quaternion.multiply(state[0] + dq, turn)
        t = t + drift
        return (t, dq, kicked(t, kick.astype(dtype), state[0] + dq, change)), None

    h = jnp.asarray(h)
    t = jnp.asarray(t, h.dtype)
    first, *rest = composition.kicks
    still = jax.tree.map(jnp.zeros_like, state)
    change = kicked(t, (first * h).astype(dtype), state[0], still[1])
    weights = tuple(jnp.asarray(part, h.dtype) * h for part in (composition.flows, rest))
    (_, dq, change), _ = lax.scan(stage, (t, still[0], change), weights)
    return dq, change


def _quintic(
    terms: PyTree[dfx.AbstractTerm], t0: Any, t1: Any, args: PyTree, y0: PyTree, y1: PyTree
) -> Any:
    """Return the five coefficients (5, …) of a polynomial for dense output (see `dense_change`).

    It has the state and its first two time derivatives at both ends, and is of order 6.
    """
    way, length = direction_and_length(terms, t0, t1)
    h = way * length

    def slopes(t: Any, y: Any) -> tuple[Any, Any]:
        t = jnp.asarray(t, y.q.dtype)
        rate, ahead = terms.vf(t, y, args), way.astype(t.dtype)
        _, second = jax.jvp(lambda s, z: terms.vf(s, z, args), (t, y), (ahead, rate))
        return rate, second

    (f0, s0), (f1, s1) = slopes(t0, y0), slopes(t1, y1)

    # `rows` returns the coefficients for one array of the state, from its values a and b at the two
    # ends of the step, its first derivatives k and m, and its second derivatives u and v. In a run
    # backwards in time diffrax uses −t as the time. First derivatives then change their sign; here
    # `h` changes its sign instead. Second derivatives keep their sign.
    def rows(a: Array, b: Array, k: Array, m: Array, u: Array, v: Array) -> Array:
        step = jnp.asarray(h, a.dtype)
        rise, second, third = cubic_coefficients(b - a, step, k, m)
        fourth = 0.5 * (step**2 * u + 2 * second - 2 * third)
        fifth = 0.5 * (step**2 * v + 2 * second + 4 * third) - fourth
        return jnp.stack([rise, second, third, fourth, fifth])

    return jax.tree.map(rows, y0, y1, f0, f1, s0, s1)
