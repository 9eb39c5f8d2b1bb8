"""The readings of sensors along a known motion: simulated data."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.propagation import sensor_inputs, what_turns
from rigidjax.identify.sensors import AbstractSensor
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.torques.base import Torque
from rigidjax.solve import simulate

Body = Inertia | MassProperties


def simulate_readings(
    sensor: AbstractSensor | Sequence[AbstractSensor],
    body: Body,
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
    readings without either. **Returns**
    readings (T, …) by the sensor's `reading_shape`, in its unit, for `Recording(ts, (sensor,
    readings), torque=torque)`; for a sequence a tuple of them.

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
    sol = simulate(what_turns(body, type(state0)), start, ts, torque)
    states = sol.ys if sol.own is None else Coupled(sol.ys, sol.own)
    count = len(sensors)
    keys = [None] * count if key is None else jax.random.split(_checks.key(key), count)
    given = body, torque, sol.ts, start, states
    out = tuple(_readings(one, *given, key=own) for one, own in zip(sensors, keys, strict=True))
    return out if several else out[0]


@eqx.filter_jit
def _readings(
    sensor: AbstractSensor,
    body: Body,
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
    lowpass = getattr(sensor, "lowpass", None)
    reading = getattr(sensor, "reading_of", None)
    if reading is not None:
        values = jax.vmap(lambda t, y, e: reading(now(t, y), e))(times, states, error)
    else:
        # The error of a zero reading is the prediction with the opposite sign.
        nothing = jnp.zeros(sensor.reading_shape, ts.dtype)
        missed = jax.vmap(lambda t, y: sensor.error(now(t, y), nothing))(times, states)
        missed = missed if lowpass is None else -lowpass(times, -missed)
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
