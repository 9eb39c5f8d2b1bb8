"""Compute one step of a filter, and draw motions under a random torque."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree, UInt32

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin, Mat3, Scalar
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties, inverse
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.filtering import roots
from rigidjax.identify.model.build import TURN_OF_A_FILTER_STEP
from rigidjax.identify.model.free import with_leaves
from rigidjax.identify.model.predict import needed_body, shifted_state
from rigidjax.identify.model.scene import (
    Process,
    Scene,
    require_known_torque,
    require_unknown_torque,
)
from rigidjax.identify.model.walks import Drift
from rigidjax.identify.sensors import AbstractSensor, Gyro, SensorInput
from rigidjax.identify.sensors.base import extras
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.manifold import (
    dimension,
    rotation_slices,
    tangent_to_vector,
    vector_to_tangent,
)
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque
from rigidjax.motion.torques.base import Torque, in_precision, require_torque, tensor_of
from rigidjax.motion.torques.composite import parts_of
from rigidjax.rotation.kernels import to_unit_length
from rigidjax.rotation.linalg3 import cross
from rigidjax.solve import equations_of_motion
from rigidjax.solve.steps.equal_steps import state_after_step
from rigidjax.solve.steps.tableaus import KUTTA4


class ExtendedState(eqx.Module):
    """Hold the state that a filter follows.

    **Fields:**

    - `motion`: a `Spin`, `Attitude` or `Rigid`.
    - `torques`: the value (3,) of each `CorrelatedTorque`, N m, body frame.
    - `walks`: the value of each `Walk`, a number that drifts as a random walk.

    An error of the state is a vector: the changes of motion, torques and walks, in this order, as
    in `motion.manifold`.
    """

    motion: Any
    torques: tuple[Array, ...]
    walks: tuple[Array, ...]


def require_sensors(sensors: Sequence[AbstractSensor]) -> None:
    """Raise `ValueError` for a sensor that the filter cannot use."""
    for sensor in sensors:
        name = type(sensor).__name__
        if sensor.noise is None:
            raise ValueError(
                f"{name}: wanted its noise, by which a filter weighs each reading, got None; give "
                f"{name}(noise=…), such as the noise that identify.fit estimates"
            )
        if extras(sensor).jitter is not None:
            raise ValueError(
                f"{name}: jitter makes the errors of a reading depend on each other, but the "
                "filter takes them as independent; leave the jitter out, and give more noise"
            )


class Dynamics(eqx.Module):
    """Hold the equations of motion, the noise and the sensors that a filter uses, for one dtype and
    one type of state; densities are given by their square roots.
    """

    scene: Scene
    field: Callable[..., Any]  # under the known torque
    inverse: Mat3  # of the inertia tensor
    white: tuple[Array, ...]  # the density of each `RandomTorque`
    coloured: tuple[tuple[Array, Scalar], ...]  # density and time, s, of each `CorrelatedTorque`
    drifts: tuple[Array, ...]  # the density of each walk
    paths: tuple[tuple[Any, ...], ...] = eqx.field(static=True)  # of each walk in the scene

    @property
    def normals_per_step(self) -> int:
        return 6 * (len(self.white) + len(self.coloured))

    def with_torques(self, rate_of_change: PyTree, torques: Sequence[Array]) -> PyTree:
        """Return the rate of change of a motion under additional `torques` (3,), body frame."""
        if not torques:
            return rate_of_change
        spin = rate_of_change.omega + jnp.sum(self.inverse * sum(torques[1:], torques[0])[None], 1)
        return eqx.tree_at(lambda s: s.omega, rate_of_change, spin)

    def advance(
        self, t: Scalar, h: Scalar, x: ExtendedState, kicks: Float[Array, " normals"]
    ) -> ExtendedState:
        """Return the state after a step of duration h, s, from the state x at the time t.

        The step is one of the classical Runge–Kutta method of order 4. The `kicks` are unit normal
        numbers, six for each random torque: each white noise is replaced by `√(density/h) (k₀ + √3
        (1 − 2τ/h) k₁)` at the time t + τ, where k₀ and k₁ (3,) are kicks. These are the first two
        terms of the expansion of white noise in Legendre polynomials. If the body is at rest at t,
        its rate and angle at t + h have, to first order in the noise, the exact joint covariance
        (Foster, Lyons and Oberhauser 2020, doi:10.1137/19M1261912).
        """
        safe = jnp.where(h > 0, h, 1)
        pairs = kicks.reshape(-1, 2, 3) * roots.inverse_sqrt(h)

        def noise_at(pair: Array, share: Scalar) -> Array:
            return pair[0] + 3.0**0.5 * share * pair[1]

        def rate_of_state(elapsed: Scalar, state: tuple[Any, tuple]) -> tuple[Any, tuple]:
            motion, torques = state
            share = 1.0 - 2.0 * elapsed / safe
            white = [r * noise_at(pair, share) for r, pair in zip(self.white, pairs, strict=False)]
            later = zip(self.coloured, pairs[len(self.white) :], torques, strict=True)
            slopes = tuple(
                (r * noise_at(pair, share) - tau) / time for (r, time), pair, tau in later
            )
            change = self.field(t + elapsed, motion, None)
            return self.with_torques(change, [*white, *torques]), slopes

        motion, torques = state_after_step(
            KUTTA4, rate_of_state, jnp.zeros_like(h), h, (x.motion, x.torques)
        )
        if isinstance(motion, HasAttitude):
            motion = eqx.tree_at(lambda s: s.q, motion, to_unit_length(motion.q))
        return ExtendedState(motion, torques, x.walks)

    def predict(
        self, t: Scalar, h: Scalar, x: ExtendedState, kicks: Array | None = None
    ) -> "Prediction":
        """Return the state after a step of duration h, s, from the state x at the time t, and the
        transition and noise of its errors, linearised at the `kicks` (zeros for `None`).
        """
        kicks = jnp.zeros(self.normals_per_step, x.motion.omega.dtype) if kicks is None else kicks
        after, push = jax.linearize(lambda y, k: self.advance(t, h, y, k), x, kicks)
        moving = ExtendedState(x.motion, x.torques, ())
        size, drifting = dimension(moving), dimension(x) - dimension(moving)
        still = tuple(jnp.zeros_like(w) for w in x.walks)

        def jacobian_column(unit: Array) -> Array:
            along = vector_to_tangent(moving, unit[:size])
            moved = push(ExtendedState(along.motion, along.torques, still), unit[size:])
            return tangent_to_vector(after, moved)[:size]

        both = jax.vmap(jacobian_column, out_axes=1)(
            jnp.eye(size + self.normals_per_step, dtype=kicks.dtype)
        )
        grown, noise = both[:, :size], both[:, size:]
        if not drifting:
            return Prediction(after, grown, noise)
        same = jnp.eye(drifting, dtype=kicks.dtype)
        strewn = jnp.diag(jnp.concatenate([d.reshape(-1) for d in self.drifts]) * jnp.sqrt(h))
        return Prediction(after, block_diag(grown, same), block_diag(noise, strewn))


class Prediction(NamedTuple):
    state: ExtendedState
    transition: Float[Array, "n n"]  # maps an error before the step to one after it
    noise: Float[Array, "n m"]  # a root of the covariance that the step adds, walks last


def dynamics_of(scene: Scene, drifts: Sequence[Drift], x: ExtendedState) -> Dynamics:
    """Return the `Dynamics` of a `scene` whose torque reads no `Input`, for states like x."""
    dtype = x.motion.omega.dtype
    body: Any = needed_body(in_precision(scene.body, dtype), type(x.motion))
    return Dynamics(
        eqx.tree_at(lambda s: s.body, scene, body),
        equations_of_motion(body, x.motion, in_precision(scene.torque, dtype)),
        inverse(tensor_of(body)),
        tuple(
            jnp.sqrt(law.density.astype(dtype))
            for law in parts_of(scene.process)
            if isinstance(law, RandomTorque)
        ),
        tuple(
            (jnp.sqrt(law.density.astype(dtype)), law.time.astype(dtype))
            for law in correlated_torques(scene.process)
        ),
        tuple(jnp.sqrt(drift.density.astype(dtype)) for drift in drifts),
        tuple(drift.path for drift in drifts),
    )


def correlated_torques(process: Process | None) -> tuple[CorrelatedTorque, ...]:
    """Return the unknown torques that are correlated in time: a filter takes them as states."""
    return tuple(part for part in parts_of(process) if isinstance(part, CorrelatedTorque))


def recentred_root(
    x: ExtendedState,
    change: Float[Array, " n"],
    root: Float[Array, "n m"],
    *,
    inverse: bool = False,
) -> Float[Array, "n m"]:
    """Return a root of the covariance of errors about the neighbour x + e of x with the `change` e,
    from the `root` for errors about x.

    Only the rows of rotation vectors change: a rotation vector e + δ from x is the rotation vector
    `log(exp(−e) exp(e + δ)) ≈ J_r(e) δ` from the neighbour. Here J_r is the right Jacobian, to
    second order in e (Mueller, Hehn and D'Andrea 2017, doi:10.2514/1.G000848). With `inverse` the
    `root` belongs to the neighbour and the result to x: the rows are multiplied by `J_r(e)⁻¹`, to
    third order in e.
    """
    first, second = (0.5, 1 / 12) if inverse else (-0.5, 1 / 6)
    across = jax.vmap(cross, (None, 1), 1)
    for rows in rotation_slices(x):
        turn, mine = change[rows], root[rows]
        once = across(turn, mine)
        mine = mine + first * once + second * across(turn, once)
        root = jnp.concatenate([root[: rows.start], mine, root[rows.stop :]])
    return root


class Stops(NamedTuple):
    """Hold the times at which the steps of a filter end, and the readings of each sensor there.

    One step uses one row of each array.
    """

    t: Array
    values: tuple[Array, ...]
    masks: tuple[Array, ...]  # whether there is a reading


class LinearReadings(NamedTuple):
    """Hold the k components of the errors of all sensors."""

    matrix: Float[Array, "k n"]  # the derivatives of the predicted readings
    error: Float[Array, " k"]  # reading minus prediction
    deviation: Float[Array, " k"]
    mask: Bool[Array, " k"]  # true for a component that was read and is below full scale


def linearise_readings(dynamics: Dynamics, stop: Stops, x: ExtendedState) -> LinearReadings:
    """Return the readings of all sensors at one time, linearised about the predicted state x."""
    dtype = x.motion.omega.dtype
    t = stop.t.astype(dtype)
    basis = jax.vmap(lambda e: vector_to_tangent(x, e))(jnp.eye(dimension(x), dtype=dtype))
    out = []
    for index, (value, mask) in enumerate(zip(stop.values, stop.masks, strict=True)):
        sensor = in_precision(dynamics.scene.sensors[index], dtype)

        def reading_error(y: ExtendedState, index: int = index, value: Array = value) -> Array:
            scene = with_leaves(dynamics.scene, dynamics.paths, y.walks)
            drifted = in_precision(scene.sensors[index], dtype)

            def field_with_torques(t: Array, state: PyTree, args: object = None) -> PyTree:
                return dynamics.with_torques(dynamics.field(t, state, args), y.torques)

            motion, when = y.motion, t
            offset = extras(drifted).offset
            if offset is not None:
                motion, when = shifted_state(field_with_torques, t, motion, offset), t + offset
            return drifted.error(
                SensorInput(when, motion, dynamics.scene.body, field_with_torques), value
            )

        value_of_error, push = jax.linearize(reading_error, x)
        matrix = -jax.vmap(push, out_axes=1)(basis)
        mask = jnp.broadcast_to(mask, value_of_error.shape)
        limit = extras(sensor).limit
        if limit is not None:
            mask = mask & (jnp.abs(value) < limit * (1 - 1e-6))
        assert sensor.noise is not None
        out.append((matrix, value_of_error, sensor.noise, mask))
    return LinearReadings(*(jnp.concatenate(parts) for parts in zip(*out, strict=True)))


class ReadNumbers(NamedTuple):
    """Hold the numbers that a filter read from one sensor, compared with their predictions.

    **Fields:** `innovation` is each number minus its prediction from all numbers read before;
    `variance` is the variance of each innovation; `mask` is true for a number that was read.
    """

    innovation: Float[Array, "*times k"]
    variance: Float[Array, "*times k"]
    mask: Bool[Array, "*times k"]


def split_by_sensor(
    sensors: Sequence[AbstractSensor], numbers: ReadNumbers
) -> tuple[ReadNumbers, ...]:
    """Return, for each sensor, its part of the numbers of all, which follow one another."""
    ends = np.cumsum([sensor.components for sensor in sensors])[:-1]
    return tuple(
        ReadNumbers(*own) for own in zip(*(jnp.split(a, ends, -1) for a in numbers), strict=True)
    )


# A step is at most this fraction of the correlation time of a torque.
MEMORY_A_STEP = 0.25


def step_counts(
    process: Process | None,
    ts: Array | np.ndarray,
    state: HasSpin,
    substeps: int | None,
    recording: Recording | None = None,
) -> Int[np.ndarray, " intervals"]:
    """Return the number of fixed steps from each time to the next, `substeps` if given.

    A step is at most a quarter of each correlation time, and the body turns only little in it, by
    its rate in `state` or the rates that gyros read. The number is 1 if JAX traces these.
    """
    if substeps is not None:
        return np.full(ts.shape[0] - 1, _checks.integer(substeps, "substeps", 1))
    coloured = correlated_torques(process)
    if not _checks.is_known((ts, state.omega, coloured)):
        return np.ones(ts.shape[0] - 1, int)
    rate = float(np.linalg.norm(np.asarray(state.omega, float)))
    for reading in () if recording is None else recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values, float)[reading.host_mask]
            rate = max(rate, float(np.quantile(np.linalg.norm(values, axis=1), 0.99)))
    times = [MEMORY_A_STEP * float(law.time) for law in coloured]
    longest = min([TURN_OF_A_FILTER_STEP / rate if rate > 0 else math.inf, *times])
    return np.maximum(1, np.ceil(np.diff(ts) / longest * (1 - 1e-9))).astype(int)


class Sampled(eqx.Module):
    """Hold the result of `sample`.

    **Fields:** `t` (T,) holds the times, s; `states` the states at these times, with a leading time
    axis; `torques` the value (T, 3) of each `CorrelatedTorque`, N m, body frame.
    """

    t: Float[Array, " times"]
    states: Any
    torques: tuple[Float[Array, "times 3"], ...]


def sample(
    key: PRNGKeyArray | UInt32[Array, "2"],
    body: Inertia | MassProperties,
    state0: Spin | Attitude | Rigid,
    ts: Float[ArrayLike, " times"] | Sequence[float],
    *,
    process: Process,
    torque: Torque | None = None,
    substeps: int | None = None,
) -> Sampled:
    """Draw one motion that a random torque could make.

    For each step the integral and the first moment of the white noise are drawn. The white noise is
    then replaced by the linear function of time that has this integral and this moment. The
    equations of motion are integrated by one step of the classical Runge–Kutta method of order 4.
    The whole method is of order 1.5; if the body is at rest before a step, its rate and angle after
    the step have, to first order in the noise, the exact joint covariance (Foster, Lyons and
    Oberhauser 2020, doi:10.1137/19M1261912). A `CorrelatedTorque` starts from its stationary
    distribution.

    **Arguments:**

    - `key`: a key of `jax.random`.
    - `body`: an `Inertia`, or `MassProperties` for a `Rigid` state.
    - `state0`: a `Spin`, `Attitude` or `Rigid`, the state at the first time.
    - `ts`: (T,) increasing times, s.
    - `process`: the random torque, a `RandomTorque`, a `CorrelatedTorque` or a `Sum` of them.
    - `torque`: the known torque, or `None`.
    - `substeps`: the number of fixed steps between two times; `None` chooses this number by the
      initial body rate and the correlation times, and takes 1 if JAX traces these.

    **Returns** `t`, `states` and `torques` at these times (`Sampled`). **Raises** `ValueError` for
    times that do not increase.

    >>> import jax
    >>> body, ts = rj.Inertia.from_principal(1.0, 2.0, 2.5), [0.0, 0.5, 1.0]
    >>> process = rj.torques.RandomTorque(0.01)
    >>> drawn = sample(jax.random.key(0), body, rj.Spin([0.0, 0.0, 1.0]), ts, process=process)
    >>> drawn.states.omega.shape, drawn.torques  # white noise has no value at a time
    ((3, 3), ())
    """
    _checks.random_key(key)
    body = validation.require_single_body(body, (Inertia, MassProperties), "body")
    _checks.require_unbatched_instance(
        state0, HasSpin, "state0", requirement="a Spin, an Attitude or a Rigid"
    )
    require_unknown_torque(process)
    if torque is not None:
        require_torque(torque)
    require_known_torque(torque)
    times = _checks.array_of_rows(ts, (), "ts")
    if times.shape[0] < 2:
        raise ValueError(f"ts: wanted at least two times, got {times.shape[0]}")
    if _checks.is_known(times):
        words = "ts: wanted increasing times, got some that are equal or decrease"
        _checks.error_if(times, not (np.diff(np.asarray(times)) > 0).all(), words)
    pieces = int(step_counts(process, times, state0, substeps).max())
    scene = Scene(body, torque, process, (), project_to_group(state0))
    return _sample(key, scene, times, pieces)


@eqx.filter_jit
def _sample(
    key: PRNGKeyArray | UInt32[Array, "2"], scene: Scene, ts: Array, pieces: int
) -> Sampled:
    """Draw one motion in one compiled program, by `pieces` equal steps between two times."""
    state0: Any = scene.start
    dtype, coloured = state0.omega.dtype, correlated_torques(scene.process)
    first, later = jax.random.split(key)
    keys = jax.random.split(first, len(coloured))
    torques = tuple(
        law.deviation.astype(dtype) * jax.random.normal(one, (3,), dtype)
        for law, one in zip(coloured, keys, strict=True)
    )
    x0 = ExtendedState(state0, torques, ())
    dynamics = dynamics_of(scene, (), x0)

    def cross_interval(
        x: ExtendedState, row: tuple[Array, Array, Array]
    ) -> tuple[ExtendedState, ExtendedState]:
        left, right, one = row
        # Subtract times before they are rounded to the dtype of the state: for times that are long
        # after zero the seven digits of float32 are too few.
        h = ((right - left) / pieces).astype(dtype)
        left = left.astype(dtype)
        kicks = jax.random.normal(one, (pieces, dynamics.normals_per_step), dtype)

        def advance(x: ExtendedState, piece: tuple[Array, Array]) -> tuple[ExtendedState, None]:
            return dynamics.advance(left + piece[0] * h, h, x, piece[1]), None

        x, _ = lax.scan(advance, x, (jnp.arange(pieces, dtype=dtype), kicks))
        return x, x

    keys = jax.random.split(later, ts.shape[0] - 1)
    _, rest = lax.scan(cross_interval, x0, (ts[:-1], ts[1:], keys))
    xs = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), x0, rest)
    return Sampled(ts, xs.motion, xs.torques)
