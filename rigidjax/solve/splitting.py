"""Splittings on the exact free flow: free motion in closed form, torque as kicks of momentum.

`A` is the free body (`rigidjax.exact`), `B` the kick `Π ← Π + c h τ(t, q)` at a fixed attitude; a
step is `B(b1) A(a1) B(b2) … A(a1) B(b1)`: symmetric, and each part an exact Hamiltonian flow.
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
    Six,
    Triple,
    add,
    adjugate,
    change_by_inverse_rotation,
    determinant,
    matvec,
)
from rigidjax.exact.derivatives import flow
from rigidjax.exact.diffrax_solver import field_of
from rigidjax.exact.principal_axes import combine_columns, components_along, principal_frame
from rigidjax.motion import Attitude
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques.base import evaluate, sees_rate
from rigidjax.rotation import quaternion
from rigidjax.solve.explicit import NestedInterpolation, cubic_rows, onward
from rigidjax.solve.magnus import require_attitude
from rigidjax.solve.tableaus import numbers


class Composition(NamedTuple):
    """A symmetric composition `B(b1) A(a1) … B(b1)`: its order, and the weights of A and B."""

    order: int
    flows: tuple[float, ...]
    kicks: tuple[float, ...]


def _symmetric(order: int, flows: tuple[float, ...], kicks: tuple[float, ...]) -> Composition:
    """The composition with these first halves; the middle weights make the sums 1."""
    if len(flows) < len(kicks):
        middle = 1 - 2 * sum(kicks)
        flows = (*flows, 0.5 - sum(flows))
        return Composition(order, (*flows, *flows[::-1]), (*kicks, middle, *kicks[::-1]))
    middle = 1 - 2 * sum(flows)
    kicks = (*kicks, 0.5 - sum(kicks))
    return Composition(order, (*flows, middle, *flows[::-1]), (*kicks, *kicks[::-1]))


# Strang 1968, doi:10.1137/0705041.
STRANG = Composition(2, (1.0,), (0.5, 0.5))
# Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, methods SRKN6b and SRKN11b, for kicks
# that commute with each other's commutators: these depend on attitude alone.
SRKN6 = _symmetric(
    4,
    numbers("0.245298957184271 0.604872665711080"),
    numbers("0.0829844064174052 0.396309801498368 -0.0390563049223486"),
)
SRKN11 = _symmetric(
    6,
    numbers("""
    0.123229775946271 0.290553797799558 -0.127049212625417 -0.246331761062075 0.357208872795928
    """),
    numbers("""
    0.0414649985182624 0.198128671918067 -0.0400061921041533 0.0752539843015807 -0.0115113874206879
    """),
)


class Frame(NamedTuple):
    """The principal frame of a body; off-diagonal entries are zero and carry the tangents."""

    moments: Six
    weights: Six  # the inverse
    axes: Array  # columns


def principal(tensor: Array) -> Frame:
    """The principal frame of an inertia (3, 3)."""
    six, axes = principal_frame(tensor)
    # Relative to the trace first: the cube of 1e37 kg m² is no number.
    size = six[0] + six[1] + six[2]
    unit: Six = tuple(i / size for i in six)
    scale = determinant(unit)
    return Frame(six, tuple(c / scale / size for c in adjugate(unit)), axes)


@jax.custom_jvp
def rate_of(weights: Six, p: Triple) -> Triple:
    """Ω of Π in principal axes."""
    return weights[0] * p[0], weights[1] * p[1], weights[2] * p[2]


@rate_of.defjvp
def rate_of_jvp(primals, tangents):
    (weights, p), (dw, dp) = primals, tangents
    return rate_of(weights, p), add(rate_of(weights, dp), matvec(dw, p))


class AbstractSplitting(dfx.AbstractSolver):
    """Kicks and exact free flows in the order of `composition`, which subclasses name."""

    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = NestedInterpolation
    composition: eqx.AbstractClassVar[Composition]

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        return self.composition.order

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
    ) -> Frame:
        return frame_of(field_of(terms)[0], y0)

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: Frame,
        made_jump: Bool[ArrayLike, ""],
    ) -> Any:
        field, way = field_of(terms)
        state, h = (y0.q, enter(solver_state, y0.omega)), jnp.asarray(t1 - t0) * way
        dq, dp = compose(self.composition, field, solver_state, jnp.asarray(t0) * way, h, state)
        # Only the change goes back: IΩ times I⁻¹ is Ω to a rounding that is the same in each step.
        omega = y0.omega + leave(solver_state, dp)
        y1 = Attitude(quaternion.normalise(y0.q + dq), omega)
        dense = dict(y0=y0, coefficients=_dense_rows(terms, t0, t1, args, y0, y1))
        return y1, None, dense, solver_state, dfx.RESULTS.successful

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)


class Splitting2(AbstractSplitting):
    """Order 2: half a kick, the exact free motion, half a kick (Strang).

    For long runs with fixed steps under torques that are small against the free motion and depend
    on time and attitude, not on the body rate. The energy's error stays bounded; an adaptive
    controller destroys that, and there is no error estimate. Dense output is on the group with the
    order of the method.

    Source: Strang 1968, doi:10.1137/0705041, with the free flow of `rigidjax.exact.free_body`.

    >>> import diffrax
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> term = diffrax.ODETerm(field)
    >>> diffrax.diffeqsolve(term, Splitting2(), 0.0, 1.0, 0.5, start).ys.q[0, 3]
    Array(0.47942554, dtype=float64)
    """

    composition: ClassVar[Composition] = STRANG


class Splitting4(AbstractSplitting):
    """Order 4: seven kicks and six free flows. For long runs; see `Splitting2` for its conditions.

    Source: Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, method SRKN6b.

    >>> Splitting4().order(None)
    4
    """

    composition: ClassVar[Composition] = SRKN6


class Splitting6(AbstractSplitting):
    """Order 6: twelve kicks and eleven free flows. For long runs; see `Splitting2`.

    Source: Blanes and Moan 2002, doi:10.1016/S0377-0427(01)00492-7, method SRKN11b.

    >>> Splitting6().order(None)
    6
    """

    composition: ClassVar[Composition] = SRKN11


def frame_of(field: Any, y0: Any) -> Frame:
    """The principal frame of the field's body; `TypeError` for a field that is no `Attitude`'s."""
    # Under a torque that feels the body rate a kick is no exact flow: the order would fall to 1.
    torque = require_attitude("Splitting", field, y0, "DormandPrince8").euler.torque
    if sees_rate(torque):
        raise TypeError(
            f"Splitting: the torque {type(torque).__name__} depends on the body rate (damping, a "
            "flywheel), or does not say that it does not; only time and attitude may enter a kick: "
            "a law of your own says so by rate_free = True; for others use DormandPrince8"
        )
    return principal(field.euler.inertia.tensor.astype(y0.omega.dtype))


def enter(frame: Frame, omega: Array) -> Triple:
    """Π in principal axes."""
    return matvec(frame.moments, components_along(frame.axes, omega))


def leave(frame: Frame, momentum: Triple) -> Array:
    """Ω in body axes."""
    return jnp.stack(combine_columns(frame.axes, rate_of(frame.weights, momentum)))


def compose(
    composition: Composition, field: AttitudeEquations, frame: Frame, t: Any, h: Any, state: Any
) -> tuple[Array, Triple]:
    """How (q, Π in principal axes) changes in one step; q is not projected."""
    dtype = state[0].dtype

    def kicked(t: Any, weight: Any, q: Array, change: Triple) -> Triple:
        if field.euler.torque is None:
            return change
        # A torque that says that it does not depend on the rate gets none.
        at = Attitude(q, jnp.full(3, jnp.nan, dtype))
        torque = components_along(
            frame.axes, evaluate(field.euler.torque, t, at, field.euler.inertia)
        )
        return add(change, tuple(weight * a for a in torque))

    # A loop, not twelve copies: the flow is long to compile.
    def stage(carry: Any, weights: tuple[Array, Array]) -> tuple[Any, None]:
        t, dq, change = carry
        drift, kick = weights
        length = drift.astype(dtype)
        momentum = add(state[1], change)
        _, (w, x, y, z) = flow(frame.moments, momentum, length)
        # What the turn changes: momentum keeps its length to the last digit of this change.
        change = add(change, change_by_inverse_rotation((w, x, y, z), momentum))
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


def _dense_rows(
    terms: PyTree[dfx.AbstractTerm], t0: Any, t1: Any, args: PyTree, y0: PyTree, y1: PyTree
) -> Any:
    """The quintic through both ends with first and second derivatives: of order 6."""
    way, length = onward(terms, t0, t1)
    h = way * length

    def slopes(t: Any, y: Any) -> tuple[Any, Any]:
        t = jnp.asarray(t, y.q.dtype)
        rate, ahead = terms.vf(t, y, args), way.astype(t.dtype)
        _, second = jax.jvp(lambda s, z: terms.vf(s, z, args), (t, y), (ahead, rate))
        return rate, second

    (f0, s0), (f1, s1) = slopes(t0, y0), slopes(t1, y1)

    # Backwards, diffrax's time falls as t rises; the second derivative keeps its sign.
    def rows(a: Array, b: Array, k: Array, m: Array, u: Array, v: Array) -> Array:
        step = jnp.asarray(h, a.dtype)
        rise, second, third = cubic_rows(b - a, step, k, m)
        fourth = 0.5 * (step**2 * u + 2 * second - 2 * third)
        fifth = 0.5 * (step**2 * v + 2 * second + 4 * third) - fourth
        return jnp.stack([rise, second, third, fourth, fifth])

    return jax.tree.map(rows, y0, y1, f0, f1, s0, s1)
