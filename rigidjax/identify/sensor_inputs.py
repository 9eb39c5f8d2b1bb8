"""The input of a sensor along a motion: for the errors of a fit and for simulated readings."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array

from rigidjax.body.inertia import MassProperties
from rigidjax.exact.free_body import FreeMotion
from rigidjax.identify.propagation import shifted
from rigidjax.identify.sensors import SensorInput
from rigidjax.motion import Rigid
from rigidjax.motion.coupled import Coupled, CoupledEquations
from rigidjax.motion.torques.states import freeze
from rigidjax.solve import equations_of_motion


def what_turns(body: Any, rung: type) -> Any:
    """The body of the equations of motion: a body at a fixed point needs no mass."""
    return body.inertia if isinstance(body, MassProperties) and rung is not Rigid else body


def sensor_inputs(
    sensor: Any, body: Any, torque: Any, ts: Array, state0: Any, states: Any
) -> tuple[Array, Any, Callable[[Array, Any], SensorInput]]:
    """The times that a sensor shows at `ts` (T,), the states then, and its input at one time.

    Times and states differ from `ts` and `states` if the sensor's clock has an `offset`.

    **Arguments:** `state0` the initial state, without the torques' own; `states` with a leading
    time axis, `Coupled` if a torque has states of its own.
    """
    turned = what_turns(body, type(state0))
    field = equations_of_motion(turned, state0, torque)
    offset, times = getattr(sensor, "offset", None), ts
    if offset is not None:
        times = ts + offset
        if torque is None:
            states = FreeMotion(turned, state0)(times - ts[0])
        else:
            whole = CoupledEquations(field, turned) if isinstance(states, Coupled) else field
            states = jax.vmap(lambda t, y: shifted(whole, t, y, offset))(ts, states)

    def now(t: Array, state: Any) -> SensorInput:
        if not isinstance(state, Coupled):
            return SensorInput(t, state, body, field)
        return SensorInput(t, state.motion, body, freeze(field, state.own), state.own)

    return times, states, now
