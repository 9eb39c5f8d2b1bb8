"""From a body and an initial state to the states at a recording's times, and to sensors' input."""

import abc
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.exact.free_body import FreeMotion
from rigidjax.identify.sensors import SensorInput
from rigidjax.motion import Rigid
from rigidjax.motion.coupled import Coupled, CoupledEquations, started
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.states import freeze
from rigidjax.solve import equations_of_motion, fixed, simulate, solvers
from rigidjax.solve.equal_steps import advance, in_a_loop
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.tableaus import KUTTA4

# The turn in a step, rad: the error of a fifth-order method is then 1e-9 a radian. A method of
# order 4 has it in steps shorter by the second factor, at two thirds of the cost.
TURN_A_STEP, TURN_OF_ORDER_4 = 0.1, 0.02


# More fixed steps than this between two samples cost more than adaptive steps.
FINEST = 32
# The least relative tolerance at which steps are compared, and the part of one to the next.
_LEAST, _CLOSER = 2.5e-14, 1e-2


class AbstractIntegrator(eqx.Module):
    """The integrator of a forced motion inside a fit, differentiable in forward mode.

    At its end a fit compares the predictions with those of `finer` steps, and goes on with these if
    a prediction changes by more than a twentieth of its noise.

    >>> class Halves(AbstractIntegrator):  # two equal steps from one sample to the next
    ...     def states(self, body, state0, ts, torque):
    ...         return FixedSteps(2).states(body, state0, ts, torque)
    >>> issubclass(Halves, AbstractIntegrator)
    True
    """

    @abc.abstractmethod
    def states(self, body: Any, state0: Any, ts: Float[Array, " times"], torque: Torque) -> Any:
        """The states at `ts`, with a leading time axis.

        They are a `motion.Coupled` if a torque has states of its own and a sensor needs them.
        """

    def finer(self) -> "AbstractIntegrator | None":
        """Shorter steps that a fit compares its own with; `None` if there are none."""
        return None


class FixedSteps(AbstractIntegrator):
    """The same number of fixed steps between any two samples.

    It is the cheapest if samples are close together, as in logs of 100 Hz and more.

    **Arguments:** `substeps` the number of steps between two samples; `solver` the method, one of
    `rigidjax.solvers`: Tsitouras's of order 5 unless given; `last` the number of the last time
    that is needed, `None` for all.

    >>> FixedSteps(2).substeps
    2
    """

    substeps: int = eqx.field(static=True, default=1)
    solver: AbstractExplicit = solvers.Tsitouras5()
    last: Int[Array, ""] | None = eqx.field(default=None, repr=False)

    def __check_init__(self):
        _checks.whole(self.substeps, "substeps", 1)
        _checks.instance(self.solver, AbstractExplicit, "solver", wanted="one of rigidjax.solvers")

    def states(self, body: Any, state0: Any, ts: Float[Array, " times"], torque: Torque) -> Any:
        y0 = started(body, state0, torque, ts[0])
        field = equations_of_motion(body, y0, torque)
        return fixed(in_a_loop(self.solver), field, ts, y0, self.substeps, self.last)

    def finer(self) -> AbstractIntegrator:
        if self.substeps > FINEST:
            return Adaptive()
        return FixedSteps(2 * self.substeps, self.solver, self.last)


def _tolerance(value: ScalarLike) -> Array:
    return jnp.asarray(_checks.number(value, "a tolerance"), jnp.result_type(float))


class Adaptive(AbstractIntegrator):
    """Steps chosen by the tolerances, through `rigidjax.simulate`.

    **Arguments:** `rtol`, `atol` as there. In float32 `rtol` is at least 1.2e-5. Another tolerance
    does not compile again.

    >>> float(Adaptive().rtol)
    1e-09
    """

    rtol: Float[Array, ""] = eqx.field(converter=_tolerance, default=1e-9)
    atol: Float[Array, ""] = eqx.field(converter=_tolerance, default=1e-12)

    def __check_init__(self):
        _checks.positive(self.rtol, "rtol")
        _checks.not_negative(self.atol, "atol")

    def states(self, body: Any, state0: Any, ts: Float[Array, " times"], torque: Torque) -> Any:
        # A solver refuses repeated times, the tail of a shorter record: they grow by round-off.
        first = jnp.zeros(1, bool)
        again = jnp.cumsum(jnp.concatenate([first, jnp.diff(ts) <= 0]).astype(ts.dtype))
        out = simulate(
            body,
            state0,
            ts + 1e-9 * (ts[-1] - ts[0]) * again,
            torque,
            rtol=jnp.maximum(self.rtol.astype(ts.dtype), 100 * jnp.finfo(ts.dtype).eps),
            atol=self.atol,
            adjoint=dfx.ForwardMode(),
            throw=False,
        )
        return out.ys if out.own is None else Coupled(out.ys, out.own)

    def finer(self) -> "Adaptive | None":
        if self.rtol <= _LEAST:
            return None
        rtol = jnp.maximum(_CLOSER * self.rtol, _LEAST)
        return Adaptive(rtol, self.atol * (rtol / self.rtol))


def integrator_for(widest: float, rate: float) -> AbstractIntegrator:
    """The integrator for samples at most `widest` s apart of a body that turns at `rate` rad/s."""
    if widest * rate <= TURN_OF_ORDER_4:
        return FixedSteps(1, solvers.RungeKutta4())
    substeps = max(1, math.ceil(widest * rate / TURN_A_STEP))
    return FixedSteps(substeps) if substeps <= 20 else Adaptive()


def states_at(
    integrator: AbstractIntegrator | None,
    body: Inertia | MassProperties,
    state0: Any,
    ts: Float[Array, " times"],
    torque: Torque | None,
) -> Any:
    """The states at `ts` from `state0` at `ts[0]`: the closed form for a free body."""
    if torque is not None:
        assert integrator is not None
        return integrator.states(body, state0, ts, torque)
    return FreeMotion(body, state0)(ts - ts[0])


def shifted(field: Callable[..., Any], t: Array, state: Any, offset: Array) -> Any:
    """The state `offset` s later or earlier: four steps of the classical method of order 4."""
    h = offset / 4.0
    for index in range(4):
        state = advance(KUTTA4, lambda t, y: field(t, y, None), t + index * h, h, state)
    return state


def what_turns(body: Any, rung: type) -> Any:
    """The body of the equations of motion: a body at a fixed point needs no mass."""
    return body.inertia if isinstance(body, MassProperties) and rung is not Rigid else body


def sensor_inputs(
    sensor: Any, body: Any, torque: Any, ts: Array, state0: Any, states: Any, late: Any = None
) -> tuple[Array, Any, Callable[[Array, Any], SensorInput]]:
    """The times that a sensor shows at `ts` (T,), by its clock, and `late` s later, one number or
    (T,); the states then; its input at one time. `states` are `Coupled` if a torque has states of
    its own.
    """
    turned = what_turns(body, type(state0))
    field = equations_of_motion(turned, state0, torque)
    offset, times = getattr(sensor, "offset", None), ts
    if late is not None:
        offset = late if offset is None else offset + late
    if offset is not None:
        times = ts + offset
        if torque is None:
            states = FreeMotion(turned, state0)(times - ts[0])
        else:
            whole = CoupledEquations(field, turned) if isinstance(states, Coupled) else field
            axes = (0, 0, 0 if jnp.ndim(offset) else None)
            states = jax.vmap(partial(shifted, whole), axes)(ts, states, offset)

    def now(t: Array, state: Any) -> SensorInput:
        if not isinstance(state, Coupled):
            return SensorInput(t, state, body, field)
        return SensorInput(t, state.motion, body, freeze(field, state.own), state.own)

    return times, states, now
