"""The state equations of a filter (motion, torques, sensor errors), and random motions by them."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin, Mat3, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties, inverse
from rigidjax.estimate import roots
from rigidjax.identify.parameters import leaf_at
from rigidjax.identify.propagation import shifted, what_turns
from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import AbstractSensor, Gyro, SensorInput
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.manifold import coordinates, dimension, tangent, turns
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque, Sum
from rigidjax.motion.torques.base import Torque, in_precision, require_law, tensor_of
from rigidjax.motion.torques.composite import parts_of
from rigidjax.rotation.kernels import normalised
from rigidjax.rotation.linalg3 import cross
from rigidjax.solve import equations_of_motion
from rigidjax.solve.equal_steps import advance
from rigidjax.solve.tableaus import KUTTA4


class Walk(eqx.Module):
    """An unknown sensor error that drifts: `dx = √density dW`, a random walk.

    **Arguments:** `where` picks it as a `Free` does: `lambda r: r.readings[0].sensor.bias`; its
    value in the recording is the initial value; `deviation` of that value, one number or one for
    each component, in its unit; `density` of the drift, unit² / s, ≥ 0: zero for a constant error.
    **Raises** `ValueError` for a deviation or density below zero.

    >>> Walk(lambda r: r.readings[0].sensor.bias, 0.01).density.tolist()
    0.0
    """

    where: Callable[[Any], Any] = eqx.field(static=True)
    deviation: Array
    density: Array

    def __init__(self, where: Callable[[Any], Any], deviation: Any, density: Any = 0.0):
        words = "of a recording, such as lambda r: r.readings[0].sensor.bias"
        self.where = _checks.function(where, "where", words)
        self.deviation = not_negative(deviation, "deviation")
        self.density = not_negative(density, "density")


class Model(eqx.Module):
    """A body, its known and unknown torques, and the errors of its sensors that drift.

    **Arguments:** `body` an `Inertia`, or `MassProperties` for a `Rigid` state; `torque` any
    torques, among them `RandomTorque` and `CorrelatedTorque`, several in a `Sum`; `None` for a free
    body without noise; `walks` the `Walk`s.

    >>> model = Model(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.RandomTorque(1e-4))
    >>> len(model.white), len(model.coloured), model.torque
    (1, 0, None)
    """

    body: Inertia | MassProperties
    torque: Torque | None
    white: tuple[RandomTorque, ...]
    coloured: tuple[CorrelatedTorque, ...]
    walks: tuple[Walk, ...]

    def __init__(
        self, body: Inertia | MassProperties, torque: Torque | None = None, *, walks: Any = ()
    ):
        self.body = validation.single(body, (Inertia, MassProperties), "body")
        if torque is not None:
            require_law(torque)
        parts = parts_of(torque)
        self.white = tuple(part for part in parts if isinstance(part, RandomTorque))
        self.coloured = tuple(part for part in parts if isinstance(part, CorrelatedTorque))
        noise = (RandomTorque, CorrelatedTorque)
        known: list[Any] = [part for part in parts if not isinstance(part, noise)]
        self.torque = Sum(*known) if len(known) > 1 else (known[0] if known else None)
        walks = (walks,) if isinstance(walks, Walk) else tuple(walks)
        for walk in walks:
            _checks.instance(walk, Walk, "walks", wanted="a sequence of Walk(where, deviation)")
        self.walks = walks


def with_torque(model: Model, torque: Torque | None) -> Model:
    """The model with a recording's own torque beside its torques."""
    if torque is None:
        return model
    laws = Sum(*parts_of(model.torque), torque, *model.white, *model.coloured)
    return Model(model.body, laws, walks=model.walks)


def bare(model: Model) -> Model:
    """The model without its walks, whose functions would have each new one compiled again."""
    return eqx.tree_at(lambda m: m.walks, model, ())


class Extended(eqx.Module):
    """The state that a filter follows: `motion`, `torques` the value (3,) of each
    `CorrelatedTorque`, N m, body frame, and `walks` those of each `Walk`. Its errors are changes as
    `motion.manifold` counts them, in this order.
    """

    motion: Any
    torques: tuple[Array, ...]
    walks: tuple[Array, ...]


class Mounted(eqx.Module):
    """A sensor without its readings; `Walk.where` finds it as in a `Recording`."""

    sensor: AbstractSensor


class Sensors(eqx.Module):
    """The sensors without readings, and the leaves that drift. No function is kept: a second model
    of the same form does not compile again.
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
        if getattr(sensor, "jitter", None) is not None:
            raise ValueError(
                f"{name}: jitter makes errors that depend on each other, which the filter takes as "
                "independent; leave it out, and give more noise"
            )
    readings = tuple(Mounted(sensor) for sensor in sensors)
    tree = Sensors(readings, (), ())
    leaves = tuple(leaf_at(walk.where, tree, "Walk", "the sensor")[0] for walk in model.walks)
    return Sensors(readings, leaves, tuple(walk.density for walk in model.walks))


NO_SENSORS = Sensors((), (), ())


class Dynamics(eqx.Module):
    """A model and sensors for one dtype and kind of state: what does not change is made once."""

    body: Inertia | MassProperties
    field: Callable[..., Any]
    inverse: Mat3
    white: tuple[Array, ...]
    coloured: tuple[tuple[Array, Scalar], ...]
    walks: tuple[Array, ...]
    sensors: Sensors

    def __init__(self, model: Model, x: Extended, sensors: Sensors = NO_SENSORS):
        dtype = x.motion.omega.dtype
        self.body = what_turns(in_precision(model.body, dtype), type(x.motion))
        self.field = equations_of_motion(self.body, x.motion, in_precision(model.torque, dtype))
        self.inverse = inverse(tensor_of(self.body))
        self.white = tuple(jnp.sqrt(law.density.astype(dtype)) for law in model.white)
        self.coloured = tuple(
            (jnp.sqrt(law.density.astype(dtype)), law.time.astype(dtype)) for law in model.coloured
        )
        self.walks = tuple(
            jnp.broadcast_to(jnp.sqrt(density.astype(dtype)), value.shape)
            for density, value in zip(sensors.densities, x.walks, strict=True)
        )
        self.sensors = sensors

    @property
    def kicks(self) -> int:
        """The number of unit normal numbers in one step of motion and torques."""
        return 6 * (len(self.white) + len(self.coloured))

    def pushed(self, change: Any, torques: Sequence[Array]) -> Any:
        """A rate of change of the motion, with torques beside those of its equations."""
        if not torques:
            return change
        spin = change.omega + jnp.sum(self.inverse * sum(torques[1:], torques[0])[None], 1)
        return eqx.tree_at(lambda s: s.omega, change, spin)

    def advance(self, t: Scalar, h: Scalar, x: Extended, kicks: Array) -> Extended:
        """`x` a time `h` later, under noise; `kicks` (kicks,) of unit variance.

        White noise within the step is replaced by its first two Legendre polynomials,
        `√(density/h) (k₀ + √3 (1 − 2s/h) k₁)`, which give its effect on rate and angle their exact
        joint covariance for a body at rest (Foster, Lyons and Oberhauser 2020,
        doi:10.1137/19M1261912); the step is the classical one of order 4.
        """
        safe = jnp.where(h > 0, h, 1)
        pairs = kicks.reshape(-1, 2, 3) * roots.inverse_root(h)

        def push(pair: Array, share: Scalar) -> Array:
            return pair[0] + 3.0**0.5 * share * pair[1]

        def rate(since: Scalar, now: tuple[Any, tuple]) -> tuple[Any, tuple]:
            motion, torques = now
            share = 1.0 - 2.0 * since / safe
            white = [r * push(pair, share) for r, pair in zip(self.white, pairs, strict=False)]
            later = zip(self.coloured, pairs[len(self.white) :], torques, strict=True)
            slopes = tuple((r * push(pair, share) - tau) / time for (r, time), pair, tau in later)
            return self.pushed(self.field(t + since, motion, None), [*white, *torques]), slopes

        motion, torques = advance(KUTTA4, rate, jnp.zeros_like(h), h, (x.motion, x.torques))
        if isinstance(motion, HasAttitude):
            motion = eqx.tree_at(lambda s: s.q, motion, normalised(motion.q))
        return Extended(motion, torques, x.walks)

    def predict(
        self, t: Scalar, h: Scalar, x: Extended, kicks: Array | None = None
    ) -> tuple[Extended, Float[Array, "n n"], Float[Array, "n m"]]:
        """`x` a time `h` later, F (n, n) of its errors, and the root G (n, m) of the noise, about
        `kicks`; drifts of walks come last in G.
        """
        kicks = jnp.zeros(self.kicks, x.motion.omega.dtype) if kicks is None else kicks
        after, push = jax.linearize(lambda y, k: self.advance(t, h, y, k), x, kicks)
        moving = Extended(x.motion, x.torques, ())
        size, drifting = dimension(moving), dimension(x) - dimension(moving)
        still = tuple(jnp.zeros_like(w) for w in x.walks)

        def column(unit: Array) -> Array:
            along = tangent(moving, unit[:size])
            moved = push(Extended(along.motion, along.torques, still), unit[size:])
            return coordinates(after, moved)[:size]

        both = jax.vmap(column, out_axes=1)(jnp.eye(size + self.kicks, dtype=kicks.dtype))
        grown, noise = both[:, :size], both[:, size:]
        if not drifting:
            return after, grown, noise
        same = jnp.eye(drifting, dtype=kicks.dtype)
        strewn = jnp.diag(jnp.concatenate([w.reshape(-1) for w in self.walks]) * jnp.sqrt(h))
        return after, block_diag(grown, same), block_diag(noise, strewn)


def reset(
    x: Extended, e: Float[Array, " n"], root: Float[Array, "n m"], *, back: bool = False
) -> Float[Array, "n m"]:
    """The root of the errors about `x ⊕ e`, from the `root` of the errors about x.

    `log(exp(−e) exp(e + δ)) ≈ J_r(e) δ`, to second order in the turn e: Mueller, Hehn and D'Andrea
    2017, doi:10.2514/1.G000848. With `back` it multiplies by `J_r(e)⁻¹`, to third order: this is
    how `log(exp(e) exp(δ))` moves with δ.
    """
    first, second = (0.5, 1 / 12) if back else (-0.5, 1 / 6)
    across = jax.vmap(cross, (None, 1), 1)
    for rows in turns(x):
        turn, mine = e[rows], root[rows]
        once = across(turn, mine)
        mine = mine + first * once + second * across(turn, once)
        root = jnp.concatenate([root[: rows.start], mine, root[rows.stop :]])
    return root


def not_negative(value: Any, name: str) -> Array:
    """Finite numbers, none below zero."""
    array, wanted = _checks.numbers(value, name), "a finite number that is not below zero"
    if not array.size:
        raise ValueError(f"{name}: wanted {wanted}, got none")
    return _checks.sign(array, name, wanted, zero=True)


class Stops(NamedTuple):
    """The times of the filter's steps, and the readings then."""

    t: Array
    values: tuple[Array, ...]
    masks: tuple[Array, ...]


def linearised(
    dynamics: Dynamics, stop: Stops, x: Extended
) -> tuple[Float[Array, "k n"], Float[Array, " k"], Float[Array, " k"], Bool[Array, " k"]]:
    """All numbers read at one time about the state x: the matrix of their predictions, their
    errors, the deviations of these, and which are seen.
    """
    dtype = x.motion.omega.dtype
    t = stop.t.astype(dtype)
    basis = jax.vmap(lambda e: tangent(x, e))(jnp.eye(dimension(x), dtype=dtype))
    out = []
    for index, (value, mask) in enumerate(zip(stop.values, stop.masks, strict=True)):
        sensor = in_precision(dynamics.sensors.readings[index].sensor, dtype)

        def error(y: Extended, index: int = index, value: Array = value) -> Array:
            seeing = in_precision(dynamics.sensors.drifted(y.walks)[index].sensor, dtype)

            def field(t: Any, state: Any, args: Any = None) -> Any:
                return dynamics.pushed(dynamics.field(t, state, args), y.torques)

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
        out.append((matrix, found, sensor.noise, seen))
    matrix, errors, noise, seen = (jnp.concatenate(parts) for parts in zip(*out, strict=True))
    return matrix, errors, noise, seen


class Read(NamedTuple):
    """Of one sensor each `innovation`, the reading minus its prediction from all numbers read
    before, its `variance`, and whether it was `seen`.
    """

    innovation: Float[Array, "*times k"]
    variance: Float[Array, "*times k"]
    seen: Bool[Array, "*times k"]


def by_sensor(sensors: Sensors, read: Read) -> tuple[Read, ...]:
    """The `Read` of each sensor, from that of all numbers in a row."""
    ends = np.cumsum([mounted.sensor.components for mounted in sensors.readings])[:-1]
    return tuple(Read(*own) for own in zip(*(jnp.split(a, ends, -1) for a in read), strict=True))


# The turn in a step of the classical method of order 4, rad: its error is 5e-8 of the turn.
TURN_A_STEP = 0.05
# The longest step as a fraction of a torque's correlation time.
MEMORY_A_STEP = 0.25


def steps_of(
    model: Model, ts: Any, state: Any, substeps: int | None, recording: Recording | None = None
) -> np.ndarray:
    """The number of fixed steps from each of the times `ts` to the next: `substeps`, or by the rate
    of the `state` and of gyros, or one if numbers are not known.
    """
    if substeps is not None:
        return np.full(ts.shape[0] - 1, _checks.whole(substeps, "substeps", 1))
    if not _checks.known((ts, state.omega, model.coloured)):
        return np.ones(ts.shape[0] - 1, int)
    rate = float(np.linalg.norm(np.asarray(state.omega, float)))
    for reading in () if recording is None else recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values, float)[reading.seen]
            rate = max(rate, float(np.quantile(np.linalg.norm(values, axis=1), 0.99)))
    times = [MEMORY_A_STEP * float(law.time) for law in model.coloured]
    longest = min([TURN_A_STEP / rate if rate > 0 else math.inf, *times])
    return np.maximum(1, np.ceil(np.diff(ts) / longest * (1 - 1e-9))).astype(int)


class Sampled(eqx.Module):
    """The result of `sample`.

    **Fields:** `t` (T,) s; `states` with a leading time axis; `torques` the value (T, 3) of each
    `CorrelatedTorque`, N m, body frame.
    """

    t: Float[Array, " times"]
    states: Any
    torques: tuple[Float[Array, "times 3"], ...]


def sample(key: Any, model: Model, state0: Any, ts: Any, *, substeps: int | None = None) -> Sampled:
    """One motion that the model's random torques could have made.

    Each step draws the integral and the first moment of the white noise, and follows the equations
    of motion under the polynomial with these moments by the classical method of order 4: of order
    1.5, and exact for a body at rest (Foster, Lyons and Oberhauser 2020, doi:10.1137/19M1261912). A
    `CorrelatedTorque` starts from its stationary distribution.

    **Arguments:** `key` of `jax.random`; `model`; `state0` a `Spin`, `Attitude` or `Rigid`; `ts`
    (T,) increasing times, s, the first is of `state0`; `substeps` fixed steps between two times,
    `None` chooses them by the rate if it is known, else one. **Returns** `t`, `states` and
    `torques` at these times (`Sampled`). **Raises** `ValueError` for times that do not increase.

    >>> import jax
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> model = rj.estimate.Model(body, rj.torques.RandomTorque(0.01))
    >>> drawn = sample(jax.random.key(0), model, rj.Spin([0.0, 0.0, 1.0]), [0.0, 0.5, 1.0])
    >>> drawn.states.omega.shape, drawn.torques  # white noise has no value at a time
    ((3, 3), ())
    """
    _checks.key(key)
    _checks.instance(model, Model, "model")
    _checks.single(state0, HasSpin, "state0", wanted="a Spin, an Attitude or a Rigid")
    times = _checks.rows(ts, (), "ts")
    if times.shape[0] < 2:
        raise ValueError(f"ts: wanted at least two times, got {times.shape[0]}")
    if _checks.known(times):
        words = "ts: wanted increasing times"
        _checks.refuse(times, not (np.diff(np.asarray(times)) > 0).all(), words)
    pieces = int(steps_of(model, times, state0, substeps).max())
    return _sample(key, model, on_the_group(state0), times, pieces)


@eqx.filter_jit
def _sample(key: PRNGKeyArray, model: Model, state0: Any, ts: Array, pieces: int) -> Sampled:
    dtype = state0.omega.dtype
    first, later = jax.random.split(key)
    keys = jax.random.split(first, len(model.coloured))
    torques = tuple(
        law.deviation.astype(dtype) * jax.random.normal(one, (3,), dtype)
        for law, one in zip(model.coloured, keys, strict=True)
    )
    x0 = Extended(state0, torques, ())
    dynamics = Dynamics(model, x0)

    def span(x: Extended, given: tuple[Array, Array, Array]) -> tuple[Extended, Extended]:
        left, right, one = given
        # Times may have more digits than the state.
        h = ((right - left) / pieces).astype(dtype)
        left = left.astype(dtype)
        kicks = jax.random.normal(one, (pieces, dynamics.kicks), dtype)

        def move(x: Extended, now: tuple[Array, Array]) -> tuple[Extended, None]:
            return dynamics.advance(left + now[0] * h, h, x, now[1]), None

        x, _ = lax.scan(move, x, (jnp.arange(pieces, dtype=dtype), kicks))
        return x, x

    keys = jax.random.split(later, ts.shape[0] - 1)
    _, rest = lax.scan(span, x0, (ts[:-1], ts[1:], keys))
    xs = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), x0, rest)
    return Sampled(ts, xs.motion, xs.torques)
