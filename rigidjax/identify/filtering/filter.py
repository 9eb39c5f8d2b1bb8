"""The extended Kalman filter on the manifold, in square-root form, and its first belief."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rigidjax import _checks
from rigidjax._types import HasSpin, Scalar, ScalarLike
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.data.reference_states import attitudes, first_rate
from rigidjax.identify.filtering import roots, steps
from rigidjax.identify.filtering.steps import Dynamics, Extended, NoiseModel, Read, Sensors, Stops
from rigidjax.motion import Attitude, Spin
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.manifold import names, plus


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
    model: NoiseModel,
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
    >>> model = NoiseModel(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.RandomTorque(1e-4))
    >>> start(model, record, rate=0.1).deviation.tolist()
    [0.1, 0.1, 0.1]
    """
    _checks.instance(model, NoiseModel, "model")
    _checks.instance(recording, Recording, "recording")
    sensors = steps.sensors_of(recording.sensors, model)
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
    walks = tuple(value.astype(dtype) for value in sensors.first_walks)
    for walk, value in zip(model.walks, walks, strict=True):
        parts.append(_spread(walk.deviation, value.shape, "deviation", dtype).reshape(-1))
        _spread(walk.density, value.shape, "density", dtype)
    x = Extended(state, tuple(jnp.zeros(3, dtype) for _ in model.coloured), walks)
    return Belief(recording.t[0], x, jnp.diag(jnp.concatenate(parts)))


def _spread(value: Any, shape: tuple[int, ...], name: str, dtype: Any) -> Array:
    deviation = steps.not_negative(value, name)
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


class Grid(NamedTuple):
    """Times `t` (N,) s; the next row of the recording, and if it is `real`; where each row is."""

    t: Float[Array, " n"]
    source: Int[Array, " n"]
    real: Bool[Array, " n"]
    rows: Int[Array, " t"]

    def of_rows(self, kept: Any) -> Any:
        """Of the values at all times those at the recording's; to pick all would be a copy."""
        same = self.rows.size == self.t.size
        return kept if same else jax.tree.map(lambda leaf: leaf[self.rows], kept)


def grid_of(model: NoiseModel, recording: Recording, first: Belief, substeps: int | None) -> Grid:
    """The times of the steps."""
    xp = _checks.namespace((recording.t, first.t))
    t, t0 = xp.asarray(recording.t), xp.asarray(first.t)
    if xp is np:
        words = (
            f"recording: readings are out of order: the first is at {t[0]:g} s, before the time "
            f"of the belief it starts from, {t0:g} s"
        )
        _checks.refuse(t, t[0] < t0, words)
    ends = xp.concatenate([t0[None], t])
    counts = steps.steps_of(model, ends, first.x.motion, substeps, recording)
    index = np.repeat(np.arange(counts.size), counts)
    rows = np.cumsum(counts) - 1
    part = (np.arange(index.size) - np.repeat(rows - counts, counts)) / counts[index]
    times = ends[index] + (t - ends[:-1])[index] * xp.asarray(part, t.dtype)
    times = xp.where(part == 1, t[index], times)
    return Grid(*map(jnp.asarray, (times, index, part == 1, rows)))


# A filter is lost if no reading was within so many deviations for so long, s, and so many readings.
LOST_AFTER, LOST_READINGS, LOST_BEYOND = 1.0, 3, 6.0
WORDS = (
    "followed",
    "lost: no reading was within six standard deviations of its prediction for more than a second",
    "stopped: an estimate is NaN or infinite",
)


class Filtered(eqx.Module):
    """The result of `filter`.

    **Fields:** `belief` a `Belief` at each time of the recording, after its readings; `readings`,
    for each sensor, a `Read`: `innovation`, `variance` and `seen`, (T, k); `log_likelihood` of all
    readings; `status` 0 followed, 1 lost, 2 stopped (`words` says it); `lost_at` s, NaN unless
    lost.
    """

    belief: Belief
    readings: tuple[Read, ...]
    log_likelihood: Scalar
    status: Int[Array, ""]
    lost_at: Scalar

    @property
    def t(self) -> Float[Array, " times"]:
        """The times of the recording, s."""
        return self.belief.t

    @property
    def states(self) -> Any:
        """The estimates, with a leading time axis."""
        return self.belief.state

    @property
    def words(self) -> str:
        """The status in words."""
        return WORDS[int(self.status)]

    @property
    def nis(self) -> tuple[Float[Array, " times"], ...]:
        """Normalised innovations squared of each sensor, and how many numbers each holds.

        They follow χ² with as many degrees of freedom if the model is right (Bar-Shalom, Li and
        Kirubarajan, Estimation (2001), §5.4).
        """
        return tuple(
            jnp.sum(jnp.where(r.seen, r.innovation**2 / r.variance, 0), -1) for r in self.readings
        )


def filter(
    model: NoiseModel,
    recording: Recording,
    first: Belief,
    *,
    substeps: int | None = None,
    throw: bool = True,
) -> Filtered:
    """Attitude, rate, unknown torque and sensor errors from the readings so far, at each time.

    The multiplicative extended Kalman filter: the estimate is a state on the group, its error a
    rotation vector and numbers (Lefferts, Markley and Shuster 1982, doi:10.2514/3.56190). Between
    readings both follow the equations of motion, by the classical method of order 4. The covariance
    is kept as a root, updated by Potter's formula for each number read.

    **Arguments:** `model`; `recording` a `Recording` whose sensors have their noise, and whose
    torque acts beside the model's; masked readings are gaps, channels at their full scale are left
    out, a sensor's `offset` is a delay; `first` of `start`; `substeps` fixed steps from one time to
    the next, `None` chooses them by the rate if the numbers are known, else one. `throw`: with
    `False` no event of the run raises an error; see `status`. **Returns** `belief`, `readings`,
    `log_likelihood`, `status` and `lost_at` (`Filtered`). It may be jitted, differentiated, and
    batched over any argument.

    **Raises:** `ValueError` for a sensor without noise, and readings before `first`; with `throw`
    also for a lost filter: no reading was within 6 deviations of its prediction for a second and
    three readings.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> model = rj.estimate.Model(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> found = rj.estimate.filter(model, record, rj.estimate.start(model, record, rate=1.0))
    >>> found.states.omega.shape, found.readings[0].innovation.shape, found.words
    ((2, 3), (2, 3), 'followed')
    """
    out = _filter(looked_at(model, recording, first, substeps))
    return told(out) if throw else out


def told(out: Any) -> Any:
    """Return `out`; raise an error in words if it is lost or stopped."""
    status = out.status
    at = f" (at {float(out.lost_at):g} s)" if _checks.known(out.lost_at) else ""
    advice = "; is the noise or density too small, or the start far off? throw=False returns it"
    out = _checks.refuse(out, status == 1, f"filter: {WORDS[1]}{at}{advice}")
    return _checks.refuse(out, status == 2, f"filter: {WORDS[2]}{advice}")


def log_likelihood(
    model: NoiseModel, recording: Recording, first: Belief, *, substeps: int | None = None
) -> Scalar:
    """The logarithm of the density of all readings, the unknown torques integrated out.

    `Σ log N(ν; 0, s)` over innovations (Schweppe 1965, doi:10.1109/TIT.1965.1053737): maximise it
    over moments, a density, a noise, an initial state. Arguments and errors are as for `filter`;
    differentiable in forward and reverse mode.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(1.0), [[1.0, 0, 0]] * 2))
    >>> model = rj.estimate.Model(rj.Inertia.from_principal(1.0, 1.0, 1.0))
    >>> first = rj.estimate.start(model, record, rj.Spin([1.0, 0, 0]), rate=0.0)
    >>> log_likelihood(model, record, first).round(6)
    Array(-5.513631, dtype=float64)
    """
    return _log_likelihood(looked_at(model, recording, first, substeps))


def step(model: NoiseModel, belief: Belief, t: ScalarLike, *readings: tuple) -> Belief:
    """The belief at `t`, after the readings at `t`: for use while the body moves.

    **Arguments:** `model`; `belief` of `start` or the last `step`; `t` s, not before it; `readings`
    pairs `(sensor, value)` or triples `(sensor, value, seen)`, `seen` a truth value. The walks'
    `where` finds the sensors as `s.sensors[i]`, in this order, so each call gives them all.
    This is one step of the classical method: the time between readings must be short against a
    turn. **Returns** the `Belief` at `t`. **Raises:** `ValueError` for a `t` before the belief, or
    a reading with NaN, if the numbers are known.

    >>> gyro = rj.identify.Gyro(0.1)
    >>> record = rj.identify.Recording([0.0, 0.1], (gyro, [[1.0, 0, 0]] * 2))
    >>> model = rj.estimate.Model(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> belief = rj.estimate.start(model, record, rate=1.0)
    >>> rj.estimate.step(model, belief, 0.1, (gyro, jnp.array([1.0, 0.0, 0.0]))).t
    Array(0.1, dtype=float64)
    """
    _checks.instance(model, NoiseModel, "model")
    _checks.instance(belief, Belief, "belief")
    if belief.t.shape != ():
        raise ValueError(
            f"belief: wanted one, got times of shape {belief.t.shape}; for many use jax.vmap"
        )
    when = _checks.time(t).astype(belief.t.dtype)
    if _checks.known((when, belief.t)):
        words = f"t: readings are out of order: {float(when):g} s is before {float(belief.t):g} s"
        _checks.refuse(when, when < belief.t, words)
    sensors = steps.sensors_of([reading[0] for reading in readings], model)
    values, masks = [], []
    for sensor, value, *seen in readings:
        name = type(sensor).__name__
        value = _checks.floating(value, sensor.reading_shape, f"{name}: reading")
        mask = jnp.asarray(seen[0] if seen else True)
        if _checks.known((value, mask)) and bool(mask):
            words = f"{name}: the reading contains NaN; give (sensor, value, False) if it is a gap"
            _checks.refuse(value, not np.isfinite(np.asarray(value)).all(), words)
        values.append(value)
        masks.append(mask)
    return _step(steps.bare(model), sensors, belief, when, tuple(values), tuple(masks))


@eqx.filter_jit
def _step(
    model: NoiseModel, sensors: Sensors, belief: Belief, t: Array, values: tuple, masks: tuple
) -> Belief:
    # A unit vector in the place of a missing reading keeps derivatives finite.
    units = (jnp.eye(1, value.size, dtype=value.dtype).reshape(value.shape) for value in values)
    values = tuple(map(jnp.where, masks, values, units))
    values = tuple(value.astype(belief.root.dtype) for value in values)
    return _one(Dynamics(model, belief.x, sensors), belief, Stops(t, values, masks))[0]


def _one(dynamics: Dynamics, belief: Belief, stop: Stops) -> tuple[Belief, Read]:
    dtype = belief.root.dtype
    # Times may have more digits than the state: after a thousand seconds seven are too few.
    since = (stop.t - belief.t).astype(dtype)
    x, grown, noise = dynamics.predict(belief.t.astype(dtype), since, belief.x)
    root = roots.predicted(grown, belief.root, noise)
    matrix, error, deviation, seen = steps.linearised(dynamics, stop, x)
    e = jnp.zeros_like(root[0])
    e, root, innovation, variance = roots.absorb_all(e, root, matrix, error, deviation**2, seen)
    return Belief(stop.t, plus(x, e), steps.reset(x, e, root)), Read(innovation, variance, seen)


# The checked arguments of a filter: see `looked_at`.
Given = tuple[NoiseModel, Sensors, Recording, Belief, Grid]


def scan_filter(given: Given, keep: Any) -> tuple[Dynamics, Stops, Any]:
    """`lax.scan` of the filter over all stops, which keeps `keep(belief, read)`."""
    model, sensors, recording, first, grid = given
    dtype = first.root.dtype
    dynamics = Dynamics(model, first.x, sensors)
    values = tuple(r.values.astype(dtype)[grid.source] for r in recording.readings)
    masks = tuple(r.mask[grid.source] & grid.real for r in recording.readings)
    stops = Stops(grid.t, values, masks)

    def body(belief: Belief, stop: Stops) -> tuple[Belief, Any]:
        belief, read = _one(dynamics, belief, stop)
        return belief, keep(belief, read)

    # A reverse pass computes a step again: a step holds some thousand numbers.
    body = jax.checkpoint(body)  # pyright: ignore[reportPrivateImportUsage]
    return dynamics, stops, lax.scan(body, first, stops)[1]


@eqx.filter_jit
def _filter(given: Given) -> Filtered:
    _, sensors, _, first, grid = given
    beliefs, read = grid.of_rows(scan_filter(given, lambda belief, read: (belief, read))[2])
    reads, total = steps.by_sensor(sensors, read), roots.terms(*read).log_density
    return Filtered(beliefs, reads, total, *status_of(beliefs, reads, first.t))


@eqx.filter_jit
def _log_likelihood(given: Given) -> Scalar:
    return roots.terms(*scan_filter(given, lambda _, read: read)[2]).log_density


def status_of(beliefs: Belief, reads: tuple[Read, ...], t0: Array) -> tuple[Array, Array]:
    t, times = beliefs.t, jnp.arange(beliefs.t.shape[0])
    lost = jnp.zeros(t.shape, bool)
    for read in reads:
        size = jnp.where(read.seen, read.innovation**2, 0) > LOST_BEYOND**2 * read.variance
        seen = read.seen.any(-1)
        bad = seen & size.any(-1)
        good = seen & ~bad
        since = lax.cummax(jnp.where(good, t, jnp.where(times == 0, t0, -jnp.inf)))
        count = jnp.cumsum(bad)
        before = lax.cummax(jnp.where(good, count, 0))
        many = count - before >= LOST_READINGS
        lost = lost | (bad & (t - since >= LOST_AFTER) & many)
    whole = jnp.isfinite(beliefs.root).all() & jnp.isfinite(beliefs.x.motion.omega).all()
    status = jnp.where(whole, jnp.where(lost.any(), 1, 0), 2)
    return status, jnp.where(lost.any(), t[jnp.argmax(lost)], jnp.nan)


def looked_at(
    model: NoiseModel, recording: Recording, first: Belief, substeps: int | None
) -> Given:
    """The checked arguments of `filter` and `smooth`: model, sensors, recording, belief, times."""
    _checks.instance(model, NoiseModel, "model")
    _checks.instance(recording, Recording, "recording")
    _checks.instance(first, Belief, "first", hint="estimate.start makes it")
    for sensor in recording.sensors:
        if not isinstance(first.x.motion, sensor.feels):
            kind, got = sensor.feels.__name__, type(first.x.motion).__name__
            raise TypeError(f"first: a sensor needs a state with {kind}, got a {got}")
    sensors = steps.sensors_of(recording.sensors, model)
    return steps.bare(model), sensors, recording, first, grid_of(model, recording, first, substeps)
