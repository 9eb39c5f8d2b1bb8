"""What readings say about a state: how far off they are, and how that depends on errors of it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax._types import Mat3, Scalar
from rigidjax.body.inertia import MassProperties
from rigidjax.estimate import roots
from rigidjax.estimate.scene import Dynamics, Extended, Model
from rigidjax.identify.propagation import shifted
from rigidjax.identify.recording import Reading, Recording
from rigidjax.identify.sensors import AbstractSensor, SensorInput
from rigidjax.motion import Rigid
from rigidjax.motion.manifold import dimension, tangent
from rigidjax.motion.torques.base import in_precision


class ReadingRow(NamedTuple):
    """What one sensor says of a state.

    **Fields:** `error` (k,) reading minus prediction; `matrix` (k, n) how the prediction changes
    with an error e of the state; `variance` (k,) of the noise; `seen` (k,) whether it counts.
    """

    error: Float[Array, " k"]
    matrix: Float[Array, "k n"]
    variance: Float[Array, " k"]
    seen: Bool[Array, " k"]


class Mounted(eqx.Module):
    """A sensor without its readings; `Walk.where` finds it as in a `Recording`."""

    sensor: AbstractSensor


class Sensors(eqx.Module):
    """The sensors of a recording, without its readings, and which of their numbers drift.

    No function is kept, so that a second model of the same form does not compile again.
    """

    readings: tuple[Mounted, ...]
    leaves: tuple[int, ...] = eqx.field(static=True)
    densities: tuple[Array, ...]

    @property
    def sensors(self) -> tuple[AbstractSensor, ...]:
        """In the order of the readings."""
        return tuple(mounted.sensor for mounted in self.readings)

    def drifted(self, walks: Sequence[Array]) -> "tuple[AbstractSensor, ...]":
        """The sensors with the walks' values in them."""
        leaves, structure = jax.tree.flatten(self.readings)
        for leaf, value in zip(self.leaves, walks, strict=True):
            leaves[leaf] = value
        return tuple(mounted.sensor for mounted in jax.tree.unflatten(structure, leaves))


def sensors_of(sensors: Sequence[AbstractSensor], model: Model) -> Sensors:
    """The sensors, looked at: each has a noise, and each walk finds its numbers."""
    for sensor in sensors:
        _checks.instance(sensor, AbstractSensor, "sensor")
        if sensor.noise is None:
            name = type(sensor).__name__
            raise ValueError(
                f"{name}: wanted its noise, a filter weighs each reading by it; give "
                f"{name}(noise=…), such as identify.fit estimates it"
            )
        if getattr(sensor, "lowpass", None) is not None:
            raise ValueError(
                f"{type(sensor).__name__}: a lowpass has a memory of its own, which the filter "
                "does not estimate; leave it out, and give its lag as offset"
            )
    readings = tuple(Mounted(sensor) for sensor in sensors)
    leaves = tuple(_leaf(walk.where, readings) for walk in model.walks)
    return Sensors(readings, leaves, tuple(walk.density for walk in model.walks))


class _Recorded(eqx.Module):
    readings: Any


def _leaf(where: Callable[[Any], Any], readings: tuple[Mounted, ...]) -> int:
    """Which of the sensors' numbers a `Walk` picks."""
    leaves, structure = jax.tree.flatten(readings)
    try:
        found = where(_Recorded(jax.tree.unflatten(structure, list(range(len(leaves))))))
    except (AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"Walk: nothing is there ({error})") from None
    if found is None:
        raise ValueError(
            "Walk: None is there; give the sensor a starting value, such as "
            "Gyro(noise, bias=[0.0, 0.0, 0.0])"
        )
    if not isinstance(found, int) or not eqx.is_inexact_array(leaves[found]):
        raise ValueError(f"Walk: wanted one array of numbers, got {type(found).__name__}")
    return found


class Pushed(eqx.Module):
    """Equations of motion with a torque beside, as sensors of the acceleration see them."""

    field: Callable[..., Any]
    inverse: Mat3
    torque: Array

    def __call__(self, t: Any, state: Any, args: Any = None) -> Any:
        change = self.field(t, state, args)
        spin = change.omega + jnp.sum(self.inverse * self.torque[None], 1)
        return eqx.tree_at(lambda s: s.omega, change, spin)


def rows(
    model: Model,
    dynamics: Dynamics,
    sensors: Sensors,
    t: Scalar,
    x: Extended,
    values: Sequence[Array],
    masks: Sequence[Array],
) -> list[ReadingRow]:
    """What each sensor's reading at t says of the state x."""
    dtype = x.motion.omega.dtype
    body = in_precision(model.body, dtype)
    if isinstance(body, MassProperties) and not isinstance(x.motion, Rigid):
        body = body.inertia
    basis = jax.vmap(lambda e: tangent(x, e))(jnp.eye(dimension(x), dtype=dtype))
    out = []
    for index, (value, mask) in enumerate(zip(values, masks, strict=True)):
        sensor = in_precision(sensors.sensors[index], dtype)

        def error(y: Extended, index: int = index, value: Array = value) -> Array:
            seeing = in_precision(sensors.drifted(y.walks)[index], dtype)
            field = dynamics.field
            if y.torques:
                field = Pushed(field, dynamics.inverse, sum(y.torques[1:], y.torques[0]))
            motion, when = y.motion, t
            offset = getattr(seeing, "offset", None)
            if offset is not None:
                motion, when = shifted(field, t, motion, offset), t + offset
            return seeing.error(SensorInput(when, motion, body, field), value)

        found, push = jax.linearize(error, x)
        matrix = -jax.vmap(push, out_axes=1)(basis)
        seen = jnp.broadcast_to(mask, found.shape)
        limit = getattr(sensor, "limit", None)
        if limit is not None:
            seen = seen & (jnp.abs(value) < limit * (1 - 1e-6))
        assert sensor.noise is not None
        out.append(ReadingRow(found, matrix, sensor.noise**2, seen))
    return out


class Read(NamedTuple):
    """What one sensor's readings gave.

    **Fields:** `innovation` (k,) what was read minus what was expected of all read before, the
    sensor's earlier components among them; `variance` (k,) of it; `seen` (k,).
    """

    innovation: Float[Array, "*times k"]
    variance: Float[Array, "*times k"]
    seen: Bool[Array, "*times k"]

    @property
    def log_density(self) -> Array:
        """The sum of the logarithms of the normal densities."""
        return jnp.sum(roots.log_normal(self.innovation, self.variance, self.seen))


def absorb_all(
    row: Sequence[ReadingRow], step: Array, root: Array
) -> tuple[Array, Array, tuple[Read, ...]]:
    """Potter's update by all numbers of all sensors, one by one."""
    stacked = ReadingRow(*(jnp.concatenate(parts) for parts in zip(*row, strict=True)))

    def one(carry: tuple[Array, Array], number: ReadingRow) -> tuple[Any, Any]:
        found = roots.absorb(*carry, number.matrix, number.error, number.variance, number.seen)
        return (found.step, found.root), (found.innovation, found.variance)

    (step, root), (innovation, variance) = lax.scan(one, (step, root), stacked)
    out, at = [], 0
    for part in row:
        here = slice(at, at + part.error.shape[0])
        out.append(Read(innovation[here], variance[here], part.seen))
        at = here.stop
    return step, root, tuple(out)


def values_of(recording: Recording, dtype: Any) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Values and masks of each reading."""
    readings: tuple[Reading, ...] = recording.readings
    return tuple(r.values.astype(dtype) for r in readings), tuple(r.mask for r in readings)
