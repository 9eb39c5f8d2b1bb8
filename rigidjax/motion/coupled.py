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
    initial_own_states,
    rates_of_own_states,
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
        """Return the state of motion `state0` together with the initial values of the states that
        `torque` has of its own, as a `Coupled`.

        - `body`, `state0`, `torque`: as for `rigidjax.simulate`
        - `t`: s, the time at which the motion starts
        """
        _checks.require_unbatched_instance(body, (Inertia, MassProperties), "body")
        _checks.require_unbatched_instance(
            state0, HasSpin, "state0", requirement="a Spin, an Attitude or a Rigid"
        )
        dtype = state0.omega.dtype
        t = _checks.array_of_shape(t, (), "t").astype(dtype)
        own = initial_own_states(in_precision(torque, dtype), t, state0, in_precision(body, dtype))
        return Coupled(state0, own)


class CoupledEquations(eqx.Module):
    """Evaluate the equations of motion of a body and of the states of its torques as one vector
    field `f(t, y, args)`.

    The state y is a `Coupled`: the state of motion, and the states that torques have of their own,
    such as the momentum of a wheel.

    - `field`: the vector field of the body alone, such as `EulerEquations`, which contains the
      torque
    - `body`: the `Inertia` or `MassProperties`, which the torque may read
    """

    field: Callable[..., Any]
    body: Any

    def __call__(self, t: ScalarLike, y: Coupled, args: object = None) -> Coupled:
        dtype = y.motion.omega.dtype
        time = _checks.array_of_shape(t, (), "t").astype(dtype)
        law, body = in_precision(self.field, dtype), in_precision(self.body, dtype)
        own = rates_of_own_states(law, time, y.own, y.motion, body)
        return Coupled(freeze_own_states(self.field, y.own)(t, y.motion, args), own)


def with_own_states(body: Body | None, state0: PyTree, torque: PyTree, t: ScalarLike) -> PyTree:
    """Return the initial state of an integration: `state0` itself, or, if the torque has states of
    its own (such as the speed of a wheel), a `Coupled` of `state0` and the initial values of the
    states of the torque.

    - `body`: an `Inertia` or `MassProperties`
    - `state0`: a `Spin`, `Attitude` or `Rigid`; a `Coupled` is returned unchanged
    - `torque`: a torque, a force or `None`
    - `t`: s, the time at which the integration starts
    """
    if isinstance(state0, Coupled) or not contains_own_states(torque):
        return state0
    return Coupled.start(body, state0, torque, t)


def motion_of(y: PyTree) -> PyTree:
    """Return the state of motion (a `Spin`, `Attitude` or `Rigid`) in `y`, which is a `Coupled` (a
    state of motion together with the states of the torques), or is a state of motion itself.
    """
    return y.motion if isinstance(y, Coupled) else y
