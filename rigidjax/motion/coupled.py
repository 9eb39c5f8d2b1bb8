"""Integrate a body's state and the states of its torques together."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import PyTree

from rigidjax import _checks
from rigidjax._types import HasSpin, ScalarLike
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.motion.torques.base import in_precision
from rigidjax.motion.torques.states import (
    contains_own_states,
    freeze_own_states,
    initial_states,
    state_rates,
)


class Coupled(eqx.Module):
    """Hold the state of a body together with the states that its torques have of their own, such as
    the speed of a wheel.

    `simulate` makes a `Coupled` itself and returns its two parts separately, as `sol.ys` and
    `sol.own`; `rigidjax.batch.rollout` returns a `Coupled`; `rigidjax.conserved` and
    `rigidjax.energy` take one. **Arguments:** `motion` a `Spin`, `Attitude` or `Rigid`; `own` a
    tuple with the states of each torque that has states, in the order of these torques.

    >>> wheel = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0])
    >>> Coupled.start(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0, 2.0]), wheel).own
    (Array([3.2], dtype=float64),)
    """

    motion: Any
    own: tuple[Any, ...]

    @staticmethod
    def start(body: Body | None, state0: PyTree, torque: PyTree, t: ScalarLike = 0.0) -> "Coupled":
        """Return the state of motion with the initial states of the torque at the time `t`, s;
        arguments as `rigidjax.simulate`.
        """
        _checks.require_unbatched_instance(body, (Inertia, MassProperties), "body")
        _checks.require_unbatched_instance(
            state0, HasSpin, "state0", requirement="a Spin, an Attitude or a Rigid"
        )
        dtype = state0.omega.dtype
        t = _checks.array_of_shape(t, (), "t").astype(dtype)
        own = initial_states(in_precision(torque, dtype), t, state0, in_precision(body, dtype))
        return Coupled(state0, own)


class CoupledEquations(eqx.Module):
    """Evaluate the equations of motion of a body and of the states of its torques as one vector
    field `f(t, y, args)` of a `Coupled`.
    """

    # The vector field of the body alone, which contains the torque.
    field: Callable[..., Any]
    body: Any

    def __call__(self, t: ScalarLike, y: Coupled, args: object = None) -> Coupled:
        dtype = y.motion.omega.dtype
        time = _checks.array_of_shape(t, (), "t").astype(dtype)
        law, body = in_precision(self.field, dtype), in_precision(self.body, dtype)
        own = state_rates(law, time, y.own, y.motion, body)
        return Coupled(freeze_own_states(self.field, y.own)(t, y.motion, args), own)


def with_own_states(body: Body | None, state0: PyTree, torque: PyTree, t: ScalarLike) -> PyTree:
    """Return `state0`, or a new `Coupled` if the torque has states of its own."""
    if isinstance(state0, Coupled) or not contains_own_states(torque):
        return state0
    return Coupled.start(body, state0, torque, t)


def motion_of(y: PyTree) -> PyTree:
    """Return the state of motion in `y`, which may be a `Coupled`."""
    return y.motion if isinstance(y, Coupled) else y
