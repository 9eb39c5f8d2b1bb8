"""Solve the rotation of a body by steps of order 4, for torques that do not read the attitude.

Each step first computes the body rate by the four stages of a Runge–Kutta method. It then turns the
body once, by the exponential of Magnus' series of the body rate.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, PyTree

from rigidjax._types import RealLike
from rigidjax.exact.components3 import QuaternionEntries, Triple, add, cross
from rigidjax.exact.diffrax_solver import field_and_direction
from rigidjax.motion import Attitude
from rigidjax.motion.equations import AttitudeEquations, project_to_group
from rigidjax.motion.torques.base import may_read_attitude
from rigidjax.rotation.barrier import barrier
from rigidjax.rotation.kernels import quaternion_product
from rigidjax.solve.steps.components import join_scalars, split_scalars
from rigidjax.solve.steps.equal_steps import change_and_slope
from rigidjax.solve.steps.explicit import (
    NestedInterpolation,
    cubic_coefficients,
    direction_and_length,
)
from rigidjax.solve.steps.tableaus import KUTTA4


def change_and_turn(
    slope: Callable[[Any, Triple], Triple], rate: Callable[[Triple], Triple],
    t: Any, end: Any, h: Array, p: Triple,
) -> tuple[Triple, QuaternionEntries]:  # fmt: skip
    """Return the change of the momentum (or body rate) `p` in a step, and the turn of the body.

    The turn is a quaternion less the identity. `rate(p)` is Ω, rad/s. The rotation vector of the
    step is `∫Ω dt + h²/12 Ω(t) × Ω(t+h)`, by Simpson's rule; p in the middle is that of the cubic
    polynomial with the right p and dp/dt at both ends. Source: Magnus 1954,
    doi:10.1002/cpa.3160070404; Iserles, Munthe-Kaas, Nørsett and Zanna 2000,
    doi:10.1017/S0962492900002154, section 5.
    """
    change, first = change_and_slope(KUTTA4, slope, t, h, p, end)
    after = barrier(add(p, change))
    last = slope(end, after)
    middle = tuple(
        a + 0.5 * b + 0.125 * h * (k - m) for a, b, k, m in zip(p, change, first, last, strict=True)
    )
    left, between, right = rate(p), rate(middle), rate(after)
    third, square = h / 12.0, h * h / 24.0
    half = tuple(
        third * (a + 4.0 * b + c) + square * d
        for a, b, c, d in zip(left, between, right, cross(left, right), strict=True)
    )
    half = barrier(half)
    # The numbers `c` and `s` are short power series of cos a − 1 and (sin a)/a, where a is half of
    # the angle by which the body turns in the step, and `x` is a². The series lose digits only if
    # this angle is more than a radian; then the method itself has no correct digits.
    x = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    c = x * (-1 / 2 + x * (1 / 24 + x * (-1 / 720 + x * (1 / 40320))))
    s = 1.0 + x * (-1 / 6 + x * (1 / 120 + x * (-1 / 5040 + x * (1 / 362880))))
    return change, barrier((c, *(s * a for a in half)))


class Magnus4(dfx.AbstractSolver):
    """Solve the rotation of a body, free or under torques of time and body rate, to order 4.

    The steps have a fixed length. With steps of the same length, this method does less work than
    `rigidjax.solvers.RungeKutta4` and has a smaller error; it is the default of
    `rigidjax.batch.rollout`. A step should turn the body by less than a radian. Source: Magnus
    1954, doi:10.1002/cpa.3160070404; see `change_and_turn`.

    **Raises:** `TypeError` for a torque that may depend on the attitude, and for a state that is
    not an `Attitude`.

    >>> import diffrax
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> field = rj.equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), start)
    >>> term = diffrax.ODETerm(field)
    >>> diffrax.diffeqsolve(term, Magnus4(), 0.0, 1.0, 0.01, start).ys.q[0, 3]
    Array(0.47942554, dtype=float64)
    """

    term_structure: ClassVar = dfx.ODETerm
    interpolation_cls: ClassVar = NestedInterpolation

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int:
        return 4

    def init(
        self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, t1: RealLike, y0: PyTree, args: PyTree
    ) -> tuple[()]:
        field, _ = field_and_direction(terms)
        refuse_attitude(attitude_equations("Magnus4", field, y0, "RungeKutta4").euler.torque)
        return ()

    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealLike,
        t1: RealLike,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Bool[ArrayLike, ""],
    ) -> Any:
        start = split_scalars(y0)
        q, omega = start[:4], start[4:]
        way, h = (part.astype(y0.omega.dtype) for part in direction_and_length(terms, t0, t1))
        # The torque has declared that it does not read the attitude. It gets NaN as the attitude,
        # so that the result is NaN if the torque reads the attitude nevertheless.
        nowhere = jnp.full_like(y0.q, jnp.nan)

        def slope(t: Any, omega: Triple) -> Triple:
            return split_scalars(way * terms.vf(t, Attitude(nowhere, jnp.stack(omega)), args).omega)

        def rate(omega: Triple) -> Triple:
            a, b, c = omega
            return way * a, way * b, way * c

        change, turn = change_and_turn(slope, rate, t0, t1, h, omega)
        change = join_scalars((*quaternion_product(q, turn), *change), y0)
        y1 = project_to_group(jax.tree.map(jnp.add, y0, change))
        left, right = terms.vf(t0, y0, args), terms.vf(t1, y1, args)

        def rows(a: Array, b: Array, k: Array, m: Array) -> Array:
            return jnp.stack(cubic_coefficients(b - a, way * h, k, m))

        dense = dict(y0=y0, coefficients=jax.tree.map(rows, y0, y1, left, right))
        return y1, None, dense, (), dfx.RESULTS.successful

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealLike, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)


def attitude_equations(
    solver_name: str, field: Any, y0: PyTree, advised_solver: str
) -> AttitudeEquations:
    """Return `field`; raise `TypeError` unless field and state are those of an attitude."""
    if isinstance(field, AttitudeEquations) and isinstance(y0, Attitude):
        return field
    raise TypeError(
        f"{solver_name}: wanted AttitudeEquations and an Attitude state, got "
        f"{type(field).__name__} and {type(y0).__name__}; use {advised_solver}"
    )


def refuse_attitude(torque: Any) -> None:
    """Raise `TypeError` for a torque that may depend on the attitude of the body.

    A torque states by `feels = HasSpin` that it does not.
    """
    if may_read_attitude(torque):
        raise TypeError(
            f"Magnus4: wanted a torque of time and body rate, got {type(torque).__name__}, which "
            "depends on the attitude, or does not say what it feels; a torque of your own says "
            "that it reads no attitude by feels = rigidjax.motion.HasSpin; for other torques use "
            "rigidjax.solvers.RungeKutta4"
        )
