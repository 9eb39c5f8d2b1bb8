"""Run an extended Kalman filter, in square-root form, whose state contains an attitude."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin, NumbersLike, Scalar, ScalarLike
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import attitudes
from rigidjax.identify.filtering import roots, steps
from rigidjax.identify.filtering.steps import (
    Dynamics,
    ExtendedState,
    ReadNumbers,
    Stops,
    correlated_torques,
    dynamics_of,
)
from rigidjax.identify.model.free import leaves_at
from rigidjax.identify.model.model import Model, bound_torque, checked_x, require_single, scene_at
from rigidjax.identify.model.scene import Process, Scene
from rigidjax.identify.model.walks import Drift, broadcast_to
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.manifold import leaf_names, plus


class Belief(eqx.Module):
    """Hold an estimate of the state at one time, and a root S of the covariance `S Sᵀ` of its
    errors.

    `first_belief` makes the belief before the first reading. The result of `filter` holds one
    `Belief` for all times, in which all fields have a leading time axis.

    **Fields:**

    - `t`: the time, s.
    - `x`: the estimated state, an `ExtendedState`: the motion (a `Spin`, `Attitude` or `Rigid`);
      each `CorrelatedTorque`, an unknown torque that is correlated in time; and each `Walk`, a
      number that drifts as a random walk, such as the bias of a gyro.
    - `root`: S (n, n) for the n components of an error of the state. Each component has a row, in
      this order: for a `Spin` the body rate Ω; for an `Attitude` a small turn δθ (body frame, rad)
      and Ω; for a `Rigid` the position, the velocity, δθ and Ω; then three rows for each
      `CorrelatedTorque`, and the rows of each `Walk`.
    """

    t: Float[Array, "*times"]
    x: ExtendedState
    root: Float[Array, "*times n n"]

    @property
    def state(self) -> Spin | Attitude | Rigid:
        """Return the estimated motion of this belief: a `Spin`, `Attitude` or `Rigid`, of the same
        type as the initial state.
        """
        return self.x.motion

    @property
    def torques(self) -> tuple[Float[Array, "*times 3"], ...]:
        """Return the torques (3,) of this belief, N m, body frame: the estimate of each
        `CorrelatedTorque`, an unknown torque that is correlated in time.
        """
        return self.x.torques

    @property
    def walks(self) -> tuple[Array, ...]:
        """Return the walks of this belief: the estimate of each `Walk`, a number that drifts as a
        random walk.
        """
        return self.x.walks

    @property
    def covariance(self) -> Float[Array, "*times n n"]:
        """Return the covariance `S Sᵀ` (n, n) of the errors of this belief, from its root S."""
        return self.root @ jnp.swapaxes(self.root, -1, -2)

    @property
    def deviation(self) -> Float[Array, "*times n"]:
        """Return the standard deviations (n,) of the errors of this belief, in the order of the
        rows of `root`.
        """
        return jnp.sqrt(jnp.sum(self.root**2, axis=-1))


def first_belief(
    model: Model,
    x: Float[Array, " n"] | None = None,
    *,
    state: Spin | Attitude | Rigid | None = None,
    rate: NumbersLike,
    attitude: NumbersLike | None = None,
    position: NumbersLike | None = None,
    velocity: NumbersLike | None = None,
) -> Belief:
    """Return the belief before the first reading: the estimated initial state with a root of the
    covariance of its errors.

    The walks (numbers of the model that drift randomly, such as the bias of a gyro) begin at the
    values that the model gives them. Each `CorrelatedTorque` begins at its stationary distribution.

    **Arguments:**

    - `model`: a `Model` of one recording.
    - `x`: (n,) the parameters of the model, such as `fit(model).x`. With `None` the body must be
      known.
    - `state`: the initial state, a `Spin`, `Attitude` or `Rigid`; `None` takes the initial state
      that x represents or, without x, the state that the first readings show.
    - `rate`: the standard deviation of the initial body rate Ω, rad/s, one number or three; zero if
      the rate is known.
    - `attitude`: the standard deviation of the initial attitude, rad, one number or three, for an
      `Attitude` or a `Rigid`.
    - `position`, `velocity`: the standard deviations of the initial position, m, and of the initial
      velocity, m/s, each one number or three, for a `Rigid`.

    **Returns** a `Belief`. **Raises:** `ValueError` for a deviation that is missing or below zero,
    and if neither x nor `state` is given and the readings show no initial attitude.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> model = rj.identify.Model(record, body, process=rj.torques.RandomTorque(1e-4))
    >>> first_belief(model, rate=0.1).deviation.tolist()
    [0.1, 0.1, 0.1]
    """
    scene, record = scene_and_recording(model, x)
    start: Any = scene.start if state is None else state
    if state is None and x is None:
        if not _checks.is_known(record):
            raise TypeError(
                "state: wanted the initial state, got None; the readings cannot show it, since "
                "they are traced by JAX"
            )
        if isinstance(start, HasAttitude) and not len(attitudes(record)[1]):
            raise ValueError(
                "state: the readings alone show no initial attitude (an attitude sensor, two "
                "directions, or three markers do); give an Attitude"
            )
    _checks.require_unbatched_instance(
        start, HasSpin, "state", requirement="a Spin, an Attitude or a Rigid"
    )
    start = project_to_group(start)
    deviations = {"attitude": attitude, "rate": rate, "position": position, "velocity": velocity}
    words = {"x": "position", "v": "velocity", "q": "attitude", "omega": "rate"}
    kind, wanted = type(start).__name__, [words[part] for part in leaf_names(start)]
    for name, value in deviations.items():
        if name not in wanted and value is not None:
            raise ValueError(f"{name}: a {kind} has no {name}; leave the argument out")
        if name in wanted and value is None:
            raise ValueError(
                f"{name}: wanted the standard deviation of the initial {name}, got None; a {kind} "
                "needs " + ", ".join(wanted)
            )
    parts = [broadcast_to(deviations[name], (3,), name) for name in wanted]
    return belief_at(record.t[0], start, jnp.concatenate(parts), scene, model.walks)


def belief_at(
    t: Scalar,
    state: HasSpin,
    deviations: Float[Array, " k"],
    scene: Scene,
    drifts: Sequence[Drift],
) -> Belief:
    """Return the `Belief` at the time t with independent errors, in the dtype of the `state`.

    The `deviations` are those of the motion. Each `CorrelatedTorque` begins at zero, with the
    deviation of its stationary distribution, and walks begin at their values in the scene.
    """
    dtype = state.omega.dtype
    coloured = correlated_torques(scene.process)
    values = leaves_at(scene, [drift.path for drift in drifts])
    walks = tuple(value.astype(dtype) for value in values)
    parts = [deviations, *(law.deviation for law in coloured)]
    parts += [drift.deviation.reshape(-1) for drift in drifts]
    root = jnp.diag(jnp.concatenate([part.astype(dtype) for part in parts]))
    return Belief(
        t, ExtendedState(state, tuple(jnp.zeros(3, dtype) for _ in coloured), walks), root
    )


def scene_and_recording(model: Model, x: Float[Array, " n"] | None) -> tuple[Scene, Recording]:
    """Return the scene of the only recording at the parameters x, and the recording.

    The torque of the scene reads the inputs that the recording holds.
    """
    require_single(model)
    if model.count != 1:
        raise ValueError(
            f"model: wanted one recording, got {model.count}; filter each by a model of its own, "
            "or put other readings in a model of one by equinox.tree_at, under jax.vmap"
        )
    if x is None:
        if model.index.bodies:
            raise ValueError(
                "x: wanted the parameters of the model, since its body is not known, got None; "
                "fit(model).x or model.start(body) makes them"
            )
        x = model.start()
    scene = _first_scene(model, checked_x(model, x))
    steps.require_sensors(scene.sensors)
    return scene, stacking.pick(model.records, 0)


@eqx.filter_jit
def _first_scene(model: Model, x: Float[Array, " n"]) -> Scene:
    row = model.index.rows(x)[0]
    record, reference, body_index = stacking.pick(
        (model.records, model.reference, model.body_indices), 0
    )
    scene = scene_at(model, row, record, reference, body_index)
    return dataclasses.replace(scene, torque=bound_torque(scene, record))


class Grid(NamedTuple):
    """Hold the N times at which the steps of a filter end.

    These are the T times of the recording, and times between them if the intervals are long.
    """

    t: Float[Array, " n"]  # s
    source: Int[Array, " n"]  # the first time of the recording that is not earlier
    real: Bool[Array, " n"]  # whether it is a time of the recording, whose readings count
    rows: Int[Array, " t"]  # the index in `t` of each time of the recording

    def at_recording(self, values: PyTree[Array]) -> PyTree[Array]:
        """Return the entries of `values`, arrays over all times, at those of the recording."""
        # If all times of the grid are times of the recording, indexing would only copy the arrays.
        same = self.rows.size == self.t.size
        return values if same else jax.tree.map(lambda leaf: leaf[self.rows], values)


def step_grid(
    process: Process | None, recording: Recording, belief: Belief, substeps: int | None
) -> Grid:
    """Return the times at which steps end: those of the recording and, if a step would be too long
    (`steps.step_counts`), times between them at equal distances.
    """
    xp = _checks.array_module((recording.t, belief.t))
    t, t0 = xp.asarray(recording.t), xp.asarray(belief.t)
    if xp is np:
        words = (
            f"recording: readings are out of order: the first is at {t[0]:g} s, before the time "
            f"of the belief it starts from, {t0:g} s"
        )
        _checks.error_if(t, t[0] < t0, words)
    ends = xp.concatenate([t0[None], t])
    counts = steps.step_counts(process, ends, belief.x.motion, substeps, recording)
    index = np.repeat(np.arange(counts.size), counts)
    rows = np.cumsum(counts) - 1
    part = (np.arange(index.size) - np.repeat(rows - counts, counts)) / counts[index]
    times = ends[index] + (t - ends[:-1])[index] * xp.asarray(part, t.dtype)
    times = xp.where(part == 1, t[index], times)
    return Grid(*map(jnp.asarray, (times, index, part == 1, rows)))


class FilterInput(NamedTuple):
    """Hold the checked arguments of a filter, which `checked_input` makes."""

    scene: Scene
    drifts: tuple[Drift, ...]
    recording: Recording
    first: Belief
    grid: Grid


# A filter is lost if, for at least LOST_AFTER seconds and at least LOST_READINGS readings of a
# sensor in a row, no reading was within LOST_BEYOND standard deviations of its prediction. WORDS
# has the texts for the status 0, 1 and 2 of a filter.
LOST_AFTER, LOST_READINGS, LOST_BEYOND = 1.0, 3, 6.0
WORDS = (
    "followed",
    "lost: no reading was within six standard deviations of its prediction for more than a second",
    "stopped: an estimate is NaN or infinite",
)


class Filtered(eqx.Module):
    """Hold the result of `filter`.

    **Fields:**

    - `belief`: the `Belief` (the estimate with a root of its covariance) at each of the T times of
      the recording, after the readings at this time.
    - `readings`: a `ReadNumbers` for each sensor, with three arrays (T, k) for the k components of
      a reading: `innovation` (reading minus prediction), the `variance` of the innovation, and
      `mask`, true for a component that was read.
    - `log_likelihood`: the logarithm of the density of all readings.
    - `status`: 0 if the filter followed the readings, 1 if it was lost, 2 if an estimate is not
      finite. `words` describes the status.
    - `lost_at`: the time at which the filter was lost, s; NaN if it was not lost.
    """

    belief: Belief
    readings: tuple[ReadNumbers, ...]
    log_likelihood: Scalar
    status: Int[Array, ""]
    lost_at: Scalar

    @property
    def t(self) -> Float[Array, " times"]:
        """Return the times of the estimates, s, which are the times of the recording."""
        return self.belief.t

    @property
    def states(self) -> Spin | Attitude | Rigid:
        """Return the estimated motion at the times of the recording, as one `Spin`, `Attitude` or
        `Rigid` with a leading time axis.
        """
        return self.belief.state

    @property
    def words(self) -> str:
        """Return the `status` of this result in words: the filter followed the readings, was lost,
        or stopped because an estimate is NaN or infinite.
        """
        return WORDS[int(self.status)]

    @property
    def nis(self) -> tuple[Float[Array, " times"], ...]:
        """Return the normalised innovations squared (T,) of each sensor: at each of the T times,
        the sum of ν²/s over the components that were read.

        The innovation ν is a component of the reading minus its prediction, and s is the variance
        of ν. If the model is right, the sum follows the χ² distribution, with as many degrees of
        freedom as components were read at this time (Bar-Shalom, Li and Kirubarajan, Estimation
        (2001), §5.4).
        """
        return tuple(
            jnp.sum(jnp.where(r.mask, r.innovation**2 / r.variance, 0), -1) for r in self.readings
        )


def filter(
    model: Model,
    belief: Belief,
    x: Float[Array, " n"] | None = None,
    *,
    substeps: int | None = None,
    throw: bool = True,
) -> Filtered:
    """Return attitude, rate, unknown torque and sensor errors from the readings up to each time.

    This is the multiplicative extended Kalman filter: the attitude is estimated as a quaternion,
    and its error is a rotation vector (Lefferts, Markley and Shuster 1982, doi:10.2514/3.56190).
    Between readings the estimate and its covariance follow the equations of motion, integrated by
    the classical Runge–Kutta method of order 4. A root of the covariance is stored, and Potter's
    formula updates this root for each component read.

    **Arguments:**

    - `model`: a `Model` of one recording; each of its sensors must have a `noise`. Masked readings
      and channels at full scale are left out. The clock `offset` of a sensor is taken into account.
    - `belief`: the belief before the first reading, such as `first_belief` returns.
    - `x`: (n,) the parameters of the model, such as `fit(model).x`, which give the body, the
      torques and the sensors. `None` for a model whose body is known.
    - `substeps`: the number of fixed steps from one time to the next; `None` chooses this number by
      the body rate and by the correlation times of unknown torques, and takes 1 if JAX traces
      these.
    - `throw`: whether to raise an error if the filter is lost or an estimate is not finite; with
      `False` look at `status`.

    **Returns** `belief`, `readings`, `log_likelihood`, `status` and `lost_at` (`Filtered`). It may
    be jitted, differentiated, and batched over `belief`, `x`, and readings that `equinox.tree_at`
    puts in the model.

    **Raises:** `ValueError` for several recordings, a sensor without noise, and readings before
    `belief`; with `throw` also if an estimate is not finite or the filter is lost. The filter is
    lost if for at least a second, and for at least three readings of one sensor in a row, no
    reading was within six standard deviations of its prediction.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> model = rj.identify.Model(record, body, process=rj.torques.RandomTorque(1e-4))
    >>> run = rj.identify.filter(model, rj.identify.first_belief(model, rate=1.0))
    >>> run.states.omega.shape, run.readings[0].innovation.shape, run.words
    ((2, 3), (2, 3), 'followed')
    """
    run = _filter(checked_input(model, belief, x, substeps))
    return require_followed(run) if throw else run


def require_followed(run: Any) -> Any:
    """Return the result of a filter, or raise an error if it was lost or is not finite."""
    status = run.status
    at = f" (at {float(run.lost_at):g} s)" if _checks.is_known(run.lost_at) else ""
    advice = (
        "; is the noise or density too small, or the initial state far off? throw=False returns "
        "the result"
    )
    run = _checks.error_if(run, status == 1, f"filter: {WORDS[1]}{at}{advice}")
    return _checks.error_if(run, status == 2, f"filter: {WORDS[2]}{advice}")


def log_likelihood(
    model: Model,
    belief: Belief,
    x: Float[Array, " n"] | None = None,
    *,
    substeps: int | None = None,
) -> Scalar:
    """Return the logarithm of the density of all readings, which is integrated over the unknown
    torques.

    The result is `Σ log N(ν; 0, s)` over the innovations ν (each reading minus its prediction from
    earlier readings). Here N(ν; 0, s) is the normal density with mean 0, and s is the variance of ν
    (Schweppe 1965, doi:10.1109/TIT.1965.1053737). The result is differentiable in forward and
    reverse mode. It can be maximised over moments, the spectral density of a torque, a noise or an
    initial state.

    **Arguments:** `model`, `belief`, `x`, `substeps` as for `filter`. **Raises** the errors of
    `filter`.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(1.0), [[1.0, 0, 0]] * 2))
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 1.0, 1.0))
    >>> model = rj.identify.Model(record, body)
    >>> first = rj.identify.first_belief(model, state=rj.Spin([1.0, 0, 0]), rate=0.0)
    >>> log_likelihood(model, first).round(6)
    Array(-5.513631, dtype=float64)
    """
    return _log_likelihood(checked_input(model, belief, x, substeps))


def step(
    model: Model,
    belief: Belief,
    t: ScalarLike,
    *readings: NumbersLike,
    mask: Sequence[Any] | None = None,
    x: Float[Array, " n"] | None = None,
) -> Belief:
    """Return the belief after the readings at the time t, to run a filter while the body moves.

    One step of the classical Runge–Kutta method of order 4 leads from the belief to the time t: the
    body may turn only little from one reading to the next.

    **Arguments:**

    - `model`: a `Model` of one recording. Its body, torque and sensors are used, its readings not.
    - `belief`: the result of `first_belief` or of the last `step`.
    - `t`: the time of the readings, s, not before the time of the belief.
    - `readings`: one reading of each sensor, in the order of the recording.
    - `mask`: a truth value for each sensor, false if the sensor has no reading at t (then the value
      in `readings` is not used). `None` if all sensors have one.
    - `x`: (n,) the parameters of the model; `None` for a model whose body is known.

    **Returns** the `Belief` at t. **Raises:** `ValueError` for a number of readings that is not the
    number of sensors; unless JAX traces the numbers, also for a t before the time of the belief and
    for a reading with NaN.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> model = rj.identify.Model(record, body, process=rj.torques.RandomTorque(1e-4))
    >>> belief = rj.identify.first_belief(model, rate=1.0)
    >>> rj.identify.step(model, belief, 0.1, jnp.array([1.0, 0.0, 0.0])).t
    Array(0.1, dtype=float64)
    """
    scene, _ = scene_and_recording(model, x)
    _checks.require_instance(belief, Belief, "belief", hint="identify.first_belief makes it")
    if belief.t.shape != ():
        raise ValueError(
            f"belief: wanted one belief, got several, with times of shape {belief.t.shape}; use "
            "jax.vmap for several"
        )
    when = _checks.checked_time(t).astype(belief.t.dtype)
    if _checks.is_known((when, belief.t)):
        words = f"t: readings are out of order: {float(when):g} s is before {float(belief.t):g} s"
        _checks.error_if(when, when < belief.t, words)
    flags = (True,) * len(readings) if mask is None else tuple(mask)
    for name, items in (("readings", readings), ("mask", flags)):
        if len(items) != len(scene.sensors):
            kinds = ", ".join(type(sensor).__name__ for sensor in scene.sensors)
            raise ValueError(
                f"{name}: wanted one entry for each sensor ({kinds}), got {len(items)}"
            )
    values, masks = [], []
    for sensor, reading, flag in zip(scene.sensors, readings, flags, strict=True):
        name = type(sensor).__name__
        value = _checks.array_of_shape(reading, sensor.reading_shape, f"{name}: reading")
        is_read = jnp.asarray(flag)
        if _checks.is_known((value, is_read)) and bool(is_read):
            words = f"{name}: the reading contains NaN; give mask=(…, False, …) if it is a gap"
            _checks.error_if(value, not np.isfinite(np.asarray(value)).all(), words)
        values.append(value)
        masks.append(is_read)
    return _step(scene, model.walks, belief, Stops(when, tuple(values), tuple(masks)))


@eqx.filter_jit
def _step(scene: Scene, drifts: tuple[Drift, ...], belief: Belief, stop: Stops) -> Belief:
    # Missing readings do not count, but their derivatives must be finite. They are replaced by a
    # unit vector, since for a quaternion of zeros derivatives would be NaN.
    units = (jnp.eye(1, v.size, dtype=v.dtype).reshape(v.shape) for v in stop.values)
    values = tuple(map(jnp.where, stop.masks, stop.values, units))
    values = tuple(value.astype(belief.root.dtype) for value in values)
    dynamics = dynamics_of(scene, drifts, belief.x)
    return _update(dynamics, belief, stop._replace(values=values))[0]


def _update(dynamics: Dynamics, belief: Belief, stop: Stops) -> tuple[Belief, ReadNumbers]:
    """Return the belief after a step and the readings at its end, and their `ReadNumbers`."""
    dtype = belief.root.dtype
    # Subtract times before they are rounded to the dtype of the state: after a thousand seconds the
    # seven digits of float32 are too few.
    since = (stop.t - belief.t).astype(dtype)
    x, grown, noise = dynamics.predict(belief.t.astype(dtype), since, belief.x)
    root = roots.predicted_root(grown, belief.root, noise)
    matrix, error, deviation, mask = steps.linearise_readings(dynamics, stop, x)
    e = jnp.zeros_like(root[0])
    e, root, innovation, variance = roots.kalman_update(e, root, matrix, error, deviation**2, mask)
    after = Belief(stop.t, plus(x, e), steps.recentred_root(x, e, root))
    return after, ReadNumbers(innovation, variance, mask)


class Scan(NamedTuple):
    dynamics: Dynamics
    stops: Stops
    kept: PyTree[Array]  # with a leading axis of times


def scan_filter(run: FilterInput, keep: Callable[[Belief, ReadNumbers], PyTree[Array]]) -> Scan:
    """Run the filter over all times, and store the result of `keep` at each of them."""
    scene, drifts, recording, first, grid = run
    dtype = first.root.dtype
    dynamics = dynamics_of(scene, drifts, first.x)
    values = tuple(r.values.astype(dtype)[grid.source] for r in recording.readings)
    masks = tuple(r.mask[grid.source] & grid.real for r in recording.readings)
    stops = Stops(grid.t, values, masks)

    def filter_step(belief: Belief, stop: Stops) -> tuple[Belief, Any]:
        belief, read = _update(dynamics, belief, stop)
        return belief, keep(belief, read)

    # Let a reverse pass compute each step again. Without `jax.checkpoint` it would store some
    # thousand numbers for each step.
    filter_step = jax.checkpoint(filter_step)  # pyright: ignore[reportPrivateImportUsage]
    return Scan(dynamics, stops, lax.scan(filter_step, first, stops)[1])


@eqx.filter_jit
def _filter(run: FilterInput) -> Filtered:
    both = scan_filter(run, lambda belief, read: (belief, read)).kept
    beliefs, read = run.grid.at_recording(both)
    reads = steps.split_by_sensor(run.scene.sensors, read)
    total = roots.density_terms(*read).total
    return Filtered(beliefs, reads, total, *outcome(beliefs, reads, run.first.t))


@eqx.filter_jit
def _log_likelihood(run: FilterInput) -> Scalar:
    return roots.density_terms(*scan_filter(run, lambda _, read: read).kept).total


class Outcome(NamedTuple):
    status: Int[Array, ""]  # the index of its text in `WORDS`
    lost_at: Scalar  # s, NaN if the filter was not lost


def outcome(beliefs: Belief, reads: tuple[ReadNumbers, ...], t0: Array) -> Outcome:
    """Return whether a filter followed the readings after the time t0, and when it was lost."""
    t, times = beliefs.t, jnp.arange(beliefs.t.shape[0])
    lost = jnp.zeros(t.shape, bool)
    for read in reads:
        size = jnp.where(read.mask, read.innovation**2, 0) > LOST_BEYOND**2 * read.variance
        is_read = read.mask.any(-1)
        bad = is_read & size.any(-1)
        good = is_read & ~bad
        since = lax.cummax(jnp.where(good, t, jnp.where(times == 0, t0, -jnp.inf)))
        count = jnp.cumsum(bad)
        before = lax.cummax(jnp.where(good, count, 0))
        many = count - before >= LOST_READINGS
        lost = lost | (bad & (t - since >= LOST_AFTER) & many)
    whole = jnp.isfinite(beliefs.root).all() & jnp.isfinite(beliefs.x.motion.omega).all()
    status = jnp.where(whole, jnp.where(lost.any(), 1, 0), 2)
    return Outcome(status, jnp.where(lost.any(), t[jnp.argmax(lost)], jnp.nan))


def checked_input(
    model: Model, belief: Belief, x: Float[Array, " n"] | None, substeps: int | None
) -> FilterInput:
    """Return the arguments of `filter` and `smooth` after checks, which raise their errors."""
    scene, recording = scene_and_recording(model, x)
    _checks.require_instance(belief, Belief, "belief", hint="identify.first_belief makes it")
    for index, sensor in enumerate(scene.sensors):
        if not isinstance(belief.x.motion, sensor.feels):
            raise TypeError(
                f"belief: sensor {index}, {type(sensor).__name__}, needs a state with "
                f"{sensor.feels.__name__}, got {type(belief.x.motion).__name__}; give "
                "first_belief(…, state=…) an Attitude, or a Rigid for what depends on the position"
            )
    grid = step_grid(scene.process, recording, belief, substeps)
    return FilterInput(scene, model.walks, recording, belief, grid)
