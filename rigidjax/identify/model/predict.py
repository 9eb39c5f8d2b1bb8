"""Predict the states of a body at the times of a recording, and the readings of sensors in these
states.
"""

import abc
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

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
from rigidjax.identify.sensors.base import extras
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.coupled import Coupled, CoupledEquations, with_own_states
from rigidjax.motion.suspension import AbstractSuspension, Law
from rigidjax.motion.torques import Carried
from rigidjax.motion.torques.carried import Kinematics, relative_acceleration
from rigidjax.motion.torques.inputs import bind
from rigidjax.motion.torques.states import freeze_own_states
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross
from rigidjax.solve import equations_of_motion, fixed, simulate, solvers
from rigidjax.solve.steps.components import split_scalars
from rigidjax.solve.steps.equal_steps import loop_low_order, state_after_step
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.fixed import equal_step, fill_rows, inputs_at_start
from rigidjax.solve.steps.steppers import cheapest_method, stepper_of
from rigidjax.solve.steps.tableaus import KUTTA4

# If the body turns by TURN_A_STEP rad in each step, a method of order 5 has an error of 1e-9 for
# each radian of the turn. A method of order 4 has this error with TURN_OF_ORDER_4 rad in each step,
# and one of its steps costs two thirds of a step of order 5.
TURN_A_STEP, TURN_OF_ORDER_4 = 0.1, 0.02
# More fixed steps than this number between two samples cost more than adaptive steps.
FINEST = 32
# `Adaptive.refine` multiplies the relative tolerance by _CLOSER, but never makes it smaller than
# _LEAST.
_LEAST, _CLOSER = 2.5e-14, 1e-2


State = Spin | Attitude | Rigid | Turn


class AbstractIntegrator(eqx.Module):
    """Integrate a forced motion inside a fit, with derivatives in forward mode.

    To make an integrator of your own, write a subclass with the method `states`. At its end a fit
    compares its predictions with those of an integrator of shorter steps (`refine`); if one changes
    by more than a twentieth of its noise, the fit goes on with the shorter steps.
    """

    @abc.abstractmethod
    def states(self, body: Body, state0: State, ts: Float[Array, " times"], torque: Law) -> PyTree:
        """Return the states of a forced motion at the times `ts`, s; `state0` is that at `ts[0]`.

        They are a `motion.Coupled` if the torque has states of its own, such as the speed of a
        motor.
        """

    def refine(self) -> "AbstractIntegrator | None":
        """Return an integrator of shorter steps, or `None` if shorter steps are not possible."""
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

    def states(self, body: Body, state0: State, ts: Float[Array, " times"], torque: Law) -> PyTree:
        y0 = with_own_states(body, state0, torque, ts[0])
        field = equations_of_motion(body, y0, torque)
        return fixed(loop_low_order(self.solver), field, ts, y0, self.substeps, self.last)

    def refine(self) -> AbstractIntegrator:
        if self.substeps > FINEST:
            return Adaptive()
        return FixedSteps(2 * self.substeps, self.solver, self.last)


def _tolerance(value: ScalarLike, name: str) -> Array:
    """Return a tolerance as an array, so that a new value needs no new compilation."""
    return jnp.asarray(_checks.python_float(value, name), jnp.result_type(float))


class Adaptive(AbstractIntegrator):
    """Integrate with steps that are chosen by tolerances, through `rigidjax.simulate`.

    **Arguments:** `rtol`, `atol` the relative and the absolute tolerance of each step, as for
    `rigidjax.simulate`. In float32 a relative tolerance of at least 1.2e-5 is used. A fit with
    other tolerances is not compiled again.

    >>> float(Adaptive().rtol)
    1e-09
    """

    rtol: Float[Array, ""] = eqx.field(converter=partial(_tolerance, name="rtol"), default=1e-9)
    atol: Float[Array, ""] = eqx.field(converter=partial(_tolerance, name="atol"), default=1e-12)

    def __check_init__(self):
        _checks.positive_float(self.rtol, "rtol")
        if _checks.python_float(self.atol, "atol"):
            _checks.positive_float(self.atol, "atol", "a number ≥ 0")

    def states(self, body: Body, state0: State, ts: Float[Array, " times"], torque: Law) -> PyTree:
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
    """Return an integrator for a body that turns by at most `turn` rad between two samples."""
    if turn <= TURN_OF_ORDER_4:
        return FixedSteps(1, solvers.RungeKutta4())
    substeps = max(1, math.ceil(turn / TURN_A_STEP))
    return FixedSteps(substeps) if substeps <= 20 else Adaptive()


class CarriedMotion(eqx.Module):
    """Hold the motion of a carried body, read from its log; call it with times (n,), s, as a
    `FreeMotion`.
    """

    body: MassProperties
    torque: Carried

    def __call__(self, ts: Array) -> Rigid:
        def state(t: Array) -> Rigid:
            now, com = self.torque.motion(t), self.body.com
            v = now.v + quaternion.rotate(now.q, cross(now.omega, com))
            return Rigid(now.x + quaternion.rotate(now.q, com), v, now.q, now.omega)

        return jax.vmap(state)(ts)

    def field(self, t: Array, state: Rigid, args: object = None) -> Rigid:
        """Return the logged time derivative of the state, for which I⁻¹ is not needed."""
        now: Kinematics = self.torque.motion(t)
        moved = relative_acceleration(now.omega, now.alpha, self.body.com)
        a = now.a + quaternion.rotate(now.q, moved)
        return Rigid(state.v, a, quaternion.rate(state.q, state.omega), now.alpha)


def known_motion(
    body: Body, state0: State, ts: Float[Array, " times"], torque: Law | None
) -> Callable[[Array], PyTree] | None:
    """Return the motion as a function of times, s, if no integrator is needed, else `None`."""
    if isinstance(torque, Carried):
        return CarriedMotion(cast(MassProperties, body), torque)
    if isinstance(torque, AbstractSuspension):
        free = torque.swing(body, cast(Turn, state0)) if torque.closed_form else None
    else:
        free = FreeMotion(body, state0) if torque is None else None
    return None if free is None else lambda times: free(times - ts[0])


class HeldSteps(AbstractIntegrator):
    """Integrate with one step of order 4 between samples, and hold the inputs in each step.

    The samples must be evenly spaced. If a delayed input changes inside a step, the step is split
    there.
    """

    last: Int[Array, ""] | None = eqx.field(default=None, repr=False)

    def states(self, body: Body, state0: State, ts: Float[Array, " times"], torque: Law) -> PyTree:
        return self.driven_states(body, state0, ts, torque, {})

    def driven_states(
        self,
        body: Body,
        state0: State,
        ts: Float[Array, " times"],
        torque: Law,
        inputs: dict[str, Array],
    ) -> PyTree:
        """Return the states at `ts` under a torque that reads sampled `inputs` (before + T, *k).

        The sample in row before + i is held in the step from `ts[i]` to `ts[i + 1]`. The torque's
        own states, such as the speed of a motor, are first integrated over the samples before
        `ts[0]`, while the body is held at its initial state.
        """
        count, size = ts.shape[0] - 1, (ts[1] - ts[0]).astype(jax.tree.leaves(state0)[0].dtype)
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


def shifted_state(field: Callable[..., Any], t: Array, state: PyTree, offset: Array) -> PyTree:
    """Return the state at t + `offset`, s, by four equal steps of order 4 along `field`."""
    h = offset / 4.0
    for index in range(4):
        state = state_after_step(KUTTA4, lambda t, y: field(t, y, None), t + index * h, h, state)
    return state


def needed_body(body: Body, state_type: type) -> Body:
    """Return the `Inertia` of a body, unless the state is one that needs the mass."""
    massless = state_type not in (Rigid, Turn)
    return body.inertia if isinstance(body, MassProperties) and massless else body


class Along(NamedTuple):
    """Hold the times at which a sensor reads, the states there, and a map to `SensorInput`."""

    # In s, after the clock offset.
    times: Float[Array, " times"]
    # The states at these times; a `Coupled` if the torque has states of its own.
    states: Any
    input_at: Callable[[Array, PyTree], SensorInput]


def sensor_inputs(
    sensor: AbstractSensor,
    body: Body,
    torque: Law | None,
    ts: Array,
    state0: State,
    states: PyTree,
    delay: Array | None = None,
) -> Along:
    """Return the `Along` of a sensor with the time stamps `ts`, s.

    The `states` are those at `ts`. `delay`, one number or one for each time, s, is added to the
    clock offset of the sensor.
    """
    turned = needed_body(body, type(state0))
    known = known_motion(turned, state0, ts, torque)
    carried = isinstance(known, CarriedMotion)
    field = known.field if carried else equations_of_motion(turned, state0, torque)
    offset, times = extras(sensor).offset, ts
    if delay is not None:
        offset = delay if offset is None else offset + delay
    if offset is not None:
        times = ts + offset
        if known is not None:
            states = known(times)
        else:
            whole = CoupledEquations(field, turned) if isinstance(states, Coupled) else field
            axes = (0, 0, 0 if jnp.ndim(offset) else None)
            states = jax.vmap(partial(shifted_state, whole), axes)(ts, states, offset)

    def input_at(t: Array, state: PyTree) -> SensorInput:
        if isinstance(torque, AbstractSuspension):
            # A sensor sees the body, not the angle.
            shown, rate = jax.jvp(partial(torque.state, body), (state,), (field(t, state, None),))
            return SensorInput(t, shown, body, lambda *_: rate)
        if not isinstance(state, Coupled):
            return SensorInput(t, state, body, field)
        return SensorInput(t, state.motion, body, freeze_own_states(field, state.own), state.own)

    return Along(times, states, input_at)


def errors_along(
    sensor: AbstractSensor, values: Float[Array, "times *shape"], along: Along
) -> Float[Array, "times k"]:
    """Return the errors of a sensor along a motion, reading minus prediction."""
    name, wanted = type(sensor).__name__, (sensor.components,)

    def error(t: Array, state: PyTree, value: Array) -> Array:
        # A user may have written the sensor's method `error`.
        motion = along.input_at(t, state)
        try:
            error = sensor.error(motion, value)
        except AttributeError as wrong:
            if type(motion.state).__name__ not in str(wrong):
                raise
            raise TypeError(
                f"{name}.error: {wrong}; it has feels = {sensor.feels.__name__}, but it reads more "
                "than that: set feels = rj.motion.HasAttitude, or rj.motion.HasPose"
            ) from wrong
        if jnp.shape(error) != wanted:
            raise ValueError(
                f"{name}.error: wanted reading minus prediction of shape {wanted}, as components = "
                f"{sensor.components} says, got {jnp.shape(error)}"
            )
        return error

    times, states, _ = along
    return jax.vmap(error)(times, states, values)


def simulate_readings(
    sensor: AbstractSensor | Sequence[AbstractSensor],
    body: Inertia | MassProperties,
    state0: Spin | Attitude | Rigid | Turn,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    torque: Law | None = None,
    *,
    key: PRNGKeyArray | None = None,
) -> Any:
    """Return the readings of a sensor along a known motion, with noise, as data to test a fit.

    `rigidjax.simulate` computes the motion. Bias, scale, mounting, clock offset and full scale are
    those of the sensor. The function may be differentiated, jitted and batched.

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
    _checks.require_instance(state0, (Spin, Attitude, Rigid, Turn), "state0", hint=order)
    shown = state0
    if isinstance(state0, Turn) and isinstance(torque, AbstractSuspension):
        shown = torque.state(body, state0)
    several = isinstance(sensor, Sequence)
    sensors = tuple(sensor) if several else (sensor,)
    if not sensors:
        raise ValueError("sensor: wanted a sensor or several, got none")
    for one in sensors:
        name, wanted = type(one).__name__, "a sensor such as Gyro(0.01), or several"
        _checks.require_instance(one, AbstractSensor, "sensor", requirement=wanted)
        if not isinstance(shown, one.feels):
            raise TypeError(
                f"{name} needs a state with {one.feels.__name__}, got {type(shown).__name__}; "
                "take Attitude, or Rigid for what depends on the position"
            )
        if one.noise is not None and jnp.shape(one.noise) != (one.components,):
            raise ValueError(
                f"sensor: {name}: noise: wanted shape ({one.components},), of one sensor, got "
                f"{jnp.shape(one.noise)}; for many use jax.vmap"
            )
        if key is not None and one.noise is None:
            raise ValueError(
                f"{name}: noise=None gives no size of the noise to draw; give noise, or key=None"
            )
        if extras(one).reading_of is None and math.prod(one.reading_shape) != one.components:
            raise ValueError(
                f"{name}: its readings of shape {one.reading_shape} are not its error of "
                f"{one.components} numbers plus a prediction; write a method reading_of(motion, "
                "error), the reading whose error is this one"
            )
    start: Any = state0
    if isinstance(torque, Carried):
        ts = jnp.asarray(ts, jnp.result_type(float))
        states = eqx.filter_jit(CarriedMotion(cast(MassProperties, body), torque))(ts)
    else:
        sol = simulate(needed_body(body, type(state0)), start, ts, torque)
        states, ts = sol.ys if sol.own is None else Coupled(sol.ys, sol.own), sol.ts
    count = len(sensors)
    keys = [None] * count if key is None else jax.random.split(_checks.random_key(key), count)
    motion = body, torque, ts, start, states
    out = tuple(_readings(one, *motion, key=own) for one, own in zip(sensors, keys, strict=True))
    return out if several else out[0]


@eqx.filter_jit
def _readings(
    sensor: AbstractSensor,
    body: Inertia | MassProperties,
    torque: Law | None,
    ts: Array,
    state0: State,
    states: PyTree,
    *,
    key: PRNGKeyArray | None,
) -> Float[Array, "times ..."]:
    """Return the readings of one sensor at the time stamps `ts` along a motion, in one program."""
    members, late = extras(sensor), None
    if key is not None and members.jitter is not None:
        key, own = jax.random.split(key)
        late = members.jitter * jax.random.normal(own, ts.shape, ts.dtype)
    along = sensor_inputs(sensor, body, torque, ts, state0, states, late)
    error = jnp.zeros((ts.shape[0], sensor.components), ts.dtype)
    if key is not None:
        assert sensor.noise is not None
        error = sensor.noise[None] * jax.random.normal(key, error.shape, ts.dtype)
    reading = members.reading_of
    if reading is not None:
        values = jax.vmap(lambda t, y, e: reading(along.input_at(t, y), e))(*along[:2], error)
    else:
        nothing = jnp.zeros((ts.shape[0], *sensor.reading_shape), ts.dtype)
        missed = errors_along(sensor, nothing, along)
        values = (error - missed).reshape(ts.shape[0], *sensor.reading_shape)
    limit = members.limit
    return values if limit is None else jnp.clip(values, -limit[None], limit[None])
