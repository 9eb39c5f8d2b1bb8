"""From a body and an initial state to the states at a recording's times, and to readings."""

import abc
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.exact.free_body import FreeMotion
from rigidjax.identify.sensors import AbstractSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, CoupledEquations, started
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import bind
from rigidjax.motion.torques.states import freeze
from rigidjax.solve import equations_of_motion, fixed, simulate, solvers
from rigidjax.solve.components import split
from rigidjax.solve.equal_steps import advance, in_a_loop
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.fixed_loop import first_row, first_rows, step
from rigidjax.solve.steppers import cheapest, stepper_of
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


def _tolerance(name: str) -> Callable[[ScalarLike], Array]:
    return lambda value: jnp.asarray(_checks.number(value, name), jnp.result_type(float))


class Adaptive(AbstractIntegrator):
    """Steps chosen by the tolerances, through `rigidjax.simulate`.

    **Arguments:** `rtol`, `atol` as there. In float32 `rtol` is at least 1.2e-5. Another tolerance
    does not compile again.

    >>> float(Adaptive().rtol)
    1e-09
    """

    rtol: Float[Array, ""] = eqx.field(converter=_tolerance("rtol"), default=1e-9)
    atol: Float[Array, ""] = eqx.field(converter=_tolerance("atol"), default=1e-12)

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


def integrator_for(turn: float) -> AbstractIntegrator:
    """Return the integrator for a body that turns by at most `turn` rad between two samples."""
    if turn <= TURN_OF_ORDER_4:
        return FixedSteps(1, solvers.RungeKutta4())
    substeps = max(1, math.ceil(turn / TURN_A_STEP))
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


class HeldSteps(AbstractIntegrator):
    """One step of order 4 from one sample to the next, with the inputs held through it.

    Samples are evenly spaced. A delayed input changes inside a step, which is split there. `last`
    is the number of the last time that is needed, `None` for all.

    >>> HeldSteps().last
    """

    last: Int[Array, ""] | None = eqx.field(default=None, repr=False)

    def states(self, body: Any, state0: Any, ts: Float[Array, " times"], torque: Torque) -> Any:
        return self.driven(body, state0, ts, torque, {})

    def driven(
        self,
        body: Any,
        state0: Any,
        ts: Float[Array, " times"],
        torque: Torque,
        inputs: dict[str, Array],
    ) -> Any:
        """Return the states at `ts` (T,); `inputs` by name (before + T, *k).

        Row before + i is held through the step from time i, the last one beyond the last time. A
        torque's own states follow the rows before the first time, with the body held at its initial
        state.
        """
        count, size = ts.shape[0] - 1, (ts[1] - ts[0]).astype(state0.omega.dtype)
        before = max((len(rows) - ts.shape[0] for rows in inputs.values()), default=0)
        start = started(body, state0, bind(torque, first_row(torque, size, inputs)), 0.0)
        field = equations_of_motion(body, start, torque)
        stepper = stepper_of(in_a_loop(cheapest(field)), field, start)

        def one(y: Any, i: Array) -> tuple[Any, Any]:
            y = step(stepper, size, jnp.zeros_like(size), i, y, inputs or None, before)
            return y, stepper.state(y)

        def warm_up(y: Any, i: Array) -> tuple[Any, None]:
            # The torque's own states follow the inputs; the body keeps its initial state.
            y, _ = one(y, i)
            return split(Coupled(start.motion, stepper.state(y).own)), None

        y0 = stepper.start
        if before and isinstance(start, Coupled):
            y0, _ = lax.scan(warm_up, y0, jnp.arange(-before, 0, dtype=jnp.int32))
        still = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), start)
        later = first_rows(count if self.last is None else self.last, one, y0, still)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)


def shifted(field: Callable[..., Any], t: Array, state: Any, offset: Array) -> Any:
    """The state `offset` s later or earlier: four steps of the classical method of order 4."""
    h = offset / 4.0
    for index in range(4):
        state = advance(KUTTA4, lambda t, y: field(t, y, None), t + index * h, h, state)
    return state


def body_of_equations(body: Any, rung: type) -> Any:
    """The body of the equations of motion: a body at a fixed point needs no mass."""
    return body.inertia if isinstance(body, MassProperties) and rung is not Rigid else body


def sensor_inputs(
    sensor: Any, body: Any, torque: Any, ts: Array, state0: Any, states: Any, late: Any = None
) -> tuple[Array, Any, Callable[[Array, Any], SensorInput]]:
    """The times that a sensor shows at `ts` (T,), by its clock, and `late` s later, one number or
    (T,); the states then; its input at one time. `states` are `Coupled` if a torque has states of
    its own.
    """
    turned = body_of_equations(body, type(state0))
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


def errors_along(
    sensor: Any, values: Array, times: Array, states: Any, now: Callable[[Array, Any], SensorInput]
) -> Float[Array, "times k"]:
    """The errors of readings `values` (T, …) along a motion, as `sensor_inputs` gives it."""

    def error(t: Array, state: Any, value: Array) -> Array:
        return _error_of(sensor, now(t, state), value)

    lowpass = getattr(sensor, "lowpass", None)
    if lowpass is None:
        return jax.vmap(error)(times, states, values)
    # The error of a zero reading is the prediction with the opposite sign.
    return values + lowpass(times, jax.vmap(error)(times, states, jnp.zeros_like(values)))


def _error_of(sensor: Any, now: SensorInput, value: Array) -> Array:
    """The checked result of a sensor's `error`, which a user may have written."""
    name = type(sensor).__name__
    try:
        found = sensor.error(now, value)
    except AttributeError as wrong:
        if type(now.state).__name__ not in str(wrong):
            raise
        raise TypeError(
            f"{name}.error: {wrong}; it has feels = {sensor.feels.__name__}, but it reads more "
            "than that: set feels = rj.motion.HasAttitude, or rj.motion.HasPose"
        ) from wrong
    wanted = (sensor.components,)
    if jnp.shape(found) != wanted:
        raise ValueError(
            f"{name}.error: wanted reading minus prediction of shape {wanted}, as components = "
            f"{sensor.components} says, got {jnp.shape(found)}"
        )
    return found


def simulate_readings(
    sensor: AbstractSensor | Sequence[AbstractSensor],
    body: Inertia | MassProperties,
    state0: Spin | Attitude | Rigid,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Torque | None = None,
    *,
    key: Any = None,
) -> Any:
    """The readings of a sensor along a known motion, with noise: data to test a fit.

    The motion comes from `rigidjax.simulate`; bias, scale, mounting, clock offset, low-pass filter
    and full scale from the sensor. It may be differentiated, jitted and batched.

    **Arguments:** `sensor` an `AbstractSensor`, or a sequence of them along one motion; `body`,
    `state0`, `ts` (T,) s, `torque` as for `rigidjax.simulate`; `MassProperties` are allowed for all
    states (a sensor's `place` is then in their frame). `key` of `jax.random`: normal noise of the
    sensor's standard deviation `noise` is added, and times scatter by its `jitter`; `None` for
    readings without either. **Returns** readings (T, …) by the sensor's `reading_shape`, in its
    unit, for `Recording(ts, (sensor, readings), torque=torque)`; for a sequence a tuple of them.

    **Raises:** `TypeError` for anything but a sensor, and for a state without the parts that the
    sensor reads; `ValueError` for a key if the sensor's noise is `None`, and for a sensor of your
    own without a method `reading_of` if its readings have another shape than its error.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.0, 2.0])
    >>> gyro = rj.identify.Gyro(noise=0.01, bias=[0.0, 0.0, 0.5])
    >>> simulate_readings(gyro, body, start, [0.0, 1.0])[1].tolist()
    [0.0, 0.0, 2.5]
    >>> simulate_readings(gyro, body, start, [0.0, 1.0], key=jax.random.key(0)).shape
    (2, 3)
    """
    order = "the order is sensor, body, state0, ts"
    _checks.instance(state0, (Spin, Attitude, Rigid), "state0", hint=order)
    several = isinstance(sensor, Sequence)
    sensors = tuple(sensor) if several else (sensor,)
    if not sensors:
        raise ValueError("sensor: wanted a sensor or several, got none")
    for one in sensors:
        _fits(one, state0, key)
    start: Any = state0
    sol = simulate(body_of_equations(body, type(state0)), start, ts, torque)
    states = sol.ys if sol.own is None else Coupled(sol.ys, sol.own)
    count = len(sensors)
    keys = [None] * count if key is None else jax.random.split(_checks.key(key), count)
    given = body, torque, sol.ts, start, states
    out = tuple(_readings(one, *given, key=own) for one, own in zip(sensors, keys, strict=True))
    return out if several else out[0]


@eqx.filter_jit
def _readings(
    sensor: AbstractSensor,
    body: Inertia | MassProperties,
    torque: Torque | None,
    ts: Array,
    state0: Any,
    states: Any,
    *,
    key: Any,
) -> Float[Array, "times ..."]:
    jitter, late = getattr(sensor, "jitter", None), None
    if key is not None and jitter is not None:
        key, own = jax.random.split(key)
        late = jitter.deviation * jax.random.normal(own, ts.shape, ts.dtype)
    times, states, now = sensor_inputs(sensor, body, torque, ts, state0, states, late)
    error = jnp.zeros((ts.shape[0], sensor.components), ts.dtype)
    if key is not None:
        assert sensor.noise is not None
        error = sensor.noise[None] * jax.random.normal(key, error.shape, ts.dtype)
    reading = getattr(sensor, "reading_of", None)
    if reading is not None:
        values = jax.vmap(lambda t, y, e: reading(now(t, y), e))(times, states, error)
    else:
        nothing = jnp.zeros((ts.shape[0], *sensor.reading_shape), ts.dtype)
        missed = errors_along(sensor, nothing, times, states, now)
        values = (error - missed).reshape(ts.shape[0], *sensor.reading_shape)
    limit = getattr(sensor, "limit", None)
    return values if limit is None else jnp.clip(values, -limit[None], limit[None])


def _fits(sensor: Any, state0: Any, key: Any) -> None:
    """Refuse anything but a sensor, and a sensor that needs more than the state has."""
    name, wanted = type(sensor).__name__, "a sensor such as Gyro(0.01), or several"
    _checks.instance(sensor, AbstractSensor, "sensor", wanted=wanted)
    if not isinstance(state0, sensor.feels):
        raise TypeError(
            f"{name} needs a state with {sensor.feels.__name__}, got {type(state0).__name__}; take "
            "Attitude, or Rigid for what depends on the position"
        )
    if sensor.noise is not None and jnp.shape(sensor.noise) != (sensor.components,):
        raise ValueError(
            f"sensor: {name}: noise: wanted shape ({sensor.components},), of one sensor, got "
            f"{jnp.shape(sensor.noise)}; for many use jax.vmap"
        )
    if key is not None and sensor.noise is None:
        raise ValueError(
            f"{name}: noise=None gives no size of the noise to draw; give noise, or key=None"
        )
    jitter, lowpass = getattr(sensor, "jitter", None), getattr(sensor, "lowpass", None)
    if key is not None and jitter is not None and (jitter.estimated or lowpass is not None):
        raise ValueError(
            f"{name}: wanted a jitter in s, and no lowpass beside it, to draw times; or key=None"
        )
    if not hasattr(sensor, "reading_of") and math.prod(sensor.reading_shape) != sensor.components:
        raise ValueError(
            f"{name}: its readings of shape {sensor.reading_shape} are not its error of "
            f"{sensor.components} numbers plus a prediction; write a method reading_of(now, "
            "error), the reading whose error is this one"
        )
