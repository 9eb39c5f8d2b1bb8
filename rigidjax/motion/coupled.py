"""Integrate a body's state and the states of its torques together."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import PyTree

from rigidjax import _checks
from rigidjax._types import HasSpin, ScalarLike
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.motion.torques.base import in_precision
from rigidjax.motion.torques.states import freeze, has_states, initial_states, rates_of_own_states


class Coupled(eqx.Module):
    """Hold the state of a body whose torque has states of its own, for the integrators.

    `simulate` makes a `Coupled` itself and returns its parts, `sol.ys` and `sol.own`;
    `rigidjax.batch.rollout` returns it; `rigidjax.conserved` and `energy` take it. **Arguments:**
    `motion` a `Spin`, `Attitude` or `Rigid`; `own`, a tuple with the states of each torque that has
    states, as `Solution.own`.

    >>> wheel = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0])
    >>> Coupled.start(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0, 2.0]), wheel).own
    (Array([3.2], dtype=float64),)
    """

    motion: Any
    own: tuple[Any, ...]

    @staticmethod
    def start(body: Body | None, state0: PyTree, torque: PyTree, t: ScalarLike = 0.0) -> "Coupled":
        """Return the `Coupled` of `state0` and the initial states of `torque` (see
        `rigidjax.simulate`) at `t`, s.
        """
        _checks.require_single(body, (Inertia, MassProperties), "body")
        _checks.require_single(
            state0, HasSpin, "state0", requirement="a Spin, an Attitude or a Rigid"
        )
        dtype = state0.omega.dtype
        t = _checks.array_of_shape(t, (), "t").astype(dtype)
        own = initial_states(in_precision(torque, dtype), t, state0, in_precision(body, dtype))
        return Coupled(state0, own)


class CoupledEquations(eqx.Module):
    """Evaluate the equations of a body, `field`, and of its torques' states as one vector field."""

    field: Callable[..., Any]
    body: Any

    def __call__(self, t: ScalarLike, y: Coupled, args: object = None) -> Coupled:
        dtype = y.motion.omega.dtype
        time = _checks.array_of_shape(t, (), "t").astype(dtype)
        law, body = in_precision(self.field, dtype), in_precision(self.body, dtype)
        own = rates_of_own_states(law, time, y.own, y.motion, body)
        return Coupled(freeze(self.field, y.own)(t, y.motion, args), own)


def with_own_states(body: Body | None, state0: PyTree, torque: PyTree, t: ScalarLike) -> Any:
    """Return `state0`, as a `Coupled` if the torque has states of its own."""
    if isinstance(state0, Coupled) or not has_states(torque):
        return state0
    return Coupled.start(body, state0, torque, t)


def motion_of(y: PyTree) -> Any:
    """Return the body's part of the state `y`, which may be a `Coupled`."""
    return y.motion if isinstance(y, Coupled) else y
