"""Predict the states of a body at the times of a recording, and the readings of sensors in these
states.
"""

import abc
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray, PyTree

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.exact.free_body import FreeMotion
from rigidjax.identify.sensors import AbstractSensor, SensorInput
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, CoupledEquations, with_own_states
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import bind
from rigidjax.motion.torques.states import freeze_own_states
from rigidjax.solve import equations_of_motion, fixed, simulate, solvers
from rigidjax.solve.components import split_scalars
from rigidjax.solve.equal_steps import loop_low_order, state_after_step
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.fixed_loop import equal_step, fill_rows, inputs_at_start
from rigidjax.solve.steppers import cheapest_method, stepper_of
from rigidjax.solve.tableaus import KUTTA4

# If the body turns by TURN_A_STEP rad in each step, a method of order 5 has an error of 1e-9 for
# each radian of the turn. A method of order 4 has this error with TURN_OF_ORDER_4 rad in each step,
# and one of its steps costs two thirds of a step of order 5.
TURN_A_STEP, TURN_OF_ORDER_4 = 0.1, 0.02
# More fixed steps than this number between two samples cost more than adaptive steps.
FINEST = 32
# `Adaptive.refine` multiplies the relative tolerance by _CLOSER, but never makes it smaller than
# _LEAST.
_LEAST, _CLOSER = 2.5e-14, 1e-2


State = Spin | Attitude | Rigid


class AbstractIntegrator(eqx.Module):
    """Integrate a forced motion inside a fit, with derivatives in forward mode.

    To make an integrator of your own, write a subclass with the method `states`, which returns the
    states at the times `ts`. At its end a fit compares its predictions with the predictions of an
    integrator of shorter steps (`refine`). If a prediction changes by more than a twentieth of its
    noise, the fit goes on with the shorter steps.

    >>> class Halves(AbstractIntegrator):  # two equal steps from one sample to the next
    ...     def states(self, body, state0, ts, torque):
    ...         return FixedSteps(2).states(body, state0, ts, torque)
    >>> issubclass(Halves, AbstractIntegrator)
    True
    """

    @abc.abstractmethod
    def states(
        self, body: Body, state0: State, ts: Float[Array, " times"], torque: Torque
    ) -> PyTree:
        """Return the states of a forced motion at the times `ts` (T,), s, with a leading time axis.

        The states are a `motion.Coupled` if the torque has states of its own, such as the speed of
        a motor.

        - `body`: the body.
        - `state0`: the state at `ts[0]`.
        - `torque`: the torque on the body.
        """

    def refine(self) -> "AbstractIntegrator | None":
        """Return an integrator of shorter steps, or `None` if shorter steps are not possible.

        A fit compares the predictions of both integrators to see whether its steps are short
        enough.
        """
        return None


class FixedSteps(AbstractIntegrator):
    """Integrate with the same number of fixed steps between any two samples.

    It is the cheapest integrator if samples are close together, as in logs of 100 Hz and more.

    **Arguments:**

    - `substeps`: the number of steps between two samples.
    - `solver`: the method, one of `rigidjax.solvers`; by default Tsitouras's method of order 5.
    - `last`: the index of the last time whose state is needed, `None` for all times.

    >>> FixedSteps(2).substeps
    2
    """

    substeps: int = eqx.field(static=True, default=1)
    solver: AbstractExplicit = solvers.Tsitouras5()
    last: Int[Array, ""] | None = eqx.field(default=None, repr=False)

    def __check_init__(self):
        _checks.integer(self.substeps, "substeps", 1)
        _checks.require_instance(
            self.solver, AbstractExplicit, "solver", requirement="one of rigidjax.solvers"
        )

    def states(
        self, body: Body, state0: State, ts: Float[Array, " times"], torque: Torque
    ) -> PyTree:
        y0 = with_own_states(body, state0, torque, ts[0])
        field = equations_of_motion(body, y0, torque)
        return fixed(loop_low_order(self.solver), field, ts, y0, self.substeps, self.last)

    def refine(self) -> AbstractIntegrator:
        if self.substeps > FINEST:
            return Adaptive()
        return FixedSteps(2 * self.substeps, self.solver, self.last)


def _tolerance_converter(name: str) -> Callable[[ScalarLike], Array]:
    """Return a function that converts a tolerance (one number) to an array of shape (), for use as
    the `converter` of a dataclass field.

    `name` is the name of the field. It appears in the error that the function raises unless the
    tolerance is one number that JAX does not trace. A compiled program takes an array as an
    argument, so that another tolerance needs no new compilation.
    """
    return lambda value: jnp.asarray(_checks.python_float(value, name), jnp.result_type(float))


class Adaptive(AbstractIntegrator):
    """Integrate with steps that are chosen by tolerances, through `rigidjax.simulate`.

    **Arguments:** `rtol`, `atol` the relative and the absolute tolerance of each step, as for
    `rigidjax.simulate`. In float32 a relative tolerance of at least 1.2e-5 is used. A fit with
    other tolerances is not compiled again.

    >>> float(Adaptive().rtol)
    1e-09
    """

    rtol: Float[Array, ""] = eqx.field(converter=_tolerance_converter("rtol"), default=1e-9)
    atol: Float[Array, ""] = eqx.field(converter=_tolerance_converter("atol"), default=1e-12)

    def __check_init__(self):
        _checks.positive_float(self.rtol, "rtol")
        _checks.nonnegative_float(self.atol, "atol")

    def states(
        self, body: Body, state0: State, ts: Float[Array, " times"], torque: Torque
    ) -> PyTree:
        # The padding of a shorter record repeats its last time, but a solver refuses equal times. A
        # small growing time is added to the repeated times.
        first = jnp.zeros(1, bool)
        repeats = jnp.cumsum(jnp.concatenate([first, jnp.diff(ts) <= 0]).astype(ts.dtype))
        out = simulate(
            body,
            cast(Any, state0),
            ts + 1e-9 * (ts[-1] - ts[0]) * repeats,
            torque,
            rtol=jnp.maximum(self.rtol.astype(ts.dtype), 100 * jnp.finfo(ts.dtype).eps),
            atol=self.atol,
            adjoint=dfx.ForwardMode(),
            throw=False,
        )
        return out.ys if out.own is None else Coupled(out.ys, out.own)

    def refine(self) -> "Adaptive | None":
        if self.rtol <= _LEAST:
            return None
        rtol = jnp.maximum(_CLOSER * self.rtol, _LEAST)
        return Adaptive(rtol, self.atol * (rtol / self.rtol))


def integrator_for(turn: float) -> AbstractIntegrator:
    """Return an integrator that is precise enough for a body that turns by at most `turn` rad
    between two samples.

    It takes few fixed steps between two samples if `turn` is small, and adaptive steps if it is
    large.
    """
    if turn <= TURN_OF_ORDER_4:
        return FixedSteps(1, solvers.RungeKutta4())
    substeps = max(1, math.ceil(turn / TURN_A_STEP))
    return FixedSteps(substeps) if substeps <= 20 else Adaptive()


def states_at(
    integrator: AbstractIntegrator | None,
    body: Body,
    state0: State,
    ts: Float[Array, " times"],
    torque: Torque | None,
) -> PyTree:
    """Return the states of a motion at the times `ts` (T,), s, with a leading time axis.

    - `integrator`: the integrator of a forced motion; it is not used for a free body.
    - `body`: the body.
    - `state0`: the state at `ts[0]`.
    - `torque`: the torque on the body, or `None` for a free body, whose motion is computed by the
      closed form.
    """
    if torque is not None:
        assert integrator is not None
        return integrator.states(body, state0, ts, torque)
    return FreeMotion(body, state0)(ts - ts[0])


class HeldSteps(AbstractIntegrator):
    """Integrate with one step of order 4 from each sample to the next, and hold the inputs constant
    in each step.

    An input is a logged quantity such as a motor command. The samples must be evenly spaced in
    time. The value of a delayed input changes inside a step; the step is then split at the change.

    **Arguments:** `last` the index of the last time whose state is needed, `None` for all times.

    >>> HeldSteps().last
    """

    last: Int[Array, ""] | None = eqx.field(default=None, repr=False)

    def states(
        self, body: Body, state0: State, ts: Float[Array, " times"], torque: Torque
    ) -> PyTree:
        return self.states_with_inputs(body, state0, ts, torque, {})

    def states_with_inputs(
        self,
        body: Body,
        state0: State,
        ts: Float[Array, " times"],
        torque: Torque,
        inputs: dict[str, Array],
    ) -> PyTree:
        """Return the states at the times `ts` (T,), s, under a torque that reads sampled inputs,
        with a leading time axis.

        The torque's own states (such as the state of a motor) are first integrated over the samples
        before `ts[0]`, while the body is held at its initial state.

        - `body`, `state0`: the body, and its state at `ts[0]`.
        - `torque`: the torque on the body.
        - `inputs`: a dict of name → samples (before + T, *k), where `before` is the number of
          samples before `ts[0]`. The sample in row before + i is held constant in the step from
          `ts[i]` to `ts[i + 1]`.
        """
        count, size = ts.shape[0] - 1, (ts[1] - ts[0]).astype(state0.omega.dtype)
        before = max((len(rows) - ts.shape[0] for rows in inputs.values()), default=0)
        start = with_own_states(
            body, state0, bind(torque, inputs_at_start(torque, size, inputs)), 0.0
        )
        field = equations_of_motion(body, start, torque)
        stepper = stepper_of(loop_low_order(cheapest_method(field)), field, start)

        def take_step(y: PyTree, i: Array) -> tuple[PyTree, PyTree]:
            y = equal_step(stepper, size, jnp.zeros_like(size), i, y, inputs or None, before)
            return y, stepper.state(y)

        def warm_up(y: PyTree, i: Array) -> tuple[PyTree, None]:
            # Before the first time of the record the torque's own states (such as the speed of a
            # motor) follow the inputs, while the body keeps its initial state.
            y, _ = take_step(y, i)
            return split_scalars(Coupled(start.motion, stepper.state(y).own)), None

        y0 = stepper.start
        if before and isinstance(start, Coupled):
            y0, _ = lax.scan(warm_up, y0, jnp.arange(-before, 0, dtype=jnp.int32))
        still = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), start)
        later = fill_rows(count if self.last is None else self.last, take_step, y0, still)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)


def shift_in_time(field: Callable[..., Any], t: Array, state: PyTree, offset: Array) -> PyTree:
    """Return the state at the time t + `offset`, s, from the `state` at the time t, s.

    It takes four equal steps of the classical Runge–Kutta method of order 4 along the equations of
    motion `field`, a function (t, state, args) that returns the time derivative of the state.
    """
    h = offset / 4.0
    for index in range(4):
        state = state_after_step(KUTTA4, lambda t, y: field(t, y, None), t + index * h, h, state)
    return state


def drop_unneeded_mass(body: Body, state_type: type) -> Body:
    """Return the part of a `body` that the equations of motion of a state of type `state_type`
    need.

    Only the equations of motion of a `Rigid` state need the mass; for all other states the result
    is the `Inertia`.
    """
    return body.inertia if isinstance(body, MassProperties) and state_type is not Rigid else body


def sensor_inputs(
    sensor: AbstractSensor,
    body: Body,
    torque: Torque | None,
    ts: Array,
    state0: State,
    states: PyTree,
    delay: Array | None = None,
) -> tuple[Array, PyTree, Callable[[Array, PyTree], SensorInput]]:
    """Return three things: the times at which a sensor reads; the states at these times; and a
    function that makes the `SensorInput` from one time and state.

    **Arguments:**

    - `sensor`: the sensor; if it has a clock offset, it reads at t + `offset` for the time stamp t.
    - `body`, `torque`: the body and the torque of the motion.
    - `ts`: (T,) the time stamps of the readings, s.
    - `state0`: the initial state of the body.
    - `states`: the states at `ts`; if the torque has states of its own (such as the speed of a
      motor), a `Coupled`, which holds the states of the body and of the torque.
    - `delay`: a further time, s, that is added to the clock offset, one number or (T,).
    """
    turned = drop_unneeded_mass(body, type(state0))
    field = equations_of_motion(turned, state0, torque)
    offset, times = getattr(sensor, "offset", None), ts
    if delay is not None:
        offset = delay if offset is None else offset + delay
    if offset is not None:
        times = ts + offset
        if torque is None:
            states = FreeMotion(turned, state0)(times - ts[0])
        else:
            whole = CoupledEquations(field, turned) if isinstance(states, Coupled) else field
            axes = (0, 0, 0 if jnp.ndim(offset) else None)
            states = jax.vmap(partial(shift_in_time, whole), axes)(ts, states, offset)

    def input_at(t: Array, state: PyTree) -> SensorInput:
        if not isinstance(state, Coupled):
            return SensorInput(t, state, body, field)
        return SensorInput(t, state.motion, body, freeze_own_states(field, state.own), state.own)

    return times, states, input_at


def errors_along(
    sensor: AbstractSensor,
    values: Array,
    times: Array,
    states: PyTree,
    input_at: Callable[[Array, PyTree], SensorInput],
) -> Float[Array, "times k"]:
    """Return the errors (T, k), reading minus prediction, of the readings of a sensor along a
    motion.

    - `sensor`: the sensor, whose error has k components.
    - `values`: (T, …) the readings.
    - `times`: (T,) the times at which the sensor reads, s.
    - `states`: the states at these times, with a leading time axis.
    - `input_at`: a function of a time and a state that returns the `SensorInput` from which the
      sensor predicts its reading.

    The arguments `times`, `states` and `input_at` are the results of `sensor_inputs`.
    """

    def error(t: Array, state: PyTree, value: Array) -> Array:
        return _checked_error(sensor, input_at(t, state), value)

    lowpass = getattr(sensor, "lowpass", None)
    if lowpass is None:
        return jax.vmap(error)(times, states, values)
    # The error of a reading of zero is minus the prediction. The low-pass filter smooths this
    # prediction, not the reading.
    return values + lowpass(times, jax.vmap(error)(times, states, jnp.zeros_like(values)))


def _checked_error(sensor: AbstractSensor, motion: SensorInput, value: Array) -> Array:
    """Return the error (k,), reading minus prediction, of one reading of a `sensor` whose error has
    k components, after checks.

    A user may have written the sensor's method `error`. A `TypeError` is raised if this method
    reads a part of the state that the sensor's member `feels` does not name, and a `ValueError` if
    it returns another shape than (k,).

    - `sensor`: the sensor.
    - `motion`: what the sensor predicts the reading from: time, state, body and equations of
      motion.
    - `value`: the reading.
    """
    name = type(sensor).__name__
    try:
        error = sensor.error(motion, value)
    except AttributeError as wrong:
        if type(motion.state).__name__ not in str(wrong):
            raise
        raise TypeError(
            f"{name}.error: {wrong}; it has feels = {sensor.feels.__name__}, but it reads more "
            "than that: set feels = rj.motion.HasAttitude, or rj.motion.HasPose"
        ) from wrong
    wanted = (sensor.components,)
    if jnp.shape(error) != wanted:
        raise ValueError(
            f"{name}.error: wanted reading minus prediction of shape {wanted}, as components = "
            f"{sensor.components} says, got {jnp.shape(error)}"
        )
    return error


def simulate_readings(
    sensor: AbstractSensor | Sequence[AbstractSensor],
    body: Inertia | MassProperties,
    state0: Spin | Attitude | Rigid,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Torque | None = None,
    *,
    key: PRNGKeyArray | None = None,
) -> Any:
    """Return the readings of a sensor along a known motion, with noise, as data to test a fit.

    `rigidjax.simulate` computes the motion. Bias, scale, mounting, clock offset, low-pass filter
    and full scale are those of the sensor. The function may be differentiated, jitted and batched.

    **Arguments:**

    - `sensor`: an `AbstractSensor`, or a sequence of them along one motion.
    - `body`, `state0`, `ts` (T,) s, `torque`: as for `rigidjax.simulate`. `MassProperties` are
      allowed for all states; a sensor's `place` is then in the frame of the `MassProperties`.
    - `key`: a key of `jax.random`, with which normal noise of the sensor's standard deviations
      `noise` is added, and the times are scattered by the sensor's `jitter`; `None` for readings
      without noise and jitter.

    **Returns** readings (T, *reading_shape) in the sensor's unit, for `Recording(ts, (sensor,
    readings))`; for a sequence of sensors a tuple with the readings of each sensor.

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
    _checks.require_instance(state0, (Spin, Attitude, Rigid), "state0", hint=order)
    several = isinstance(sensor, Sequence)
    sensors = tuple(sensor) if several else (sensor,)
    if not sensors:
        raise ValueError("sensor: wanted a sensor or several, got none")
    for one in sensors:
        _require_sensor_for_simulation(one, state0, key)
    start: Any = state0
    sol = simulate(drop_unneeded_mass(body, type(state0)), start, ts, torque)
    states = sol.ys if sol.own is None else Coupled(sol.ys, sol.own)
    count = len(sensors)
    keys = [None] * count if key is None else jax.random.split(_checks.random_key(key), count)
    motion = body, torque, sol.ts, start, states
    out = tuple(
        _readings_along_motion(one, *motion, key=own)
        for one, own in zip(sensors, keys, strict=True)
    )
    return out if several else out[0]


@eqx.filter_jit
def _readings_along_motion(
    sensor: AbstractSensor,
    body: Inertia | MassProperties,
    torque: Torque | None,
    ts: Array,
    state0: State,
    states: PyTree,
    *,
    key: PRNGKeyArray | None,
) -> Float[Array, "times ..."]:
    """Return the readings (T, *reading_shape) of one sensor at T times along a motion, in the unit
    of the sensor, computed in one compiled program.

    `reading_shape` is the shape of one reading of the sensor.

    - `sensor`: the sensor, with its bias, clock offset, low-pass filter and full scale.
    - `body`, `torque`: the body, and the torque of the motion or `None`.
    - `ts`: (T,) the time stamps of the readings, s.
    - `state0`: the initial state of the body.
    - `states`: the states at `ts`; if the torque has states of its own (such as the speed of a
      motor), a `Coupled`, which holds the states of the body and of the torque.
    - `key`: the random key of the noise and of the jitter (random error of the time stamps); `None`
      for readings without noise and jitter.
    """
    jitter, late = getattr(sensor, "jitter", None), None
    if key is not None and jitter is not None:
        key, own = jax.random.split(key)
        late = jitter.deviation * jax.random.normal(own, ts.shape, ts.dtype)
    times, states, input_at = sensor_inputs(sensor, body, torque, ts, state0, states, late)
    error = jnp.zeros((ts.shape[0], sensor.components), ts.dtype)
    if key is not None:
        assert sensor.noise is not None
        error = sensor.noise[None] * jax.random.normal(key, error.shape, ts.dtype)
    reading = getattr(sensor, "reading_of", None)
    if reading is not None:
        values = jax.vmap(lambda t, y, e: reading(input_at(t, y), e))(times, states, error)
    else:
        nothing = jnp.zeros((ts.shape[0], *sensor.reading_shape), ts.dtype)
        missed = errors_along(sensor, nothing, times, states, input_at)
        values = (error - missed).reshape(ts.shape[0], *sensor.reading_shape)
    limit = getattr(sensor, "limit", None)
    return values if limit is None else jnp.clip(values, -limit[None], limit[None])


def _require_sensor_for_simulation(sensor: PyTree, state0: State, key: object) -> None:
    """Raise an error unless `sensor` is a sensor whose readings of a motion can be simulated.

    - `sensor`: must be a single sensor, not a batch. Its readings must have as many numbers as its
      error has components, unless the sensor has a method `reading_of`.
    - `state0`: the initial state of the motion, which must have the parts that the sensor reads.
    - `key`: a random key, or `None` for readings without noise and jitter. With a key the noise of
      the sensor must be known. With a key a sensor that has jitter (a random error of its time
      stamps) must have jitter of known size and no low-pass filter.
    """
    name, wanted = type(sensor).__name__, "a sensor such as Gyro(0.01), or several"
    _checks.require_instance(sensor, AbstractSensor, "sensor", requirement=wanted)
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
            f"{sensor.components} numbers plus a prediction; write a method reading_of(motion, "
            "error), the reading whose error is this one"
        )
