"""Find the most likely cause of the errors of a fit.

A mistake with which a file was read is looked for first (`misread`). Any other cause has
a direction: the change that the cause would make in the readings along the fitted motion. The
errors are regressed on this direction together with the derivatives of the readings with respect
to all parameters (a score test: Rao 1948, doi:10.1017/S0305004100023987). Therefore a cause
explains nothing if a change of the parameters has the same effect on the readings. The score test
chooses which causes are fitted together with the model, and these refits decide.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.answer.answers import Cause
from rigidjax.identify.answer.misread import (
    Reread,
    cause_by_misread_file,
    other_readings,
    with_values,
)
from rigidjax.identify.data import stacking
from rigidjax.identify.model.charts import body_list, tensor_of
from rigidjax.identify.model.free import Free
from rigidjax.identify.model.model import Model, part_of_sensor
from rigidjax.identify.model.terms import Noise, scaled_slopes
from rigidjax.identify.model.widened import with_slots, with_torques
from rigidjax.identify.search.stages import (
    STRIDE,
    Attempt,
    Task,
    blocks_at,
    fit_in_stages,
    search_whole,
)
from rigidjax.identify.search.starts import (
    TorqueColumns,
    regress_inertia,
    starting_points,
)
from rigidjax.identify.sensors import AbstractSensor, Gyro
from rigidjax.identify.sensors.base import extras
from rigidjax.identify.uncertainty.considered import slope_in_time
from rigidjax.identify.uncertainty.covariance import (
    Linearisation,
    linearise,
    white_noise_variance,
)
from rigidjax.motion import torques

# At most this number of causes that cannot be told apart are named.
MOST = 3
# A cause is refitted if it explains at least the fraction TRIED of the squared errors, to first
# order, in at most TURNS rounds. It is named if the refit makes the logarithm of the errors'
# variance, relative to that of white noise, less by more than the fraction ENOUGH. The rounds end
# once this logarithm falls by less than SETTLED. Causes whose deviance (−2 log-likelihood) is at
# most NEARLY higher than that of the best one are named, too. All causes are refitted if the errors
# have more than the fraction FAR of the readings' variance.
TRIED, TURNS, SETTLED, ENOUGH, NEARLY, FAR = 0.1, 10, 1e-3, 0.6, 10.0, 1e-3
# A cause changes the readings along one or more directions of length one. All changes of the
# readings that the parameters can make are subtracted from them. A combination of the remainders is
# dropped if its singular value is at most this number, since the parameters could make nearly the
# same change.
APART = 0.05
# The torques of causes, whose `Free`s have these names after the word MISSING.
TORQUES, MISSING = ("drag", "wheel", "spin-up", "push"), "missing "
# The entry SKEW[i, j, k] is 1 if the k-th angle of skew adds component i, times this angle, to the
# reading of axis j.
SKEW = np.zeros((3, 3, 3))
SKEW[1, 0, 0] = SKEW[2, 0, 1] = SKEW[2, 1, 2] = 1.0


class _Candidate(NamedTuple):
    name: str
    width: int  # how many numbers θ a cause has, such as the components of a bias
    words: str  # with `{size}` for θ
    remedy: str
    # Return the change of the predicted readings (R, T, k) for numbers θ.
    change: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda shown, theta: 0.0 * shown

    def direction(self, shown: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the derivative (R, T, k, c) of the change with respect to θ, by differences."""
        steps = 1e-5 * np.eye(self.width)
        ends = ((self.change(shown, theta + e), self.change(shown, theta - e)) for e in steps)
        return np.stack([(after - before) / 2e-5 for after, before in ends], axis=-1)


class _Share(NamedTuple):
    share: float  # of the squared errors, 0 to 1
    size: Float[np.ndarray, " c"]  # of the cause, such as the components of a bias


class _Refit(NamedTuple):
    candidate: _Candidate
    size: Float[np.ndarray, " c"]
    squares: Float[np.ndarray, " sensors"]  # the mean squared error of each sensor, in noises


def causes(
    model: Model,
    x: Float[Array, " n"],
    noise: Noise,
    linear: Linearisation,
    indices: Sequence[int],
) -> tuple[Cause, ...]:
    """Return the most likely cause of the errors of each sensor in `indices` that has one.

    If a file was most likely misread, this cause alone is returned.
    """
    for one in stacking.kinds_of(model):
        given = zip(stacking.on_host(one.records, one.counts), one.body_names, strict=True)
        mine = [recording for recording, name in given if name == one.body_names[0]]
        wrong = cause_by_misread_file(mine, one.torque)
        if wrong is not None:
            return (wrong,)
    if not np.isfinite(linear.weighted_jacobian).all():
        return ()
    model = stacking.pad_to_few(model)
    linear = linear.first_times(model.records.t.shape[1])
    free = np.linalg.qr(linear.weighted_jacobian)[0]
    out, sensors = [], model.records.sensors
    # If all sensors that read vectors are explained, one of them may still spoil the others.
    vectors = [index for index in indices if _is_vector_error(sensors[index])]
    if not vectors:
        vectors = [index for index, one in enumerate(sensors) if _is_vector_error(one)]
    for index in sorted({*indices, *vectors}):
        sensor: Any = sensors[index]
        cause = time_stamp_cause(model, noise, linear, index) if index in indices else None
        if cause is None and index in vectors:
            cause = _likeliest(model, x, noise, linear, index, free)
        suspect = extras(sensor).suspect
        if cause is None and suspect is not None:
            cause = Cause(suspect[0], type(sensor).__name__, None, *suspect[1:])
        out += [] if cause is None else [cause]
    return tuple(out)


def time_stamp_cause(model: Model, noise: Noise, linear: Linearisation, index: int) -> Cause | None:
    """Return the cause "clock" if the time stamps of a sensor scatter by more than its jitter.

    A late time stamp makes an error along dy/dt, the derivative of the readings y with respect to
    time: the errors along it are then larger than errors of random direction would be.
    """
    sensor, error = model.records.readings[index].sensor, linear.raw[index]
    kept = linear.mask[index].all(axis=-1)
    if not (_is_vector_error(sensor) and error[kept].any()):
        return None
    slope = slope_in_time(model, np.asarray(model.records.readings[index].values) - error)
    late = model.records.readings[index].jitter_error
    both = np.asarray(scaled_slopes(np.stack([error, slope], -1), noise[index], late))
    error, slope = both[..., 0], both[..., 1]
    moved = np.sum(slope**2, axis=-1) * kept
    moving = moved > 1e-2 * moved.max()
    if not moving.any():
        return None
    along = np.sum(np.sum(error * slope, axis=-1)[moving] ** 2 / moved[moving])
    channels = np.sum(error[kept] ** 2, axis=0)
    # Random errors lie along dy/dt, too, by chance. If they are as large in each channel as the
    # errors of the fit, `chance` is the expected fraction of their sum of squares along dy/dt.
    ways = np.mean(slope[moving] ** 2 / moved[moving][:, None], axis=0)
    chance, share = float(ways @ channels / channels.sum()), float(along / channels.sum())
    if not share > chance + 0.5 * (1.0 - chance) + 1.0 / np.sqrt(moving.sum()):
        return None
    # Noise across dy/dt, two of the three components, shows how much of it lies along dy/dt.
    across = (float(np.sum(error[moving] ** 2)) - float(along)) / 2
    scatter = np.sqrt(max(float(along) - across, 0.0) / moved[moving].sum())
    return _cause_with_share(
        "clock", sensor, share, f"time stamps that scatter by {1e3 * scatter:.2g} ms",
        f"take times from the sensor's own count of samples, or give it jitter={scatter:.2g}",
    )  # fmt: skip


def _cause_with_share(
    name: str, sensor: AbstractSensor, share: float, words: str, remedy: str
) -> Cause:
    """Return a cause whose words say what fraction of the squared errors it explains."""
    kind = type(sensor).__name__
    explained = f"{100 * share:.0f} % of the squared errors of the {kind}"
    return Cause(name, kind, share, f"most likely {words}: {explained}", remedy)


def _likeliest(
    model: Model,
    x: Float[Array, " n"],
    noise: Noise,
    linear: Linearisation,
    index: int,
    free: Float[np.ndarray, "records rows m"],
) -> Cause | None:
    """Return the cause of the errors of a sensor whose refit explains most of them, if that is
    enough. Causes that explain nearly as much are joined to it by "or".
    """
    reading = model.records.readings[index]
    shown = np.asarray(reading.values) - linear.raw[index]
    before, floor = _mean_squares(linear), _noise_floor(model, linear)
    sizes = np.array([mask.sum() for mask in linear.mask])
    refits, whole = [], None
    # To first order a cause is known only if the errors are small beside the readings.
    used, error = linear.mask[index].all(axis=-1), linear.raw[index]
    far = np.mean(error[used] ** 2) > FAR * np.mean(np.var(shown[used], axis=0))
    one_by_one = not model.parts and model.clusters is None

    def level(squares: np.ndarray) -> float:
        return float(sizes @ np.log(np.maximum(squares / floor, 1.0)))

    def deviance(refit: _Refit) -> float:
        return float(sizes @ np.log(refit.squares) + refit.size.size * np.log(sizes.sum()))

    for one in _candidates(model, x, linear, index):
        direction = one.direction(shown, np.zeros(one.width))
        share, size = _share(model, noise, linear, index, free, direction)
        after = before * np.where(np.arange(before.size) == index, 1.0 - share, 1.0)
        if not (far or share > TRIED or level(after) < (1.0 - TRIED) * level(before)):
            continue
        first = _Refit(one, size, after)
        if not one_by_one:
            refits.append(first)
        elif one.name in TORQUES:
            # A torque needs another compiled program: not if an error of the sensor explains all,
            # and the torque, to first order, does not.
            best = min(refits, key=deviance, default=first)
            done = not far and level(best.squares) < TRIED * level(before)
            if done and deviance(first) > deviance(best) + NEARLY:
                continue
            whole = _with_torques(model, x, noise) if whole is None else whole
            refits.append(_refit_torque(*whole, noise, one))
        else:
            refits.append(_refit(model, x, noise, index, one))
    if (one_by_one and (1.0 - TRIED) * np.var(shown) < np.mean(linear.raw[index] ** 2)) or refits:
        refits += [_refit_anew(noise, one) for one in other_readings(model, index)]
    best = min(refits, key=deviance, default=None)
    if best is None or not level(best.squares) < (1.0 - ENOUGH) * level(before):
        return None
    # A cause that leaves most of what varies in the readings is none.
    left = np.mean(error[used] ** 2) * (best.squares / before)[index]
    if left > 0.5 * np.mean(np.var(np.asarray(reading.values)[used], axis=0)):
        return None
    named = [r for r in sorted(refits, key=deviance) if deviance(r) < deviance(best) + NEARLY]
    if any(r.candidate.name == "wheel" for r in named):
        named = [r for r in named if r.candidate.name != "spin-up"]
    rows = [
        (one.name, one.words.format(size=", ".join(f"{x:.2g}" for x in size)), one.remedy)
        for one, size, _ in named[:MOST]
    ]
    names, words, remedies = (" or ".join(dict.fromkeys(x)) for x in zip(*rows, strict=True))
    # The share is that of the sensor whose errors become less by the largest factor.
    after = best.squares / before
    most = int(np.argmin(sizes * np.log(after)))
    kind = model.records.sensors[most]
    return _cause_with_share(names, kind, 1.0 - float(after[most]), words, remedies)


def _mean_squares(linear: Linearisation) -> Float[np.ndarray, " sensors"]:
    """Return the mean square of the errors of each sensor, in standard deviations of the noise."""
    rows = zip(linear.errors, linear.weights, linear.mask, strict=True)
    return np.array([np.mean((w[..., None] * e**2)[m]) + 1e-300 for e, w, m in rows])


def _noise_floor(model: Model, linear: Linearisation) -> Float[np.ndarray, " sensors"]:
    """Return the mean square that white noise leaves of each sensor's errors, in its noises."""
    out = []
    for reading, error, mask in zip(
        model.records.readings, linear.errors, linear.mask, strict=True
    ):
        if reading.has_known_noise:
            out.append(1.0)
            continue
        rows = [np.moveaxis(a, -1, 0).reshape(-1, a.shape[1]) for a in (error, mask)]
        out.append(white_noise_variance([r[m] for r, m in zip(*rows, strict=True)]) + 1e-300)
    return np.array(out)


def _refit_anew(noise: Noise, one: Reread) -> _Refit:
    """Return the fit of a model without a mistake, from a start of its own."""
    sigma = tuple(each * one.unit for each in noise)
    task = Task(one.model, sigma, 1e-4, 4 * STRIDE)
    x = fit_in_stages(starting_points(one.model, 1, None)[0], task).x
    squares = _mean_squares(linearise(one.model, x, sigma, blocks_at(one.model, x)))
    return _Refit(_Candidate(one.name, 0, one.words, one.remedy), np.zeros(0), squares)


def _with_torques(
    model: Model, x: Float[Array, " n"], noise: Noise
) -> tuple[Model, Float[Array, " m"]]:
    """Return a model with the torques of all causes, zero at first, and its parameters at x."""
    t, tensors = model.records.t, [tensor_of(b) for b in body_list(model.bodies(x))]
    ends, none = [float(t.min()), float(t.max())], np.zeros(3)
    inertia, rate = float(np.max(tensors)), float(model.typical_rate)
    further = (
        torques.Damping(none),
        torques.Flywheel(none),
        torques.Flywheel(torques.Linear(jnp.asarray(ends), jnp.zeros((2, 3)))),
        torques.ConstantTorque(none),
    )
    sizes = inertia * rate * np.array([0.1, 0.1, 0.1, 0.1 * rate])
    numbers: tuple[Callable[[Any], Any], ...] = (
        lambda s: s.torque.parts[-4].coefficient,
        lambda s: s.torque.parts[-3].momentum,
        lambda s: s.torque.parts[-2].momentum.values[1],
        lambda s: s.torque.parts[-1].torque,
    )
    every = zip(numbers, TORQUES, sizes.tolist(), strict=True)
    free = [Free(where, MISSING + name, scale=size) for where, name, size in every]
    wide, places = with_slots(with_torques(model, further), free)
    return wide, jnp.zeros(wide.size, x.dtype).at[places].set(x)


def _torque_columns(model: Model) -> dict[str, TorqueColumns]:
    """Return the torques per unit of the numbers of each cause, by its name."""
    first, last = float(model.records.t.min()), float(model.records.t.max())

    def axes(t: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.eye(3), (t.size, 3, 3))

    def wheel(t: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.cross(axes(t, w), w[:, None, :]).swapaxes(1, 2)

    def spun(t: np.ndarray, w: np.ndarray) -> np.ndarray:
        begun, rise = wheel(t, w), ((t - first) / (last - first))[:, None, None]
        return np.concatenate([begun, begun * rise - axes(t, w) / (last - first)], axis=2)

    return {
        "drag": lambda t, w: -w[..., None] * axes(t, w),
        "wheel": wheel,
        "spin-up": spun,
        "push": axes,
    }


def _refit_torque(
    model: Model, x: Float[Array, " m"], noise: Noise, candidate: _Candidate
) -> _Refit:
    """Return the fit of a model that has the torques of all causes, with those of one of them."""
    mine = ("wheel", "spin-up") if candidate.name == "spin-up" else (candidate.name,)
    places = [i for i, slot in enumerate(model.slots) if slot.name.startswith(MISSING)]
    # The priors hold the other torques at zero: all causes then share one compiled program.
    priors = [
        jnp.asarray(1e6 if model.slots[i].name.removeprefix(MISSING) in mine else 1e-9)
        for i in places
    ]
    held = eqx.tree_at(
        lambda m: [m.slots[i].prior for i in places], model, priors, is_leaf=lambda y: y is None
    )
    task, ends = Task(held, noise, 1e-4, 4 * STRIDE), []
    ends.append(fit_in_stages(x, task))
    if model.body_indices is None:
        columns = _torque_columns(model)[candidate.name]
        known = model.torque.parts[0] if len(model.torque.parts) > len(TORQUES) else None
        found = regress_inertia(stacking.on_host(model.records, model.counts), known, columns)
        if found is not None:
            start = np.array(model.start(found.body))
            factor = np.trace(tensor_of(model.bodies(jnp.asarray(start)))) / np.trace(
                found.body.tensor
            )
            for name, values in zip(mine, found.coefficients.reshape(-1, 3), strict=True):
                slot = next(one for one in model.slots if one.name == MISSING + name)
                start[np.asarray(slot.shared)] = factor * values / float(slot.scale)
            ends.append(search_whole(Attempt(jnp.asarray(start)), task))
    end = min(ends, key=lambda one: float(one.cost))
    linear = linearise(held, end.x, noise, blocks_at(held, end.x))
    return _Refit(candidate, np.zeros(candidate.width), _mean_squares(linear))


def _refit(
    model: Model, x: Float[Array, " n"], noise: Noise, index: int, candidate: _Candidate
) -> _Refit:
    """Return the fit of a model together with a cause, started at x.

    In turn the numbers of the cause and the parameters are fitted. The cause is subtracted from the
    readings, so that the compiled program of the search serves.
    """
    values = np.asarray(model.records.readings[index].values)
    theta, changed, moved, best = np.zeros(candidate.width), model, 0.0 * values, None
    for _ in range(TURNS):
        linear = linearise(changed, x, noise, blocks_at(changed, x))
        if not np.isfinite(linear.weighted_jacobian).all():
            break
        now = _Refit(candidate, theta, _mean_squares(linear))
        gain = 1.0 if best is None else float(np.sum(np.log(best.squares / now.squares)))
        best = now if gain > 0.0 else best
        if best is not now or gain < SETTLED:
            break
        shown, free = values - moved - linear.raw[index], np.linalg.qr(linear.weighted_jacobian)[0]
        direction = candidate.direction(shown, theta)
        theta = theta + _share(changed, noise, linear, index, free, direction, 1e-3).size
        moved = candidate.change(shown, theta)
        changed = with_values(model, index, values - moved)
        x = search_whole(Attempt(x), Task(changed, noise, 1e-4, STRIDE)).x
    return _Refit(candidate, theta, np.full(len(noise), np.inf)) if best is None else best


def _is_vector_error(sensor: AbstractSensor) -> bool:
    return sensor.reading_shape == (sensor.components,) and sensor.components in (3, 6)


def _candidates(
    model: Model, x: Float[Array, " n"], linear: Linearisation, index: int
) -> list[_Candidate]:
    """Return the possible causes of the errors of a sensor."""
    reading = model.records.readings[index]
    t, shown = np.asarray(model.records.t), np.asarray(reading.values) - linear.raw[index]
    k, unit, since = shown.shape[-1], reading.sensor.unit, (t - t[:, :1])[..., None]

    def late(y: np.ndarray, s: np.ndarray) -> np.ndarray:
        slope = slope_in_time(model, y)
        return slope * s + slope_in_time(model, slope) * s**2 / 2

    def turned(y: np.ndarray, s: np.ndarray) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(-s).apply(y.reshape(-1, 3)).reshape(y.shape) - y

    few = [
        ("lag", 1, "a clock offset of {size} s",
         "let a Free move the sensor's offset, or the delay of the torque's log", late),
        ("bias", k, f"a bias left out, ({{size}}) {unit}", "let a Free move the sensor's bias",
         lambda y, s: np.broadcast_to(s, y.shape)),
        ("scale", k, "scale errors of ({size}) (all equal: a unit, or a clock that runs fast or "
         "slow)", "look at the sensor's unit, or let a Free move its scale", lambda y, s: y * s),
        ("drift", k, f"a bias that drifts by ({{size}}) {unit} a second",
         "cut the record into pieces with a bias each", lambda y, s: since * s),
    ]  # fmt: skip
    if k == 3:
        few += [
            ("mounting", 3, "axes turned by ({size}) rad",
             "let a Free move the sensor's mounting, or take a chart of the full tensor", turned),
            ("skew", 3, "axes not orthogonal by ({size}) rad", "let a Free move the sensor's skew",
             lambda y, s: np.einsum("rti,ijk,k->rtj", y, SKEW, s)),
        ]  # fmt: skip
    if isinstance(reading.sensor, Gyro):
        response = _rate_response(model, x, linear, index)
        pushes = {
            name: response(np.stack([columns(*row) for row in zip(t, shown, strict=True)]))
            for name, columns in _torque_columns(model).items()
        }
        words = {
            "drag": ("a torque against the rate, such as drag of the air",
                     "add a Damping or QuadraticDamping whose coefficient is free"),
            "wheel": ("a constant internal angular momentum, such as a wheel's",
                      "add a Flywheel whose momentum is free"),
            "spin-up": ("a wheel that spins up or down", "add a Flywheel with the wheel's speed"),
            "push": ("a constant torque in the body's axes",
                     "add a ConstantTorque whose value is free"),
        }  # fmt: skip
        few += [
            (name, d.shape[-1], *words[name], lambda y, s, d=d: d @ s) for name, d in pushes.items()
        ]
    return [_Candidate(*row) for row in few]


def _rate_response(
    model: Model, x: Float[Array, " n"], linear: Linearisation, index: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from torques τ (R, T, 3, c) to the changes of the body rate by them.

    The change is `Φ(t) ∫ Φ⁻¹ I⁻¹ τ dt`, with the integral from the first time to t, where
    Φ = dΩ/dΩ₀ is the derivative of the rate with respect to the initial rate along the fitted
    motion. It is zero for a sensor that is not a `Gyro`.
    """
    if not isinstance(model.records.readings[index].sensor, Gyro):
        return np.zeros_like
    width, of = part_of_sensor(model, index).model.index.width, model.body_indices
    flow = linear.raw_slopes[index][..., width - 3 : width]
    tensors = np.stack([np.asarray(tensor_of(b)) for b in body_list(model.bodies(x))])
    back = np.linalg.inv(tensors)[np.zeros(model.count, int) if of is None else np.asarray(of)]
    back = np.linalg.pinv(flow) @ back[:, None]
    steps = np.diff(np.asarray(model.records.t), axis=1)[..., None, None]

    def response(torque: np.ndarray) -> np.ndarray:
        pushed = back @ torque
        middle = 0.5 * (pushed[:, 1:] + pushed[:, :-1]) * steps
        return flow @ np.concatenate([0 * pushed[:, :1], np.cumsum(middle, axis=1)], axis=1)

    return response


def _share(
    model: Model,
    noise: Noise,
    linear: Linearisation,
    index: int,
    free_columns: Float[np.ndarray, "records rows m"],
    direction: Float[np.ndarray, "records times k c"],
    apart: float = APART,
) -> _Share:
    """Return the fraction of a sensor's squared errors that a cause along `direction` explains.

    The `free_columns` are orthonormal and span all changes of the errors that the parameters can
    make, which are subtracted from directions and errors.
    """
    roots = [np.sqrt(weight)[..., None] for weight in linear.weights]
    errors = [e * root for e, root in zip(linear.errors, roots, strict=True)]
    jitter_error = model.records.readings[index].jitter_error
    changes = scaled_slopes(direction, noise[index], jitter_error)
    scaled = np.asarray(changes) * roots[index][..., None]
    size = np.sqrt(np.sum(scaled**2, axis=(0, 1, 2)))
    size[size == 0] = 1.0
    columns = [np.zeros((*error.shape, size.size)) for error in errors]
    columns[index] = scaled / size

    def residual_of_free(parts: Sequence[np.ndarray], width: int) -> np.ndarray:
        x = np.concatenate([part.reshape(len(part), -1, width) for part in parts], axis=1)
        return (x - free_columns @ (free_columns.swapaxes(1, 2) @ x)).reshape(-1, width)

    u, s, v = np.linalg.svd(residual_of_free(columns, size.size), full_matrices=False)
    projection = np.where(s > apart, u.T @ residual_of_free(errors, 1)[:, 0], 0.0)
    total = float(np.sum(errors[index] ** 2))
    share = min(float(projection @ projection) / total, 1.0)
    return _Share(share, v.T @ (projection / np.maximum(s, apart)) / size)
