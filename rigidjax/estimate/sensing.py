"""The errors of readings at a state, and their derivatives in errors of the state."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax.estimate import roots
from rigidjax.estimate.scene import Dynamics, Extended, Model
from rigidjax.identify.free_parameters import leaf_at
from rigidjax.identify.propagation import shifted
from rigidjax.identify.sensors import AbstractSensor, SensorInput
from rigidjax.motion.manifold import dimension, tangent
from rigidjax.motion.torques.base import in_precision


class ReadingRow(NamedTuple):
    """The reading of one sensor, linearised about a state.

    **Fields:** `matrix` (k, n) how the prediction changes with an error e of the state; `error`
    (k,) reading minus prediction; `variance` (k,) of the noise; `seen` (k,) whether it counts.
    """

    matrix: Float[Array, "k n"]
    error: Float[Array, " k"]
    variance: Float[Array, " k"]
    seen: Bool[Array, " k"]


class Mounted(eqx.Module):
    """A sensor without its readings; `Walk.where` finds it as in a `Recording`."""

    sensor: AbstractSensor


class _Recorded(eqx.Module):
    readings: tuple[Mounted, ...]


class Sensors(eqx.Module):
    """The sensors of a recording, without its readings, and which of their numbers drift.

    No function is kept, so that a second model of the same form does not compile again.
    """

    readings: tuple[Mounted, ...]
    leaves: tuple[int, ...] = eqx.field(static=True)
    densities: tuple[Array, ...]

    def drifted(self, walks: Sequence[Array]) -> tuple[Mounted, ...]:
        """The sensors with the walks' values in them."""
        leaves, structure = jax.tree.flatten(self.readings)
        for leaf, value in zip(self.leaves, walks, strict=True):
            leaves[leaf] = value
        return jax.tree.unflatten(structure, leaves)


def sensors_of(sensors: Sequence[AbstractSensor], model: Model) -> Sensors:
    """The checked sensors: each has a noise, and each walk finds its numbers."""
    for sensor in sensors:
        _checks.instance(sensor, AbstractSensor, "sensor")
        name = type(sensor).__name__
        if sensor.noise is None:
            raise ValueError(
                f"{name}: wanted its noise, a filter weighs each reading by it; give "
                f"{name}(noise=…), such as identify.fit estimates it"
            )
        if getattr(sensor, "lowpass", None) is not None:
            raise ValueError(
                f"{name}: a lowpass has states of its own, which the filter does not estimate; "
                "leave it out, and give its lag as offset"
            )
    readings = tuple(Mounted(sensor) for sensor in sensors)
    tree = _Recorded(readings)
    leaves = tuple(leaf_at(walk.where, tree, "Walk", "the sensor")[0] for walk in model.walks)
    return Sensors(readings, leaves, tuple(walk.density for walk in model.walks))


class Stops(NamedTuple):
    """The times of the filter's steps, and the readings then."""

    t: Array
    values: tuple[Array, ...]
    masks: tuple[Array, ...]


def _rows(dynamics: Dynamics, sensors: Sensors, stop: Stops, x: Extended) -> list[ReadingRow]:
    """The reading of each sensor at one time, linearised about the state x."""
    dtype = x.motion.omega.dtype
    t = stop.t.astype(dtype)
    basis = jax.vmap(lambda e: tangent(x, e))(jnp.eye(dimension(x), dtype=dtype))
    out = []
    for index, (value, mask) in enumerate(zip(stop.values, stop.masks, strict=True)):
        sensor = in_precision(sensors.readings[index].sensor, dtype)

        def error(y: Extended, index: int = index, value: Array = value) -> Array:
            seeing = in_precision(sensors.drifted(y.walks)[index].sensor, dtype)

            def field(t: Any, state: Any, args: Any = None) -> Any:
                torque = sum(y.torques[1:], y.torques[0]) if y.torques else None
                return dynamics.pushed(dynamics.field(t, state, args), torque)

            motion, when = y.motion, t
            offset = getattr(seeing, "offset", None)
            if offset is not None:
                motion, when = shifted(field, t, motion, offset), t + offset
            return seeing.error(SensorInput(when, motion, dynamics.body, field), value)

        found, push = jax.linearize(error, x)
        matrix = -jax.vmap(push, out_axes=1)(basis)
        seen = jnp.broadcast_to(mask, found.shape)
        limit = getattr(sensor, "limit", None)
        if limit is not None:
            seen = seen & (jnp.abs(value) < limit * (1 - 1e-6))
        assert sensor.noise is not None
        out.append(ReadingRow(matrix, found, sensor.noise**2, seen))
    return out


class Read(NamedTuple):
    """The innovations of one sensor's readings.

    **Fields:** `innovation` (k,) the reading minus its prediction from all readings before, also
    from the sensor's earlier components; `variance` (k,) of it; `seen` (k,).
    """

    innovation: Float[Array, "*times k"]
    variance: Float[Array, "*times k"]
    seen: Bool[Array, "*times k"]

    @property
    def log_density(self) -> Array:
        """The sum of the logarithms of the normal densities."""
        return jnp.sum(roots.log_normal(self.innovation, self.variance, self.seen))


def absorb_all(
    dynamics: Dynamics, sensors: Sensors, stop: Stops, x: Extended, step: Array, root: Array
) -> tuple[Array, Array, tuple[Read, ...]]:
    """Potter's update by all numbers of all sensors, one by one, of an error of mean `step`."""
    rows = _rows(dynamics, sensors, stop, x)
    stacked = ReadingRow(*(jnp.concatenate(parts) for parts in zip(*rows, strict=True)))
    found = roots.absorb_all(step, root, *stacked)
    out, at = [], 0
    for row in rows:
        here = slice(at, at + row.error.shape[0])
        out.append(Read(found.innovation[here], found.variance[here], row.seen))
        at = here.stop
    return found.step, found.root, tuple(out)
