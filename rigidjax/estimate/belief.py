"""The estimate of a state at a time, and the root of its covariance."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin
from rigidjax.estimate.scene import Extended, Model, not_negative, sensors_of, with_torque
from rigidjax.identify.recording import Recording
from rigidjax.identify.reference_states import attitudes, first_rate
from rigidjax.motion import Attitude, Spin
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.manifold import names


class Belief(eqx.Module):
    """An estimate of the state at a time, and the root S of its covariance `S Sᵀ`.

    **Fields:** `t` s; `x` the `Extended` state, `root` (n, n), with the rows in its order: for a
    `Spin` the errors of Ω; for an `Attitude` δθ (body frame, rad) and Ω; for a `Rigid` x, v, δθ, Ω;
    then 3 for each `CorrelatedTorque`, then the walks. After `filter` all fields have a leading
    time axis. `start` makes the first belief.
    """

    t: Float[Array, "*times"]
    x: Extended
    root: Float[Array, "*times n n"]

    @property
    def state(self) -> Any:
        """The `Spin`, `Attitude` or `Rigid`."""
        return self.x.motion

    @property
    def torques(self) -> tuple[Float[Array, "*times 3"], ...]:
        """Each `CorrelatedTorque`, N m, body frame."""
        return self.x.torques

    @property
    def walks(self) -> tuple[Array, ...]:
        """The value of each `Walk`."""
        return self.x.walks

    @property
    def covariance(self) -> Float[Array, "*times n n"]:
        """The covariance of the errors."""
        return self.root @ jnp.swapaxes(self.root, -1, -2)

    @property
    def deviation(self) -> Float[Array, "*times n"]:
        """The standard deviations of the errors."""
        return jnp.sqrt(jnp.sum(self.root**2, axis=-1))


def start(
    model: Model,
    recording: Recording,
    state: Any = None,
    *,
    rate: Any,
    attitude: Any = None,
    position: Any = None,
    velocity: Any = None,
) -> Belief:
    """The belief before the first reading.

    **Arguments:** `model`; `recording`, which gives the first time and the first values of the
    walks; `state` a `Spin`, `Attitude` or `Rigid`, the kind that is followed; `None` takes the
    initial attitude and rate from the recording (`Spin` if no sensor shows an attitude). Then
    standard deviations, one number or three, zero for known values: `rate` of Ω, rad/s; `attitude`
    rad; `position` m and `velocity` m/s of a `Rigid`. Torques start from their model's stationary
    distribution. **Returns** a `Belief`. **Raises:** `ValueError` for a deviation that is missing
    or below zero.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> model = Model(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.RandomTorque(1e-4))
    >>> start(model, record, rate=0.1).deviation.tolist()
    [0.1, 0.1, 0.1]
    """
    _checks.instance(model, Model, "model")
    _checks.instance(recording, Recording, "recording")
    model = with_torque(model, recording.torque)
    sensors = sensors_of(recording.sensors, model)
    if state is None:
        state = _shown(recording)
    _checks.single(state, HasSpin, "state", wanted="a Spin, an Attitude or a Rigid")
    state = on_the_group(state)
    dtype = state.omega.dtype
    given = {"attitude": attitude, "rate": rate, "position": position, "velocity": velocity}
    words = {"x": "position", "v": "velocity", "q": "attitude", "omega": "rate"}
    kind, wanted = type(state).__name__, [words[part] for part in names(state)]
    for name, value in given.items():
        if name not in wanted and value is not None:
            raise ValueError(f"{name}: a {kind} has none; leave it out")
        if name in wanted and value is None:
            raise ValueError(
                f"{name}: wanted the standard deviation of the first one, got None; a {kind} needs "
                + ", ".join(wanted)
            )
    parts = [_spread(given[name], (3,), name, dtype) for name in wanted]
    parts += [law.deviation.astype(dtype) for law in model.coloured]
    numbers = jax.tree.leaves(sensors.readings)
    walks = tuple(jnp.asarray(numbers[leaf]).astype(dtype) for leaf in sensors.leaves)
    for walk, value in zip(model.walks, walks, strict=True):
        parts.append(_spread(walk.deviation, value.shape, "deviation", dtype).reshape(-1))
        _spread(walk.density, value.shape, "density", dtype)
    x = Extended(state, tuple(jnp.zeros(3, dtype) for _ in model.coloured), walks)
    return Belief(recording.t[0], x, jnp.diag(jnp.concatenate(parts)))


def _spread(value: Any, shape: tuple[int, ...], name: str, dtype: Any) -> Array:
    deviation = not_negative(value, name)
    if deviation.shape not in ((), shape):
        raise ValueError(f"{name}: wanted one number or shape {shape}, got {deviation.shape}")
    return jnp.broadcast_to(deviation, shape).astype(dtype)


def _shown(recording: Recording) -> Spin | Attitude:
    """The initial attitude and rate that the readings show."""
    if not _checks.known(recording.t):
        raise TypeError("state: wanted a state; a traced recording shows none")
    omega = jnp.asarray(first_rate(recording), recording.t.dtype)
    if all(sensor.feels is HasSpin for sensor in recording.sensors):
        return Spin(omega)
    _, q = attitudes(recording)
    if not len(q):
        raise ValueError(
            "state: the readings alone show no initial attitude (an attitude sensor, two "
            "directions, or three markers do); give an Attitude"
        )
    return Attitude(jnp.asarray(np.asarray(q[0]), recording.t.dtype), omega)
